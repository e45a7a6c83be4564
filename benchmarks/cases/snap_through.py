# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A shallow arch that snaps through.

demos/demo_snap_through.py is its simplest form and has the equations.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Shallow elastic arch that snaps through, by displacement control.")
parser.add_argument("--cell", type=kit.positive, default=0.5, help="background cell size, m")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument("--steps", type=kit.whole, default=24, help="steps of the crown's way")
parser.add_argument("--by-load", action="store_true", help="raise the load, to see where it ends")
parser.add_order()
parser.set_defaults(degree=2)
args = parser.parse()

comm = MPI.COMM_WORLD
half, rise, depth, way = 10.0, 1.0, 0.5, 2.4  # m
young, poisson, pressure = 12e6, 0.2, 10e3  # Pa, -, Pa

# The background reaches from below the arch that hangs to above the one that stands. The body's
# cells are half as long as the background's and follow the axis.

cells = [round(half / args.cell), round(6.0 / args.cell)]
background = mesh.create_rectangle(
    comm, [[0.0, -3.0], [half, 3.0]], cells, mesh.CellType.quadrilateral
)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
body = kit.box([half, depth], [2 * cells[0], 4], kit.DOMAINS[args.domain])
x = body.geometry.x
x[:, 1] += rise * np.sin(np.pi / 2.0 * x[:, 0] / half)


def on_top(x: np.ndarray) -> np.ndarray:
    """Whether points are on the upper face, near the crown."""
    height = x[1] - rise * np.sin(np.pi / 2.0 * x[0] / half)
    return (x[0] > half - 1.0 - 1e-9) & np.isclose(height, depth)


loaded = np.sort(mesh.locate_entities_boundary(body, 1, on_top))
tags = mesh.meshtags(body, 1, loaded, np.full(len(loaded), 1, dtype=np.int32))


def held(component: int, place: float) -> fem.DirichletBC:
    side = mesh.locate_entities_boundary(background, 1, lambda x: np.isclose(x[0], place))
    dofs = fem.locate_dofs_topological(V.sub(component), 1, side)
    return fem.dirichletbc(0.0, dofs, V.sub(component))


particles = mpm.Particles(body, V, **kit.order(args))
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.Hencky(young, poisson),
        tractions=[((0.0, -pressure), 1)],
        facet_tags=tags,
    ),
    bcs=[held(0, 0.0), held(1, 0.0), held(0, half)],
    solver=mpm.Solver(petsc_options_prefix="arch_", stabilisation=kit.stabilisation(args)),
)

# What is controlled is the way of a point of the body, which need not be a node.

crown = mpm.DisplacementControl(
    particles, way, point=(half, rise + depth / 2.0), direction=(0.0, -1.0)
)
path = [(0.0, 0.0)]
failure = None
if args.plot:
    fig, axes = kit.figure(13.0, 4.4, [["arch", "path"]], width_ratios=[1.35, 1.0])
    mpm.plot.background(V, ax=axes["arch"], color="0.9")


def outline() -> None:
    """Draw the arch as it is now in grey."""
    mpm.plot.domains(particles, ax=axes["arch"], facecolor="0.96", edgecolor="0.75", linewidth=0.3)


if args.plot:
    outline()
try:
    steps = problem.steps(args.steps, control=None if args.by_load else crown)
    share = None if args.by_load else lambda step: step.displacement / way
    for step in kit.progress(steps, args.steps, args, share):
        path.append((crown.present(), step.load))
        if args.plot and abs(path[-1][0] - 1.0) < 0.5 * way / args.steps:
            outline()
except mpm.MPMError as error:
    failure = error

# Finite elements of degree 2 on the same continuum (80 by 4 cells, right to 1e-3) have these loads:

REFERENCE = np.array(
    [
        (0.00, 0.0),
        (0.20, 0.105233),
        (0.40, 0.147589),
        (0.50, 0.152921),
        (0.60, 0.151423),
        (0.80, 0.136940),
        (1.00, 0.119336),
        (1.20, 0.111730),
        (1.40, 0.128146),
        (1.60, 0.184572),
        (1.80, 0.297552),
        (2.00, 0.482094),
        (2.20, 0.751074),
        (2.40, 1.115785),
    ]
)

# `limit` is the largest load before the crown is 1 m lower, `valley` the smallest after it has been
# reached, and `error` the largest deviation from the finite elements, over their limit load, until
# the arch hangs (1.4 m).

w, load = np.array(path).T
before = w <= 1.0
limit = load[before].max()
valley = load[(w >= w[np.argmax(load * before)]) & (w < 1.6)].min()
known, exact = REFERENCE[REFERENCE[:, 0] <= min(1.4, w[-1])].T
error = np.abs(np.interp(known, w, load) - exact)[np.isin(np.round(known, 9), np.round(w, 9))]
error = float(np.max(error, initial=0.0)) / REFERENCE[3, 1]
numbers = {
    **kit.outcome(problem.history, failure),
    "limit": limit,
    "valley": valley,
    "crown": w[-1],
    "error": error,
    "particles": particles.num_global,
}
rows = [
    ("particles", f"{particles.num_global} ({args.domain}), degree {args.degree}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("crown", f"{w[-1]:g} m lower, load {load[-1]:.4f}"),
    ("limit load", f"{limit:.5f} (finite elements {REFERENCE[3, 1]:.5f})"),
    ("valley", f"{valley:.5f} (finite elements {REFERENCE[7, 1]:.5f})"),
    ("error of load", f"{error:.1e}"),
]

# The picture: the arch as it stands, at 1 m and at the end, and its path beside that of the
# finite elements.

if args.plot:
    stress = particles.stress[:, 0, 0] / 1e6
    span = kit.largest(np.abs(stress))
    colours = mpm.plot.domains(
        particles, stress, ax=axes["arch"], cmap="RdBu_r", vmin=-span, vmax=span, linewidth=0.1
    )
    if comm.rank == 0:
        ax = axes["arch"]
        ax.set(xlim=(0.0, half), ylim=(-2.4, 2.2), xlabel="x, m", ylabel="y, m", aspect="equal")
        ax.set_title("The arch before, 1 m lower, and at the end")
        fig.colorbar(colours, ax=ax, label="stress along, MPa", shrink=0.6)
        ax = axes["path"]
        ax.plot(w, load, color=kit.COLOURS["blue"], label="particles")
        ax.plot(
            *REFERENCE.T,
            "o",
            color=kit.COLOURS["orange"],
            mfc="white",
            mew=1.6,
            label="finite elements",
        )
        landing = float(np.interp(limit, load[w > 1.2], w[w > 1.2])) if w[-1] > 1.6 else way
        ax.annotate(
            "",
            (landing, limit),
            (w[np.argmax(load * before)], limit),
            arrowprops={"arrowstyle": "->", "color": "0.4", "ls": "--"},
        )
        ax.text(1.0, 1.03 * limit, "by load: snap", ha="center", color="0.3")
        ax.set(xlim=(0.0, 1.85), ylim=(0.0, 0.3), xlabel="crown's way down, m")
        ax.set_ylabel("load over 10 kPa")
        ax.set_title(f"Limit load {limit:.4f}")
        ax.legend(loc="upper left")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the path is that of the finite elements.

if args.default:
    assert error < 5e-3
    assert numbers["cutbacks"] == 0
