# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A wall that is glued into soil, much thinner than the cells of the background.

The soil is 10 m wide and 6 m high and held at its base and its ends. A wall of concrete, 0.1 m
thick, goes from its surface 4 m down, and a load pushes its head aside. Wall and soil are one mesh:
what the background carries cannot bend within a cell of 0.5 m, and the wall is far too stiff. Where
its nodes are free, and those of a layer of soil, it bends as it does with finite elements.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A thin wall in soil, its nodes carried or free.")
parser.add_argument("--degree", type=int, choices=(1, 2), default=2, help="of both spaces")
parser.add_argument(
    "--layers",
    choices=("none", "0", "1", "2", "all"),
    default="1",
    help="what is free: the wall and so many layers of soil, nothing, or all of the body",
)
parser.add_argument("--cell", type=kit.positive, default=0.5, help="background cell size, m")
parser.add_argument("--offset", type=float, default=0.37, help="of the grid to the side, in cells")
parser.add_argument("--law", choices=("elastic", "mohr-coulomb"), default="elastic", help="of soil")
parser.add_argument("--steps", type=kit.whole, help="1, with Mohr-Coulomb 8 by default")
args = parser.parse()

comm = MPI.COMM_WORLD
width, height, depth, thickness = 10.0, 6.0, 4.0, 0.1  # m
toe, half = height - depth, 0.5 * thickness
if args.law == "elastic":
    soil, load = mpm.materials.LinearElastic(20e3, 0.3), 20.0  # kPa, kN/m
else:
    soil = mpm.materials.MohrCoulomb(20e3, 0.3, cohesion=5.0, friction_angle=25.0)
    load = 40.0
wall = mpm.materials.LinearElastic(30e6, 0.2)
steps = args.steps or (1 if args.law == "elastic" else 8)

# The mesh of the body: its cells are half as large as the background's, and in the wall there is
# one across with degree 2, four with degree 1, which are flatter too, as bending locks them.

side = 0.5 * args.cell
right = np.append(half, side * np.arange(1, round(0.5 * width / side) + 1))
parts, flat = (4, 0.25) if args.degree == 1 else (1, 1.0)
across = np.concatenate([-right[:0:-1], np.linspace(-half, half, parts + 1), right[1:]])
up = np.linspace(0.0, height, round(height / (flat * side)) + 1)

h = args.cell
corner = np.array([-0.5 * width - (2.0 + args.offset % 1.0) * h, -2.0 * h])
cells = [round(width / h) + 5, round(height / h) + 6]


def free(layers: str):
    """Where nodes are free; `None` for finite elements."""
    if layers == "none":
        return []
    beside = int(layers)
    return mpm.region(x=(-right[beside], right[beside]), y=(toe - beside * side, np.inf))


def run(layers: str) -> tuple[mpm.QuasiStaticProblem, float, mpm.MPMError | None]:
    """Push the wall; return the problem, the displacement of its head, and what went wrong."""
    body = kit.grid([across, up], mesh.CellType.quadrilateral)
    if layers == "all":
        particles = mpm.Particles(body, degree=args.degree)
    else:
        background = mesh.create_rectangle(
            comm, [corner, corner + h * np.array(cells)], cells, mesh.CellType.quadrilateral
        )
        V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
        particles = mpm.Particles(body, V, degree=args.degree, free=free(layers))
    in_wall = mpm.region(x=(-half, half), y=(toe, height))
    cell_tags = mpm.cell_tags(body, {1: mpm.region(y=(0.0, height)), 2: in_wall})
    ends = 0.5 * width
    facet_tags = mpm.facet_tags(
        body,
        {
            1: lambda x: np.isclose(np.abs(x[0]), ends) | np.isclose(x[1], 0.0),
            2: mpm.region(x=(-half, half), y=height),
        },
    )
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            {1: soil, 2: wall},
            tractions=[((load / thickness, 0.0), 2)],
            cell_tags=cell_tags,
            facet_tags=facet_tags,
        ),
        supports=[mpm.boundary.fixed(particles, facet_tags, 1)],
        solver=mpm.Solver(petsc_options_prefix="wall_"),
    )
    failure = None
    try:
        for _ in kit.progress(problem.steps(steps), steps, args):
            pass
    except mpm.MPMError as error:
        failure = error
    x = particles.W.tabulate_dof_coordinates()[:, :2]
    at_head = np.linalg.norm(x - (half, height), axis=1) < 1e-9
    moved = particles.displacement.x.array.reshape(-1, 2)[at_head, 0]
    return problem, kit.largest(moved), failure


# What is compared with is the same mesh with all nodes free. The unknowns of a body that is wholly
# carried are those of the background alone.

problem, head, failure = run(args.layers)
unknowns = int(problem.history.statistics["free_dofs"])
reference = head if args.layers == "all" else run("all")[1]
carried = unknowns
if args.layers != "none":
    first = run("none")[0]
    carried = int(first.history.statistics["free_dofs"])

numbers = {
    **kit.outcome(problem.history, failure),
    "head": head,
    "reference": reference,
    "error": head / reference - 1.0,
    "unknowns": unknowns,
    "unknowns_carried": carried,
}
rows = [
    ("free", args.layers),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("displacement of the head", f"{1e3 * head:.4g} mm"),
    ("finite elements", f"{1e3 * reference:.4g} mm; error {100 * numbers['error']:.2f} %"),
    ("unknowns", f"{unknowns}, all carried {carried}"),
]
if args.plot:
    fig, axes = kit.figure(9.0, 5.5)
    mpm.plot.domains(problem.bodies[0], ax=axes["main"], warp=0.1 * height / max(head, 1e-12))
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)

if args.default:
    assert abs(numbers["error"]) < 1e-3
    assert unknowns < 1.25 * carried
