# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The kernel of T in the free column, for docs/solver-measured.md: python docs/studies/kernel.py

Prints how many combinations of free background dofs move no node of the body, at each converged
step, and draws one of them.
"""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import matplotlib as mpl
import numpy as np

mpl.use("agg")
import matplotlib.pyplot as plt

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

IMAGES = Path(__file__).resolve().parents[1] / "images"
BLUE, ORANGE = "#0072B2", "#D55E00"
CELL, STEPS = 0.5, 40
SCENES = [("quad", 20e3, 20.0), ("quad", 80e3, 80.0), ("tri", 20e3, 20.0), ("tri", 80e3, 80.0)]


def column(domain: str, g0: float, width: float, **options):
    """Return the column of demo_column_free.py and the dofs that are fixed."""
    cells = [round(width / CELL), round(10.0 / CELL)]
    quadrilateral = mesh.CellType.quadrilateral
    background = mesh.create_rectangle(MPI.COMM_WORLD, [[0, 0], [width, 10]], cells, quadrilateral)
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    body = mesh.create_rectangle(
        MPI.COMM_WORLD,
        [[0, 0], [4, 8]],
        [16, 32],
        quadrilateral if domain == "quad" else mesh.CellType.triangle,
        diagonal=mesh.DiagonalType.left_right,
    )
    bcs = []
    for axis in (0, 1):
        side = mesh.locate_entities_boundary(background, 1, lambda x, i=axis: np.isclose(x[i], 0))
        dofs = fem.locate_dofs_topological(V.sub(axis), 1, side)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
    particles = mpm.Particles(body, V)
    material = mpm.materials.VonMises(1e6, 0.3, rho_y=20e3)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, material, density=1000.0, body_force=(0.0, -g0 / 1000.0)),
        bcs,
        solver=mpm.Solver(**options),
    )
    return particles, problem, np.concatenate([bc.dof_indices()[0] for bc in bcs])


def kernel(particles: mpm.Particles, fixed: np.ndarray):
    """Return the free dofs, singular values of T's scaled columns, and its kernel."""
    free = np.setdiff1d(particles.active_dofs, fixed)
    start, columns, values = particles.T.getValuesCSR()
    dense = np.zeros(particles.T.getSize())
    dense[np.repeat(np.arange(len(start) - 1), np.diff(start)), columns] = values
    size = np.linalg.norm(dense[:, free], axis=0)
    # A square factor of the same singular values is quicker to decompose.
    _, sizes, vectors = np.linalg.svd(np.linalg.qr(dense[:, free] / size, mode="r"))
    null = sizes < 1e-12
    return free, sizes, vectors[null] / size


def draw(particles: mpm.Particles, free: np.ndarray, vector: np.ndarray, ax) -> None:
    """Draw a combination of background dofs that moves nothing."""
    vector = vector / vector[np.argmax(np.abs(vector))]
    mpm.plot.background(particles.V, ax=ax, color="0.75", linewidth=1.0)
    mpm.plot.domains(
        particles,
        ax=ax,
        facecolor=mpl.colors.to_rgba(ORANGE, 0.25),
        edgecolor=ORANGE,
        linewidth=1.2,
    )
    strong = np.abs(vector) > 1e-6
    points = particles.V.tabulate_dof_coordinates()[free[strong] // 2, :2]
    arrows = np.zeros((strong.sum(), 2))
    arrows[np.arange(len(arrows)), free[strong] % 2] = 0.33 * vector[strong]
    ax.quiver(
        *points.T,
        *arrows.T,
        color=BLUE,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.012,
        zorder=4,
    )
    ax.plot(*points.T, "o", color=BLUE, ms=8, zorder=4)
    for point, value in zip(points, vector[strong], strict=True):
        ax.annotate(f"{value:+.2f}", point, (7, 7), textcoords="offset points", color=BLUE, size=13)
    middle = points.mean(axis=0)
    ax.set(xlim=middle[0] + np.array([-0.9, 0.9]), ylim=middle[1] + np.array([-1.0, 0.5]))
    ax.axis("off")


def main() -> None:
    plt.rcParams.update({"font.size": 12, "axes.titlesize": 13, "axes.titlelocation": "left"})
    fig, (left, right) = plt.subplots(1, 2, figsize=(11.5, 4.0), width_ratios=[1.0, 1.7])
    drawn = False
    for domain, g0, width in SCENES:
        particles, problem, fixed = column(domain, g0, width)
        dimensions, smallest, last = [], np.inf, 0.0
        for step in problem.steps(STEPS):
            free, sizes, null = kernel(particles, fixed)
            dimensions.append(len(null))
            smallest = min(smallest, sizes[len(sizes) - len(null) - 1])
            last = step.load
            if not drawn and len(null):
                # One component of a pair that is alike in x and y.
                vertical = null[:, free % 2 == 1]
                mix = np.linalg.svd(null[:, free % 2 == 0])[0][:, -1] if len(null) > 1 else [1.0]
                draw(particles, free, np.asarray(mix) @ null, left)
                left.set_title(f"one of them: load {100 * last:.0f} % of {g0 / 1e3:g} kN/m³")
                drawn = vertical.size > 0
        print(
            f"{domain}, {g0 / 1e3:g} kN/m3: kernel in {np.count_nonzero(dimensions)} of "
            f"{len(dimensions)} states, at most {max(dimensions)}; smallest other singular value "
            f"{smallest:.1e}; free dofs at the end {len(free)}",
            flush=True,
        )
        if g0 == 80e3:
            name, shift = ("quadrilaterals", -0.2) if domain == "quad" else ("triangles", 0.2)
            colour = BLUE if domain == "quad" else ORANGE
            right.bar(np.arange(1, STEPS + 1) + shift, dimensions, 0.4, color=colour, label=name)
    right.set(xlabel="converged step", ylabel="combinations that move nothing", xlim=(0, STEPS + 1))
    right.set_title("kernel of T at 80 kN/m³")
    right.spines[["top", "right"]].set_visible(False)
    right.legend(frameon=False)
    fig.tight_layout()
    fig.savefig(IMAGES / "kernel.png", dpi=140)


if __name__ == "__main__":
    main()
