# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The table of docs/splitting.md."""

from __future__ import annotations

from functools import partial
from typing import Any

from case_runs import Table, run

SCENES = [
    (0.5, 1, 20),
    (0.5, 1, 40),
    (0.5, 1, 80),
    (0.5, 1, 160),
    (0.53, 1, 160),
    (0.45, 1, 80),
    (0.5, 2, 160),
    (0.53, 2, 160),
    (0.25, 2, 80),
]


def cells(cell: float, each: int, weight: int) -> list[str]:
    found = []
    common: list[Any] = ["--domain", "quad", "--cell", cell, "--g0", 1e3 * weight]
    common += ["--particles-per-cell", each]
    for options in ([], ["--on-distortion", "split"], ["--f-bar", "domain"]):
        r = run("column_free", *common, *options)
        done = "whole" if r["completed"] else f"**{100 * r['load']:.0f} %**"
        height = [f"{r['y_mean']:.4f}"] if r["completed"] else []
        text = ", ".join([done, str(r["iterations"]), str(r["cutbacks"]), *height])
        found.append(text + (f" ({r['split_domains']})" if "--on-distortion" in options else ""))
    return found


def tables() -> dict[str, Table]:
    labels = [f"{h:g} m, {each}, {g} kN/m³" for h, each, g in SCENES]
    return {
        "splitting/column": Table(
            "splitting",
            [
                "cells, domains each way, load",
                "one point",
                "one point, split (domains cut)",
                "F-bar over the domain",
            ],
            {label: partial(cells, *s) for label, s in zip(labels, SCENES, strict=True)},
            quick=labels[:1],
            cases=["column_free"],
        )
    }
