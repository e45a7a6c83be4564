# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A column of soil that settles as the water leaves its pores (Terzaghi 1943, Biot 1941).

docs/porous-ufl.md has the equations. Lengths are over the height, stresses over the load, and times
over `H^2 / c_v`.
"""

from mpi4py import MPI

import kit
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Consolidation of a column, drained at its top.")
parser.add_argument("--cell", type=kit.positive, default=1 / 8, help="of the background")
parser.add_argument("--degree", type=int, choices=(2, 3), default=2, help="of displacements")
parser.add_argument("--steps", type=kit.whole, default=16, help="steps of time")
parser.add_argument("--offset", type=float, default=0.37, help="of the column, in cells")
parser.add_argument("--settlement", type=kit.positive, default=0.1, help="at the end of all time")
parser.add_argument("--time", type=kit.positive, default=0.1, help="at the end of the run")
args = parser.parse()
if not 0.0 <= args.offset <= 1.0:
    parser.error("argument --offset: from 0 to 1 cells")

comm = MPI.COMM_WORLD
n = max(1, round(1.0 / args.cell))
h = 1.0 / n
low = args.offset * h

background = mesh.create_rectangle(
    comm,
    [[0.0, -(2 + np.ceil(args.settlement / h)) * h], [2 * h, 1 + 2 * h]],
    [2, n + 4 + int(np.ceil(args.settlement / h))],
    mesh.CellType.quadrilateral,
)
body = mesh.create_rectangle(
    comm, [[0.0, low], [2 * h, 1.0 + low]], [4, 2 * n], mesh.CellType.quadrilateral
)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
particles = mpm.Particles(body, V, degree=args.degree, quadrature_degree=2 * args.degree)

# The skeleton: linear elastic, of the oedometric modulus that gives the settlement, and of a
# permeability with which the coefficient of consolidation is 1. Both ends lie on the body: the top
# is drained and loaded, the bottom stands on a roller.

modulus, poisson = 1.0 / args.settlement, 0.25
young = modulus * (1.0 + poisson) * (1.0 - 2.0 * poisson) / (1.0 - poisson)
ends = mesh.locate_entities_boundary(
    body, 1, lambda x: np.isclose(x[1], 1.0 + low) | np.isclose(x[1], low)
)
ends.sort()
middle = mesh.compute_midpoints(body, 1, ends)[:, 1]
tags = mesh.meshtags(body, 1, ends, np.where(middle > 0.5 + low, 1, 2).astype(np.int32))
side = mesh.locate_entities_boundary(
    background, 1, lambda x: np.isclose(x[0], 0.0) | np.isclose(x[0], 2 * h)
)
problem = mpm.PorousProblem(
    mpm.Body(
        particles,
        mpm.materials.LinearElastic(young, poisson),
        tractions=[((0.0, -1.0), 1)],
        facet_tags=tags,
        pore_fluid=mpm.PoreFluid(args.settlement, drained=[(0.0, 1)]),
    ),
    bcs=[fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(0), 1, side), V.sub(0))],
    supports=[mpm.boundary.roller(particles, tags, 2, normal=(0.0, -1.0))],
    solver=mpm.Solver(petsc_options_prefix="consolidation_"),
)
(p,) = problem.pore_pressure


def terzaghi(z: np.ndarray, time: float) -> np.ndarray:
    """Pressure over the load, z below the drained top."""
    M = (2.0 * np.arange(2000) + 1.0) * np.pi / 2.0
    return (2.0 / M * np.sin(np.outer(z, M)) * np.exp(-M * M * time)).sum(axis=1)


failure = None
depth = 1.0 + low - p.W.tabulate_dof_coordinates()[:, 1]
profiles = []
run = problem.steps(time=args.time, dt=args.time / args.steps)
try:
    for number, step in enumerate(run, start=1):
        if args.plot and number % max(1, args.steps // 4) == 0:
            profile = np.column_stack([depth, p.x.array])[: p.W.dofmap.index_map.size_local]
            profiles.append((step.time, kit.gathered(profile)))
except mpm.MPMError as told:
    failure = told

# The error of the pressure in the L2 norm, and the settlement of the top over that at the end of
# all time, less Terzaghi's.

exact = fem.Function(p.W)
exact.x.array[:] = terzaghi(depth, args.time)
squares = [
    kit.total(fem.assemble_scalar(fem.form(f**2 * particles.dx))) for f in (p - exact, exact)
]
error = float(np.sqrt(squares[0] / squares[1]))
d = particles.displacement
ds = ufl.Measure("ds", domain=body, subdomain_data=tags)
area = kit.total(fem.assemble_scalar(fem.form(fem.Constant(body, 1.0) * ds(1))))
sunk = -kit.total(fem.assemble_scalar(fem.form(d[1] * ds(1)))) / area / args.settlement
M = (2.0 * np.arange(2000) + 1.0) * np.pi / 2.0
degree = 1.0 - float((2.0 / M**2 * np.exp(-M * M * args.time)).sum())
numbers = {
    **kit.outcome(problem.history, failure),
    "pressure_error": error if failure is None else None,
    "degree": sunk,
    "settlement_error": abs(sunk - degree),
    "particles": particles.num_global,
}
rows = [
    ("particles", f"{particles.num_global}, {n} cells over the height"),
    ("linear solves", f"{numbers['iterations']} in {args.steps} steps"),
    ("pressure, error", f"{error:.2e}"),
    ("degree of consolidation", f"{sunk:.4f} (exact {degree:.4f})"),
]

if args.plot:
    fig, axes = kit.figure(7.0, 5.0)
    if comm.rank == 0:
        ax, z = axes["main"], np.linspace(0.0, 1.0, 200)
        for time, points in profiles:
            ax.plot(terzaghi(z, time), z, color="0.6", lw=1.0)
            ax.plot(points[:, 1], points[:, 0], ".", color=kit.COLOURS["blue"], ms=3)
        ax.set(xlabel="pressure over load", ylabel="depth over height", ylim=(1.0, 0.0))
        ax.set_title("Nodes of the body, and Terzaghi's series")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert error < 7.5e-3 and numbers["iterations"] == args.steps
