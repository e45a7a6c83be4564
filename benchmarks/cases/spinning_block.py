# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A free block that spins, elastic or plastic: angular momentum and energy."""

from math import ceil

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A free block that spins: angular momentum and energy.")
parser.add_argument("--angle", type=kit.positive, default=0.04, help="radians in a step")
parser.add_argument("--turn", type=kit.positive, default=20.0, help="radians in all")
parser.add_argument("--steps", type=kit.whole, help="time steps; by angle and turn")
parser.add_argument("--material", choices=("hencky", "neo_hooke", "von_mises"), default="hencky")
parser.add_argument("--yield-stress", type=kit.positive, default=0.05, help="Pa, von Mises")
parser.add_argument("--domain", choices=("quad", "tri", "hex"), default="quad")
parser.add_argument("--cell", type=kit.positive, default=0.1, help="background cell size, m")
parser.add_argument("--scheme", choices=("midpoint", "conserving", "euler"), default="conserving")
parser.add_argument("--out-of-range", choices=("project", "reflect"), default="reflect")
args = parser.parse()

comm = MPI.COMM_WORLD
steps = args.steps or max(1, round(args.turn / args.angle))
dt = args.angle  # one radian a second
dim = 3 if args.domain == "hex" else 2
half, n = ceil(0.85 / args.cell), round(2.0 / args.cell)
low = -half * args.cell + 0.013
size = 2 * half * args.cell
kind = mesh.CellType.hexahedron if dim == 3 else mesh.CellType.quadrilateral
make = mesh.create_box if dim == 3 else mesh.create_rectangle
background = make(comm, [[low] * dim, [low + size] * dim], [2 * half] * dim, kind)
V = fem.functionspace(background, ("Lagrange", 1, (dim,)))
body = make(comm, [[-0.5] * dim, [0.5] * dim], [n] * dim, kit.DOMAINS[args.domain])
elastic = (100.0, 0.3)
law = {
    "hencky": mpm.materials.Hencky(*elastic),
    "neo_hooke": mpm.materials.NeoHooke(*elastic),
    "von_mises": mpm.materials.VonMises(*elastic, rho_y=args.yield_stress),
}[args.material]
particles = mpm.Particles(body, V)
problem = mpm.DynamicProblem(
    mpm.Body(
        particles, law, density=1.0, velocity=lambda x: np.stack([-x[1], x[0], 0.0 * x[2]][:dim])
    ),
    scheme=args.scheme,
    out_of_range=args.out_of_range,
    solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
)
turning, momentum = problem.angular_momentum[-1], problem.momentum
spins, failure, drift = [turning], None, 0.0
try:
    for _ in kit.progress(problem.steps(time=steps * dt, dt=dt), steps, args):
        spins.append(problem.angular_momentum[-1])
        drift = max(drift, float(np.abs(problem.momentum - momentum).max()))
except mpm.MPMError as error:
    failure = error

history = problem.history
whole = np.array([e.kinetic + e.strain for e in history.energies])
balances = np.array([e.balance for e in history.energies])
changes = np.array(spins) / turning - 1.0
numbers = {
    **kit.outcome(history, failure),
    "energy_change": whole[-1] / whole[0] - 1.0,
    "energy_largest": whole.max() / whole[0] - 1.0,
    "angular_momentum_change": float(np.abs(changes).max()),
    "momentum_error": drift,
    "balance_error": float(np.abs(balances - balances[0]).max() / whole[0]),
    "plastic_strain": kit.largest(particles.plastic_strain),
    "iterations_per_step": float(np.mean(history.iterations)),
    "particles": particles.num_global,
}
rows = [
    ("block", f"{args.material}, {args.domain}, {args.scheme}, {args.out_of_range}"),
    ("time steps", f"{len(history.steps)} of {dt:g} rad"),
    ("change of energy", f"{numbers['energy_change']:+.2e}"),
    ("change of angular momentum", f"{numbers['angular_momentum_change']:.2e}"),
    ("linear solves in a step", f"{numbers['iterations_per_step']:.2f}"),
]

if args.plot:
    fig, axes = kit.figure(11.0, 4.5, [["body", "energy"]])
    mpm.plot.background(V, ax=axes["body"], color="0.9") if dim == 2 else None
    if dim == 2:
        mpm.plot.domains(particles, ax=axes["body"])
    if comm.rank == 0:
        ax = axes["energy"]
        angles = [e.time for e in history.energies]
        ax.plot(angles, whole / whole[0] - 1.0, label="energy", color=kit.COLOURS["orange"])
        ax.plot(angles, changes, label="angular momentum", color=kit.COLOURS["blue"])
        ax.set(xlabel="turn, rad", ylabel="relative change")
        ax.legend()
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

if args.default:
    assert numbers["completed"] and abs(numbers["energy_change"]) < 1e-9
    assert numbers["angular_momentum_change"] < 1e-10
