# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Generalised vortex (Kamojjala, Brannon, Sadeghirad & Guilkey 2015): a ring shears in its middle.

A point at the radius R turns by ``a = g(t) h(R)`` with ``g = sin(pi t)``,
``h = (1 - 16 (R - 1)^2)^2``, so that F has the determinant 1 and the neo-Hookean stress is
``mu (F - F^-T)``. Body force per volume, with the unit vectors of the turned position:

    b_r = mu R a'^2 - rho R a_t^2,     b_t = rho R a_tt - mu (3 a' + R a'').

The ring is a polygon; the exact traction P N acts on its sides, so that it is no error.
"""

from math import ceil

from mpi4py import MPI

import kit
import numpy as np

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Generalised vortex: a manufactured motion with large shear.")
parser.add_argument("--cell", type=kit.positive, default=1 / 8, help="background cell size")
parser.add_argument("--steps", type=kit.whole, default=20, help="time steps up to t = 1")
parser.add_argument("--static", action="store_true", help="without mass, the rim held")
parser.add_argument("--scheme", choices=("midpoint", "euler"), default="midpoint")
parser.add_argument("--out-of-range", choices=("project", "reflect"), default="project")
parser.add_order()
args = parser.parse()

comm = MPI.COMM_WORLD
h, degree = args.cell, args.degree
young, poisson, rho = 1000.0, 0.3, 0.0 if args.static else 1000.0
mu = young / (2.0 * (1.0 + poisson))
lame = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))

# The background is a square around the ring 0.75 < R < 1.25 of two quadrilaterals a cell each way.

half = ceil(1.3 / h + 0.3)
square = [[-half * h] * 2, [half * h] * 2]
background = mesh.create_rectangle(comm, square, [2 * half] * 2, mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", degree, (2,)))
around, across = 4 * round(np.pi / h), round(1.0 / h)
angle, radius = np.meshgrid(
    2.0 * np.pi * np.arange(around) / around, np.linspace(0.75, 1.25, across + 1)
)
points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
number = np.arange(len(points)).reshape(across + 1, around)
after = np.roll(number, -1, axis=1)
cells = np.stack([number[:-1], number[1:], after[:-1], after[1:]], axis=-1).reshape(-1, 4)
if comm.rank > 0:
    cells, points = cells[:0], points[:0]
element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
body = mesh.create_mesh(comm, cells.astype(np.int64), element, points)
particles = mpm.Particles(
    body, V, **{**kit.order(args), "quadrature_degree": args.quadrature_degree or 2 * degree + 1}
)

X = ufl.SpatialCoordinate(body)
R = ufl.sqrt(ufl.dot(X, X))
s = R - 1.0
H, H1, H2 = 1 - 32 * s**2 + 256 * s**4, -64 * s + 1024 * s**3, -64 + 3072 * s**2
g, g_t, g_tt = (fem.Constant(body, 0.0) for _ in range(3))


def place():
    """The exact positions."""
    c, w = ufl.cos(g * H), ufl.sin(g * H)
    return ufl.as_vector([c * X[0] - w * X[1], w * X[0] + c * X[1]])


x = place()
e_r = x / R
e_t = ufl.as_vector([-e_r[1], e_r[0]])
b = (mu * R * (g * H1) ** 2 - rho * R * (g_t * H) ** 2) * e_r
b += (rho * R * g_tt * H - mu * g * (3 * H1 + R * H2)) * e_t
F_exact = ufl.grad(x)
traction = mu * (F_exact - ufl.inv(F_exact).T) * ufl.FacetNormal(body)
v_exact = g_t * H * ufl.as_vector([-x[1], x[0]])

d, w = particles.displacement, ufl.TestFunction(particles.W)
F = ufl.Identity(2) + ufl.grad(d)
P = mu * (F - ufl.inv(F).T) + lame * ufl.ln(ufl.det(F)) * ufl.inv(F).T
fine = {"quadrature_degree": 2 * degree + 3}
dx = ufl.dx(domain=body, metadata=fine)
ds = ufl.ds(domain=body, metadata=fine)
residual = ufl.inner(P, ufl.grad(w)) * particles.dx - ufl.inner(b, w) * dx
residual -= ufl.inner(traction, w) * ds


def update(t):
    """Set what depends on time."""
    g.value = np.sin(np.pi * t)
    g_t.value = np.pi * np.cos(np.pi * t)
    g_tt.value = -(np.pi**2) * np.sin(np.pi * t)


update(0.0)
own = {"symmetric": True, "solver": mpm.Solver(stabilisation=kit.stabilisation(args))}
if args.static:
    rim = mpm.facet_tags(body, {1: lambda x: np.abs(np.hypot(x[0], x[1]) - 1.0) > 0.25 - 1e-9})
    residual += mpm.boundary.fixed(particles, rim, 1, modulus=young).residual
    problem = mpm.ParticleProblem(residual, particles, **own)
    run = problem.steps(args.steps, update=update)
else:
    problem = mpm.DynamicParticleProblem(
        residual,
        particles,
        rho,
        velocity=v_exact,
        scheme=args.scheme,
        out_of_range=args.out_of_range,
        **own,
    )
    run = problem.steps(time=1.0, dt=1.0 / args.steps, update=update)


def size(expression) -> float:
    """The L2 norm on the body."""
    form = fem.form(ufl.inner(expression, expression) * dx)
    return float(np.sqrt(comm.allreduce(fem.assemble_scalar(form))))


first = size(v_exact)
update(0.5)
largest = size(x - X)
update(0.0)
error_d, failure = [0.0], None
try:
    for step in kit.progress(run, args.steps, args):
        if (step.load if args.static else step.time) in (0.5, 1.0):
            error_d.append(size(d - (x - X)) / largest)
except mpm.MPMError as error:
    failure = error
numbers = {
    **kit.outcome(problem.history, failure),
    "displacement_error": error_d[-1],
    "displacement_error_half": error_d[1] if len(error_d) > 1 else 0.0,
    "velocity_error": None if args.static else size(problem.velocity - v_exact) / first,
    "iterations_per_step": float(np.mean(problem.history.iterations)),
    "particles": particles.num_global,
}
rows = [
    ("ring", f"{particles.num_global} domains of degree {degree}, cells of {h:g}"),
    ("time steps", f"{len(problem.history.steps)}, {args.scheme}, {args.out_of_range}"),
    ("error of displacement at t = 1", f"{numbers['displacement_error']:.2e} of the largest"),
    ("linear solves in a step", f"{numbers['iterations_per_step']:.2f}"),
]
if args.static:
    rows[1] = ("load steps, at rest", f"{len(problem.history.steps)}")
else:
    rows += [("error of velocity at t = 1", f"{numbers['velocity_error']:.2e} of the first")]

if args.plot:
    fig, axes = kit.figure(6.5, 6.0)
    mpm.plot.background(V, ax=axes["main"], color="0.9")
    mpm.plot.domains(particles, ax=axes["main"])
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

if args.default:
    assert numbers["completed"] and numbers["displacement_error"] < 6e-2
