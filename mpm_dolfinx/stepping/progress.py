# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A progress bar for load steps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from ..history import Step

__all__ = ["with_bar"]


def with_bar(
    steps: Iterable[Step], number: int, done: Callable[[Step], float] | None = None
) -> Iterator[Step]:
    """Go through load steps with a bar on the terminal.

    Args:
        steps: Converged steps.
        number: How many equal steps the run is.
        done: Returns which share of it is done after a step; ``None``: the load.

    Yields:
        Each of the steps.
    """
    from tqdm import tqdm  # (a tenth of the start-up, for those who want it)

    with tqdm(
        total=number,
        unit="step",
        bar_format="{l_bar}{bar}| {n:.3g}/{total} [{elapsed}<{remaining}{postfix}]",
    ) as bar:
        for step in steps:
            bar.set_postfix_str(f"{step.iterations} solves")
            bar.update((step.load if done is None else done(step)) * number - bar.n)
            yield step
