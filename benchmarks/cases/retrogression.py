# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A slope of sensitive clay that fails backwards, slide by slide, until its debris holds it.

A slope of 45 degrees, 5 m high, on a rough base. The clay is undrained, and its strength in shear
falls with the plastic strain from a peak to that of the remoulded clay, by an average over
`--length`. At first it stands, being ten times as strong; then it is let go with the peak.
demos/demo_retrogression.py is its simplest form.

`run_out` is how far the front has come from the toe, `retrogression` how far behind the crest the
ground has moved by a tenth of the height at least; both in m. `curve` has them through time.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A slope of sensitive clay that fails backwards.")
parser.add_argument("--cells", type=kit.whole, default=8, help="background cells in its height")
parser.add_argument("--crest", type=kit.positive, default=18.0, help="length of its top, m")
parser.add_argument("--peak", type=kit.positive, default=15.0, help="strength in shear, kPa")
parser.add_argument("--residual", type=kit.positive, default=5.0, help="once remoulded, kPa")
parser.add_argument("--decay", type=kit.positive, default=30.0, help="of strength with strain")
parser.add_argument("--length", type=float, default=0.65, help="of the average, m; 0: none")
parser.add_argument("--viscosity", type=kit.positive, default=50.0, help="E beta, Pa s")
parser.add_argument("--time", type=kit.positive, default=7.0, help="until when, s")
parser.add_argument("--steps", type=kit.whole, default=70, help="time steps")
args = parser.parse()

comm = MPI.COMM_WORLD
height, gravity, density, young, poisson = 5.0, 9.81, 2150.0, 5e6, 0.49
h, toe, crest = height / args.cells, args.crest + height, args.crest

# The background is longer than the debris comes. Domains are triangles, half as wide as cells.

along = round((toe + 20.0) / h)
background = mesh.create_rectangle(
    comm,
    [[0.0, 0.0], [along * h, height + 2 * h]],
    [along, args.cells + 2],
    mesh.CellType.quadrilateral,
)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
body = kit.box([toe, height], [round(2 * toe / h), 2 * args.cells], mesh.CellType.triangle)
x = body.geometry.x
x[:, 0] *= 1.0 - x[:, 1] / toe
particles = mpm.Particles(body, V)

uniaxial = np.sqrt(3.0) * 1e3 * args.peak  # Pa
strength = fem.Constant(body, 10.0 * uniaxial)
clay = mpm.materials.VonMises(young, poisson, yield_stress=strength)
clay = clay.with_softening(args.decay, residual=args.residual / args.peak)
slope = mpm.Body(
    particles,
    clay,
    density=density,
    body_force=(0.0, -gravity),
    f_bar="patch",
    length=args.length or None,
)
bcs = [mpm.held(V, y=0.0), mpm.held(V, 0, x=0.0)]
standing = mpm.QuasiStaticProblem(slope, bcs)
standing.solve(steps=2)
standing.step()
strength.value = uniaxial
problem = mpm.DynamicProblem(
    slope, bcs, scheme="euler", rayleigh=(0.0, args.viscosity / young), after=standing
)

X = particles.W.tabulate_dof_coordinates()[:, :2]
top = np.isclose(X[:, 1], height)


def reach() -> tuple[float, float]:
    """How far the front and the scarp have come, m."""
    d = particles.displacement.x.array.reshape(-1, 2)
    moved = top & (np.hypot(*d.T) > 0.1 * height)
    return (
        kit.largest((X + d)[:, 0]) - toe,
        max(0.0, crest - kit.smallest(X[moved, 0])),
    )


curve, failure = [(0.0, 0.0, 0.0)], None
try:
    steps = problem.steps(time=args.time, dt=args.time / args.steps)
    for step in kit.progress(steps, args.steps, args):
        curve.append((step.time, *reach()))
except mpm.MPMError as error:
    failure = error

history = problem.history
kinetic = [energy.kinetic for energy in history.energies]
numbers = {
    **kit.outcome(history, failure),
    "run_out": curve[-1][1],
    "retrogression": curve[-1][2],
    "kinetic_left": kinetic[-1] / max(kinetic),
    "alternations": sum(step.alternations for step in history.steps),
    "particles": particles.num_global,
    "curve": [list(row) for row in curve],
    "kinetic": kinetic,
}
rows = [
    ("slope", f"{args.cells} cells high, {particles.num_global} domains"),
    ("steps", f"{len(history.steps)}, {history.cutbacks} cutbacks"),
    ("linear solves", f"{history.total_iterations}"),
    ("run-out", f"{curve[-1][1]:.2f} m"),
    ("retrogression", f"{curve[-1][2]:.2f} m"),
    ("kinetic energy left", f"{numbers['kinetic_left']:.1e} of its largest"),
]
if args.plot:
    fig, axes = kit.figure(13.0, 6.0, [["body"], ["path"]])
    colours = mpm.plot.domains(
        particles, particles.plastic_strain, ax=axes["body"], cmap="YlOrBr", vmin=0.0, vmax=1.5
    )
    if comm.rank == 0:
        ax = axes["body"]
        ax.plot([0.0, crest, toe], [height, height, 0.0], color="0.4", ls="--", lw=1.0)
        ax.set(xlim=(0.0, toe + 15.0), ylim=(0.0, 1.1 * height), xlabel="x, m", ylabel="y, m")
        fig.colorbar(colours, ax=ax, label="plastic strain")
        times, run_out, back = np.array(curve).T
        ax = axes["path"]
        ax.plot(times, run_out, color=kit.COLOURS["orange"], label="run-out")
        ax.plot(times, back, color=kit.COLOURS["blue"], label="retrogression")
        ax.set(xlabel="time, s", ylabel="m")
        ax.legend()
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)
