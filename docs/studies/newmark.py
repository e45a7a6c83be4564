# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Draw docs/images/newmark.png: what time integration does in MPM. python docs/studies/newmark.py

An elastic bar of length 1 and wave speed 1 vibrates in its first mode and flies through a grid of
cells of 1/16, with 32 linear elements. All is of one dimension and linear, so mass and stiffness
are constant, and only T, the hat functions of the grid at the bar's nodes, changes in each step.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

IMAGES = Path(__file__).resolve().parents[1] / "images"
CELL, ELEMENTS, AMPLITUDE, DT, STEPS = 1 / 16, 32, 0.1, 0.02, 1000
START = 3 * CELL

type Array = NDArray[np.float64]
type Scheme = Callable[[Array, Array, Array, Array], tuple[Array, Array, Array]]
"""From T, the nodes' displacement, velocity and acceleration to those at the end of the step."""


def of_elements(element: Array) -> Array:
    """Sum the same matrix of all elements."""
    total = np.zeros((ELEMENTS + 1, ELEMENTS + 1))
    for e in range(ELEMENTS):
        total[e : e + 2, e : e + 2] += element
    return total


X = START + np.linspace(0.0, 1.0, ELEMENTS + 1)
M = of_elements(np.array([[2.0, 1.0], [1.0, 2.0]]) / 6.0 / ELEMENTS)
K = of_elements(np.array([[1.0, -1.0], [-1.0, 1.0]]) * ELEMENTS)
MODE = np.cos(np.pi * (X - START))


def transfer(x: Array) -> Array:
    """Return T: the hat functions of the grid nodes around the bar at its nodes."""
    first, last = np.floor(x.min() / CELL), np.ceil(x.max() / CELL)
    nodes = np.arange(first, last + 1.0)
    T = np.maximum(0.0, 1.0 - np.abs(x[:, None] / CELL - nodes))
    return T[:, T.max(axis=0) > 1e-12]


def solve(T: Array, A: Array, force: Array) -> Array:
    """Return ``T u`` with ``T^T A T u = T^T force``."""
    return np.asarray(T @ np.linalg.lstsq(T.T @ A @ T, T.T @ force, rcond=1e-13)[0])


def newmark(T: Array, d: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
    """Average acceleration (beta 1/4, gamma 1/2), with velocity and acceleration kept."""
    past = M @ (4.0 * v / DT + a) - K @ d
    w = solve(T, 4.0 * M / DT**2 + K, past)
    after = 4.0 * (w / DT - v) / DT - a
    return d + w, v + 0.5 * DT * (a + after), after


def generalised_alpha(radius: float) -> Scheme:
    """Chung & Hulbert (1993), with velocity and acceleration kept.

    Args:
        radius: Spectral radius at high frequencies.
    """
    am, af = (2.0 * radius - 1.0) / (radius + 1.0), radius / (radius + 1.0)
    gamma = 0.5 - am + af
    beta = 0.25 * (1.0 - am + af) ** 2

    def step(T: Array, d: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        past = (v / DT + (0.5 - beta) * a) / beta  # of the acceleration at the end
        matrix = (1.0 - am) / (beta * DT**2) * M + (1.0 - af) * K
        w = solve(T, matrix, M @ ((1.0 - am) * past - am * a) - K @ d)
        after = w / (beta * DT**2) - past
        return d + w, v + DT * ((1.0 - gamma) * a + gamma * after), after

    return step


def midpoint(projects: bool) -> Scheme:
    """The midpoint rule of the package: no acceleration is kept."""

    def step(T: Array, d: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        w = solve(T, 4.0 * M / DT**2 + K, 4.0 * M @ v / DT - 2.0 * K @ d)
        before = solve(T, M, M @ v) if projects else v
        after = 2.0 * w / DT - before
        return d + w, after, (after - before) / DT

    return step


def fly(scheme: Scheme, speed: float) -> tuple[Array, Array, Array]:
    """Let the bar fly; return times, energy of the vibration over its first, and acceleration."""
    d, v, a = np.zeros_like(X), speed + np.pi * AMPLITUDE * MODE, np.zeros_like(X)
    first = 0.5 * (np.pi * AMPLITUDE) ** 2 * MODE @ M @ MODE
    energies, accelerations = [1.0], [0.0]
    for _ in range(STEPS):
        d, v, a = scheme(transfer(X + d), d, v, a)
        own = v - (M @ v).sum()
        energies.append(0.5 * (own @ M @ own + d @ K @ d) / first)
        accelerations.append(float(np.sqrt(a @ M @ a)))
        if not energies[-1] < 1e6:
            break
    return DT * np.arange(len(energies)), np.array(energies), np.array(accelerations)


def main() -> None:
    schemes = {
        "Newmark": (newmark, "#D55E00"),
        "generalised alpha, 0.9": (generalised_alpha(0.9), "#CC79A7"),
        "midpoint, reflect": (midpoint(False), "#0072B2"),
        "midpoint, project": (midpoint(True), "#009E73"),
    }
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    for name, (scheme, colour) in schemes.items():
        for speed in (0.0, 0.37, 0.5):
            _, energies, _ = fly(scheme, speed)
            print(f"{name:24s} {speed:5.2f} {len(energies) - 1:5d} steps {energies[-1] - 1.0:+.1e}")
        times, energies, accelerations = fly(scheme, 0.37)
        width = 1.2 if scheme is newmark else 1.8
        axes[0].plot(times, energies, color=colour, label=name, lw=width)
        axes[1].plot(times, accelerations, color=colour, lw=width)
    exact = AMPLITUDE * np.pi**2 / np.sqrt(2.0)
    axes[1].axhline(exact, color="0.6", ls=":", label="largest exact one")
    axes[0].set(yscale="log", ylim=(0.2, 1e4), xlabel="time", title="energy of the vibration")
    axes[1].set(yscale="log", ylim=(1e-2, 1e6), xlabel="time", title="acceleration")
    axes[0].legend()
    axes[1].legend()
    for ax in axes:
        ax.set(xlim=(0.0, DT * STEPS))
    figure.savefig(IMAGES / "newmark.png", dpi=120)


if __name__ == "__main__":
    main()
