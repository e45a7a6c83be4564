# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A von Mises column that slumps in time under its own weight."""

from math import ceil
from time import process_time

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A von Mises column that slumps in time under its own weight.")
parser.add_argument("--time", type=kit.positive, default=2.0, help="until when, s")
parser.add_argument("--dt", type=kit.positive, default=0.02, help="time step, s")
parser.add_argument("--steps", type=kit.whole, help="time steps; by time and dt")
parser.add_argument("--cell", type=kit.positive, default=0.5, help="background cell size, m")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad")
parser.add_argument("--scheme", choices=("midpoint", "conserving", "euler"), default="conserving")
parser.add_argument("--out-of-range", choices=("project", "reflect"), default="project")
parser.add_argument("--static", action="store_true", help="equilibrium instead, for comparison")
args = parser.parse()

comm = MPI.COMM_WORLD
h = args.cell
cells = [ceil(20.0 / h), ceil(10.0 / h)]
background = kit.box([cells[0] * h, cells[1] * h], cells, mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
body = kit.box([4.0, 8.0], [round(8 / h), round(16 / h)], kit.DOMAINS[args.domain])
bcs = []
for axis in (0, 1):
    facets = mesh.locate_entities_boundary(background, 1, lambda x, i=axis: np.isclose(x[i], 0.0))
    dofs = fem.locate_dofs_topological(V.sub(axis), 1, facets)
    bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))

particles = mpm.Particles(body, V)
law = mpm.materials.VonMises(1e6, 0.3, rho_y=20e3)
column = mpm.Body(particles, law, density=1000.0, body_force=(0.0, -10.0))
steps = args.steps or max(1, round(args.time / args.dt))
failure = None
if args.static:
    problem = mpm.QuasiStaticProblem(column, bcs)
    run = problem.steps(args.steps or 40)
else:
    problem = mpm.DynamicProblem(column, bcs, scheme=args.scheme, out_of_range=args.out_of_range)
    run = problem.steps(time=args.time, dt=args.time / steps)
X = particles.W.tabulate_dof_coordinates()
path = [(0.0, 4.0, 8.0)]
began = process_time()
try:
    for step in kit.progress(run, steps, args):
        x = X[:, :2] + particles.displacement.x.array.reshape(-1, 2)
        path.append((step.time, kit.largest(x[:, 0]), kit.largest(x[:, 1])))
except mpm.MPMError as error:
    failure = error

history = problem.history
seconds = kit.largest([process_time() - began])
_, toe, top = path[-1]
numbers = {
    **kit.outcome(history, failure),
    "toe": toe,
    "top": top,
    "iterations_per_step": float(np.mean(history.iterations)),
    "cpu_per_step": seconds / max(1, len(history.steps)),
    "plastic_strain": kit.largest(particles.plastic_strain),
    "particles": particles.num_global,
}
if not args.static:
    balances = np.array([e.balance for e in history.energies])
    numbers["balance_error"] = float(np.abs(balances - balances[0]).max()) / max(
        e.kinetic for e in history.energies
    )
    numbers["dissipated"] = history.energies[-1].dissipated
rows = [
    ("column", f"cells of {h:g} m, {'equilibrium' if args.static else args.scheme}"),
    ("steps", f"{len(history.steps)}, {history.cutbacks} cutbacks"),
    ("toe", f"{toe:.3f} m"),
    ("top", f"{top:.3f} m"),
    ("linear solves in a step", f"{numbers['iterations_per_step']:.2f}"),
    ("CPU in a step", f"{1e3 * numbers['cpu_per_step']:.1f} ms"),
]

if args.plot:
    fig, axes = kit.figure(13.0, 5.0, [["body", "path"]], width_ratios=[2.0, 1.0])
    mpm.plot.background(V, ax=axes["body"], color="0.9")
    mpm.plot.domains(particles, ax=axes["body"], warp=0.0, facecolor="0.97", edgecolor="0.85")
    colours = mpm.plot.domains(
        particles, particles.plastic_strain, ax=axes["body"], cmap="YlGnBu", vmin=0.0
    )
    if comm.rank == 0:
        axes["body"].set(xlim=(0.0, 20.0), ylim=(0.0, 8.6), xlabel="x, m", ylabel="y, m")
        fig.colorbar(colours, ax=axes["body"], label="plastic strain", shrink=0.7)
        ax = axes["path"]
        at, toes, tops = np.array(path).T
        ax.plot(at, toes, color=kit.COLOURS["orange"], label="toe")
        ax.plot(at, tops, color=kit.COLOURS["blue"], label="top")
        ax.set(xlabel="load" if args.static else "time, s", ylabel="m", ylim=(0.0, None))
        ax.legend()
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

if args.default:
    assert numbers["completed"] and numbers["cutbacks"] == 0
    assert abs(toe - 11.96) < 0.02
