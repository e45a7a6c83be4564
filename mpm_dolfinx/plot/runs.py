# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Curves of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from ..errors import MPMError, agree
from ..history import History
from ..parallel.boundary import collective
from .outlines import imported

__all__ = ["history"]


@collective()
def history(
    problem: Any,
    path: str | Path | None = None,
    *,
    curve: Mapping[str, Sequence[float]] | None = None,
) -> Any:
    """Draw what a run did: loads, energies, linear solves, cutbacks, residuals (collective).

    The first panel is ``curve``, e.g. force over displacement; else the load over the controlled
    displacement; else the load over the time, unless the problem is one of motion, of which it
    shows the energies. The others are linear solves and size of each step (a step that is smaller
    than the one before comes after a cutback), and the residuals of Newton's method in each step.

    Args:
        problem: A problem that has been run.
        path: Where to save it, e.g. ``"run.png"``.
        curve: Two lists by their labels, of the horizontal and the vertical axis:
            ``{"settlement, m": [...], "force, kN": [...]}``.

    Returns:
        The figure of matplotlib on rank 0, ``None`` elsewhere.

    Raises:
        MPMError: There is no step yet, a curve that is none, or matplotlib is missing.
    """
    run = getattr(problem, "history", None)
    if not isinstance(run, History):
        raise MPMError(f"A history is drawn of a problem, not of {problem!r}.")
    comm: MPI.Comm = problem.bodies[0].mesh.comm
    with agree(comm):
        if not run.steps:
            raise MPMError("There is no step yet; draw the history after a run.")
        if curve is not None and (
            len(curve) != 2 or len({len(values) for values in curve.values()}) != 1
        ):
            raise MPMError("curve= has two lists of the same length, each under its label.")
    figures = imported("matplotlib.figure", comm)
    with agree(comm):
        if comm.rank > 0:
            return None
        figure = figures.Figure(figsize=(11.0, 6.6), layout="constrained")
        (first, solves), (sizes, residuals) = figure.subplots(2, 2)
        _first(first, run, curve)
        _solves(solves, run)
        _sizes(sizes, run)
        _residuals(residuals, run)
        for ax in (first, solves, sizes, residuals):
            ax.grid(color="0.92", linewidth=0.6)
            ax.set_axisbelow(True)
        if path is not None:
            figure.savefig(path, dpi=150)
        return figure


def _first(ax: Any, run: History, curve: Mapping[str, Sequence[float]] | None) -> None:
    """Draw the user's curve, energies, or the load."""
    if curve is not None:
        (x_label, x), (y_label, y) = curve.items()
        ax.plot(x, y, ".-", color="C0")
        ax.set(xlabel=x_label, ylabel=y_label)
        return
    if run.energies:
        times = [energy.time for energy in run.energies]
        always = ("kinetic", "internal", "external", "lost")
        for name in (*always, "strain", "damping", "stabilisation", "prescribed"):
            values = np.array([getattr(energy, name) for energy in run.energies])
            if name in always or np.any(values[np.isfinite(values)] != 0.0):
                ax.plot(times, values, label=name)
        ax.plot(times, [energy.balance for energy in run.energies], "k--", label="balance")
        ax.set(xlabel="time", ylabel="energy")
        ax.legend(fontsize="small")
        return
    controlled = [(0.0 if s.displacement is None else s.displacement, s.load) for s in run.steps]
    if any(step.displacement is not None for step in run.steps):
        ax.plot(*np.transpose([(0.0, 0.0), *controlled]), ".-", color="C0")
        ax.set(xlabel="controlled displacement", ylabel="load factor")
        return
    ax.plot([0.0, *(s.time for s in run.steps)], [0.0, *run.load], ".-", color="C0")
    ax.set(xlabel="time", ylabel="load factor, or parameter of the path")


def _solves(ax: Any, run: History) -> None:
    numbers = np.arange(1, len(run.steps) + 1)
    apart = len(numbers) <= 60  # gaps of less than a pixel are drawn as stripes
    ax.bar(numbers, run.iterations, width=0.8 if apart else 1.0, antialiased=apart, color="C0")
    failed = f", and {run.failed_iterations} in steps that failed" if run.failed_iterations else ""
    ax.set(xlabel="step", ylabel="linear solves")
    ax.set_title(f"{sum(run.iterations)} linear solves{failed}", fontsize="medium")
    ax.xaxis.get_major_locator().set_params(integer=True)


def _sizes(ax: Any, run: History) -> None:
    numbers = np.arange(1, len(run.steps) + 1)
    size = np.diff([0.0, *(step.time for step in run.steps)])
    ax.step(numbers, size, where="mid", color="C1")
    smaller = np.flatnonzero(size[1:] < 0.75 * size[:-1]) + 1
    ax.plot(numbers[smaller], size[smaller], "v", color="C3")
    ax.set(xlabel="step", ylabel="size of the step in time", ylim=(0.0, 1.15 * float(size.max())))
    ax.set_title(f"{run.cutbacks} cutback{'' if run.cutbacks == 1 else 's'}", fontsize="medium")
    ax.xaxis.get_major_locator().set_params(integer=True)


def _residuals(ax: Any, run: History) -> None:
    cold = np.array([0.75, 0.85, 0.95])
    for number, step in enumerate(run.steps):
        share = number / max(len(run.steps) - 1, 1)
        residuals = np.maximum(step.residuals, 1e-18)
        ax.semilogy(residuals, ".-", color=cold * (1.0 - share), linewidth=0.8, markersize=3)
    # A step that begins by moving something has nothing yet that its residual is relative to.
    ax.set(xlabel="Newton iteration", ylabel="relative residual")
    ax.set_ylim(top=min(ax.get_ylim()[1], 1e3))
    ax.set_title("Each step; the last one is black", fontsize="medium")
    ax.xaxis.get_major_locator().set_params(integer=True)
