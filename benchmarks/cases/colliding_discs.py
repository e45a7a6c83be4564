# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Two elastic discs collide, on one background or by contact (Sulsky, Chen & Schreyer 1994)."""

from mpi4py import MPI

import kit
import numpy as np

import basix.ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Two elastic discs collide on one background, or on two by contact.")
parser.add_argument("--cell", type=kit.positive, default=1 / 20, help="background cell size")
parser.add_argument("--dt", type=kit.positive, default=0.02, help="time step")
parser.add_argument("--steps", type=kit.whole, help="time steps; up to 3.5 by dt")
parser.add_argument("--scheme", choices=("midpoint", "conserving", "euler"), default="conserving")
parser.add_argument("--out-of-range", choices=("project", "reflect"), default="reflect")
parser.add_argument(
    "--fields", choices=("one", "two"), default="one", help="two: with contact of the facets"
)
parser.add_argument("--friction", type=float, default=0.0, help="of the contact")
parser.add_argument("--beside", type=float, default=0.0, help="how far the paths lie apart")
args = parser.parse()
separate = args.fields == "two"

comm = MPI.COMM_WORLD
h, speed = args.cell, 0.1
steps = args.steps or round(3.5 / args.dt)
cells = round(1.4 / h)
background = mesh.create_rectangle(
    comm, [[-0.2, -0.2], [1.2, 1.2]], [cells, cells], mesh.CellType.quadrilateral
)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
spaces = [V, fem.functionspace(background, ("Lagrange", 1, (2,))) if separate else V]


def disc(centre, n):
    """A disc of radius 0.2 of n x n quadrilaterals."""
    q = np.linspace(-1.0, 1.0, n + 1)
    xi, eta = (a.ravel() for a in np.meshgrid(q, q, indexing="ij"))
    x, y = xi * np.sqrt(1 - eta**2 / 2), eta * np.sqrt(1 - xi**2 / 2)
    points = np.sqrt(0.5) * 0.2 * np.stack([x - y, x + y], axis=1) + centre
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    corners = np.stack([i[:-1, :-1], i[1:, :-1], i[:-1, 1:], i[1:, 1:]], axis=-1).reshape(-1, 4)
    if comm.rank > 0:
        corners, points = corners[:0], points[:0]
    element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    return mesh.create_mesh(comm, corners.astype(np.int64), element, points)


n = max(2, round(0.72 / h))
side = np.sqrt(0.5) * args.beside / 2.0
centres = (0.2 - side, 0.2 + side), (0.8 + side, 0.8 - side)
bodies = [
    # (by contact, meshes do not mirror each other)
    mpm.Particles(disc(c, n + number * separate), V, quadrature_degree=3)
    for number, (c, V) in enumerate(zip(centres, spaces, strict=True))
]
touch = mpm.contact.Pair(*bodies, friction=args.friction) if separate else None
problem = mpm.DynamicProblem(
    [
        mpm.Body(body, mpm.materials.Hencky(1000.0, 0.3), density=1000.0, velocity=(way, way))
        for body, way in zip(bodies, (speed, -speed), strict=True)
    ],
    scheme=args.scheme,
    out_of_range=args.out_of_range,
    terms=[touch] if touch else [],
    solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
)


def mean_speed(number: int) -> float:
    """Mean velocity of a disc along x, by its mass."""
    body = bodies[number]
    mass = problem.built.mass_matrices(number).sum(axis=2)
    v = problem.velocity[number].x.array.reshape(-1, 2)[body.domain_nodes][: body.num_local, :, 0]
    return kit.mean(v.ravel(), mass.ravel())


def smallest_gap() -> float:
    """Smallest gap of the contact."""
    return comm.allreduce(touch.gap.min(initial=np.inf), MPI.MIN) if touch else np.inf


failure, drift, turned = None, 0.0, 0.0
scale = 1000.0 * np.pi * 0.04 * speed
momentum, turning = problem.momentum, problem.angular_momentum
gap, first_gap = smallest_gap(), -np.inf
try:
    for _ in kit.progress(problem.steps(time=steps * args.dt, dt=args.dt), steps, args):
        drift = max(drift, float(np.abs(problem.momentum - momentum).max()) / scale)
        turned = max(turned, float(np.abs(problem.angular_momentum - turning).max()) / scale / 0.2)
        before, gap = gap, smallest_gap()
        if touch and np.abs(problem.reaction(touch)).max() > 0.0:
            first_gap = max(first_gap, min(before, gap) / h)
except mpm.MPMError as error:
    failure = error
history = problem.history
whole = np.array([e.kinetic + e.strain for e in history.energies])
balances = np.array([e.balance for e in history.energies])
kinetic = np.array([e.kinetic for e in history.energies])
numbers = {
    **kit.outcome(history, failure),
    "energy_change": whole[-1] / whole[0] - 1.0,
    "energy_largest": whole.max() / whole[0] - 1.0,
    "kinetic_least": kinetic.min() / kinetic[0],
    "rebound": mean_speed(0) / speed,
    "momentum_error": drift,
    "angular_momentum_error": turned,
    "force_at_gap": first_gap if touch else None,
    "friction_loss": history.energies[-1].damping / whole[0],
    "balance_error": float(np.abs(balances - balances[0]).max() / whole[0]),
    "iterations_per_step": float(np.mean(history.iterations)),
    "particles": sum(body.num_global for body in bodies),
}
rows = [
    ("discs", f"{numbers['particles']} domains, cells of {h:g}, {args.scheme}"),
    ("time steps", f"{len(history.steps)} of {args.dt:g}"),
    ("change of energy", f"{numbers['energy_change']:+.2e}"),
    ("speed after, over that before", f"{numbers['rebound']:.3f}"),
    ("momentum, over a disc's", f"{drift:.1e}"),
    ("angular momentum", f"{turned:.1e}"),
]
if touch:
    rows += [("largest gap with a force, in cells", f"{first_gap:.3f}")]

if args.plot:
    fig, axes = kit.figure(12.0, 5.0, [["bodies", "energy"]])
    mpm.plot.background(V, ax=axes["bodies"], color="0.9")
    for body in bodies:
        mpm.plot.domains(body, ax=axes["bodies"])
    if comm.rank == 0:
        ax = axes["energy"]
        times = [e.time for e in history.energies]
        ax.plot(times, kinetic / whole[0], label="kinetic", color=kit.COLOURS["blue"])
        ax.plot(times, 1.0 * whole / whole[0], label="with strain", color=kit.COLOURS["orange"])
        ax.set(xlabel="time", ylabel="energy, over its first", ylim=(0.0, 1.1))
        ax.legend()
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

if args.default:
    assert numbers["completed"] and abs(numbers["energy_change"]) < 1e-6
    assert -0.96 < numbers["rebound"] < -0.94 and numbers["momentum_error"] < 1e-10
