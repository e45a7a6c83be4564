# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Collapse of an elasto-plastic block.

demos/demo_collapse.py is its simplest form and has the equations.
"""

from math import ceil

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Collapse of an elasto-plastic block under its own weight.")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument("--cell", type=kit.positive, default=1.0, help="background cell size, m")
parser.add_argument(
    "--particles-per-cell", type=kit.whole, default=3, help="quadrilaterals, each way"
)
parser.add_f_bar()
parser.add_order()
parser.add_steps(40)
args = parser.parse()

comm = MPI.COMM_WORLD
size = 8.0  # m
young, poisson, rho_y = 1e6, 0.3, 20e3  # Pa, -, Pa
density, gravity = 1000.0, 10.0  # kg/m3, m/s2

# The background is 16 m wide, which leaves the toe room to move by 8 m, and a cell higher than the
# block.

h = args.cell
cells = [ceil(16.0 / h), ceil(9.0 / h)]
background = kit.box([cells[0] * h, cells[1] * h], cells, mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
along = max(1, round(size / h * args.particles_per_cell))
body = kit.box([size, size], [along, along], kit.DOMAINS[args.domain])

bcs = []
for axis in (0, 1):
    facets = mesh.locate_entities_boundary(background, 1, lambda x, i=axis: np.isclose(x[i], 0.0))
    dofs = fem.locate_dofs_topological(V.sub(axis), 1, facets)
    bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))

particles = mpm.Particles(body, V, **kit.order(args))
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.VonMises(young, poisson, rho_y=rho_y),
        density=density,
        body_force=(0.0, -gravity),
        f_bar=args.f_bar,
    ),
    bcs=bcs,
    solver=mpm.Solver(petsc_options_prefix="collapse_", stabilisation=kit.stabilisation(args)),
)

# What is watched is the top of the plane of symmetry and the toe, two nodes of the body.

X = particles.W.tabulate_dof_coordinates()


def displacement(corner, component: int) -> float:
    """A component of the displacement of the body's node at an undeformed position."""
    at = np.isclose(X[:, :2], corner).all(axis=1)
    return kit.largest(particles.displacement.x.array.reshape(-1, 2)[at, component])


path = [(0.0, 0.0, 0.0)]
failure = None
try:
    for step in kit.progress(problem.steps(**kit.chosen(args)), args.steps, args):
        path.append((step.load, displacement((0.0, size), 1), displacement((size, 0.0), 0)))
except mpm.MPMError as error:
    failure = error

_, u_top, u_toe = path[-1]
numbers = {
    **kit.outcome(problem.history, failure),
    "u_top": u_top,
    "u_toe": u_toe,
    "particles": particles.num_global,
    "worst_domain": kit.smallest(particles.domain_distortion()),
}
rows = [
    ("particles", f"{particles.num_global} ({args.domain}), cells of {h:g} m, F-bar: {args.f_bar}"),
    ("load steps", f"{len(path) - 1}, load {numbers['load']:g}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("top of the symmetry plane", f"{u_top:.3f} m"),
    ("toe", f"{u_toe:.3f} m"),
    ("worst domain", f"{numbers['worst_domain']:.3f}"),
]

# The picture: the body before and after, coloured by plastic strain, and the way there. The
# crosses are AMPLE's particles next to the corner, with cells of 1 m and 3 by 3 particles.

if args.plot:
    fig, axes = kit.figure(13.0, 5.0, [["body", "path"]], width_ratios=[2.0, 1.0])
    mpm.plot.background(V, ax=axes["body"], color="0.9")
    mpm.plot.domains(particles, ax=axes["body"], warp=0.0, facecolor="0.97", edgecolor="0.85")
    colours = mpm.plot.domains(
        particles, particles.plastic_strain, ax=axes["body"], cmap="YlGnBu", vmin=0.0
    )
    if comm.rank == 0:
        ax = axes["body"]
        ax.set(xlim=(0.0, 16.0), ylim=(0.0, 8.6), xlabel="x, m", ylabel="y, m")
        ax.set_title(f"The toe moves {u_toe:.2f} m, the top {-u_top:.2f} m")
        fig.colorbar(colours, ax=ax, label="plastic strain", shrink=0.7)
        ax = axes["path"]
        load, top, toe = np.array(path).T
        ax.plot(100 * load, toe, color=kit.COLOURS["orange"], label="toe, sideways")
        ax.plot(100 * load, -top, color=kit.COLOURS["blue"], label="top, down")
        known = (
            (0.25, 0.0756),
            (0.5, 0.231),
            (0.625, 1.055),
            (0.75, 1.802),
            (0.875, 2.329),
            (1, 2.656),
        )
        ax.plot(*(100 * np.array(known) * (1.0, 0.01)).T, "x", color="0.2", label="top, AMPLE")
        ax.set(xlabel="weight, %", ylabel="displacement, m", xlim=(0.0, 102.0), ylim=(0.0, None))
        ax.set_title("It gives way past half its weight")
        ax.legend(loc="upper left")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the numbers are known: AMPLE's particles, which are half a domain away
# from these nodes, move by -2.656 m and 5.800 m.

if args.default:
    assert numbers["completed"] and numbers["cutbacks"] == 0
    assert abs(u_top / -2.70 - 1.0) < 0.01
    assert abs(u_toe / 5.79 - 1.0) < 0.01
