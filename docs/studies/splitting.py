# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of docs/splitting.md."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
from case_runs import ROOT, Table, run, scientific

sys.path.append(str(ROOT / "tests"))
import splits

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


#: What a split and a rebase leave as it is, by what the tests call it.
SUMS = {
    "volume, undeformed and present": ("volume", "present volume"),
    "mass, and its moment": ("mass", "moment of mass"),
    "mass at each node of the background": ("mass at nodes of the background",),
    "external forces, sum of all forces, at each node": ("external forces", "forces"),
    "elastic strain, plastic strain": ("elastic strain", "plastic strain"),
    "sums of stress and deformation gradient": ("stress", "F"),
}


@cache
def before_and_after() -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
    """Sums of a split column, and of rebased blocks in the plane and in space."""
    found = []
    split = splits.half_way(splits.column())
    quadrilaterals = splits.half_way(splits.block_of(splits.QUADRILATERAL), 4)
    hexahedra = splits.half_way(splits.block_of(splits.HEXAHEDRON), 4)
    for problem in (split, quadrilaterals, hexahedra):
        before = splits.sums(problem)
        if problem is split:
            problem.split(splits.some(problem.particles))
        else:
            problem.rebase()
        found.append((before, splits.sums(problem)))
    return found


def differences(names: Sequence[str]) -> list[str]:
    """The largest differences of some sums, relative to the largest number of each."""
    row = []
    for before, after in before_and_after():
        gaps = [np.abs(after[n] - before[n]).max() / np.abs(before[n]).max() for n in names]
        row.append(scientific(float(max(gaps)), 0))
    return row


def tables() -> dict[str, Table]:
    labels = [f"{h:g} m, {each}, {g} kN/m³" for h, each, g in SCENES]
    return {
        "splitting/sums": Table(
            "splitting",
            ["", "split", "rebase, quadrilaterals", "rebase, hexahedra"],
            {label: partial(differences, names) for label, names in SUMS.items()},
        ),
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
        ),
    }
