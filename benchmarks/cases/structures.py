# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bars and linings in soil, beside what is known exactly.

- `bar`: a bar at the edge of an elastic block, under loads for which its force is known.
- `lining`: a sheet around a hole in a ring, under pressure from within, by Lamé's formulas.
- `pull-out`: a nail with a bond of limited strength is pulled out of soil: limit times length.
- `cut`: a vertical cut is dug in four stages, with a row of nails in each (for a picture).
"""

from mpi4py import MPI

import kit
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Bars and linings in soil.")
parser.add_argument("--case", choices=("bar", "lining", "pull-out", "cut"), default="bar")
parser.add_argument(
    "--free",
    choices=("none", "layer", "all"),
    default="layer",
    help="nodes of the body that are free (bar, lining)",
)
parser.add_argument("--degree", type=int, choices=(1, 2), help="of both spaces: 2 for the bar")
parser.add_argument("--cells", type=kit.whole, default=16, help="of the body along the structure")
parser.add_argument("--steps", type=kit.whole, help="1; 12 to pull out, 4 for each metre of cut")
args = parser.parse()

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
degree = args.degree or (2 if args.case == "bar" else 1)
steps = args.steps or {"pull-out": 12, "cut": 4}.get(args.case, 1)


def particles(body: mesh.Mesh, lower, upper, cells, layer) -> mpm.Particles:
    """The body, in a background of some cells unless all of its nodes are free."""
    if args.free == "all":
        return mpm.Particles(body, degree=degree)
    background = mesh.create_rectangle(comm, [lower, upper], cells, quadrilateral)
    V = fem.functionspace(background, ("Lagrange", degree, (2,)))
    free = layer if args.free == "layer" else []
    return mpm.Particles(body, V, degree=degree, free=free)


def bar() -> tuple[mpm.QuasiStaticProblem, float, float]:
    """A bar along the lower edge of a block of 2 x 1; the largest error of its force."""
    n, k, poisson, stiffness, size = args.cells, 0.5 * np.pi, 0.3, 800.0, 1e-5
    body = mesh.create_rectangle(comm, [[0, 0], [2, 1]], [n, n // 2 or 1], quadrilateral)
    h = 2.0 / n
    coarse = [n // 2, n // 4 + 1]  # cells of the background, twice as large
    soil = particles(body, [0, 0], [2, 4 * coarse[1] / n], coarse, mpm.region(y=(0.0, 2 * h)))
    law = mpm.materials.LinearElastic(1e3, poisson)

    # Displacements sin(kx) f(y), cos(kx) g(y), of two of Papkovich's solutions: the shear stress
    # at y = 0 is what the force of the bar changes by.
    kappa = 3.0 - 4.0 * poisson
    B = -stiffness * k / (law.shear * (kappa + 1.0))
    both, apart = -1.0 / k, kappa * B / k
    x, y = ufl.SpatialCoordinate(body)
    up, down = (ufl.cos(k * x) * ufl.exp(s * k * y) for s in (1, -1))
    u = 0.5 * (both + apart) * ufl.grad(up) + 0.5 * (both - apart) * ufl.grad(down)
    u = size * (u + B * (y * ufl.grad(down) - kappa * ufl.as_vector((0.0, down))))
    strain = ufl.sym(ufl.grad(u))
    stress = (law.bulk - 2 / 3 * law.shear) * ufl.tr(strain) * ufl.Identity(2)
    stress += 2.0 * law.shear * strain

    truss = mpm.Truss(soil, np.linspace((0, 0), (2, 0), 2 * n + 1), stiffness)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            soil,
            law,
            tractions=[(stress[:, 1], 1)],
            facet_tags=mpm.facet_tags(body, {1: mpm.region(y=1.0)}),
        ),
        bcs=[mpm.held(soil.V, 1, y=0.0), mpm.held(soil.V, 0, x=0.0), mpm.held(soil.V, 0, x=2.0)],
        terms=[truss],
    )
    problem.solve(steps)
    middle = truss.nodes[truss.cells][:, :, 0].mean(axis=1)
    exact = size * stiffness * k * np.cos(k * middle)
    return problem, float(np.abs(truss.force).max()), float(np.abs(truss.force - exact).max())


def lining() -> tuple[mpm.QuasiStaticProblem, float, float]:
    """A sheet in the hole of a quarter of a ring of radii 1 and 3; its force, and its error."""
    n, outer, pressure, stiffness = args.cells, 3.0, 1e-3, 500.0
    body = mesh.create_rectangle(comm, [[0, 0], [1, 1]], [n, 2 * n], quadrilateral)
    x = body.geometry.x
    r, turn = outer ** x[:, 0], 0.5 * np.pi * x[:, 1]
    x[:, 0], x[:, 1] = r * np.cos(turn), r * np.sin(turn)
    width = 0.5 * np.pi / n
    count = round(outer / width) + 2
    ring = particles(
        body,
        [0, 0],
        [count * width] * 2,
        [count] * 2,
        lambda x: np.hypot(x[0], x[1]) < outer ** (1.5 / n),
    )

    def inside(x):
        return np.hypot(x[0], x[1]) < 1.0 + 1e-9

    wall = mesh.create_submesh(body, 1, mesh.locate_entities_boundary(body, 1, inside))[0]
    sheet = mpm.Membrane(ring, wall, stiffness)
    place = ufl.SpatialCoordinate(body)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            ring,
            law := mpm.materials.LinearElastic(1e3, 0.3),
            tractions=[(pressure * place / ufl.sqrt(ufl.dot(place, place)), 1)],
            facet_tags=mpm.facet_tags(body, {1: inside}),
        ),
        bcs=[mpm.held(ring.V, 0, x=0.0), mpm.held(ring.V, 1, y=0.0)],
        terms=[sheet],
    )
    problem.solve(steps)
    c = 2.0 * law.shear
    soft = c / (1.0 - 2.0 * 0.3)
    A, B = np.linalg.solve(
        [[soft, -c / outer**2], [soft - stiffness, -c - stiffness]], [0.0, -pressure]
    )
    force = sheet.force[:, 0]
    return problem, float(force.mean()), float(np.abs(force - stiffness * (A + B)).max())


def pull_out() -> tuple[mpm.QuasiStaticProblem, float, float]:
    """A nail of 3 m is pulled out of a block of 5 x 2 m; the pull, and how far from limit L."""
    n, limit, length, reach = args.cells, 5.0, 3.0, 0.03
    body = mesh.create_rectangle(comm, [[0, 0], [5, 2]], [20, 8], quadrilateral)
    background = mesh.create_rectangle(comm, [[-0.5, -0.5], [5.5, 3]], [12, 7], quadrilateral)
    V = fem.functionspace(background, ("Lagrange", degree, (2,)))
    soil = mpm.Particles(body, V, degree=degree, quadrature_degree=2)
    nail = mpm.Truss(
        soil,
        [(-0.5, 1.1), *np.linspace((0, 1.1), (length, 1.1), n + 1)],
        2e4,
        bond=mpm.Bond(1e5, limit, where=mpm.region(x=(0, length))),
        held=mpm.region(x=-0.5),
        degree=1,
    )
    tags = mpm.facet_tags(body, {1: mpm.region(y=0.0), 2: mpm.region(x=5.0)})
    problem = mpm.QuasiStaticProblem(
        mpm.Body(soil, mpm.materials.LinearElastic(2e4, 0.3)),
        supports=[mpm.boundary.fixed(soil, tags, tag) for tag in (1, 2)],
        terms=[nail],
    )
    problem.solve(steps, update=lambda t: nail.move((-reach * t, 0.0)))
    pull = -float(problem.reaction(nail)[0])
    return problem, pull, abs(pull - limit * length)


def cut() -> tuple[mpm.QuasiStaticProblem, float, float]:
    """A cut of 4 m in soil with cohesion, dug from above in stages of 1 m, each with its nail."""
    size = 0.25
    body = mesh.create_rectangle(comm, [[0, 0], [10, 7]], [40, 28], quadrilateral)
    background = mesh.create_rectangle(comm, [[0, 0], [10, 8]], [20, 16], quadrilateral)
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    soil = mpm.Particles(body, V, quadrature_degree=2)
    given = mpm.Body(
        soil,
        mpm.materials.MohrCoulomb(30e3, 0.3, cohesion=6.0, friction_angle=30.0),
        density=1.8,
        body_force=(0.0, -9.81),
        f_bar="patch",
    )
    problem = mpm.QuasiStaticProblem(
        given, bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=10.0), mpm.held(V, y=0.0)]
    )
    problem.solve(steps)
    nails: list[mpm.Truss] = []
    for row in range(4):
        top = 7.0 - row
        problem.remove(lambda x, top=top: (x[0] < 4.0) & (x[1] > top - 1.0), name=f"dig {row}")
        problem.solve(steps)
        head = np.array([4.0, top - 0.5])
        tip = head + 3.5 * np.array([np.cos(0.2), -np.sin(0.2)])
        bond = mpm.Bond(2e4, 30.0)
        nails.append(mpm.Truss(soil, np.linspace(head, tip, round(3.5 / size) + 1), 4e4, bond=bond))
        problem.stage(f"nail {row}", terms=list(nails))
    problem.solve(1)
    return problem, max(float(nail.force.max()) for nail in nails), 0.0


problem, force, gap = {"bar": bar, "lining": lining, "pull-out": pull_out, "cut": cut}[args.case]()
numbers = {**kit.outcome(problem.history, None), "force": force, "error": gap / abs(force)}
rows = [
    ("case", args.case),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("largest force", f"{force:.5g}"),
    ("error", f"{100 * numbers['error']:.3g} %" if args.case != "cut" else "not known"),
]
if args.plot:
    fig, axes = kit.figure(9.0, 5.5)
    field = "membrane_force" if args.case == "lining" else "axial_force"
    mpm.plot.scene(problem, field, ax=axes["main"], label="axial force of nails, kN/m")
    kit.save(fig, args)
kit.report(args, numbers, rows, None)

if args.default:
    assert numbers["error"] < 1e-3
