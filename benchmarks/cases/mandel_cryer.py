# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pore pressure that rises in the middle of a body before it falls (Mandel 1953, Cryer 1963).

What drains first at the surface of a loaded body shrinks and presses on its middle. Two bodies:

- a slab between rigid, smooth plates that drains at its sides (Cheng & Detournay 1988); the plates
  move as under a constant force, and the force tells the error;
- a sphere under pressure that drains at its surface. With Poisson's ratio ``nu`` and
  ``eta = (1 - nu) / (1 - 2 nu)`` its centre has the pressure, over that of the load,
  ``-2 sum_j (q_j - sin q_j) / (q_j D'(q_j)) exp(-q_j^2 t)`` with the positive roots ``q_j`` of
  ``D(q) = sin q + (2 / eta) (q cos q - sin q) / q^2``.

Lengths are over half the width or the radius a, times over ``a^2 / c_v``. Neither body lies on the
grid. `peak` is the largest pressure in the middle over that of the beginning, `exact` what it
should be, and `error` the largest error of that pressure after the time 0.02.
"""

from itertools import pairwise

from mpi4py import MPI

import kit
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Pore pressure rises in the middle of a slab or a sphere, before it falls.")
parser.add_argument("--case", choices=("slab", "sphere"), default="sphere", help="the body")
parser.add_argument("--cells", type=kit.whole, default=8, help="background cells in a half")
parser.add_argument("--poisson", type=float, default=0.2, help="Poisson's ratio")
parser.add_argument("--steps", type=kit.whole, default=28, help="in each of four periods")
args = parser.parse()

comm = MPI.COMM_WORLD
n, nu, shear = args.cells, args.poisson, 1e3
h, eta = 1.0 / n, (1.0 - nu) / (1.0 - 2.0 * nu)
sphere = args.case == "sphere"
left, low = (0.0 if sphere else 0.37 * h), 0.37 * h


def roots(function) -> np.ndarray:
    """The first roots above 0 of a function that changes sign there."""
    q = np.linspace(0.3, 300.0, 30000)
    at = function(q)
    lower = np.flatnonzero((at[1:] * at[:-1] < 0.0) & (np.abs(at[1:] - at[:-1]) < 10.0))
    a, b = q[lower], q[lower + 1]
    for _ in range(60):
        middle = 0.5 * (a + b)
        same = function(middle) * function(a) > 0.0
        a, b = np.where(same, middle, a), np.where(same, b, middle)
    return 0.5 * (a + b)


if sphere:
    q = roots(lambda q: np.sin(q) + 2.0 / eta * (q * np.cos(q) - np.sin(q)) / q**2)
    slope = np.cos(q) - 2.0 / eta * (np.sin(q) / q + 2.0 * (q * np.cos(q) - np.sin(q)) / q**3)
    weights = -2.0 * (q - np.sin(q)) / (q * slope)
else:
    q = roots(lambda q: np.sin(q) - 2.0 * eta * q * np.cos(q))
    weights = np.sin(q) / (q - np.sin(q) * np.cos(q)) * (1.0 - np.cos(q)) * 2.0


def pressure(time: float) -> float:
    """The exact pressure in the middle, over that of the beginning."""
    return float((weights * np.exp(-q * q * time)).sum())


# A quarter of the slab is a square; a quarter of the sphere's section is what a square becomes
# whose points keep their polar angle and have the larger coordinate for their radius, half way.

body = mesh.create_rectangle(
    comm, [[0.0, 0.0], [1.0, 1.0]], [2 * n, 2 * n], mesh.CellType.quadrilateral
)
if sphere:
    x, y = body.geometry.x[:, 0].copy(), body.geometry.x[:, 1].copy()
    body.geometry.x[:, 0] = x * np.sqrt(1.0 - 0.5 * y * y)
    body.geometry.x[:, 1] = y * np.sqrt(1.0 - 0.5 * x * x)
where = {1: mpm.region(y=0.0), 2: mpm.region(x=0.0), 3: mpm.region(x=1.0), 4: mpm.region(y=1.0)}
if sphere:
    where[3] = lambda x: np.hypot(x[0], x[1]) > 1.0 - 1e-9
    del where[4]
tags = mpm.facet_tags(body, where)
body.geometry.x[:, :2] += (left, low)
first = 0.0 if sphere else -2.0 * h
background = mesh.create_rectangle(
    comm,
    [[first, -2.0 * h], [1.0 + 3.0 * h, 1.0 + 3.0 * h]],
    [n + 3 if sphere else n + 5, n + 5],
    mesh.CellType.quadrilateral,
)
V = fem.functionspace(background, ("Lagrange", 2, (2,)))
particles = mpm.Particles(body, V, degree=2, quadrature_degree=4)
law = mpm.materials.LinearElastic(2.0 * shear * (1.0 + nu), nu)
confined = 2.0 * shear * eta
top = fem.Constant(body, 0.0)
supports = [mpm.boundary.roller(particles, tags, 1, (0.0, -1.0))]
if not sphere:
    plate = mpm.boundary.roller(particles, tags, 4, (0.0, 1.0), top)
    supports += [mpm.boundary.roller(particles, tags, 2, (-1.0, 0.0)), plate]
problem = mpm.PorousProblem(
    mpm.Body(
        particles,
        law,
        tractions=[(-ufl.FacetNormal(body), 3)] if sphere else [],
        facet_tags=tags,
        pore_fluid=mpm.PoreFluid(1.0 / confined, drained=[(0.0, 3)]),
    ),
    bcs=[mpm.held(V, 0, x=0.0)] if sphere else [],
    supports=supports,
    axisymmetric=sphere,
    solver=mpm.Solver(petsc_options_prefix="mandel_cryer_"),
)
(p,) = problem.pore_pressure
x = p.W.tabulate_dof_coordinates()
middle = np.hypot(x[:, 0] - left, x[:, 1] - low) < 1e-9


def path(time: float) -> None:
    """Move the plate as a constant force does, of 1 over half a plate."""
    w = np.sin(q) * np.cos(q) / (q - np.sin(q) * np.cos(q))
    top.value = -((1.0 - nu) / 2.0 - (w * np.exp(-q * q * time)).sum() / 2.0) / shear


# The first steps are short, as what backward Euler makes of them stays beside the drain.

start = 1.0 if sphere else 0.5
periods = (0.0, 0.005, 0.02, 0.1, 0.4)
found, forces, failure = [], [], None
try:
    for begin, end in pairwise(periods):
        update = None if sphere else path
        for step in problem.steps(time=end, dt=(end - begin) / args.steps, update=update):
            value = kit.largest(p.x.array[middle]) / start
            found.append((step.time, value, pressure(step.time)))
            if not sphere:
                forces.append(problem.reaction(plate)[1] + 1.0)
except mpm.MPMError as told:
    failure = told

time, value, exact = np.array(found).reshape(-1, 3).T
late = time > 0.02
peak = kit.largest(value)
known = max(map(pressure, np.linspace(0.02, 0.3, 2000)))
numbers = {
    **kit.outcome(problem.history, failure),
    "peak": peak,
    "exact": known,
    "error": float(np.abs(value - exact)[late].max(initial=0.0)),
    "error_force": float(np.abs(forces).max(initial=0.0)) if forces else None,
    "particles": particles.num_global,
}
rows = [
    ("particles", f"{particles.num_global}, {n} cells, {args.case}"),
    ("linear solves", f"{numbers['iterations']} in {len(time)} steps"),
    ("peak", f"{peak:.4f} (exact {known:.4f})"),
    ("pressure in the middle, error", f"{numbers['error']:.2e}"),
]
if args.plot:
    fig, axes = kit.figure(7.0, 4.0)
    if comm.rank == 0:
        axes["main"].semilogx(time, exact, color="0.6", lw=3.0, label="exact")
        axes["main"].semilogx(time, value, color=kit.COLOURS["blue"], label="particles")
        axes["main"].set(xlabel="time", ylabel="pressure in the middle")
        axes["main"].legend(frameon=False)
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert abs(peak / known - 1.0) < 0.01 and numbers["error"] < 0.025
