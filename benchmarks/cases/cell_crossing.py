# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""When particles cross cells.

demos/demo_cell_crossing.py is its simplest form and has the equations.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A bar pulled over the grid: the stress of its particles, method by method.")
parser.add_argument("--steps", type=kit.whole, default=80, help="load steps")
parser.add_argument("--cells", type=kit.whole, default=8, help="background cells, bar's length")
parser.add_argument("--stretch", type=kit.positive, default=1.5, help="at the held end")
parser.add_order()
args = parser.parse()
if args.stretch >= np.exp(1.0):
    parser.error("argument --stretch: the load has its maximum at 2.718")

comm = MPI.COMM_WORLD
length, width = 8.0, 1.0  # m
young = 1e6  # Pa
g0 = young * np.log(args.stretch) / args.stretch / length  # N/m3
h = length / args.cells

RUNS = {
    "mpm": {"method": "mpm"},
    "gimp_fixed": {"method": "ugimp"},
    "gimp": {"method": "gimp"},
    "cpdi": {"method": "cpdi"},
    "cpdi2": {"method": "cpdi2"},
}

# The background is a strip, as wide as the bar, with room for it to grow; what differs between the
# runs is one argument of `Particles`.


def bar(options):
    reach = 2 + int(np.ceil(args.stretch * length / h))
    background = mesh.create_rectangle(
        comm, [[0.0, 0.0], [reach * h, width]], [reach, 1], mesh.CellType.quadrilateral
    )
    high = options["method"] == "cpdi2"
    V = fem.functionspace(background, ("Lagrange", args.degree if high else 1, (2,)))
    body = mesh.create_rectangle(
        comm, [[0.0, 0.0], [length, width]], [2 * args.cells, 2], mesh.CellType.quadrilateral
    )
    particles = mpm.Particles(body, V, **options, **(kit.order(args) if high else {}))

    held = mesh.locate_entities_boundary(background, 1, lambda x: np.isclose(x[0], 0.0))
    sides = mesh.locate_entities_boundary(
        background, 1, lambda x: np.isclose(x[1], 0.0) | np.isclose(x[1], width)
    )
    bcs = [
        fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(0), 1, held), V.sub(0)),
        fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(1), 1, sides), V.sub(1)),
    ]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, mpm.materials.Hencky(young, 0.0), body_force=(g0, 0.0)),
        bcs=bcs,
        solver=mpm.Solver(
            petsc_options_prefix="bar_", stabilisation=kit.stabilisation(args) if high else None
        ),
    )
    return particles, problem


# The marked particle starts in the middle of the bar. The rank that owns it knows it by its initial
# place; the others contribute nothing to the sum.

marked_at = ((args.cells // 2 + 0.25) * h, 0.25 * width)


def run(options):
    particles, problem = bar(options)
    X = particles.initial_centroid
    mine = np.isclose(X, marked_at).all(axis=1)
    loads, marked, places, squares, failure = [0.0], [0.0], [marked_at[0]], [0.0, 0.0], None
    try:
        for step in kit.progress(problem.steps(args.steps), args.steps, args):
            sigma = particles.stress[:, 0, 0]
            exact = g0 * step.load * (length - X[:, 0])
            squares[0] += kit.total((sigma - exact) ** 2)
            squares[1] += kit.total(exact**2)
            loads.append(step.load)
            marked.append(kit.total(sigma[mine]))
            places.append(kit.total(particles.centroid[mine, 0]))
    except mpm.MPMError as error:
        failure = error
    scatter = np.sqrt(squares[0] / squares[1]) if squares[1] else np.nan
    return particles, problem.history, failure, scatter, np.array([loads, marked, places])


results = {name: run(options) for name, options in RUNS.items()}
histories = {name: result[1] for name, result in results.items()}
failure = next((r[2] for name, r in results.items() if name == "cpdi2"), None)
numbers = {
    **kit.outcome(histories["cpdi2"], failure),
    "iterations": sum(h.total_iterations for h in histories.values()),
    "cutbacks": sum(h.cutbacks for h in histories.values()),
    **{f"scatter_{name}": result[3] for name, result in results.items()},
    **{f"load_{name}": result[4][0, -1] for name, result in results.items()},
    "particles": results["cpdi2"][0].num_global,
}

rows = [("method", "     scatter   load   solves")]
for name, (_, history, stopped, scatter, path) in results.items():
    text = f"{100 * scatter:10.2f} %  {path[0, -1]:5.3f} {history.total_iterations:8d}"
    rows.append((name, text + (f"  ({type(stopped).__name__})" if stopped else "")))

# The picture: above, the stress of the marked particle over the load, with the moments at which it
# crosses; below, the bar at the end by the two extremes, coloured by how far the stress is off.

if args.plot:
    layout = [["stress", "stress"], ["mpm", "cpdi2"]]
    fig, axes = kit.figure(11.5, 7.2, layout, height_ratios=[3.2, 1.0])
    off = {}
    for name in ("mpm", "cpdi2"):
        particles = results[name][0]
        exact = g0 * results[name][4][0, -1] * (length - particles.initial_centroid[:, 0])
        mpm.plot.background(particles.V, ax=axes[name], color="0.75")
        off[name] = mpm.plot.domains(
            particles,
            100.0 * (particles.stress[:, 0, 0] - exact) / (g0 * length),
            ax=axes[name],
            cmap="RdBu_r",
            vmin=-40.0,
            vmax=40.0,
        )
    far = max(kit.largest(kit.nodes(results[name][0])[:, 0]) for name in off)
    if comm.rank == 0:
        ax = axes["stress"]
        blue, orange, green = (kit.COLOURS[name] for name in ("blue", "orange", "green"))
        ax.plot(
            [0.0, 1.0],
            [0.0, g0 * (length - marked_at[0]) / 1e3],
            color="0.2",
            lw=1.2,
            label="exact",
            zorder=1,
        )
        looks = {
            "mpm": ("MPM", orange, {"lw": 1.6}),
            "gimp_fixed": ("GIMP, boxes of fixed size", green, {"lw": 1.6}),
            "gimp": ("GIMP", blue, {"ls": "", "marker": "s", "ms": 10}),
            "cpdi": ("CPDI", blue, {"ls": "", "marker": "D", "ms": 6}),
            "cpdi2": ("CPDI2", blue, {"ls": "", "marker": "o", "ms": 3}),
        }
        for name, (label, colour, look) in looks.items():
            loads, marked, _ = results[name][4]
            every = max(1, len(loads) // 12) if "marker" in look else 1
            ax.plot(
                loads[::every],
                marked[::every] / 1e3,
                color=colour,
                mfc="white",
                mew=1.2,
                label=f"{label} (scatter {100 * results[name][3]:.1f} %)",
                **look,
            )
        loads, _, places = results["cpdi2"][4]
        for at in np.flatnonzero(np.diff(np.floor(places / h - 1e-9))):
            ax.axvline(loads[at + 1], color="0.7", lw=1.0, ls="--", zorder=0)
            ax.annotate(
                " it leaves its cell (CPDI2)",
                (loads[at + 1], 0.03),
                xycoords=("data", "axes fraction"),
                color="0.45",
            )
        ax.set(xlim=(0.0, 1.0), xlabel="load")
        ax.set(ylabel="stress of one particle, kPa")
        ax.set_title("Points that cross cells upset the stress; domains do not")
        ax.legend(loc="upper left")
        for name, label in (("mpm", "MPM"), ("cpdi2", "CPDI2")):
            axes[name].set(xlim=(0.0, 1.02 * far), ylim=(-0.02, 1.02))
            axes[name].set(yticks=[], xlabel="x, m")
            axes[name].set_title(f"{label}: the bar at the end")
            axes[name].spines["left"].set_visible(False)
        fig.colorbar(off["mpm"], ax=axes["cpdi2"], label="error, % of $g_0 L$", aspect=8)
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert numbers["completed"] == 1
    assert max(numbers[f"scatter_{name}"] for name in ("gimp", "cpdi", "cpdi2")) < 0.02
    assert numbers["scatter_mpm"] > 0.1
