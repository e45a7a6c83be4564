# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Draw the figures of docs/theory.md into docs/images: python docs/studies/figures.py

The states drawn are computed: a soft block that slumps under its weight.
"""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

IMAGES = Path(__file__).resolve().parents[1] / "images"
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "0.55"
STYLE = {
    "font.size": 12,
    "axes.titlesize": 13,
    "axes.titlepad": 8,
    "axes.titlelocation": "left",
    "savefig.dpi": 150,
}
CELLS = (6, 4)  # of the background, each of length 1
ORDER = [0, 1, 3, 2]  # corners of a quadrilateral, around it


def block(size: tuple[float, float] = (2.0, 3.0)) -> tuple[mpm.Particles, mpm.QuasiStaticProblem]:
    """Return a block with four by six domains, on a floor and against a wall."""
    corners = [[0.0, 0.0], list(map(float, CELLS))]
    quadrilateral = mesh.CellType.quadrilateral
    background = mesh.create_rectangle(MPI.COMM_WORLD, corners, CELLS, quadrilateral)
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    body = mesh.create_rectangle(MPI.COMM_WORLD, [[0.0, 0.0], size], [4, 6], quadrilateral)
    bcs = []
    for axis in (0, 1):
        side = mesh.locate_entities_boundary(background, 1, lambda x, i=axis: np.isclose(x[i], 0))
        dofs = fem.locate_dofs_topological(V.sub(axis), 1, side)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
    particles = mpm.Particles(body, V)
    material = mpm.materials.VonMises(1e4, 0.3, rho_y=600.0)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, material, density=100.0, body_force=(0.0, -10.0)), bcs=bcs
    )
    return particles, problem


def grid(ax: Axes, u: np.ndarray | None = None, color: str = "0.8", shown=None, **style) -> None:
    """Draw the background, displaced by values at its nodes."""
    nx, ny = CELLS
    x, y = np.meshgrid(np.arange(nx + 1.0), np.arange(ny + 1.0), indexing="ij")
    points = np.stack([x, y], axis=2) + (0.0 if u is None else u)
    shown = np.ones((nx, ny), dtype=bool) if shown is None else shown
    cells = [
        [points[i, j], points[i + 1, j], points[i + 1, j + 1], points[i, j + 1]]
        for i, j in zip(*np.nonzero(shown), strict=True)
    ]
    options = {"facecolors": "none", "edgecolors": color, "linewidths": 1.0, "zorder": 1, **style}
    ax.add_collection(PolyCollection(cells, **options))


def domains(ax: Axes, corners: np.ndarray, alpha: float = 0.25, **style) -> None:
    options = {
        "facecolors": mpl.colors.to_rgba(ORANGE, alpha),
        "edgecolors": ORANGE,
        "linewidths": 1.3,
        "zorder": 2,
        **style,
    }
    ax.add_collection(PolyCollection(corners[:, ORDER], **options))


def frame(ax: Axes, xlim: tuple[float, float], ylim: tuple[float, float], title: str) -> None:
    ax.set(xlim=xlim, ylim=ylim, title=title)
    ax.set_aspect("equal")
    ax.axis("off")


def on_grid(particles: mpm.Particles, values: np.ndarray) -> np.ndarray:
    """Return nodal values ``(n, k)`` of V as an array over the grid's nodes."""
    where = np.rint(particles.V.tabulate_dof_coordinates()[:, :2]).astype(int)
    result = np.zeros((CELLS[0] + 1, CELLS[1] + 1, values.shape[1]))
    result[where[:, 0], where[:, 1]] = values
    return result


def transfer(particles: mpm.Particles) -> None:
    """The domains on the grid, and one corner's row of T."""
    corners = particles.domains
    chosen = int(np.argmin(np.abs(corners.mean(axis=1) - [2.8, 1.4]).sum(axis=1)))
    domain = corners[chosen]
    corner = 3  # the upper right one
    x = domain[corner]
    node = particles.W.dofmap.list[chosen, corner]
    columns, values = particles.T.getRow(2 * node)
    nodes = particles.V.tabulate_dof_coordinates()[columns // 2, :2]

    fig, (left, right) = plt.subplots(1, 2, figsize=(11.5, 3.9), width_ratios=[1.65, 1.0])
    grid(left)
    domains(left, corners)
    domains(left, domain[None], alpha=0.75)
    left.plot(*x, "o", color="k", ms=6, zorder=4)
    frame(left, (-0.1, CELLS[0] + 0.1), (-0.05, 2.45), "particle domains on the background")

    lower = np.floor(x)
    grid(right, color="0.6", linewidths=1.3)
    domains(right, domain[None], alpha=0.35, linewidths=2.0)
    right.plot(*domain.T, "o", color=ORANGE, ms=6, zorder=3)
    right.plot(*x, "o", color="k", ms=9, zorder=4)
    right.annotate("$x_c$", x, xytext=(10, -4), textcoords="offset points", size=14)
    for point, value in zip(nodes, values, strict=True):
        right.add_collection(LineCollection([[x, point]], colors=BLUE, linewidths=1.0, zorder=2))
        right.plot(*point, "o", color=BLUE, ms=8 + 34 * value, alpha=0.85, zorder=3)
        above = point[1] > lower[1]
        right.annotate(
            f"{value:.2f}",
            point,
            xytext=(0, (9 + 17 * value) * (1 if above else -1)),
            textcoords="offset points",
            ha="center",
            va="bottom" if above else "top",
            color=BLUE,
            size=14,
        )
    frame(
        right,
        (lower[0] - 0.45, lower[0] + 1.45),
        (lower[1] - 0.33, lower[1] + 1.33),
        "the row of T of corner $c$: $N_i(x_c)$",
    )
    fig.tight_layout()
    fig.savefig(IMAGES / "transfer.png", bbox_inches="tight")


def phases() -> None:
    """The three phases of a step: locate, solve, reset."""
    particles, problem = block((1.6, 2.8))
    run = problem.steps(6)
    for _ in range(3):
        next(run)
    before = particles.domains.copy()
    active = np.unique(particles.active_dofs // 2)
    next(run)
    after = particles.domains.copy()
    u = on_grid(particles, particles.increment.x.array.reshape(-1, 2))
    mark = on_grid(particles, np.isin(np.arange(len(u.reshape(-1, 2))), active)[:, None])
    mark = mark[:, :, 0] > 0
    moved = mark[1:, 1:] & mark[:-1, 1:] & mark[1:, :-1] & mark[:-1, :-1]

    fig, axes = plt.subplots(1, 3, figsize=(13.0, 3.4))
    titles = (
        "(i) locate: rows of T, active nodes",
        "(ii) solve: the increment u moves all",
        "(iii) reset: commit d, keep the grid",
    )
    nodes = np.argwhere(mark)
    for ax, title, state in zip(axes, titles, (before, after, after), strict=True):
        frame(ax, (-0.15, 4.6), (-0.15, 3.2), title)
        domains(ax, state)
    grid(axes[0])
    grid(axes[2])
    axes[0].plot(*nodes.T, "o", color=BLUE, ms=7, zorder=3)
    grid(axes[1], color="0.88")
    grid(axes[1], u, color=BLUE, shown=moved, linestyles="--", linewidths=1.2)
    axes[1].plot(*(nodes + u[mark]).T, "o", color=BLUE, ms=7, zorder=3)
    domains(axes[1], before, alpha=0.0, edgecolors="0.6", linewidths=0.7)
    fig.tight_layout()
    fig.savefig(IMAGES / "phases.png", bbox_inches="tight")


def main() -> None:
    mpl.use("agg")
    plt.rcParams.update(STYLE)
    IMAGES.mkdir(exist_ok=True)
    particles, problem = block()
    problem.solve(steps=10)
    transfer(particles)
    phases()


if __name__ == "__main__":
    main()
