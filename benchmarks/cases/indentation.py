# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A footing is pressed into a block of wet ground, the stiffness of which is found from that.

A quarter of the ground: a cube of 5 m, held at its sides and its base, neo-Hookean with water in
its pores, into which a smooth footing of 1 m x 1 m at a corner goes 0.02 m in each step of 0.1 s.
Units are kN, m and s. `stiffness` is the force over the depth in the end. Then the force after each
step is what was measured, and Young's modulus is found from a tenth of it by Gauss and Newton's
method: `inverse_runs` is the number of runs, with the derivative of the force carried along, until
it changes by less than 1e-6, and `inverse_error` what it differs by in the end, relative.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

SIDE, WIDTH, SINKS, DURATION = 5.0, 1.0, 0.02, 0.1
POISSON, POROSITY, MOBILITY, WATER = 0.3, 0.5, 1e-8, 2.2e6
RUNS, CLOSE = 10, 1e-6

parser = kit.Parser("Indentation of wet ground, and its inverse.")
parser.add_argument("--cells", type=kit.whole, default=5, help="over the side, a multiple of 5")
parser.add_argument("--young", type=kit.positive, default=1e4, help="Young's modulus, kPa")
parser.add_argument("--steps", type=kit.whole, default=25, help="of 0.02 m")
args = parser.parse()
if args.cells % 5:
    parser.error(f"argument --cells: {args.cells} is not a multiple of 5")

comm, n, kind = MPI.COMM_WORLD, args.cells, mesh.CellType.hexahedron


def made(modulus):
    """A problem with a modulus, the modulus, the footing and where it goes."""
    high = SIDE * (1.0 + 1.0 / n)  # the ground heaves beside the footing
    grid = mesh.create_box(comm, [[0, 0, 0], [SIDE, SIDE, high]], [n, n, n + 1], kind)
    body = mesh.create_box(comm, [[0, 0, 0], [SIDE] * 3], [n] * 3, kind)
    V = fem.functionspace(grid, ("Lagrange", 2, (3,)))
    particles = mpm.Particles(body, V, degree=2, quadrature_degree=4)
    young, level = fem.Constant(body, modulus), fem.Constant(body, 0.0)
    up = (0.0, 0.0, 1.0)
    under = mpm.region(x=(0.0, WIDTH), y=(0.0, WIDTH), z=SIDE)
    tags = mpm.facet_tags(body, {1: under})
    footing = mpm.boundary.roller(particles, tags, 1, up, level)
    ground = mpm.Body(
        particles,
        mpm.materials.NeoHooke(young, POISSON),
        pore_fluid=mpm.PoreFluid(MOBILITY, storage=POROSITY / WATER),
    )
    bcs = [mpm.held(V, i, **{"xyz"[i]: place}) for i in (0, 1) for place in (0.0, SIDE)]
    bcs.append(mpm.held(V, 2, z=0.0))
    problem = mpm.PorousProblem(ground, bcs, supports=[footing])
    return problem, young, footing, level


def pressed(modulus, differentiates=True):
    """Force after each step, its derivative by the modulus, and the history of the run."""
    problem, young, footing, level = made(modulus)
    gradient = mpm.Sensitivity(problem, [young]) if differentiates else None

    def path(t):
        level.value = -SINKS * t / DURATION

    def force():
        return -problem.reaction(footing)[2]

    curve, slopes = [], []
    for _ in problem.steps(time=args.steps * DURATION, dt=DURATION, update=path):
        curve.append(force())
        if gradient is not None:
            slopes.append(float(gradient.of(force)[0]))
    return np.array(curve), np.array(slopes), problem.history


failure, history, numbers = None, mpm.History(), {}
try:
    measured, _, history = pressed(args.young, differentiates=False)
    found, change, runs = 0.1 * args.young, np.inf, 0
    while runs < RUNS and abs(change) > CLOSE * found:
        curve, slopes, _ = pressed(found)
        change = float(slopes @ (measured - curve) / (slopes @ slopes))
        found, runs = max(found + change, 0.1 * found), runs + 1
    numbers = {
        "stiffness": abs(measured[-1]) / (SINKS * args.steps),
        "inverse_runs": runs,
        "inverse_error": abs(found / args.young - 1.0),
    }
except mpm.MPMError as error:
    failure = error

rows = [(name, f"{value:.6g}") for name, value in numbers.items()]
kit.report(args, {**kit.outcome(history, failure), **numbers}, rows, failure)
