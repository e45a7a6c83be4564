# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of docs/methods.md; run by itself it draws the page's figures."""

from __future__ import annotations

import sys
from functools import cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any

from mpi4py import MPI

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from case_runs import Table, run, scientific
from matplotlib.collections import PolyCollection
from matplotlib.patheffects import withStroke
from PIL import Image

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT.parent / "tests"))
from physics import test_patch  # noqa: E402

IMAGES = ROOT / "images"
BLUE, ORANGE = "#0072B2", "#D55E00"
WIDTH = 1250  # pixels
METHODS = {"cpdi2": "CPDI2", "cpdi": "CPDI", "gimp": "GIMP", "mpm": "MPM"}
ORDER = [0, 1, 3, 2]  # corners of a quadrilateral, around it


def percent(value: float) -> str:
    return "0" if value < 1e-9 else f"{100 * value:.1f} %"


def compaction(method: str) -> list[str]:
    row = []
    for ne in (16, 64, 256):
        r = run("compaction", "--method", method, "--elements", ne)
        done = "" if r["completed"] else f", to {100 * r['load']:.0f} %"
        row.append(f"{scientific(r['error'], 2)} ({r['iterations']}{done})")
    return row


@cache
def motions() -> dict[str, Any]:
    return run("domain_distortion")["motions"]


def distortion(method: str) -> list[str]:
    row = []
    for motion in ("shear", "rotation", "swirl"):
        values = motions()[motion]
        row.append(" / ".join(percent(values[f"{k}_{method}"]) for k in ("gap", "overlap")))
    return [*row, percent(motions()["swirl"][f"error_F_{method}"])]


@cache
def crossing() -> dict[str, Any]:
    return run("cell_crossing")


def block(method: str, n: int = 32, weight: float = 50.0) -> mpm.QuasiStaticProblem:
    """Return a block under its weight: 2 x 2 rectangles in each of n x n cells.

    The walls stand in the background, since CPDI's parallelograms reach through them a little.
    """
    quadrilateral = mesh.CellType.quadrilateral
    ends = [[-2 / n, -2 / n], [2, 2]]
    grid = mesh.create_rectangle(MPI.COMM_WORLD, ends, [2 * n + 2, 2 * n + 2], quadrilateral)
    V = fem.functionspace(grid, ("Lagrange", 1, (2,)))
    body = mesh.create_rectangle(MPI.COMM_WORLD, [[0, 0], [1, 1]], [2 * n, 2 * n], quadrilateral)
    bcs = []
    for axis in (0, 1):
        behind = mesh.locate_entities(grid, 2, lambda x, i=axis: x[i] < 1e-9)
        grid.topology.create_connectivity(2, 2)
        dofs = fem.locate_dofs_topological(V.sub(axis), 2, behind)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
    particles = mpm.Particles(body, V, method=method)
    material = mpm.materials.Hencky(1e3, 0.3)
    return mpm.QuasiStaticProblem(mpm.Body(particles, material, body_force=(0.0, -weight)), bcs=bcs)


@cache
def times(steps: int = 4, repeats: int = 3) -> dict[str, tuple[float, float]]:
    """Return solves and time of a step, the methods in turn, the least of the repeats."""
    seconds = dict.fromkeys(METHODS, np.inf)
    solves = {}
    for _ in range(repeats):
        for method in METHODS:
            problem = block(method)
            start = perf_counter()
            problem.solve(steps=steps)
            seconds[method] = min(seconds[method], (perf_counter() - start) / steps)
            solves[method] = problem.history.total_iterations / steps
    return {method: (solves[method], seconds[method]) for method in METHODS}


def cycle(method: str) -> list[str]:
    """Return what is left of the displacement of an elastic block, loaded and unloaded."""
    row = []
    for steps in (10, 20, 40):
        problem = block(method, 8, 10.0)
        d = problem.particles.displacement.x
        problem.solve(steps=steps)
        most = np.abs(d.array).max()
        for step in range(steps - 1, -1, -1):
            problem.particles.load.value = step / steps
            problem.step()
        row.append(scientific(np.abs(d.array).max() / most))
    return row


def hexahedra(amplitude: float) -> list[str]:
    return [f"{100 * d:.2g} %" for d in test_patch.hexahedra_difference(amplitude)]


def tables() -> dict[str, Table]:
    crossed = {"cpdi2": "CPDI2", "cpdi": "CPDI", "gimp": "GIMP, stretched"}
    crossed |= {"gimp_fixed": "GIMP, fixed", "mpm": "MPM"}
    failing = test_patch.FAILING
    moved = {f"{a:.0%}": partial(hexahedra, a) for a in (0.05, 0.1, 0.2)}
    cost = {n: (lambda m=m: cost_of(m)) for m, n in METHODS.items()}
    return {
        "methods/distortion": Table(
            "methods",
            ["gap / overlap", "simple shear", "rotation", "swirl", "error of F, swirl"],
            {name: partial(distortion, m) for m, name in METHODS.items()},
            quick=list(METHODS.values()),
            cases=["domain_distortion"],
        ),
        "methods/crossing": Table(
            "methods",
            ["method", "scatter of stress"],
            {n: (lambda m=m: [percent(crossing()[f"scatter_{m}"])]) for m, n in crossed.items()},
            cases=["cell_crossing"],
        ),
        "methods/compaction": Table(
            "methods",
            ["method", "16", "64", "256"],
            {name: partial(compaction, m) for m, name in METHODS.items()},
            quick=["CPDI2"],
            cases=["compaction"],
        ),
        "methods/patches": Table(
            "methods",
            ["", "error of stress"],
            {name: (lambda f=f: [scientific(f[0](), 2)]) for name, f in failing.items()},
            quick=list(failing),
        ),
        "methods/cycle": Table(
            "methods",
            ["steps each way", "10", "20", "40"],
            {METHODS[m]: partial(cycle, m) for m in ("cpdi2", "gimp")},
            quick=["CPDI2"],
        ),
        "methods/hexahedra": Table(
            "methods", ["corners moved by", "gradients", "volumes"], moved, quick=list(moved)
        ),
        "methods/cost": Table(
            "methods", ["method", "solves", "time over that of CPDI2"], cost, times=True
        ),
    }


def cost_of(method: str) -> list[str]:
    solves, seconds = times()[method]
    return [f"{solves:g}", f"{seconds / times()['cpdi2'][1]:.2f}"]


def picture() -> None:
    """Draw one particle's rows: the background nodes that it sees, and S_ip, by each method."""
    fig, axes = plt.subplots(1, 4, figsize=(13.0, 3.7))
    quadrilateral = mesh.CellType.quadrilateral
    for ax, (method, name) in zip(axes, reversed(METHODS.items()), strict=True):
        grid = mesh.create_rectangle(MPI.COMM_WORLD, [[0, 0], [4, 4]], [4, 4], quadrilateral)
        V = fem.functionspace(grid, ("Lagrange", 1, (2,)))
        body = mesh.create_rectangle(MPI.COMM_WORLD, [[0, 0], [1.5, 1.5]], [3, 3], quadrilateral)
        particles = mpm.Particles(body, V, method=method)
        x, y = particles.W.tabulate_dof_coordinates()[:, :2].T
        shear = 1.1 - 0.1 * x + 0.2 * y + 0.36 * x * y
        bend = 1.1 + 0.4 * x - 0.5 * x * y + 0.3 * y
        particles.displacement.x.array.reshape(-1, 2)[:] = np.column_stack([shear, bend])
        particles.commit()
        centre = int(np.argmin(np.abs(particles.initial_centroid - 0.75).sum(axis=1)))
        corners = particles.domains[:, ORDER]
        for i in range(5):
            ax.plot([i, i], [0, 4], color="0.82", lw=1.0, zorder=0)
            ax.plot([0, 4], [i, i], color="0.82", lw=1.0, zorder=0)
        if method != "mpm":
            style = {"facecolor": mpl.colors.to_rgba(ORANGE, 0.16), "edgecolor": ORANGE}
            ax.add_collection(PolyCollection(corners, lw=0.9, **style))
            style["facecolor"] = mpl.colors.to_rgba(ORANGE, 0.6)
            ax.add_collection(PolyCollection(corners[[centre]], lw=2.0, **style))
            if method != "gimp":
                ax.plot(*corners[centre].T, "o", color="k", ms=5, zorder=4)
        ax.plot(*particles.centroid.T, ".", color="0.2", ms=4, zorder=3)
        if method == "mpm":
            ax.plot(*particles.centroid[centre], "o", color="k", ms=6, zorder=4)
        w = particles.weights()
        part = slice(w.offsets[centre], w.offsets[centre + 1])
        nodes = V.tabulate_dof_coordinates()[w.nodes[part], :2]
        sizes = 30 + 1100 * w.S[part]
        ax.scatter(*nodes.T, s=sizes, color=BLUE, alpha=0.75, zorder=2, lw=0)
        for node, value, size in zip(nodes, w.S[part], sizes, strict=True):
            if value < 0.005:
                continue
            beyond = 0.4 * size**0.5  # of the disc, half its diameter to the right and down
            ax.annotate(
                f"{value:.2f}",
                node,
                xytext=(beyond + 1, -beyond - 1),
                textcoords="offset points",
                va="top",
                color=BLUE,
                size=12,
                zorder=5,
                path_effects=[withStroke(linewidth=3, foreground="w")],
            )
        what = {"mpm": "a point", "gimp": "boxes", "cpdi": "parallelograms"}
        ax.set_title(f"{name}: {what.get(method, 'connected corners')}", loc="left", size=14)
        ax.set(xlim=(0.85, 3.6), ylim=(0.6, 3.35))
        ax.set_aspect("equal")
        ax.axis("off")
    fig.tight_layout()
    fig.savefig(IMAGES / "methods.png", dpi=140)
    print(f"{IMAGES / 'methods.png'}: {(IMAGES / 'methods.png').stat().st_size / 1e3:.0f} kB")


def demo_pictures() -> None:
    for demo in ("domain_distortion", "cell_crossing"):
        path = IMAGES / f"{demo}.png"
        run(demo, "--plot", path)
        with Image.open(path) as shot:
            small = shot.convert("RGB")
        small.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
        small.save(path, optimize=True)
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", flush=True)


def main() -> None:
    mpl.use("agg")
    picture()
    demo_pictures()


if __name__ == "__main__":
    main()
