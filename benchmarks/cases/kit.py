# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What the cases share: options, sums over ranks, the JSON object and the table, figures."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx import mesh
from dolfinx.fem.petsc import NonlinearProblem  # noqa: F401 (for cases)

import mpm_dolfinx as mpm
from mpm_dolfinx._compat import interpolation_points  # noqa: F401 (for cases)
from mpm_dolfinx.stepping.progress import with_bar

comm = MPI.COMM_WORLD

# All ranks parse the same command line; rank 0 alone prints help and complaints. A value that
# makes no sense ends the program with status 2, as `argparse` does.


class Parser(argparse.ArgumentParser):
    """The options that all cases have."""

    def __init__(self, description: str) -> None:
        super().__init__(
            description=description, formatter_class=argparse.ArgumentDefaultsHelpFormatter
        )
        self.add_argument("--json", action="store_true", help="print one JSON object, no more")
        self.add_argument("--plot", metavar="FILE.png", help="make a picture")

    def add_mixed(self) -> None:
        """Add the unknowns besides displacements."""
        self.add_argument(
            "--mixed",
            choices=("none", "pressure", "stabilised pressure"),
            default="none",
            help="the pressure as an unknown, of one degree less",
        )

    def add_f_bar(self, default: str = "none") -> None:
        """The options of the domains' rule and of averages of the volume ratio."""
        self.add_argument(
            "--quadrature-degree",
            type=whole,
            help="of the domains' rule: one point by default, 2 with an average over them",
        )
        self.add_argument("--f-bar", choices=F_BARS, default=default, help="average of volume")

    def add_order(self) -> None:
        """The options of the degrees of background and domains."""
        degrees = (1, 2, 3)
        self.add_argument(
            "--degree", type=int, choices=degrees, default=1, help="of the background"
        )
        self.add_argument(
            "--domain-degree", type=int, choices=degrees, help="of the domains; the same by default"
        )
        if "--quadrature-degree" not in self._option_string_actions:
            self.add_argument(
                "--quadrature-degree", type=whole, help="of the domains' rule; by their degree"
            )
        self.add_stabilisation()

    def add_steps(self, default: int) -> None:
        """Add the number of load steps, which an estimate of their error may choose."""
        self.add_argument("--steps", type=steps, default=default, help="load steps, or auto")
        self.add_argument("--tolerance", type=positive, default=1e-2, help="with --steps auto")

    def add_stabilisation(self) -> None:
        """Add the cures of badly supported dofs."""
        self.add_argument(
            "--stabilisation",
            choices=("auto", "ghost", "none"),
            default="auto",
            help="of badly supported dofs",
        )

    def _print_message(self, message: str, file: Any = None) -> None:
        if comm.rank == 0:
            super()._print_message(message, file)

    def parse(self) -> argparse.Namespace:
        """Parse the command line; from here on our errors are reported, not traced."""
        args = self.parse_args()
        if args.plot and not args.plot.lower().endswith(".png"):
            self.error(f"argument --plot: {args.plot!r} does not end in .png")
        if args.plot and find_spec("matplotlib") is None:
            self.error("argument --plot: needs matplotlib; pip install 'mpm-dolfinx[plot]'")
        given = {k: v for k, v in vars(args).items() if k != "plot"}
        args.default = all(v == self.get_default(k) for k, v in given.items())
        sys.excepthook = _reporting(args)
        return args


def whole(text: str) -> int:
    """A whole number from 1 on."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 1 on")
    return value


def steps(text: str) -> int | str:
    """A number of steps, or the word for steps that are chosen."""
    return text if text == "auto" else whole(text)


def count(text: str) -> int:
    """A whole number from 0 on."""
    return whole(text) if text.strip() != "0" else 0


def positive(text: str) -> float:
    """A positive finite number."""
    value = float(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def rule(args: argparse.Namespace) -> int | None:
    """The degree of the domains' rule; an average over a domain's points needs several."""
    given: int | None = args.quadrature_degree
    few = (args.domain_degree or args.degree) == 1
    averaged = getattr(args, "f_bar", "none") == "domain"
    return 2 if given is None and few and averaged else given


def order(args: argparse.Namespace) -> dict[str, Any]:
    """Arguments of `mpm.Particles` for the degree of the domains and their rule."""
    return {"degree": args.domain_degree or args.degree, "quadrature_degree": rule(args)}


def stabilisation(args: argparse.Namespace) -> str | None:
    """What a problem does about badly supported dofs."""
    return None if args.stabilisation == "none" else args.stabilisation


DOMAINS = {
    "quad": mesh.CellType.quadrilateral,
    "tri": mesh.CellType.triangle,
    "hex": mesh.CellType.hexahedron,
    "tet": mesh.CellType.tetrahedron,
}
F_BARS = ("none", "domain", "patch")
METHODS = ("cpdi2", "cpdi", "gimp", "mpm")


def lines(h: float, fine: float, whole: float) -> np.ndarray:
    """Grid lines `h` apart up to `fine`, and from there to `whole` each cell a fifth longer."""
    cells = np.full(round(fine / h), h)
    longer = h * 1.2 ** np.arange(1, 100)
    longer = longer[: 1 + np.argmax(np.cumsum(longer) >= whole - cells.sum())]
    longer *= (whole - cells.sum()) / longer.sum()
    return np.concatenate([[0.0], np.cumsum(cells), cells.sum() + np.cumsum(longer)])


def divided(along: np.ndarray, parts: int) -> np.ndarray:
    """Lines that divide each interval of others into equal parts."""
    places = np.arange((len(along) - 1) * parts + 1) / parts
    return np.interp(places, np.arange(len(along)), along)


def finer_at(place: float, along: np.ndarray, times: int) -> np.ndarray:
    """Lines of which the intervals next to one at `place` are halved towards it."""
    middle = int(np.argmin(np.abs(along - place)))
    lengths = [along[i] - along[middle] for i in (middle - 1, middle + 1) if 0 <= i < len(along)]
    more = [along[middle] + length / 2.0**k for length in lengths for k in range(1, times + 1)]
    return np.sort(np.append(along, more))


def grid(places: Sequence[np.ndarray], kind: mesh.CellType) -> mesh.Mesh:
    """A mesh with given grid lines along each axis: that of a box with its vertices moved."""
    counts = [len(along) - 1 for along in places]
    domain = box([float(count) for count in counts], counts, kind)
    for axis, along in enumerate(places):
        place = domain.geometry.x[:, axis]
        place[:] = np.interp(place, np.arange(len(along)), along)
    return domain


def box(upper: Sequence[float], cells: Sequence[int], kind: mesh.CellType) -> mesh.Mesh:
    """A structured mesh from the origin to `upper`, in the plane or in space."""
    corners = [[0.0] * len(upper), list(upper)]
    if len(upper) == 3:
        return mesh.create_box(comm, corners, cells, kind)
    diagonal = mesh.DiagonalType.left_right
    return mesh.create_rectangle(comm, corners, cells, kind, diagonal=diagonal)


# Each rank owns some of the particles. A sum or an extreme over all of them is one collective
# call, and every rank gets the same answer.


def total(values: Any) -> float:
    """Sum of an array over all ranks."""
    return float(comm.allreduce(float(np.sum(values)), MPI.SUM))


def largest(values: Any) -> float:
    """Largest value on any rank."""
    return float(comm.allreduce(float(np.max(values, initial=-np.inf)), MPI.MAX))


def smallest(values: Any) -> float:
    """Smallest value on any rank."""
    return float(comm.allreduce(float(np.min(values, initial=np.inf)), MPI.MIN))


def mean(values: Any, weights: Any) -> float:
    """Weighted mean over all ranks."""
    return total(values * weights) / total(weights)


def rise(place: Sequence[float], load: Sequence[float]) -> float:
    """By which share a load rose over the last tenth of its path: nothing at a limit load."""
    before = float(np.interp(0.9 * place[-1], place, load))
    return load[-1] / before - 1.0 if before > 0.0 else np.nan


def nodes(particles: mpm.Particles) -> np.ndarray:
    """Present positions of the nodes that this rank owns, shape `(n, gdim)`."""
    gdim = particles.mesh.geometry.dim
    own = particles.W.dofmap.index_map.size_local
    d = particles.displacement.x.array.reshape(-1, gdim)
    return (particles.W.tabulate_dof_coordinates()[:, :gdim] + d)[:own]


def gathered(values: Any) -> np.ndarray | None:
    """Values of all ranks on rank 0, `None` elsewhere."""
    parts = comm.gather(np.asarray(values))
    return None if parts is None else np.concatenate(parts)


# The exact solutions of a column need Lambert's function, $W(x)\, e^{W(x)} = x$ for $x \ge 0$.


def lambert_w(x: Any) -> np.ndarray:
    """Lambert's W by Newton's method, which converges from log(1 + x) for all x >= 0."""
    x = np.asarray(x, dtype=float)
    w = np.log1p(x)
    for _ in range(50):
        w = w - (w - x * np.exp(-w)) / (1.0 + w)
    return w


# Hertz's pressure (1882) between long cylinders, from the middle outwards.


def hertz(
    x: np.ndarray, force: np.ndarray, length: np.ndarray, stiff: float, radius: float
) -> tuple[float, np.ndarray]:
    """The half width of contact and the mean pressure over facets of one of its halves.

    `x` has the facets' middles, `force` what they bear, `length` how long they are; `stiff` is the
    modulus and `radius` the radius of the cylinder that is as curved as both together.
    """
    whole = 2.0 * force.sum()
    half = np.sqrt(4.0 * whole * radius / np.pi / stiff)

    def below(s: np.ndarray) -> np.ndarray:
        """The integral of the pressure from 0 to s."""
        s = np.minimum(s / half, 1.0)
        return whole / np.pi * (s * np.sqrt(1.0 - s**2) + np.arcsin(s))

    return float(half), (below(x + length / 2) - below(x - length / 2)) / length


# ## A run and its report


def chosen(args: argparse.Namespace) -> dict[str, Any]:
    """Arguments of `problem.solve` and `problem.steps` for the options of `add_steps`."""
    automatic = {"tolerance": args.tolerance} if args.steps == "auto" else {}
    return {"steps": args.steps, **automatic}


def progress(
    steps: Iterable[mpm.Step], number: int | str, args: argparse.Namespace, done: Any = None
) -> Iterator:
    """Go through load steps with the bar that `solve(progress=True)` shows."""
    whole = 1 if isinstance(number, str) else number
    yield from steps if args.json or comm.rank > 0 else with_bar(steps, whole, done)


def outcome(history: mpm.History, failure: mpm.MPMError | None) -> dict[str, Any]:
    """What every case reports of a run; iterations count failed attempts too."""
    failure = failure or history.stopped
    return {
        "completed": int(failure is None),
        "load": history.load[-1] if history.load else 0.0,
        "iterations": history.total_iterations,
        "cutbacks": history.cutbacks,
        "failure": type(failure).__name__ if failure is not None else None,
    }


def report(
    args: argparse.Namespace,
    numbers: dict[str, Any],
    rows: Sequence[tuple[str, str]] = (),
    failure: mpm.MPMError | None = None,
) -> None:
    """Print the JSON object, or else a table, from rank 0; a run that stopped ends here.

    The status is 1 then, but 0 with --json, as the object says what happened.
    """
    if comm.rank == 0 and args.json:
        print(json.dumps(_plain(numbers), allow_nan=False), flush=True)
    elif comm.rank == 0:
        width = max((len(name) for name, _ in rows), default=0)
        lines = [f"  {name:<{width}}  {text}" for name, text in rows]
        if args.plot:
            lines.append(f"  {'picture':<{width}}  {args.plot}")
        if failure is not None:
            lines += ["", f"The run stopped. {failure}"]
        print("", *lines, sep="\n", flush=True)
    if failure is not None:
        raise SystemExit(0 if args.json else 1)


def _plain(value: Any) -> Any:
    """Make numbers plain, and null of what JSON has no number for."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def _reporting(args: argparse.Namespace) -> Any:
    """Report errors of the package that no case caught, e.g. before its first step."""

    def hook(kind: type, error: BaseException, trace: Any) -> None:
        if not isinstance(error, mpm.MPMError):
            sys.__excepthook__(kind, error, trace)
            return
        args.plot = None
        report(args, outcome(mpm.History(), error), (), error)

    return hook


# Figures are made on rank 0 without a display; elsewhere figure and axes are `None`.

COLOURS = {"blue": "#0072B2", "orange": "#D55E00", "green": "#009E73", "grey": "0.45"}
STYLE = {
    "font.size": 12,
    "axes.titlesize": 13,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 12,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.fontsize": 11,
    "legend.frameon": False,
    "lines.linewidth": 2.0,
    "figure.dpi": 100,
    "savefig.dpi": 160,
}


def figure(width: float, height: float, layout: Any = (("main",),), **options: Any) -> Any:
    """Make a figure and a mosaic of axes (none where the layout is empty)."""
    if comm.rank > 0:
        return None, defaultdict(lambda: None)
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(STYLE)
    if not layout:
        return plt.figure(figsize=(width, height)), {}
    fig = plt.figure(figsize=(width, height), layout="constrained")
    return fig, fig.subplot_mosaic([list(row) for row in layout], **options)


def save(fig: Any, args: argparse.Namespace) -> None:
    """Write the figure, from rank 0."""
    if fig is not None:
        Path(args.plot).parent.mkdir(parents=True, exist_ok=True)
        fig.savefig(args.plot)
