# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of docs/validation.md: cases beside exact solutions and published results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

from case_runs import Table, run, scientific

type Result = Mapping[str, Any]


class Value(NamedTuple):
    """A result that is known, and two runs of it.

    Attributes:
        key: Of the case's JSON, or what gets it from there.
        known: What is right; a key of the JSON, or a number.
        coarse: The case and its options.
        fine: What is added, or differs, on the finer grid.
        digits: After the point.
    """

    key: str | Callable[[Result], float]
    known: str | float
    coarse: str
    fine: str
    digits: int = 3


class Error(NamedTuple):
    """An error that a case finds beside an exact solution, and two runs of it."""

    key: str | Callable[[Result], float]
    coarse: str
    fine: str


@cache
def result(command: str) -> Result:
    case, *options = command.split()
    return run(case, *options)


def found(row: Value | Error) -> list[Any]:
    """Return what stands right of a label."""
    command = f"{row.coarse} {row.fine}"  # (of an option that is given twice the last one counts)
    coarse, fine = result(row.coarse), result(command)
    done = [one["completed"] for one in (coarse, fine)]

    def get(what: str | Callable[[Result], float], one: Result) -> float:
        return what(one) if callable(what) else float(one[what])

    asked = f"`{_once(command)}`"
    if isinstance(row, Error):
        shown = [
            percent(get(row.key, one)) if whole else "stops"
            for one, whole in zip((coarse, fine), done, strict=True)
        ]
        return ["", *shown, "", asked]
    known = row.known if isinstance(row.known, float) else get(row.known, fine)
    values = [get(row.key, one) for one in (coarse, fine)]
    shown = [
        f"{value:.{row.digits}f}" if whole else "stops"
        for value, whole in zip(values, done, strict=True)
    ]
    off = round(100.0 * (values[1] / known - 1.0), 2) + 0.0  # (no -0.00)
    return [f"{known:.{row.digits}f}", *shown, f"{off:+.2f} %" if done[1] else "", asked]


def _once(command: str) -> str:
    """Return a command in which each option stands once, as it was given last."""
    case, *words = command.split()
    kept: dict[str, list[str]] = {}
    for word in words:
        if word.startswith("--"):
            kept.pop(word, None)
            kept[word] = [word]
        else:
            kept[next(reversed(kept))].append(word)
    return " ".join([case, *(word for words in kept.values() for word in words)])


def percent(share: float) -> str:
    """Return a relative error, in percent where that can be read."""
    return f"{100.0 * abs(share):.2g} %" if abs(share) >= 5e-5 else scientific(abs(share))


CLAMPED = "cantilever --degree 2 --cell 0.5", "--cell 0.25"
HERTZ = "sphere --cells 3", "--cells 6"
COLUMN = "column_roller --elements 16", "--elements 64"
STRIP = "strength --recommended --case"
WEDGE = "penetration --obstacle wedge --depth 0.5"
SHEARED = "notch --case shear --model AT2 --length 0.06 --body free --slit 0.125"
BLOCK = "spinning_block --turn 4 --angle 0.08", "--angle 0.04"

ELASTIC = {
    "Column that its weight shortens by half, stress; exact by Lambert's function": Error(
        "error", "compaction --elements 16", "--elements 64"
    ),
    "Cantilever, tip's deflection over length; converged finite elements": Value(
        "deflection", 0.825387, *CLAMPED, digits=4
    ),
    "Its shortening": Value("shortening", 0.554005, *CLAMPED, digits=4),
    "Shallow arch that snaps through, load; converged finite elements": Error(
        "error", "snap_through --cell 0.1", "--cell 0.05"
    ),
    "Thick tube under pressure, radii; ordinary differential equation": Error(
        "error_axisymmetric", "cylinder --elements 8", "--elements 16"
    ),
    "Its stress": Error(
        lambda one: one["error_stress_axisymmetric"][-1], "cylinder --elements 8", "--elements 16"
    ),
    "Cantilever as finite elements; stock DOLFINx": Error(
        "difference", "free_body --scene cantilever", "--degree 2"
    ),
    "Rigid sphere on a half-space, force (Hertz 1882)": Error("error_force", *HERTZ),
    "Radius of its contact": Error("error_radius", *HERTZ),
    "Its pressure": Error("error_pressure", *HERTZ),
    "Block on a rough plane, angle at which it slides (Coulomb)": Value(
        "stick_angle", "exact", "incline --tilt 30 --steps 20", "--steps 50"
    ),
}
PLASTIC = {
    "Column that yields between rollers, stress along; exact, finite strain": Error(
        "error_syy", *COLUMN
    ),
    "Stress across": Error("error_sxx", *COLUMN),
    "Tube widened to eight radii, pressure (Hill 1950)": Error(
        "error", "expansion --cells 4", "--cells 8"
    ),
    "Strip on clay, pressure over $(2 + \\pi)\\, c$ (Prandtl 1920)": Value(
        "ratio", 1.0, "footing --cell 0.25", "--cell 0.125"
    ),
    "Smooth wedge into clay, force (Hill, Lee & Tupper 1947)": Value(
        "ratio", 1.0, f"{WEDGE} --cell 0.125", "--cell 0.0625"
    ),
}
SOILS = {
    "$N_c$, undrained (Prandtl 1920)": Value(
        "factor", "exact", f"{STRIP} footing --friction-angle 0 --halvings 2", "--halvings 5"
    ),
    "$N_c$, 30° (Prandtl 1920)": Value(
        "factor", "exact", f"{STRIP} footing --friction-angle 30 --halvings 2", "--halvings 3", 2
    ),
    "$N_q$, 30° (Reissner 1924)": Value(
        "factor",
        "exact",
        f"{STRIP} footing_surcharge --friction-angle 30 --halvings 2",
        "--halvings 3",
        2,
    ),
    "$N_\\gamma$, 20°, smooth (Martin 2005)": Value(
        "factor",
        "exact",
        f"{STRIP} footing_weight --friction-angle 20 --halvings 3",
        "--halvings 5",
    ),
    "$N_\\gamma$, 30°, smooth (Martin 2005)": Value(
        "factor",
        "exact",
        f"{STRIP} footing_weight --friction-angle 30 --halvings 2",
        "--halvings 3",
        2,
    ),
    "$N_\\gamma$, 30°, rough (Martin 2005)": Value(
        "factor",
        "exact",
        f"{STRIP} footing_weight --friction-angle 30 --rough --halvings 2",
        "--halvings 3",
        2,
    ),
    "Circle on clay, smooth (Cox, Eason & Hopkins 1961)": Value(
        "factor", "exact", f"{STRIP} circle --halvings 2", "--halvings 5"
    ),
    "Circle on clay, rough (Eason & Shield 1960)": Value(
        "factor", "exact", f"{STRIP} circle --rough --halvings 2", "--halvings 5"
    ),
    "Vertical cut, $\\gamma H / c$ (bounds 3.775 and 3.786)": Value(
        "factor", "exact", f"{STRIP} vertical_cut --cell 0.125", "--cell 0.0625"
    ),
    "Pipe deep in clay, smooth (Randolph & Houlsby 1984)": Value(
        "factor", "exact", "pipe --cell 0.166667", "--cell 0.083333"
    ),
    "Pipe deep in clay, rough (Randolph & Houlsby 1984)": Value(
        "factor", "exact", "pipe --rough --cell 0.166667", "--cell 0.083333"
    ),
    "Slope 2:1, factor of safety (Griffiths & Lane 1999, example 1)": Value(
        "factor", "exact", "strength --case slope --cell 0.1", "--cell 0.05"
    ),
}
WATER = {
    "Seepage under a sheet pile, half as deep as its layer, discharge (Harr 1962)": Value(
        "discharge", "exact", "seepage --cell 0.25", "--cell 0.125", 4
    ),
    "That slope under water, factor of safety (Griffiths & Lane 1999, example 5)": Value(
        "factor", "exact", "strength --case slope --water 0 --cell 0.1", "--cell 0.05"
    ),
    "Water lowered slowly by 0.7 of its height": Value(
        "factor", "exact", "strength --case slope --water 0.7 --cell 0.1", "--cell 0.05"
    ),
    "Dam on its foundation, factor of safety (their example 6)": Value(
        "factor", "exact", "strength --case dam --cell 0.125", "--cell 0.083333"
    ),
    "With a reservoir, 0.8 of its height": Value(
        "factor",
        "exact",
        "strength --case dam --water 0.197 --cell 0.125",
        "--cell 0.083333",
    ),
    "Column, pressure (Terzaghi 1943)": Error(
        "pressure_error", "consolidation --cell 0.125 --steps 16", "--cell 0.0625 --steps 64"
    ),
    "Its degree of consolidation": Error(
        "settlement_error", "consolidation --cell 0.125 --steps 16", "--cell 0.0625 --steps 64"
    ),
    "Slab between plates, largest pressure (Mandel 1953)": Value(
        "peak", "exact", "mandel_cryer --case slab --cells 4", "--cells 8 --steps 56", 4
    ),
    "Sphere, largest pressure (Cryer 1963)": Value(
        "peak",
        "exact",
        "mandel_cryer --case sphere --cells 8 --steps 56",
        "--cells 16 --steps 112",
        4,
    ),
}
MOTION = {
    "Bar that vibrates and flies, displacement over amplitude; exact": Error(
        "displacement_error",
        "flying_bar --cell 0.125 --dt 0.04 --steps 250",
        "--cell 0.0625 --dt 0.02 --steps 500",
    ),
    "Generalised vortex, displacement (Kamojjala et al. 2015)": Error(
        "displacement_error", "vortex --cell 0.0625 --steps 40", "--cell 0.03125 --steps 80"
    ),
    "Its velocity": Error(
        "velocity_error", "vortex --cell 0.0625 --steps 40", "--cell 0.03125 --steps 80"
    ),
    "Discs that collide, change of energy (Sulsky, Chen & Schreyer 1994)": Error(
        "energy_change", "colliding_discs --cell 0.1", "--cell 0.05"
    ),
    "Block that spins, change of energy": Error("energy_change", *BLOCK),
    "Its angular momentum": Error("angular_momentum_change", *BLOCK),
}
CRACKS = {
    "Notched square, sheared, force; PhaseFieldX on DOLFINx": Value(
        "peak", 0.4947, f"{SHEARED} --cells 4 --steps 48 --reach 0.0096", "--cells 6", 4
    ),
    "L-shaped panel, carried, force; stock DOLFINx": Value(
        "peak", 15.998, "notch --case l-panel --steps 25 --reach 0.5 --cells 1", "--cells 2", 2
    ),
}


def table(rows: Mapping[str, Value | Error]) -> Table:
    cases = {row.coarse.split()[0]: None for row in rows.values()}
    return Table(
        "validation",
        ["", "known", "coarse", "fine", "off", "`benchmarks/cases/`, fine"],
        {label: partial(found, row) for label, row in rows.items()},
        cases=list(cases),
    )


def tables() -> dict[str, Table]:
    groups = {
        "elastic": ELASTIC,
        "plastic": PLASTIC,
        "soils": SOILS,
        "water": WATER,
        "motion": MOTION,
        "cracks": CRACKS,
    }
    return {f"validation/{name}": table(rows) for name, rows in groups.items()}
