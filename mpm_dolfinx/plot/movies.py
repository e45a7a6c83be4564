# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A run as a movie."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, agree
from ..parallel.boundary import collective
from ..parallel.given import as_positive, require_whole
from .fields import Field, bodies_of
from .looks import Look, look_of
from .outlines import imported
from .scenes import Shot, draw, framed, new_figure, take

__all__ = ["movie"]


@collective("steps", "field")
def movie(
    problem: Any,
    steps: Iterable[Any],
    path: str | Path,
    field: Field = "displacement",
    *,
    every: int = 1,
    fps: float = 10.0,
    dpi: float = 90.0,
    **look: Any,
) -> None:
    """Run a problem and make a movie of it: ``movie(problem, problem.steps(40), "run.gif")``.

    A frame is drawn as :func:`scene` draws it, of the beginning and after each step (collective).
    All frames have the same colours and show the same part of the space: where bodies are in any of
    them. The movie is written at the end of the run, also of one that ends in an error.

    Args:
        problem: The problem.
        steps: What runs it: ``problem.steps(...)``, or any iterator that goes on by a step each
            time.
        path: A file that ends in ``.gif`` or ``.webp``.
        field: As in :func:`scene`; of values of your own a function without arguments that
            returns them at the moment.
        every: A frame after so many steps, and after the last.
        fps: Frames in a second.
        dpi: Pixels in an inch; a frame in the plane is eight inches wide.
        **look: As in :func:`scene`; the title stands before the time.

    Raises:
        MPMError: Another kind of file, there is no such field or look, or matplotlib is missing;
            or what the run raises.
    """
    bodies = bodies_of(problem)
    comm: MPI.Comm = bodies[0].mesh.comm
    with agree(comm):
        if Path(path).suffix not in (".gif", ".webp"):
            raise MPMError(f"A movie is a file that ends in .gif or .webp, not {str(path)!r}.")
        require_whole("every", every, least=1)
        as_positive(fps, "fps")
        as_positive(dpi, "dpi")
        own = look_of(look, field, bodies[0].mesh.geometry.dim)
    figures = imported("matplotlib.figure", comm)
    imported("PIL.Image", comm)

    def shot() -> tuple[float, Shot | None]:
        now = field() if callable(field) else field
        return problem.history.time, take(problem, bodies, now, own)

    frames = [shot()]
    number, taken = 0, 0
    try:
        for _ in steps:
            number += 1
            if number % every == 0:
                frames.append(shot())
                taken = number
        if taken != number:
            frames.append(shot())
    finally:
        with agree(comm):
            if comm.rank == 0:
                kept = [(time, frame) for time, frame in frames if frame is not None]
                _write(figures, kept, own, Path(path), fps, dpi)


def _write(
    figures: Any,
    frames: list[tuple[float, Shot]],
    look: Look,
    path: Path,
    fps: float,
    dpi: float,
) -> None:
    """Draw all frames and write them to a file, on rank 0."""
    shots = [frame for _, frame in frames]
    if look.box is None:
        low = np.min([frame.extent[0] for frame in shots], axis=0)
        high = np.max([frame.extent[1] for frame in shots], axis=0)
        look = replace(look, box=framed(np.array([low, high]), shots[0].around))
    least, most = (f([frame.range[i] for frame in shots]) for i, f in enumerate((min, max)))
    given = (None, None) if look.limits is None else look.limits
    first, last = given
    limits = (least if first is None else first, most if last is None else last)
    look = replace(look, limits=limits)
    image = import_module("PIL.Image")
    pictures = _frames(figures, frames, look, dpi)
    # One palette for all frames: what does not move does not flicker.
    strip = np.concatenate(pictures[:: max(1, len(pictures) // 8)] + pictures[-1:])
    palette = image.fromarray(strip).quantize(256, image.Quantize.MAXCOVERAGE)
    still = [
        image.fromarray(p).quantize(palette=palette, dither=image.Dither.NONE) for p in pictures
    ]
    times = [round(1000.0 / fps)] * (len(still) - 1) + [1500]  # ms, the last one stays
    still[0].save(path, save_all=True, append_images=still[1:], duration=times, loop=0)


def _frames(
    figures: Any, frames: list[tuple[float, Shot]], look: Look, dpi: float
) -> list[NDArray[np.uint8]]:
    """Return the pixels of all frames, drawn on one figure."""
    figure = new_figure(figures, frames[0][1], look)
    figure.set_dpi(dpi)
    canvas = import_module("matplotlib.backends.backend_agg").FigureCanvasAgg(figure)
    ax = figure.add_subplot()
    pictures = []
    for number, (time, shot) in enumerate(frames):
        ax.clear()
        title = f"{look.title}, time" if look.title else "time"
        draw(shot, replace(look, title=f"{title} {time:.3f}"), ax, bar=number == 0)
        canvas.draw()
        if number == 0:
            figure.set_layout_engine("none")  # what stands where stays
        pictures.append(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
    return pictures
