# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An elasto-plastic column that collapses.

demos/demo_column_free.py is its simplest form and has the equations.
"""

from math import ceil
from pathlib import Path

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

LOADS = (10e3, 20e3, 40e3, 80e3, 160e3)


def load(text: str) -> tuple[float, ...]:
    return LOADS if text == "all" else (kit.positive(text),)


parser = kit.Parser("Elasto-plastic column without side restraint, under its own weight.")
parser.add_argument("--domain", choices=("quad", "tri"), default="tri", help="particle domains")
parser.add_argument("--g0", type=load, default=(20e3,), help="weight per volume, N/m3, or 'all'")
patterns = ("left", "right", "left_right", "right_left", "crossed")
parser.add_argument("--diagonal", choices=patterns, default="left_right", help="of triangles")
parser.add_argument("--cell", type=kit.positive, default=0.5, help="background cell size, m")
parser.add_argument(
    "--particles-per-cell", type=kit.whole, default=2, help="quadrilaterals, each way"
)
parser.add_steps(40)
parser.add_argument("--width", type=kit.positive, help="of the background, m (ample by default)")
parser.add_argument(
    "--outside", choices=("error", "stop", "delete"), default="error", help="if particles leave it"
)
parser.add_argument(
    "--on-distortion", choices=("error", "split"), default="error", help="if quadrilaterals fold"
)
parser.add_argument("--plain-solver", action="store_true", help="no shift, no line search")
parser.add_f_bar()
parser.add_order()
parser.add_argument("--checkpoint", metavar="FILE", help="save each step (a file for each load)")
parser.add_argument("--resume", action="store_true", help="go on from the checkpoint, if any")
args = parser.parse()
if args.resume and not args.checkpoint:
    parser.error("argument --resume: needs --checkpoint FILE")
one_point = (args.degree, args.domain_degree or 1, args.quadrature_degree or 1) == (1, 1, 1)
if args.on_distortion == "split" and not (
    args.domain == "quad" and one_point and args.f_bar == "none"
):
    parser.error("argument --on-distortion: split is for --domain quad of one point, --f-bar none")

comm = MPI.COMM_WORLD
width, height = 4.0, 8.0  # m
young, poisson, rho_y = 1e6, 0.3, 20e3  # Pa, -, Pa
density = 1000.0  # kg/m3

# The background must be wide enough for the body to flow into: 20, 40, 80 and 128 m up to 20,
# 40, 80 and 160 kN/m3 (the body's volume hardly changes, so the reach grows with the load), and
# in proportion beyond. It may be larger than needed at no cost in the solver: only nodes that
# the body touches are unknowns. With `--width` it can be made smaller, and `--outside` says what
# becomes of particles that flow over its end.


def reach(g0: float) -> float:
    if args.width is not None:
        return args.width
    for limit, size in ((20e3, 20.0), (40e3, 40.0), (80e3, 80.0), (160e3, 128.0)):
        if g0 <= limit:
            return size
    return 128.0 * g0 / 160e3


# With several loads each has its checkpoint, with the load in the name.


def checkpoint_of(g0: float) -> Path | None:
    if args.checkpoint is None:
        return None
    path = Path(args.checkpoint)
    return path if len(args.g0) == 1 else path.with_stem(f"{path.stem}_{g0 / 1e3:g}")


# One run. A step that fails is halved and tried again; if the smallest step fails too, the package
# raises an error, and the particles are where they were at the last converged step.


def collapse(g0: float):
    h, per_cell = args.cell, args.particles_per_cell
    cells = [ceil(reach(g0) / h), ceil(10.0 / h)]
    background = mesh.create_rectangle(
        comm,
        [[0.0, 0.0], [cells[0] * h, cells[1] * h]],
        cells,
        mesh.CellType.quadrilateral,
    )
    V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
    body = mesh.create_rectangle(
        comm,
        [[0.0, 0.0], [width, height]],
        [max(1, round(side / h * per_cell)) for side in (width, height)],
        mesh.CellType.quadrilateral if args.domain == "quad" else mesh.CellType.triangle,
        diagonal=getattr(mesh.DiagonalType, args.diagonal),
    )

    side = mesh.locate_entities_boundary(background, 1, lambda x: np.isclose(x[0], 0.0))
    base = mesh.locate_entities_boundary(background, 1, lambda x: np.isclose(x[1], 0.0))
    bcs = [
        fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(0), 1, side), V.sub(0)),
        fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(1), 1, base), V.sub(1)),
    ]

    particles = mpm.Particles(
        body,
        V,
        method="cpdi2",
        outside=args.outside,
        on_distortion=args.on_distortion,
        **kit.order(args),
    )
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.VonMises(young, poisson, rho_y=rho_y),
            density=density,
            body_force=(0.0, -g0 / density),
            f_bar=args.f_bar,
        ),
        bcs=bcs,
        solver=mpm.Solver(
            stabilisation=kit.stabilisation(args),
            **({"shift": 0.0, "line_search": False} if args.plain_solver else {}),
        ),
    )

    # What each particle's yield function has been at most is no part of the package's state, so
    # it goes into the checkpoint as a Function of ours (which cannot be restored to domains that
    # were split: a run that goes on begins with it anew). Where a step has split domains, it is
    # carried to the mesh that the particles have then.
    violation = fem.Function(fem.functionspace(body, ("DG", 0)), name="violation")
    violation.x.array[:] = -np.inf
    kept = args.on_distortion == "error"
    checkpoint = checkpoint_of(g0)
    failure = None
    try:
        if args.resume and comm.bcast(checkpoint.exists()):
            problem.restore(checkpoint, functions=[violation] if kept else [])
        for _ in kit.progress(problem.steps(**kit.chosen(args)), args.steps, args):
            violation = particles.carry(violation)
            most = violation.x.array[: particles.num_local]
            np.maximum(most, problem.yield_function, out=most)
            if checkpoint is not None:
                problem.save(checkpoint, functions=[violation] if kept else [])
    except mpm.MPMError as error:
        failure = error
    most = particles.carry(violation).x.array[: particles.num_local]
    return particles, problem.history, kit.largest(most), failure


# What is measured: the highest and the farthest node of the body, the mean height
# $\bar y = \int y\, \mathrm{d}X / \int \mathrm{d}X$, by how much the yield condition is violated
# over the run (reported to 12 digits), and the shape of the worst domain: the smallest
# determinant of its map at a corner over the mean of that determinant. It is one for a triangle
# (half a quadrilateral too) and a parallelogram, zero where a quadrilateral has become a triangle,
# negative where it is concave.

bodies, results, failures = [], [], []
for g0 in args.g0:
    particles, history, yield_violation, failure = collapse(g0)
    x = particles.domains[~particles.deleted].reshape(-1, 2)
    numbers = {
        "g0": g0,
        **kit.outcome(history, failure),
        "top": kit.largest(x[:, 1]),
        "toe": kit.largest(x[:, 0]),
        "y_mean": kit.mean(particles.centroid[:, 1], particles.initial_volume * ~particles.deleted),
        "yield_violation": round(yield_violation, 12) + 0.0,
        "worst_domain": kit.smallest(particles.domain_distortion()),
        "lost_mass": history.statistics["lost_mass"],
        "split_domains": history.statistics["split_domains"],
    }
    bodies.append(particles)
    results.append(numbers)
    failures.append(failure)

# For several loads the common numbers are the worst or the sum, and each load has its own under
# `loads`.

failure = next((f for f in failures if f is not None), None)
if len(results) == 1:
    summary = results[0]
else:
    summary = {
        "completed": min(r["completed"] for r in results),
        "load": min(r["load"] for r in results),
        "iterations": sum(r["iterations"] for r in results),
        "cutbacks": sum(r["cutbacks"] for r in results),
        "failure": next((r["failure"] for r in results if r["failure"]), None),
        "yield_violation": max(r["yield_violation"] for r in results),
        "worst_domain": min(r["worst_domain"] for r in results),
        "split_domains": sum(r["split_domains"] for r in results),
        "loads": results,
    }

kind = f"triangles {args.diagonal}" if args.domain == "tri" else "quadrilaterals"
rows = [
    ("particles", f"{bodies[0].num_global} {kind}, cells of {args.cell:g} m"),
    ("g0, kN/m3", "  load  solves  cutbacks    top, m    toe, m  y mean, m  worst domain"),
]
rows += [
    (
        f"{r['g0'] / 1e3:g}",
        f"{r['load']:6.3f}{r['iterations']:8d}{r['cutbacks']:10d}{r['top']:10.3f}{r['toe']:10.2f}"
        f"{r['y_mean']:11.4f}{r['worst_domain']:14.3f}",
    )
    for r in results
]

# The picture: the body at first and now, domains coloured by plastic strain, with an enlargement
# of its toe. For several loads the bodies stand above each other at one scale.


def title(r: dict) -> str:
    whole = f"{r['g0'] / 1e3:g} kN/m³"
    return whole if r["completed"] else f"{100.0 * r['load']:.0f} % of {whole}"


def draw(particles: mpm.Particles, ax, limits, ghost=True):
    """Draw a body by its plastic strain, on the background, before what it was at first."""
    mpm.plot.background(particles.V, ax=ax, color="0.9")
    if ghost:
        mpm.plot.domains(particles, ax=ax, warp=0.0, facecolor="0.97", edgecolor="0.8")
    artist = mpm.plot.domains(particles, particles.plastic_strain, ax=ax, **style)
    if ax is not None:
        ax.set(xlim=limits[0], ylim=limits[1])
    return artist


def window(r: dict):
    """Limits of the enlargement: six cells at the toe."""
    size = 6.0 * args.cell
    return (r["toe"] - 0.94 * size, r["toe"] + 0.06 * size), (
        0.0,
        min(0.45 * size, 4 * r["y_mean"]),
    )


if args.plot:
    most = max(kit.largest(p.plastic_strain) for p in bodies)
    style = {"vmin": 0.0, "vmax": max(most, 1e-12), "cmap": "YlGnBu", "linewidth": 0.3}
    far = 1.02 * max(width, *(r["toe"] for r in results))
    domains = "Triangles" if args.domain == "tri" else "Quadrilaterals"

if args.plot and len(bodies) == 1:
    (result,) = results
    tall = 1.03 * max(height, result["top"])
    limits = window(result)
    wide = far > 2.0 * tall
    share = tall / far / (limits[1][1] / (limits[0][1] - limits[0][0]))
    fig, axes = kit.figure(
        *((12, 7.5) if wide else (14, 4.6)),
        [["body"], ["toe"]] if wide else [["body", "toe"]],
        **({"height_ratios": [share, 1.0]} if wide else {"width_ratios": [1.0, 1.3]}),
    )
    colours = draw(bodies[0], axes["body"], ((0.0, far), (0.0, tall)))
    draw(bodies[0], axes["toe"], limits, ghost=False)
    if comm.rank == 0:
        (x0, x1), (y0, y1) = limits
        axes["body"].indicate_inset(
            [x0, y0, x1 - x0, y1 - y0], edgecolor=kit.COLOURS["orange"], alpha=1.0, lw=1.5
        )
        reached = "carry" if result["completed"] else "stop at"
        axes["body"].set_title(f"{domains} {reached} {title(result)}")
        axes["toe"].set_title(f"Its toe (worst domain anywhere: {result['worst_domain']:.2f})")
        for ax in axes.values():
            ax.set(xlabel="x, m", ylabel="y, m")
        fig.colorbar(colours, ax=list(axes.values()), label="plastic strain", shrink=0.8)
    kit.save(fig, args)

# Several loads: rows of one scale, with the undeformed body first; two toes enlarged in the room
# that the first rows leave.

if args.plot and len(bodies) > 1:
    page, left, gap = 13.0, 0.5, 0.44  # inches
    scale = (page - left - 0.3) / far
    tops = [height, *(r["top"] for r in results)]
    sizes = [max(scale * 1.02 * top, 0.1) for top in tops]
    tallness = sum(sizes) + gap * len(sizes) + 0.6
    fig, _ = kit.figure(page, tallness, ())
    at = tallness
    for i, size in enumerate(sizes):
        at -= size + gap
        ax = None
        if comm.rank == 0:
            ax = fig.add_axes([left / page, at / tallness, scale * far / page, size / tallness])
        body = bodies[max(i - 1, 0)]
        values = np.zeros(body.num_local) if i == 0 else body.plastic_strain
        rows_style = {**style, "linewidth": 0.15 if i == 0 else 0.05}
        colours = mpm.plot.domains(body, values, ax=ax, warp=float(i > 0), **rows_style)
        if comm.rank == 0:
            label = "before" if i == 0 else title(results[i - 1])
            ax.set_title(label, size=12, pad=3)
            ax.set(xlim=(0.0, far), ylim=(0.0, size / scale), yticks=[])
            ax.spines["left"].set_visible(False)
            if i < len(results):
                ax.set_xticks([])
                ax.spines["bottom"].set_bounds(0.0, width if i == 0 else results[i - 1]["toe"])
            else:
                ax.set_xlabel("x, m (one scale for all rows)")
    for i, start in ((1, 0.36), (len(bodies) - 1, 0.70)):
        ax = fig.add_axes([start, 0.50, 0.27, 0.27]) if comm.rank == 0 else None
        draw(bodies[i], ax, window(results[i]), ghost=False)
        if comm.rank == 0:
            ax.set_title(f"toe at {title(results[i])}", size=12)
            ax.tick_params(labelsize=10)
    if comm.rank == 0:
        carried = sum(r["completed"] for r in results)
        carried = "all" if carried == len(results) else f"{carried} of"
        fig.text(
            0.33,
            0.945,
            f"{domains} carry {carried} {len(results)} loads",
            size=15,
            weight="bold",
            va="center",
        )
        bar = fig.add_axes([0.70, 0.88, 0.27, 0.022])
        fig.colorbar(colours, cax=bar, orientation="horizontal")
        bar.set_title("plastic strain", size=12, weight="normal", loc="center", pad=4)
    kit.save(fig, args)

kit.report(args, summary, rows, failure)

# With the default arguments the numbers are known (the mean height changes little with the mesh).

if args.default:
    assert summary["completed"] and summary["cutbacks"] <= 2
    assert abs(summary["toe"] / 12.23 - 1.0) < 0.01
    assert abs(summary["y_mean"] / 1.3307 - 1.0) < 0.005
    assert summary["yield_violation"] < 1e-8
