# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of docs/locking-measured.md."""

from __future__ import annotations

from functools import partial
from typing import Any

from case_runs import Table, run, scientific, share

FOOTING = {
    "one point": "--f-bar none --quadrature-degree 1",
    "2 by 2 points": "--f-bar none",
    '2 by 2 points, `"domain"`': "--f-bar domain",
    "triangles": "--f-bar none --domain tri",
    'one point, `"patch"`': "--f-bar patch --quadrature-degree 1",
    '2 by 2 points, `"patch"`': "--f-bar patch",
    'triangles, `"patch"`': "--f-bar patch --domain tri",
    "degree 2": "--f-bar none --degree 2",
    'degree 2, `"domain"`': "--f-bar domain --degree 2",
    'degree 2, `mixed="pressure"`': "--mixed pressure --degree 2",
    'one point, `"stabilised pressure"`': "--mixed stabilised --quadrature-degree 1",
    '2 by 2 points, `"stabilised pressure"`': "--mixed stabilised",
}
STRIPS = {
    "facets of the soil": "--strip body",
    "facets, small strain": "--strip body --small-strain",
    "nodes of the background": "--strip background",
    "nodes, small strain": "--strip background --small-strain",
}
ONE = "--particles-per-cell 1 --stabilisation none"
EDGES = {
    "one domain, `None`": (ONE, (0, 0)),
    "one domain, `None`, finer": (ONE, (2, 1)),
    "one domain, ghost penalty, finer": ("--particles-per-cell 1", (2, 1)),
    "2 by 2, ghost penalty, finer": ("", (2, 1)),
}
BEAM = {
    'one point, `"patch"`': "--quadrature-degree 1 --f-bar patch",
    '2 by 2 points, `"patch"`': "--quadrature-degree 2 --f-bar patch",
    'triangles, `"patch"`': "--domain tri --f-bar patch",
    "degree 2": "--degree 2",
    'degree 2, `"domain"`': "--degree 2 --f-bar domain",
    'one point, `"stabilised pressure"`': "--mixed stabilised --quadrature-degree 1",
    '2 by 2 points, `"stabilised pressure"`': "--mixed stabilised --quadrature-degree 2",
}
MIXED = [(0.5, 0.0), (0.5, 0.1), (0.5, 0.37), (0.5, 2e-9), (0.25, 0.0), (0.25, 0.37)]
TUBE = {
    '`mixed="pressure"`': "",
    "shifted by 0.37 cells": "--offset 0.37",
    "cells of half the wall, shifted": "--offset 0.37 --cells 2",
    "displacements alone": "--mixed none",
    "displacements alone, shifted": "--mixed none --offset 0.37",
    'degree 1, `"patch"`, shifted': "--mixed none --degree 1 --f-bar patch --offset 0.37",
}
COLUMNS = {
    'quadrilaterals, `"domain"`': "--f-bar domain",
    'quadrilaterals, `"patch"`': "--f-bar patch",
    'triangles, `"patch"`': "--f-bar patch --domain tri",
}
BLOCK = {
    "none, 3 by 3": "--particles-per-cell 3",
    "none, 6 by 6": "--particles-per-cell 6",
    '`"patch"`, 3 by 3': "--particles-per-cell 3 --f-bar patch",
    '`"patch"`, 6 by 6': "--particles-per-cell 6 --f-bar patch",
}


def words(options: str) -> list[str]:
    """Return options one by one, of which some are two words."""
    return ["stabilised pressure" if word == "stabilised" else word for word in options.split()]


def footing(options: str) -> list[Any]:
    found = []
    for cell in (0.25, 0.125):
        r = run("footing", "--cell", cell, *words(options))
        found += [share(r, f"{r['ratio']:.3f} ({100 * r['plateau']:.1f} %)"), r["iterations"]]
    return found


def strip(options: str, finer: tuple[int, int] = (0, 0)) -> list[Any]:
    found: list[Any] = []
    for cell, times in zip((0.25, 0.125), finer, strict=True):
        asked = ["--mixed", "pressure", "--degree", 2, "--finer", times, *options.split()]
        r = run("footing", "--cell", cell, *asked)
        found.append(share(r, f"{r['peak']:.4f}, {r['ratio']:.4f} ({100 * r['drop']:.2f} %)"))
        found.append(f"{r['iterations']} ({r['most_solves']})")
    return found


def beam(options: str) -> list[Any]:
    results = [
        run("cantilever", "--poisson", 0.4999, "--cell", cell, *words(options))
        for cell in (0.5, 0.25)
    ]
    errors = [share(r, scientific(r["error"])) for r in results]
    return [*errors, ", ".join(str(r["iterations"]) for r in results)]


def mixed(cell: float, offset: float) -> list[Any]:
    options = ["--poisson", 0.4999, "--degree", 2, "--mixed", "pressure"]
    r = run("cantilever", *options, "--cell", cell, "--offset", offset * cell)
    return [share(r, scientific(r["error"])), r["iterations"], r["cutbacks"]]


def tube(options: str) -> list[Any]:
    r = run("expansion", *words(options))
    errors = [scientific(r[key]) for key in ("error_early", "error")]
    return [*errors, r["iterations"], r["cutbacks"]]


def columns(options: str) -> list[str]:
    """Return errors over those of the same domains without an average."""
    kind = ["--domain", "tri"] if "tri" in options else []
    asked = ["--elements", 16, *options.split()]
    r, plain = run("column_roller", *asked), run("column_roller", "--elements", 16, *kind)
    return [f"{r[key] / plain[key]:.2f}" for key in ("error_syy", "error_sxx")]


def block(options: str) -> list[Any]:
    found = []
    for cell in (1.0, 2.0):
        r = run("collapse", "--cell", cell, *options.split())
        found += [share(r, f"{-r['u_top']:.3f}, {r['u_toe']:.3f}"), r["iterations"]]
    return found


def tables() -> dict[str, Table]:
    beside = ["cells of 0.25 m", "solves", "0.125 m", "solves"]
    return {
        "locking/footing": Table(
            "locking-measured",
            ["", *beside],
            {name: partial(footing, options) for name, options in FOOTING.items()},
            cases=["footing"],
        ),
        "locking/strip": Table(
            "locking-measured",
            ["the strip holds", *beside],
            {name: partial(strip, options) for name, options in STRIPS.items()},
            cases=["footing"],
        ),
        "locking/edge": Table(
            "locking-measured",
            ["domains in a cell, `stabilisation`", *beside],
            {name: partial(strip, *asked) for name, asked in EDGES.items()},
            cases=["footing"],
        ),
        "locking/cantilever": Table(
            "locking-measured",
            ["", "cells of 0.5 m", "0.25 m", "linear solves"],
            {name: partial(beam, options) for name, options in BEAM.items()},
            cases=["cantilever"],
        ),
        "locking/mixed": Table(
            "locking-measured",
            ["cells; the beam is lower by", "larger error", "linear solves", "cutbacks"],
            {
                f"{h:g} m; {scientific(o, 0) if 0.0 < o < 1e-3 else format(o, 'g')} cells": partial(
                    mixed, h, o
                )
                for h, o in MIXED
            },
            quick=["0.5 m; 0 cells"],
            cases=["cantilever"],
        ),
        "locking/expansion": Table(
            "locking-measured",
            ["", "radius 1.02", "1.5 to 8.5, largest", "linear solves", "cutbacks"],
            {name: partial(tube, options) for name, options in TUBE.items()},
            quick=list(TUBE)[:1],
            cases=["expansion"],
        ),
        "locking/columns": Table(
            "locking-measured",
            ["", "stress along", "across"],
            {name: partial(columns, options) for name, options in COLUMNS.items()},
            quick=list(COLUMNS)[:1],
            cases=["column_roller"],
        ),
        "locking/collapse": Table(
            "locking-measured",
            ["average, domains in a cell", "cells of 1 m: top, toe", "solves", "2 m", "solves"],
            {name: partial(block, options) for name, options in BLOCK.items()},
            quick=list(BLOCK)[:1],
            cases=["collapse"],
        ),
    }
