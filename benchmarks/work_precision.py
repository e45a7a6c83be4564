# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Run time against error: columns, a cantilever, flow, contact, motion, beside finite elements.

Each point is a process of its own on one thread. Its CPU seconds (user and system) are those of
start-up (imports, meshes, forms from FFCx's cache), of the run (load steps), and of the whole
process; of several processes the one that took least counts. A process that compiled a form is
run again. Other codes' points are CPU seconds of their whole processes on the same cases. Finite
elements are those of stock DOLFINx on the mesh of the body (`finite_elements.py`).
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "work_precision.json"
IMAGES = HERE.parent / "docs" / "images"


class Kind(NamedTuple):
    """Domains and their method, and how they are drawn."""

    domain: str
    method: str
    degree: int
    name: str
    colour: str
    marker: str
    f_bar: str = "none"


KINDS = {
    "quad1": Kind("quad", "cpdi2", 1, "CPDI2 quads, degree 1", "#0072B2", "o"),
    "tri1": Kind("tri", "cpdi2", 1, "CPDI2 triangles, degree 1", "#56B4E9", "^"),
    "fbar": Kind("quad", "cpdi2", 1, "CPDI2 quads, F-bar", "#332288", "X", "domain"),
    "gimp": Kind("quad", "gimp", 1, "GIMP", "#009E73", "D"),
    "mpm": Kind("quad", "mpm", 1, "point MPM", "#CC79A7", "v"),
    "quad2": Kind("quad", "cpdi2", 2, "quads, degree 2", "#D55E00", "s"),
    "tri2": Kind("tri", "cpdi2", 2, "triangles, degree 2", "#E69F00", ">"),
    "quad3": Kind("quad", "cpdi2", 3, "quads, degree 3", "#882255", "P"),
    "hex1": Kind("hex", "cpdi2", 1, "CPDI2 hexahedra, degree 1", "#0072B2", "o"),
    "hexf": Kind("hex", "cpdi2", 1, "CPDI2 hexahedra, F-bar", "#332288", "X", "domain"),
    "hex2": Kind("hex", "cpdi2", 2, "hexahedra, degree 2", "#D55E00", "s"),
    "equal": Kind("quad", "cpdi2", 1, "equal steps", "#0072B2", "o"),
    "auto": Kind("quad", "cpdi2", 1, "automatic steps", "#D55E00", "s"),
    "equal-tri": Kind("tri", "cpdi2", 1, "equal steps, triangles", "#56B4E9", "^"),
    "auto-tri": Kind("tri", "cpdi2", 1, "automatic steps, triangles", "#E69F00", ">"),
    "free1": Kind("body", "fem", 1, "finite element body, degree 1", "#117733", "o"),
    "free2": Kind("body", "fem", 2, "finite element body, degree 2", "#117733", "s"),
    "adapt1": Kind("body", "adapted", 1, "nodes freed, degree 1", "#AA4499", "D"),
    "adapt2": Kind("body", "adapted", 2, "nodes freed, degree 2", "#AA4499", "P"),
    "fem1": Kind("", "stock", 1, "stock DOLFINx, degree 1", "0.0", "o"),
    "fem2": Kind("", "stock", 2, "stock DOLFINx, degree 2", "0.0", "s"),
}

# Coarse to fine: background cells over the height (A, B), over the width (D), over 1 m (P, V), in
# half of the width that touches (H); size of a cell in m (C, E); steps or tolerances (F).
SIZES: dict[str, dict[str, list[float]]] = {
    "A": {
        "quad1": [16, 64, 256, 1024, 4096],
        "tri1": [16, 64, 256, 1024],
        "gimp": [16, 64, 256, 1024],
        "mpm": [16, 64, 256],
        "quad2": [4, 8, 16, 32, 64, 128],
        "tri2": [8, 16, 32, 64],
        "quad3": [4, 8, 16, 32],
        "free1": [8, 32, 128, 512],
        "free2": [2, 4, 8, 16, 32],
    },
    "B": {
        "quad1": [16, 64, 256, 1024],
        "tri1": [16, 64, 256],
        "gimp": [16, 64, 256],
        "mpm": [16, 64],
        "quad2": [8, 16, 32, 64, 128],
        "tri2": [8, 16, 32],
        "quad3": [4, 8, 16, 32],
        "free1": [8, 32, 128, 512],
        "free2": [4, 8, 16, 32],
    },
    "C": {
        "quad1": [1.0, 0.5, 0.25],
        "tri1": [1.0, 0.5, 0.25, 0.125],
        "fbar": [1.0, 0.5, 0.25],
        "gimp": [1.0, 0.5],
        "quad2": [2.0, 1.0, 0.5],
        "tri2": [2.0, 1.0],
        "free1": [2.0, 1.0, 0.5, 0.25],
        "free2": [2.0, 1.0, 0.5],
        "fem1": [2.0, 1.0, 0.5, 0.25],
        "fem2": [2.0, 1.0, 0.5],
    },
    "D": {
        "hex1": [1, 2, 4, 8],
        "hex2": [1, 2, 4],
        "free1": [1, 2, 4, 8],
        "free2": [1, 2],
        "fem1": [1, 2, 4, 8],
        "fem2": [1, 2],
    },
    "E": {
        "quad1": [0.5, 0.25, 0.125, 0.0625],
        "tri1": [0.5, 0.25, 0.125],
        "gimp": [0.5, 0.25],
        "mpm": [0.5, 0.25],
        "quad2": [1.0, 0.5, 0.25],
        "tri2": [1.0, 0.5, 0.25],
        "quad3": [1.0, 0.5],
        "free1": [0.5, 0.25, 0.125, 0.0625],
        "free2": [1.0, 0.5, 0.25],
        "fem1": [0.5, 0.25, 0.125, 0.0625],
        "fem2": [1.0, 0.5, 0.25],
    },
    "F": {
        "equal": [10, 20, 40, 80, 160],
        "auto": [0.04, 0.02, 0.01, 0.005],
        "equal-tri": [10, 20, 40, 80, 160],
        "auto-tri": [0.04, 0.02, 0.01, 0.005],
    },
    "H": {
        "quad1": [4, 8, 16, 32],
        "quad2": [2, 4, 8],
        "free1": [4, 8, 16, 32],
        "free2": [2, 4, 8, 16],
        "fem1": [4, 8, 16, 32],
        "fem2": [2, 4, 8, 16],
    },
    "P": {
        "hex1": [2, 4, 8],
        "hexf": [2, 4, 8],
        "hex2": [1, 2, 4],
        "free1": [2, 4, 8],
        "free2": [1, 2, 3],
        "fem1": [2, 4, 8],
        "fem2": [1, 2, 3],
    },
    "V": {
        "quad1": [8, 16, 32],
        "quad2": [4, 8],
        "free1": [8, 16, 32],
        "free2": [4, 8, 16],
        "fem1": [8, 16, 32],
        "fem2": [4, 8, 16],
    },
}
SMOKE: dict[str, dict[str, list[float]]] = {
    "A": {"quad1": [4, 8], "quad2": [4]},
    "B": {"quad1": [4]},
    "C": {"quad1": [2.0]},
    "D": {"hex1": [1], "free1": [1], "fem1": [1]},
    "E": {"quad1": [1.0]},
    "F": {"equal": [4], "auto": [0.1]},
    "H": {"quad1": [2], "free1": [2], "fem1": [2]},
    "P": {"hex1": [1], "fem1": [1]},
    "V": {"quad1": [4], "free2": [2], "fem1": [4]},
}
#: The runs that those of C and of both kinds of F are compared with.
REFERENCES: dict[tuple[str, str], tuple[str, float, float]] = {
    ("C", ""): ("fbar", 0.125, 1.0),
    ("F", "equal"): ("equal", 640, 8),
    ("F", "equal-tri"): ("equal-tri", 640, 8),
}

#: How much faster AMPLE would be in MATLAB, which it is written for: an estimate.
MATLAB = 12.0
# Other codes: CPU seconds of the whole process, error.
PEERS: dict[str, dict[str, list[tuple[float, float]]]] = {
    "A": {
        "AMPLE in Octave, GIMP": [(13.8, 3.66e-3), (50, 4.36e-4), (263, 1.03e-4)],
        "AMPLE, point MPM": [(18, 8.7e-2), (81, 8.3e-2)],
        "GeoWarp, GIMP (and 105 s once)": [(4.4, 3.66e-3), (7.8, 4.36e-4), (24.6, 1.03e-4)],
        "Kratos, point MPM": [(0.45, 7.3e-2), (0.87, 8.1e-2), (3.0, 8.1e-2)],
    },
    "B": {
        "AMPLE in Octave, GIMP": [(19, 3.84e-3), (35, 1.49e-3), (75, 5.19e-4)],
        "AMPLE, point MPM": [(18, 1.1e-1), (69, 1.0e-1)],
    },
    "E": {"AMPLE in Octave, GIMP, ghost penalty": [(81, 1.01e-2), (314, 4.7e-3), (1255, 1.6e-3)]},
}


# ## One point


def point(case: str, kind: str, size: float, steps: int | None) -> None:
    """Run a scene in this process and print what it took and what came out."""
    from mpi4py import MPI  # noqa: F401

    import mpm_dolfinx as mpm

    scene = made(case, kind, size, steps)
    start = time.process_time()
    failure = None
    try:
        scene.solve()
    except mpm.MPMError as error:
        failure = type(error).__name__
    end = time.process_time()
    compiler = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(
        json.dumps(
            {
                "startup": start,
                "run": end - start,
                "compiler": compiler.ru_utime + compiler.ru_stime,
                **scene.account(),
                "failure": failure,
                **scene.measure(),
            }
        )
    )


def made(case: str, kind: str, size: float, steps: int | None = None) -> Any:
    """Return a scene, before its first step."""
    import finite_elements
    import scenes

    domain, method, degree = KINDS[kind][:3]
    options: dict[str, Any] = {} if steps is None else {"steps": steps}
    if KINDS[kind].f_bar != "none":
        options["f_bar"] = KINDS[kind].f_bar
    if method == "stock":
        return finite_elements.CASES[case](size, degree, **options)
    if domain == "body":
        domain = "hex" if case in ("D", "P") else "quad"
    return scenes.CASES[case](size, domain, method, degree, **options)


def process(arguments: dict[str, Any]) -> dict[str, Any]:
    """Run a point in a process of its own."""
    child = subprocess.Popen(
        [sys.executable, str(Path(__file__).resolve()), "--point", json.dumps(arguments)],
        stdout=subprocess.PIPE,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        text=True,
    )
    assert child.stdout is not None
    out = child.stdout.read()
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode != 0:
        raise SystemExit(f"{arguments} ended with status {child.returncode}")
    return {**json.loads(out), "process": usage.ru_utime + usage.ru_stime}


def measured(case: str, kind: str, size: float, steps: int | None, repeats: int) -> dict[str, Any]:
    """The least of several processes; one that takes long is not repeated."""
    arguments = {"case": case, "kind": kind, "size": size, "steps": steps}
    row = process(arguments)
    if row["compiler"] > 0.1:
        row = process(arguments)
    rows = [row]
    if row["process"] < 5.0:
        rows += [process(arguments) for _ in range(repeats - 1)]
    best = min(rows, key=lambda row: row["process"])
    return {"case": case, "kind": kind, "size": size, **best}


# ## All points


def run(cases: list[str], smoke: bool, repeats: int, quiet: bool) -> list[dict[str, Any]]:
    steps = 4 if smoke else None
    rows: list[dict[str, Any]] = []

    def add(case: str, kind: str, size: float, reference: Any = None) -> dict[str, Any]:
        row = measured(case, kind, size, steps, repeats)
        rows.append({k: v for k, v in row.items() if k != "displacement"})
        if reference is not None:
            rows[-1]["error"] = difference(row, reference)
        shown = rows[-1]
        if not quiet:
            said = row["failure"] or ", ".join(
                f"{name} {shown[name]:.3e}" for name in ("error", "y_mean") if name in shown
            )
            print(
                f"{case} {kind:9s} {size:8g} {row['particles']:8d} particles"
                f" {row['startup']:7.2f} {row['run']:8.2f} {row['process']:8.2f} s"
                f" {row['iterations']:5d} solves {row['cutbacks']:3d} cutbacks  {said}",
                flush=True,
            )
        return row

    if not quiet:
        print("CPU seconds of start-up, run, whole process")
    for case in cases:
        reference = None
        for kind, sizes in (SMOKE if smoke else SIZES)[case].items():
            first = "" if reference is None else kind
            for key in ((case, first), (case, kind)):
                if key in REFERENCES:
                    of, size, tiny = REFERENCES[key]
                    reference = add(case, of, tiny if smoke else size)
                    rows[-1]["reference"] = True
                    break
            for size in sizes:
                add(case, kind, size, reference)
    return rows


def difference(row: dict[str, Any], reference: dict[str, Any]) -> float:
    """Return how far a run ends from its reference: mean heights, or all displacements."""
    if "y_mean" in row:
        return float(abs(row["y_mean"] / reference["y_mean"] - 1.0))
    off = [
        (a - b) ** 2 for a, b in zip(*(r["displacement"] for r in (row, reference)), strict=True)
    ]
    return math.sqrt(sum(off) / sum(b * b for b in reference["displacement"]))


def machine() -> dict[str, Any]:
    """Return what the runs were made on."""
    from mpi4py import MPI  # noqa: F401

    import dolfinx

    names = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "dolfinx": dolfinx.__version__,
        "python": platform.python_version(),
    }


def curve(rows: list[dict[str, Any]], case: str, kind: str) -> list[dict[str, Any]]:
    """The complete runs of a kind that have an error, coarse to fine."""
    return [
        row
        for row in rows
        if (row["case"], row["kind"]) == (case, kind)
        and not row["failure"]
        and "error" in row
        and "reference" not in row
    ]


def seconds_at(points: list[dict[str, Any]], error: float) -> dict[str, Any] | None:
    """CPU seconds at an error, by log-log interpolation or from the last two points on.

    None where the error is out of reach: more than 100 times the seconds of the last point.
    """
    if len(points) < 2:
        return None
    line = [(math.log(row["error"]), math.log(row["run"])) for row in points]
    target = math.log(error)
    inside = (pair for pair in pairwise(line) if pair[0][0] >= target >= pair[1][0])
    pair = next(inside, None)
    if target >= line[0][0]:
        run, at = points[0]["run"], "coarsest point"
    else:
        (e0, t0), (e1, t1) = pair or line[-2:]
        if e1 >= e0:
            return None
        log_run = t1 + (t1 - t0) / (e1 - e0) * (target - e1)
        if log_run > line[-1][1] + math.log(100.0):
            return None
        run, at = math.exp(log_run), "interpolated" if pair else "extrapolated"
    return {"run": run, "process": run + points[-1]["process"] - points[-1]["run"], "at": at}


AT = {
    "A": (1e-4, 1e-5, 1e-6, 1e-7),
    "B": (1e-4, 1e-5),
    "C": (2e-2, 1e-2),
    "D": (1e-3, 2e-4, 5e-5),
    "E": (1e-3, 2e-4),
    "F": (3e-2, 1e-2),
    "H": (4e-2, 2e-2),
    "P": (5e-2, 2e-2),
    "V": (5e-2, 1e-2),
}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """CPU seconds of run and process at errors, for each kind of a case."""
    table = {
        f"{case} at {error:g}": {
            kind: found
            for kind in KINDS
            if (found := seconds_at(curve(rows, case, kind), error)) is not None
        }
        for case, errors in AT.items()
        for error in errors
    }
    return {name: entry for name, entry in table.items() if entry}


# ## Pictures

TITLES = {
    "A": "Elastic column, compacted to half",
    "B": "Elasto-plastic column between rollers",
    "C": "Elasto-plastic column, collapsing",
    "D": "Elastic column in space",
    "E": "Cantilever, large deflection",
    "F": "Column that collapses: load steps",
    "H": "Rigid disc on an elastic block (Hertz)",
    "P": "Von Mises block in space, rough plates",
    "V": "Vortex (dynamics)",
}
ERRORS = {
    "A": "mean error of stress",
    "B": "mean error of stress",
    "C": "relative error of mean height",
    "D": "error of displacements (L2), over the largest",
    "E": "error of the tip, over the length",
    "F": "error of the displacement, 640 steps as reference",
    "H": "error of the pressure (L2)",
    "P": "error of the force on a plate",
    "V": "error of displacements (L2), over the largest",
}
UNSURE = {"C": 1e-2, "E": 1e-4}  # errors below are as large as the reference's own
GREY = "0.5"


def draw(rows: list[dict[str, Any]], cases: list[str], key: str, path: Path) -> None:
    """Draw error over CPU seconds, log-log, a panel for each case that was run."""
    cases = [case for case in cases if any(curve(rows, case, kind) for kind in KINDS)]
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(
        {
            "font.size": 13,
            "axes.titlesize": 14,
            "axes.titleweight": "bold",
            "axes.titlelocation": "left",
            "axes.spines.top": False,
            "axes.spines.right": False,
        }
    )
    columns = 2 if len(cases) > 1 else 1
    lines = math.ceil(len(cases) / columns)
    fig, axes = plt.subplots(
        lines, columns, figsize=(7.5 * columns, 6.0 * lines), layout="constrained", squeeze=False
    )
    for ax in axes.flat[len(cases) :]:
        ax.remove()
    for ax, case in zip(axes.flat, cases, strict=False):
        panel(ax, rows, case, key)
    what = "whole process" if key == "process" else "run, without start-up"
    for ax in axes[-1]:
        ax.set_xlabel(f"CPU seconds, {what}")
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=100)
    plt.close(fig)


def panel(ax: Any, rows: list[dict[str, Any]], case: str, key: str) -> None:
    """One case: this package in colours, other codes in grey, each curve with its name."""
    names = []
    if key == "process":
        for name, points in PEERS.get(case, {}).items():
            ax.loglog(*zip(*points, strict=True), "o-", color=GREY, ms=6, lw=1.5, zorder=1)
            names.append((name, points, GREY))
            if name.startswith("AMPLE") and "point" not in name:
                faster = [(seconds / MATLAB, error) for seconds, error in points]
                ax.loglog(*zip(*faster, strict=True), ":", color=GREY, lw=1.5, zorder=1)
                names.append(("in MATLAB, estimated", faster, GREY))
    for name, kind in KINDS.items():
        points = [(row[key], row["error"]) for row in curve(rows, case, name)]
        if points:
            x, y = zip(*points, strict=True)
            ax.loglog(x, y, "-", marker=kind.marker, color=kind.colour, ms=8, lw=2.2, zorder=2)
            names.append((kind.name, points, kind.colour))
    ax.set_title(f"{TITLES[case]}\n")
    ax.text(0.0, 1.02, ERRORS[case], transform=ax.transAxes, color="0.3")
    ax.grid(which="major", color="0.92")
    if key == "process":
        ax.set_xlim(left=0.25)
    label(ax, names)
    left, right = ax.get_xlim()
    ticks = marked(left, right)
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    bottom, top = ax.get_ylim()
    if top < 200 * bottom:
        ticks = marked(bottom, top)
        ax.set_yticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    if case in UNSURE:
        ax.axhspan(ax.get_ylim()[0], UNSURE[case], color="0.95", zorder=0)
        ax.annotate(
            "less than the reference is sure of",
            (1.0, 0.0),
            (-4, 4),
            xycoords="axes fraction",
            textcoords="offset points",
            ha="right",
            va="bottom",
            color=GREY,
            fontsize=11,
        )
    if key == "process":
        startup = min(row["process"] - row["run"] for row in rows if row["case"] == case)
        ax.axvspan(left, startup, color="0.95", zorder=0)
        at = (math.sqrt(left * startup), math.sqrt(math.prod(ax.get_ylim())))
        ax.text(*at, "start-up", rotation=90, ha="center", va="center", color=GREY, fontsize=11)


def marked(low: float, high: float) -> list[float]:
    """Return the round numbers between two at which a logarithmic axis has ticks."""
    digits = range(1, 10) if high < 6 * low else (1, 2, 5) if high < 200 * low else (1,)
    ticks = [float(f"{digit}e{power}") for power in range(-9, 5) for digit in digits]
    return [tick for tick in ticks if low <= tick <= high]


def label(ax: Any, names: list[tuple[str, list[tuple[float, float]], str]]) -> None:
    """Write each name beside its curve where it covers no point and no other name."""
    import numpy as np

    left, right = ax.get_xlim()
    bottom, top = ax.get_ylim()
    ax.set_xlim(left, right * (right / left) ** 0.1)
    ax.set_ylim(bottom / (top / bottom) ** 0.05, top * (top / bottom) ** 0.06)
    ax.figure.canvas.draw()
    renderer = ax.figure.canvas.get_renderer()
    place = ax.transData.transform
    fine = np.linspace(0.0, 1.0, 60)[:, None]
    corners = [place(np.array(points)) for _, points, _ in names]
    drawn = np.vstack([*corners, *(a + fine * (b - a) for xy in corners for a, b in pairwise(xy))])
    frame = ax.get_window_extent(renderer)
    towards = np.array([(1, 0), (1, 1), (1, -1), (0, 1), (0, -1), (-1, -1), (-1, 1), (-1, 0)])

    def covered(low: Any, high: Any, points: Any, near: float) -> Any:
        within = (points > low[:, None] - near) & (points < high[:, None] + near)
        return within.all(axis=2).sum(axis=1)

    boxes, costs = [], []
    for number, (text, _, _) in enumerate(names):
        mark = ax.text(left, bottom, text, fontsize=12)
        size = np.array(mark.get_window_extent(renderer).size)
        mark.remove()
        index, reach, way = (
            part.ravel() for part in np.indices((len(corners[number]), 4, len(towards)))
        )
        at = corners[number][index] + 11.0 * (reach + 1)[:, None] * towards[way]
        low = at - 0.5 * (1 - towards[way]) * size
        high = low + size
        cost = 2 * covered(low, high, drawn, 3) + 3.0 * reach - 0.5 * index
        for other, points in enumerate(corners):
            cost += 50 * covered(low, high, points, 5)
            cost += 0 if other == number else 20 * covered(low, high, points, 14)
        beyond = (low[:, 0] < frame.x0) | (high[:, 0] > frame.x1 + 20)
        beyond |= (low[:, 1] < frame.y0) | (high[:, 1] > frame.y1)
        boxes.append((low, high, corners[number][index]))
        costs.append(cost + 500 * beyond)
    crossing = {}  # whether a place of one name is too near to one of another
    for one, (low, high, _) in enumerate(boxes):
        for other, (first, last, _) in enumerate(boxes):
            if other != one:
                near = (low[:, None] < last + 6) & (high[:, None] > first - 6)
                crossing[one, other] = 100.0 * near.all(axis=2)
    found = (np.inf, [])
    random = np.random.default_rng(0)
    for _ in range(100):
        chosen = [int(np.argmin(cost)) for cost in costs]
        for one in [k for _ in range(4) for k in random.permutation(len(names))]:
            others = (crossing[one, k][:, chosen[k]] for k in range(len(names)) if k != one)
            chosen[one] = int(np.argmin(costs[one] + sum(others)))
        total = sum(cost[k] for cost, k in zip(costs, chosen, strict=True))
        total += sum(near[chosen[one], chosen[other]] for (one, other), near in crossing.items())
        found = min(found, (total, chosen))
    chosen = found[1]
    for (text, _, colour), (low, high, of), best in zip(names, boxes, chosen, strict=True):
        ax.annotate(
            text,
            ax.transData.inverted().transform(of[best]),
            0.5 * (low[best] + high[best]) - of[best],
            textcoords="offset pixels",
            ha="center",
            va="center",
            color=colour,
            fontsize=12,
        )


# ## Command line


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument(
        "--json",
        nargs="?",
        const="-",
        metavar="FILE",
        help="where to write the results, - or nothing for standard output; cases of an "
        "earlier run that are not asked for stay in it (default: "
        f"results/{RESULTS.name}; with --smoke nowhere)",
        default=argparse.SUPPRESS,
    )
    parser.add_argument("--cases", default=",".join(SIZES), help="which to run, e.g. A,E")
    parser.add_argument("--smoke", action="store_true", help="a few tiny runs, no pictures")
    parser.add_argument("--repeats", type=int, default=2, help="processes a point, least taken")
    parser.add_argument(
        "--draw", action="store_true", help="run nothing, draw the pictures of an earlier run"
    )
    parser.add_argument("--point", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.point:
        point(**json.loads(args.point))
        return
    cases = list(dict.fromkeys(args.cases.split(",")))
    if unknown := [case for case in cases if case not in SIZES]:
        parser.error(
            f"argument --cases: there is no case {unknown[0]!r}; choose from {','.join(SIZES)}"
        )
    if args.repeats < 1:
        parser.error("argument --repeats: must be 1 or more")
    target = getattr(args, "json", None) or (None if args.smoke else str(RESULTS))

    rows: list[dict[str, Any]] = []
    if target not in (None, "-") and Path(target).exists() and not args.smoke:
        old = json.loads(Path(target).read_text())["points"]
        rows = old if args.draw else [row for row in old if row["case"] not in cases]
    if not args.draw:
        rows += run(cases, args.smoke, 1 if args.smoke else args.repeats, target == "-")
    results = {"machine": machine(), "points": rows, "summary": summary(rows), "peers": PEERS}
    if target == "-":
        print(json.dumps(results))
    elif target is not None and not args.draw:
        Path(target).parent.mkdir(parents=True, exist_ok=True)
        Path(target).write_text(json.dumps(results, indent=1) + "\n")
    if target is not None and not args.smoke and Path(target) == RESULTS:
        draw(rows, ["A", "E"], "process", IMAGES / "work_precision.png")
        draw(rows, ["A", "B", "C", "E"], "run", IMAGES / "work_precision_run.png")
        draw(rows, ["D", "P", "V", "H"], "run", IMAGES / "work_precision_more.png")
        draw(rows, ["F"], "run", IMAGES / "work_precision_steps.png")


if __name__ == "__main__":
    main()
