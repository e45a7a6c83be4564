# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An elastic cantilever that bends by more than its length allows to ignore.

demos/demo_cantilever.py is its simplest form and has the equations.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Elastic cantilever that bends through a background under a dead load.")
parser.add_argument("--cell", type=kit.positive, default=0.5, help="background cell size, m")
parser.add_argument("--particles-per-cell", type=kit.whole, default=2, help="domains, each way")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument("--root", choices=("clamped", "pinned"), default="clamped", help="support")
parser.add_argument("--poisson", type=float, default=0.2, help="Poisson's ratio")
parser.add_argument("--offset", type=float, default=0.0, help="of the beam, downwards, m")
parser.add_steps(50)
parser.add_f_bar()
parser.add_mixed()
parser.add_order()
args = parser.parse()
if not -0.5 <= args.offset <= 1.0:
    parser.error("argument --offset: the beam leaves the background; -0.5 to 1 m will do")

comm = MPI.COMM_WORLD
length, depth, axis = 10.0, 1.0, 9.5 - args.offset  # m
young, poisson, load = 12e6, args.poisson, 100e3  # Pa, -, N/m
REFERENCE = {
    ("clamped", 0.2): (0.554005, 0.825387),
    ("pinned", 0.2): (0.555218, 0.828139),
    ("clamped", 0.4999): (0.4944, 0.7929),  # benchmarks/cantilever_reference.py
}

# The background is 11 m by 10 m and a little more: a row of cells above leaves room for an offset
# upwards.

h = args.cell
cells = [round(11.0 / h), round(10.0 / h) + (1 if args.offset < 0.0 else 0)]
background = kit.box([cells[0] * h, cells[1] * h], cells, mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))

along = [max(1, round(side / h * args.particles_per_cell)) for side in (length, depth)]
body = mesh.create_rectangle(
    comm,
    [[0.0, axis - depth / 2.0], [length, axis + depth / 2.0]],
    along,
    kit.DOMAINS[args.domain],
    diagonal=mesh.DiagonalType.left_right,
)

ends = np.sort(mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[0], length)))
tags = mesh.meshtags(body, 1, ends, np.full(len(ends), 1, dtype=np.int32))

# The root stays on the grid line $x = 0$, so its conditions are the background's. Pinned, the
# vertical displacement is held at one node of the background, the nearest to the beam's axis.

side = mesh.locate_entities_boundary(background, 1, lambda x: np.isclose(x[0], 0.0))
bcs = [fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(0), 1, side), V.sub(0))]
if args.root == "clamped":
    held = fem.locate_dofs_topological(V.sub(1), 1, side)
else:
    nodes = V.tabulate_dof_coordinates()
    gap = np.where(np.isclose(nodes[:, 0], 0.0), abs(nodes[:, 1] - axis + 1e-6 * h), np.inf)
    held = (2 * np.flatnonzero(gap < kit.smallest(gap) + 1e-9 * h) + 1).astype(np.int32)
bcs.append(fem.dirichletbc(0.0, held, V.sub(1)))

particles = mpm.Particles(body, V, **kit.order(args))
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.Hencky(young, poisson),
        tractions=[((0.0, -load / depth), 1)],
        facet_tags=tags,
        f_bar=args.f_bar,
    ),
    bcs=bcs,
    mixed=None if args.mixed == "none" else args.mixed,
    solver=mpm.Solver(petsc_options_prefix="cantilever_", stabilisation=kit.stabilisation(args)),
)

# The tip is the body's node at half depth of its end; where the domains have none there, the mean
# of the two nodes next to it.

X = particles.W.tabulate_dof_coordinates()[: particles.W.dofmap.index_map.size_local]
gap = np.where(np.isclose(X[:, 0], length), abs(X[:, 1] - axis), np.inf)
at_tip = gap < kit.smallest(gap) + 1e-9
along_axis = abs(X[:, 1] - axis) < kit.smallest(gap) + 1e-9


def tip() -> tuple[float, float]:
    """Shortening and deflection of the tip over the length."""
    d = particles.displacement.x.array.reshape(-1, 2)[: len(X)][at_tip]
    count = kit.total(np.ones(len(d)))
    return tuple(-kit.total(d[:, i]) / count / length for i in (0, 1))


path = [(0.0, 0.0, 0.0)]
shapes = []
failure = None
try:
    for step in kit.progress(problem.steps(**kit.chosen(args)), args.steps, args):
        path.append((step.load, *tip()))
        if args.plot and step.load >= 0.2 * (len(shapes) + 1) - 1e-9 and step.load < 1.0:
            shapes.append(kit.gathered(kit.nodes(particles)[along_axis]))
except mpm.MPMError as error:
    failure = error

# `error` is the larger error of the two numbers in (4), for a run that is complete.

shortening, deflection = tip()
exact = REFERENCE.get((args.root, poisson), (np.nan, np.nan))
error = max(abs(shortening - exact[0]), abs(deflection - exact[1]))
numbers = {
    **kit.outcome(problem.history, failure),
    "shortening": shortening,
    "deflection": deflection,
    "error": error if failure is None and np.isfinite(error) else None,
    "particles": particles.num_global,
    "most_solves": max((step.iterations for step in problem.history.steps), default=0),
    "ghost_facets": problem.history.statistics["ghost_facets"],
}
degrees = f"degree {args.domain_degree or args.degree} on {args.degree}"
rows = [
    ("particles", f"{particles.num_global} ({args.domain}, {degrees}), cells of {h:g} m"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("shortening / length", f"{shortening:.6f} (finite elements {exact[0]:.6f})"),
    ("deflection / length", f"{deflection:.6f} (finite elements {exact[1]:.6f})"),
    ("larger error", f"{error:.1e}"),
]

# The picture: the beam on its background, its axis at each fifth of the load, and the tip's way
# beside that of the finite elements.

CURVE = {
    "clamped": ((0.2, 0.153344, 0.487205), (0.6, 0.429610, 0.751601), (1.0, 0.554005, 0.825387)),
    "pinned": ((0.2, 0.153673, 0.488225), (0.6, 0.430493, 0.753587), (1.0, 0.555218, 0.828139)),
}

if args.plot:
    fig, axes = kit.figure(13.0, 5.6, [["beam", "tip"]], width_ratios=[1.15, 1.0])
    mpm.plot.background(V, ax=axes["beam"], color="0.88")
    mpm.plot.domains(particles, ax=axes["beam"], warp=0.0, facecolor="0.94", edgecolor="0.75")
    stress = particles.stress
    mises = np.sqrt(
        1.5
        * np.sum(
            (stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)) ** 2,
            axis=(1, 2),
        )
    )
    colours = mpm.plot.domains(particles, mises / 1e6, ax=axes["beam"], cmap="YlGnBu", vmin=0.0)
    if comm.rank == 0:
        ax = axes["beam"]
        for line in shapes:
            ax.plot(*line[np.argsort(line[:, 0] - line[:, 1])].T, color="0.55", lw=1.0)
        ax.set(xlim=(0.0, 11.0), ylim=(0.0, cells[1] * h), xlabel="x, m", ylabel="y, m")
        ax.set_title(f"The beam bends through the background, {degrees}")
        fig.colorbar(colours, ax=ax, label="von Mises stress, MPa", shrink=0.8)
        ax, way = axes["tip"], np.array(path)
        for i, (name, colour) in enumerate((("shortening", "orange"), ("deflection", "blue"))):
            ax.plot(way[:, 0], way[:, i + 1], color=kit.COLOURS[colour], label=name)
            points = np.array(CURVE[args.root])
            ax.plot(
                points[:, 0],
                points[:, i + 1],
                "o",
                color=kit.COLOURS[colour],
                mfc="white",
                mew=1.6,
                label="finite elements" if i else None,
            )
        ax.set(xlim=(0.0, 1.03), ylim=(0.0, None), xlabel="load over 100 kN/m")
        ax.set_ylabel("of the tip, over the length")
        ax.set_title(f"Tip: off by {100 * error:.2g} % of the length")
        ax.legend(loc="lower right")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert error < 1e-2
    assert numbers["iterations"] <= 240 and numbers["cutbacks"] == 0
