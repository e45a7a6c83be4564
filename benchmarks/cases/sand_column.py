# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A column of dry sand that is let go, beside the run-out of experiments.

demos/demo_sand_column.py is its simplest form. `runout` is how far the sand has come that is
connected and at least one grain thick, over the column's width, without what was thrown ahead of it
or is drawn out to a thread there. `experiment` is that of Lube, Huppert, Sparks & Freundt
(2005) between plane walls: 1.2 a for aspects a = height/width below 1.8, 1.9 a^(2/3) above 2.8
(straight in between); `ratio` is the one over the other. `outermost` is the same of the outermost
corner, `front` of the place up to which 99 % of the sand lies.

With `--law mu-i` friction at rest is that of Mohr-Coulomb's sand in plane strain, and rises with
the inertial number by what was measured for glass beads (Jop, Forterre & Pouliquen 2006); grains
are a hundredth of the width by default.
"""

from math import ceil, sqrt

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A column of dry sand that is let go.")
parser.add_argument("--aspect", type=kit.positive, default=1.0, help="height over width")
parser.add_argument("--cell", type=kit.positive, default=1 / 8, help="over the width")
parser.add_argument("--particles-per-cell", type=kit.whole, default=2, help="each way")
parser.add_argument("--domain", choices=("tri", "quad"), default="tri", help="particle domains")
parser.add_argument(
    "--law", choices=("mu-i", "mohr-coulomb", "drucker-prager"), default="mohr-coulomb"
)
parser.add_argument("--grain", type=kit.positive, default=0.01, help="its diameter, m")
parser.add_argument("--friction-angle", type=kit.positive, default=30.0, help="degrees")
parser.add_argument("--dilation-angle", type=float, default=0.0, help="degrees")
parser.add_argument("--cohesion", type=float, default=0.0, help="Pa")
parser.add_argument("--young", type=kit.positive, default=1e6, help="Pa")
parser.add_argument("--no-volume-correction", action="store_true", help="what opens stays open")
parser.add_argument("--rayleigh", type=float, default=3e-6, help="damping by stiffness, beta in s")
parser.add_argument("--f-bar", choices=("none", "patch"), default="none")
parser.add_argument(
    "--outside", choices=("error", "delete"), default="error", help="if grains leave the background"
)
parser.add_argument("--dt", type=kit.positive, default=0.01, help="time step, s")
parser.add_argument("--time", type=kit.positive, help="until when, s; by default until it rests")
parser.add_argument("--steps", type=kit.whole, help="time steps; by time and dt")
args = parser.parse()
if args.law == "mu-i" and (args.cohesion or args.dilation_angle or args.no_volume_correction):
    parser.error("mu-i has no cohesion and no dilation, and a volume correction always")

comm = MPI.COMM_WORLD
width, density, gravity = 1.0, 2000.0, 10.0  # m, kg/m3, m/s2
n = max(1, round(1.0 / args.cell))
a, h = args.aspect, width / n
height = a * width


def experiment(aspect: float) -> float:
    """The run-out of Lube et al. (2005), over the width."""
    low, high = 1.2 * 1.8, 1.9 * 2.8 ** (2.0 / 3.0)
    if aspect <= 1.8:
        return 1.2 * aspect
    if aspect >= 2.8:
        return float(1.9 * aspect ** (2.0 / 3.0))
    return float(np.interp(aspect, [1.8, 2.8], [low, high]))


known = experiment(a)

# The base is a rough floor of cells that are held, so that a corner which falls onto it between two
# steps stays where it is.

cells = [ceil((1.0 + 2.2 * known) * width / h) + 4, ceil(height / h) + 3]
background = mesh.create_rectangle(
    comm,
    [[0.0, -h], [cells[0] * h, (cells[1] - 1) * h]],
    cells,
    mesh.CellType.quadrilateral,
)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
background.topology.create_connectivity(1, 2)
floor = mesh.locate_entities(background, 1, lambda x: x[1] < 1e-9)
wall = mesh.locate_entities_boundary(background, 1, lambda x: np.isclose(x[0], 0.0))
bcs = [
    fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(i), 1, facets), V.sub(i))
    for i, facets in ((0, floor), (1, floor), (0, wall))
]
n *= args.particles_per_cell
body = kit.box([width, height], [n, max(1, round(n * a))], kit.DOMAINS[args.domain])
particles = mpm.Particles(body, V, outside=args.outside)


def law() -> mpm.materials.Material:
    """Return the sand."""
    if args.law == "mu-i":
        friction, solid = np.sin(np.radians(args.friction_angle)), density / 0.6
        return mpm.materials.MuIRheology(
            args.young, 0.3, friction, friction + 0.26, args.grain, solid
        )
    strength = (args.cohesion, args.friction_angle, args.dilation_angle)
    correction = not args.no_volume_correction
    if args.law == "mohr-coulomb":
        return mpm.materials.MohrCoulomb(args.young, 0.3, *strength, volume_correction=correction)
    return mpm.materials.DruckerPrager(
        args.young, 0.3, *strength, match="plane_strain", volume_correction=correction
    )


at_rest = 1.0 - np.sin(np.radians(args.friction_angle))  # Jaky (1944)
problem = mpm.DynamicProblem(
    mpm.Body(
        particles,
        law(),
        density=density,
        body_force=(0.0, -gravity),
        f_bar=args.f_bar,
        initial_stress=mpm.geostatic(height, density, at_rest, (0.0, -gravity)),
    ),
    bcs=bcs,
    scheme="euler",
    rayleigh=(0.0, args.rayleigh),
)
end = args.time or 3.5 * sqrt(height / gravity) + sqrt(known * width / gravity)
steps = args.steps or ceil(end / args.dt)

X = particles.W.tabulate_dof_coordinates()[:, :2]
path, failure = [(0.0, 0.0)], None
try:
    for step in kit.progress(problem.steps(time=end, dt=end / steps), steps, args):
        x = X + particles.displacement.x.array.reshape(-1, 2)
        path.append((step.time, kit.largest(x[:, 0]) / width - 1.0))
except mpm.MPMError as error:
    failure = error


def front(share: float) -> float:
    """Up to where a share of the sand lies."""
    x = np.concatenate(comm.allgather(particles.centroid[:, 0]))
    volume = np.concatenate(comm.allgather(particles.initial_volume))
    order = np.argsort(x)
    total = np.cumsum(volume[order])
    return float(x[order][np.searchsorted(total, share * total[-1])])


def deposit() -> float:
    """Up to where the sand is connected, and as thick as a grain at least."""
    x = np.concatenate(comm.allgather(particles.domains[:, :, 0]))
    volume = np.concatenate(comm.allgather(particles.initial_volume))
    low, high = x.min(axis=1, keepdims=True), x.max(axis=1, keepdims=True)
    places = np.arange(0.0, high.max() + 2.0 * args.grain, args.grain)
    within = np.clip((places - low) / (high - low), 0.0, 1.0)
    thickness = np.diff(volume @ within) / args.grain
    return float(places[np.flatnonzero(thickness < args.grain)[0]])


history, outermost = problem.history, path[-1][1]
connected = deposit() / width - 1.0
kinetic = [energy.kinetic for energy in history.energies]
at_wall = np.isclose(X[:, 0], 0.0)
top = kit.largest((X[:, 1] + particles.displacement.x.array[1::2])[at_wall])
numbers = {
    **kit.outcome(history, failure),
    "outermost": outermost,
    "experiment": known,
    "ratio": connected / known,
    "runout": connected,
    "front": front(0.99) / width - 1.0,
    "height_at_wall": top,
    "kinetic_left": kinetic[-1] / max(kinetic),
    "iterations_per_step": float(np.mean(history.iterations)),
    "particles": particles.num_global,
    "lost_particles": history.statistics["lost_particles"],
}
rows = [
    ("column", f"aspect {a:g}, cells of {h:.3g} m, {particles.num_global} {args.domain}"),
    ("steps", f"{len(history.steps)}, {history.cutbacks} cutbacks"),
    ("linear solves in a step", f"{numbers['iterations_per_step']:.1f}"),
    ("run-out over width", f"{connected:.3f}, experiment {known:.3f}"),
    ("outermost corner, 99 % of all", f"{outermost:.3f}, {numbers['front']:.3f}"),
    ("kinetic energy left", f"{numbers['kinetic_left']:.1e} of its largest"),
]

if args.plot:
    fig, axes = kit.figure(13.0, 4.5, [["body", "path"]], width_ratios=[2.2, 1.0])
    mpm.plot.background(V, ax=axes["body"], color="0.93")
    colours = mpm.plot.domains(
        particles, particles.plastic_strain, ax=axes["body"], cmap="YlOrBr", vmin=0.0, vmax=4.0
    )
    if comm.rank == 0:
        ax = axes["body"]
        ax.plot([0.0, width, width], [height, height, 0.0], color="0.4", ls="--", lw=1.0)
        ax.plot([width * (1.0 + known)] * 2, [0.0, 0.3 * height], color=kit.COLOURS["blue"])
        reach = width * (1.3 + max(known, outermost))
        ax.set(xlim=(0.0, reach), ylim=(-h, 1.05 * height), xlabel="x, m", ylabel="y, m")
        fig.colorbar(colours, ax=ax, label="plastic strain", shrink=0.7)
        ax = axes["path"]
        ax.axhline(known, color=kit.COLOURS["blue"], label="experiment")
        ax.plot(*np.array(path).T, color=kit.COLOURS["orange"], label="outermost corner")
        ax.set(xlabel="time, s", ylabel="run-out over width", ylim=(0.0, None))
        ax.legend()
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

if args.default:
    assert numbers["completed"] and abs(numbers["ratio"] - 1.0) < 0.15
