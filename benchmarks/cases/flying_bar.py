# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""First axial mode of an elastic bar that flies through the background.

Small strains, so that the exact motion is known for any amplitude: ``d = A sin(pi t) cos(pi X)``
besides the flight. What grows here has nothing to do with physics: the page on dynamics tells what
Newmark's method does.
"""

from math import ceil

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("First axial mode of an elastic bar that flies through the background.")
parser.add_argument("--speed", type=float, default=0.37, help="of the flight; waves have 1")
parser.add_argument("--dt", type=kit.positive, default=0.02, help="time step; a period is 2")
parser.add_argument("--steps", type=kit.whole, default=1000, help="time steps")
parser.add_argument("--cell", type=kit.positive, default=1 / 16, help="background cell size")
parser.add_argument("--amplitude", type=kit.positive, default=0.1, help="over the bar's length")
parser.add_argument("--scheme", choices=("midpoint", "conserving", "euler"), default="midpoint")
parser.add_argument("--out-of-range", choices=("project", "reflect"), default="project")
parser.add_order()
args = parser.parse()

comm = MPI.COMM_WORLD
h, w, A = args.cell, np.pi, args.amplitude

# The background has room for the flight. It is one cell high, and holds all against its height, so
# that the bar is one of one dimension, with two quadrilaterals in a cell each way.

reach = args.speed * args.dt * args.steps
start = ceil((A + 2 * h + max(-reach, 0.0)) / h)
left = start * h
cells = [start + ceil((1.0 + max(reach, 0.0) + A) / h) + 4, 1]
background = kit.box([cells[0] * h, h], cells, mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
across = V.sub(1).collapse()[0]
held = fem.locate_dofs_geometrical((V.sub(1), across), lambda x: np.full(x.shape[1], True))
bcs = [fem.dirichletbc(fem.Function(across), held, V.sub(1))]
body = mesh.create_rectangle(
    comm, [[left, 0.0], [left + 1.0, h]], [round(2 / h), 2], mesh.CellType.quadrilateral
)
particles = mpm.Particles(body, V, **kit.order(args))
problem = mpm.DynamicProblem(
    mpm.Body(
        particles,
        mpm.materials.LinearElastic(1.0, 0.0),
        density=1.0,
        velocity=lambda x: np.stack([args.speed + w * A * np.cos(w * (x[0] - left)), 0.0 * x[0]]),
    ),
    scheme=args.scheme,
    out_of_range=args.out_of_range,
    bcs=bcs,
    solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}, stabilisation=kit.stabilisation(args)),
)

x = particles.W.tabulate_dof_coordinates()[:, 0] - left
momentum, mass = problem.momentum[0], h
weight = problem.built.mass_matrices(0).sum(axis=2).ravel()
nodes = particles.domain_nodes[: particles.num_local].ravel()


def size(error: np.ndarray) -> float:
    """The mean of a nodal error over the bar, in the square."""
    return float(np.sqrt(kit.mean(error[nodes] ** 2, weight)))


period = max(1, round(2.0 / args.dt))
errors = {"displacement": 0.0, "velocity": 0.0}
drift, failure = 0.0, None
try:
    run = problem.steps(time=args.steps * args.dt, dt=args.dt)
    for number, step in enumerate(kit.progress(run, args.steps, args), 1):
        drift = max(drift, abs(problem.momentum[0] - momentum) / mass)
        if number <= args.steps - period:
            continue
        t = step.time
        d = particles.displacement.x.array.reshape(-1, 2)[:, 0]
        v = problem.velocity.x.array.reshape(-1, 2)[:, 0]
        mode = A * np.cos(w * x)
        exact = {
            "displacement": args.speed * t + mode * np.sin(w * t),
            "velocity": args.speed + w * mode * np.cos(w * t),
        }
        sizes = {"displacement": A, "velocity": w * A}
        for (name, values), found in zip(exact.items(), (d, v), strict=True):
            errors[name] = max(errors[name], size(found - values) / sizes[name])
except mpm.MPMError as error:
    failure = error

# Energy of the vibration: the flight's is constant as the momentum is.

flight = 0.5 * mass * args.speed**2
vibration = np.array([e.kinetic - flight + e.strain for e in problem.history.energies])
balances = np.array([e.balance for e in problem.history.energies])
numbers = {
    **kit.outcome(problem.history, failure),
    "energy_change": vibration[-1] / vibration[0] - 1.0,
    "energy_largest": vibration.max() / vibration[0] - 1.0,
    "displacement_error": errors["displacement"],
    "velocity_error": errors["velocity"],
    "momentum_error": drift,
    "balance_error": float(np.abs(balances - balances[0]).max() / balances[0]),
    "particles": particles.num_global,
}
rows = [
    ("bar", f"speed {args.speed:g}, cells of {h:g}, {args.scheme}, {args.out_of_range}"),
    ("time steps", f"{len(problem.history.steps)} of {args.dt:g}"),
    ("change of the vibration's energy", f"{numbers['energy_change']:+.2e}"),
    ("error of displacement, over A", f"{errors['displacement']:.2e}"),
    ("error of velocity, over pi A", f"{errors['velocity']:.2e}"),
    ("change of the mean velocity", f"{drift:.1e}"),
]

if args.plot:
    fig, axes = kit.figure(9.0, 4.5)
    if comm.rank == 0:
        ax = axes["main"]
        times = [e.time for e in problem.history.energies]
        ax.plot(times, vibration / vibration[0], color=kit.COLOURS["blue"])
        ax.set(xlabel="time", ylabel="energy of the vibration, over its first")
        ax.set_title(f"It changes by {numbers['energy_change']:+.1e}")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

if args.default:
    assert numbers["completed"] and -2e-3 < numbers["energy_change"] < 0.0
    assert numbers["velocity_error"] < 1.1e-2 and numbers["displacement_error"] < 4e-3
