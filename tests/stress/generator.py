# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scenes by number: classes, each with its own random choices.

Lengths and stresses are dimensionless here: a body is about 1 long, Young's modulus is 1, and
a weight ``g`` is that of a unit volume over Young's modulus. ``units`` scales them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

SEED = 20260801

type Scene = dict[str, Any]
type Random = np.random.Generator

CELLS = {2: ("triangle", "quadrilateral"), 3: ("tetrahedron", "hexahedron")}
DIAGONALS = ("left", "right", "left_right", "right_left", "crossed")
SHAPES = ("block", "turned", "disc", "ring", "trapezium", "wave", "jitter")
#: Shapes with a flat base, on which a body can stand.
FLAT = ("block", "trapezium", "jitter")
OFFSETS = (0.0, 1e-14, 1e-13, 1e-12, 1e-10, 1e-9, 1e-8, 1e-6, 1e-3, 0.1, 0.37, 0.5, 0.9)

#: name: (number of scenes, maker, whether each scene must be expected to complete).
#: New classes go to the end, since a scene's number has its class's place in it.
CLASSES: dict[str, tuple[int, Callable[[Random, int], Scene], bool]] = {}


def scene_class(count: int, well_posed: bool = False) -> Callable[..., Any]:
    """Register a maker of scenes."""

    def register(maker: Callable[[Random, int], Scene]) -> Callable[[Random, int], Scene]:
        CLASSES[maker.__name__] = (count, maker, well_posed)
        return maker

    return register


def numbers() -> dict[int, str]:
    """Return the class of each scene; a class has its numbers to itself, from k * 1000 on."""
    return {
        1000 * (k + 1) + i: name
        for k, (name, (count, _, _)) in enumerate(CLASSES.items())
        for i in range(count)
    }


def scene(number: int, seed: int = SEED) -> Scene:
    """Return a scene, the same each time."""
    name = list(CLASSES)[number // 1000 - 1]
    index = number % 1000
    made = CLASSES[name][1](np.random.default_rng([seed, number]), index)
    about = {"number": number, "seed": seed, "class": name, "well_posed": CLASSES[name][2]}
    return {**about, **made}


# -- Parts that the classes share ----------------------------------------------------------


def pick(rng: Random, *values: Any) -> Any:
    return values[rng.integers(len(values))]


def between(rng: Random, low: float, high: float) -> float:
    """Return a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def body(rng: Random, dim: int = 2, **given: Any) -> Scene:
    """Return a body near the unit square or cube."""
    shape = pick(rng, *SHAPES) if dim == 2 else pick(rng, "block", "turned", "jitter")
    return {
        "shape": shape,
        "cell": pick(rng, *CELLS[dim]),
        "n": None,
        "size": [1.0, float(pick(rng, 0.5, 1.0, 1.5)), 0.5][:dim],
        "origin": [0.0] * dim,
        "angle": float(rng.uniform(-0.5, 0.5)),
        "diagonal": pick(rng, *DIAGONALS),
        **given,
    }


def background(rng: Random, dim: int = 2, **given: Any) -> Scene:
    """Return a background of cells of ``h`` around the body, ``room`` wide at each side."""
    return {
        "cell": pick(rng, *CELLS[dim]),
        "h": float(pick(rng, 0.2, 0.25, 0.3) if dim == 2 else pick(rng, 0.3, 0.4)),
        "room": 0.75,
        "shift": [0.0] * dim,
        "diagonal": pick(rng, *DIAGONALS),
        "jitter": 0.0,
        **given,
    }


def hencky(rng: Random, **given: Any) -> Scene:
    return {"law": "hencky", "poisson": float(pick(rng, 0.0, 0.2, 0.3, 0.4)), **given}


def von_mises(rng: Random, rho_y: float = 1e-2, **given: Any) -> Scene:
    return {
        "law": "von_mises",
        "poisson": float(pick(rng, 0.2, 0.3, 0.4)),
        "rho_y": rho_y,
        "hardening": float(pick(rng, 0.0, 0.0, 1e-2, 0.1)),
        **given,
    }


def down(g: float, dim: int = 2, turn: float = 0.0) -> list[float]:
    """Return a weight of size g that acts downwards, or turned from it."""
    return [g * np.sin(turn), -g * np.cos(turn), 0.0][:dim]


def assembled(rng: Random, dim: int = 2, **parts: Any) -> Scene:
    """Return a scene of parts, those not given made at random.

    Where a body's number of domains is not given there are ``per_cell`` in a background cell.
    """
    parts.setdefault("body", body(rng, dim))
    parts.setdefault("background", background(rng, dim))
    parts.setdefault("material", hencky(rng))
    per_cell = parts.pop("per_cell", 2.0)
    for one in [parts["body"], *([parts["second"]] if "second" in parts else [])]:
        if one["n"] is None:
            length = [0.5 * np.pi, 0.5] if one["shape"] == "ring" else one["size"]
            least = [int(np.ceil(per_cell * a / parts["background"]["h"] - 1e-9)) for a in length]
            one["n"] = [n + int(rng.integers(0, 3)) for n in least]
    return {
        "dim": dim,
        "units": [1.0, 1.0],
        "method": "cpdi2",
        "quadrature_degree": None,
        "support": "clamp",
        "weight": [0.0] * dim,
        "path": "ramp",
        "steps": 4,
        "limit": 60.0,
        **parts,
    }


# -- Well-posed classes ----------------------------------------------------------------------


@scene_class(60, well_posed=True)
def elastic(rng: Random, index: int) -> Scene:
    """Elastic bodies of any shape, cells and method under a moderate weight."""
    method = pick(rng, "cpdi2", "cpdi2", "cpdi")
    return assembled(
        rng,
        method=method,
        quadrature_degree=pick(rng, None, None, 2) if method == "cpdi2" else None,
        material=hencky(rng, law=pick(rng, "hencky", "hencky", "linear")),
        weight=down(between(rng, 1e-6, 0.03), turn=float(rng.uniform(-3, 3))),
        support=pick(rng, "clamp", "stand"),
    )


@scene_class(20, well_posed=True)
def elastic_space(rng: Random, index: int) -> Scene:
    """Elastic bodies of tetrahedra and hexahedra."""
    return assembled(
        rng,
        3,
        weight=down(between(rng, 1e-5, 0.03), 3),
        support=pick(rng, "clamp", "stand"),
        steps=2,
        limit=120.0,
    )


@scene_class(40, well_posed=True)
def pulled(rng: Random, index: int) -> Scene:
    """Elastic bodies between two grips that move apart, together or past each other."""
    return assembled(
        rng,
        body=body(rng, shape="block", size=[1.5, 0.5]),
        background=background(rng, h=float(pick(rng, 0.2, 0.25))),
        support="grips",
        motion=[float(rng.uniform(-0.15, 0.2)), float(rng.uniform(-0.2, 0.2))],
    )


@scene_class(40, well_posed=True)
def plastic(rng: Random, index: int) -> Scene:
    """Columns of von Mises material below their limit load."""
    height = float(pick(rng, 0.5, 1.0, 1.5))
    rho_y = between(rng, 1e-4, 1e-1)
    return assembled(
        rng,
        body=body(rng, shape=pick(rng, "block", "jitter"), size=[1.0, height]),
        material=von_mises(rng, rho_y, law=pick(rng, "von_mises", "von_mises", "small")),
        weight=down(float(rng.uniform(0.3, 1.0)) * rho_y / height),
        support="stand",
    )


@scene_class(65, well_posed=True)
def offset(rng: Random, index: int) -> Scene:
    """A body shifted through a cell, down to distances of round-off."""
    h, shift = 0.25, OFFSETS[index % len(OFFSETS)]
    return assembled(
        rng,
        body=body(rng, shape="block", size=[1.5, 0.5], n=[int(rng.integers(8, 14)), 4]),
        background=background(
            rng,
            h=h,
            shift=[h * shift * pick(rng, 0.0, 1.0, -1.0), h * shift * pick(rng, 1.0, -1.0)],
        ),
        method=pick(rng, "cpdi2", "cpdi2", "cpdi2", "cpdi"),
        weight=down(between(rng, 1e-4, 5e-3)),
    )


@scene_class(40, well_posed=True)
def units(rng: Random, index: int) -> Scene:
    """Lengths and stresses in units from 1e-6 to 1e9."""
    plastic = index % 2 == 1
    rho_y = 1e-2
    return assembled(
        rng,
        body=body(rng, shape="block") if plastic else body(rng),
        units=[10.0 ** rng.integers(-6, 10), 10.0 ** rng.integers(-6, 10)],
        material=von_mises(rng, rho_y) if plastic else hencky(rng),
        weight=down(0.5 * rho_y if plastic else 0.02),
        support="stand" if plastic else pick(rng, "clamp", "stand"),
    )


@scene_class(30, well_posed=True)
def incompressible(rng: Random, index: int) -> Scene:
    """Poisson's ratios up to 0.4999."""
    return assembled(
        rng,
        material=hencky(rng, poisson=float(pick(rng, 0.45, 0.49, 0.499, 0.4999))),
        weight=down(between(rng, 1e-4, 2e-2)),
        quadrature_degree=pick(rng, None, 2),
        support=pick(rng, "clamp", "stand"),
    )


@scene_class(20, well_posed=True)
def zero(rng: Random, index: int) -> Scene:
    """No load at all, held or not."""
    return assembled(
        rng,
        material=pick(rng, hencky(rng), von_mises(rng)),
        support=pick(rng, "clamp", "stand", "none"),
        method=pick(rng, "cpdi2", "cpdi", "mpm"),
    )


@scene_class(20, well_posed=True)
def reversed_load(rng: Random, index: int) -> Scene:
    """Load, unload, load the other way."""
    plastic = index % 2 == 1
    return assembled(
        rng,
        body=body(rng, shape="block", size=[1.5, 0.5]),
        material=von_mises(rng, 1e-2, hardening=0.1) if plastic else hencky(rng),
        support="grips",
        motion=[float(rng.uniform(-0.05, 0.05)), float(rng.uniform(-0.05, 0.05))],
        path="reverse",
        steps=8,
    )


@scene_class(20, well_posed=True)
def cyclic(rng: Random, index: int) -> Scene:
    """Cycles of load."""
    plastic = index % 2 == 1
    return assembled(
        rng,
        material=von_mises(rng, 1e-2, hardening=0.05) if plastic else hencky(rng),
        weight=down(5e-3, turn=float(rng.uniform(-3, 3))),
        support="stand",
        path="cycle",
        steps=12,
    )


@scene_class(30, well_posed=True)
def other_methods(rng: Random, index: int) -> Scene:
    """Points, boxes and parallelograms under a small weight, two and more in each cell."""
    method = ("mpm", "gimp", "cpdi")[index % 3]
    h = 0.25
    cell = "quadrilateral" if method == "gimp" else pick(rng, *CELLS[2])
    return assembled(
        rng,
        body=body(
            rng,
            shape="block",
            cell=cell,
            size=[1.0, 1.0],
        ),
        background=background(
            rng, h=h, cell="quadrilateral" if method == "gimp" else pick(rng, *CELLS[2])
        ),
        method=method,
        update=pick(rng, "stretch", "fixed"),
        weight=down(between(rng, 1e-6, 1e-3)),
        support="stand",
        steps=2,
    )


@scene_class(20, well_posed=True)
def any_background(rng: Random, index: int) -> Scene:
    """Backgrounds whose cells are distorted."""
    return assembled(
        rng,
        background=background(rng, jitter=float(rng.uniform(0.05, 0.2))),
        weight=down(between(rng, 1e-4, 2e-2)),
        support=pick(rng, "clamp", "stand"),
    )


@scene_class(40, well_posed=True)
def f_bar(rng: Random, index: int) -> Scene:
    """F-bar of each kind, nearly incompressible or below the limit load."""
    kind = ("domain", "patch")[index % 2]
    plastic = index % 3 == 2
    dim = 3 if index % 10 == 9 and kind == "patch" else 2
    cell = "quadrilateral" if kind == "domain" else pick(rng, *CELLS[dim])
    return assembled(
        rng,
        dim,
        body=body(rng, dim, cell=cell, diagonal=pick(rng, "left", "right", "left_right")),
        material=von_mises(rng, 1e-2)
        if plastic
        else hencky(rng, poisson=float(pick(rng, 0.3, 0.49, 0.499))),
        quadrature_degree=2 if kind == "domain" else pick(rng, None, 2),
        weight=down(between(rng, 1e-4, 5e-3), dim),
        support=pick(rng, "clamp", "stand") if not plastic else "stand",
        options={"f_bar": kind},
        limit=120.0,
    )


@scene_class(40, well_posed=True)
def high_order(rng: Random, index: int) -> Scene:
    """Backgrounds and domains of degree 2 and 3, with each stabilisation, at any offset."""
    h, shift = 0.25, OFFSETS[index % len(OFFSETS)]
    degree = 3 if index % 5 == 4 else 2
    return assembled(
        rng,
        body=body(rng, shape=pick(rng, "block", "jitter"), size=[1.0, 0.5]),
        background=background(rng, h=h, shift=[h * shift * pick(rng, 0.0, 1.0), -h * shift]),
        degree=degree,
        domain_degree=degree,
        weight=down(between(rng, 1e-4, 5e-3)),
        options={"stabilisation": pick(rng, "auto", "ghost")},
        steps=2,
        limit=120.0,
    )


# -- Hard classes ----------------------------------------------------------------------------


@scene_class(25)
def slender(rng: Random, index: int) -> Scene:
    """Domains up to a thousand times longer than wide."""
    ratio = between(rng, 10, 1000)
    lying = bool(rng.integers(2))
    n = [2, max(1, min(60, int(ratio // 4)))]
    return assembled(
        rng,
        body=body(
            rng,
            shape=pick(rng, "block", "turned"),
            n=n if lying else n[::-1],
            size=[1.0, n[1] / (2 * ratio)] if lying else [n[1] / (2 * ratio), 1.0],
        ),
        weight=down(between(rng, 1e-6, 1e-3)),
        support=pick(rng, "clamp", "stand"),
    )


@scene_class(30)
def few_particles(rng: Random, index: int) -> Scene:
    """About one domain in a cell or less, with one point or more."""
    dim = 3 if index % 5 == 4 else 2
    return assembled(
        rng,
        dim,
        per_cell=float(rng.uniform(0.4, 1.0)),
        quadrature_degree=pick(rng, None, None, 2),
        weight=down(between(rng, 1e-6, 1e-2), dim),
        support=pick(rng, "clamp", "stand"),
    )


@scene_class(35)
def absurd(rng: Random, index: int) -> Scene:
    """Elastic bodies under loads from large to absurd."""
    return assembled(
        rng,
        material=hencky(rng, law=pick(rng, "hencky", "hencky", "linear")),
        weight=down(between(rng, 0.03, 1e8), turn=float(rng.uniform(-3, 3))),
        support=pick(rng, "clamp", "stand"),
        method=pick(rng, "cpdi2", "cpdi2", "cpdi", "mpm"),
        steps=int(pick(rng, 1, 4, 10)),
        limit=120.0,
    )


@scene_class(40)
def flow(rng: Random, index: int) -> Scene:
    """Columns of von Mises material beyond their limit load."""
    rho_y = between(rng, 1e-4, 3e-2)
    method = pick(rng, "cpdi2", "cpdi2", "cpdi2", "cpdi")
    return assembled(
        rng,
        body=body(rng, shape=pick(rng, "block", "jitter"), size=[1.0, 1.0]),
        background=background(rng, room=2.0),
        material=von_mises(rng, rho_y, law=pick(rng, "von_mises", "von_mises", "small")),
        method=method,
        quadrature_degree=pick(rng, None, None, 2) if method == "cpdi2" else None,
        weight=down(between(rng, 1.0, 10.0) * rho_y),
        support="roll",
        steps=int(pick(rng, 5, 10, 20)),
        limit=180.0,
    )


@scene_class(20)
def flow_f_bar(rng: Random, index: int) -> Scene:
    """Columns beyond their limit load, with F-bar."""
    kind = ("domain", "patch")[index % 2]
    rho_y = between(rng, 1e-3, 3e-2)
    return assembled(
        rng,
        body=body(rng, shape="block", size=[1.0, 1.0], cell="quadrilateral"),
        background=background(rng, room=2.0),
        material=von_mises(rng, rho_y),
        quadrature_degree=2 if kind == "domain" else None,
        weight=down(between(rng, 1.0, 6.0) * rho_y),
        support="roll",
        options={"f_bar": kind},
        steps=10,
        limit=180.0,
    )


@scene_class(20)
def flow_high_order(rng: Random, index: int) -> Scene:
    """Columns beyond their limit load, of degree 2, with each stabilisation or none."""
    rho_y = between(rng, 1e-3, 3e-2)
    return assembled(
        rng,
        per_cell=1.0,
        body=body(rng, shape="block", size=[1.0, 1.0]),
        background=background(rng, room=2.0),
        material=von_mises(rng, rho_y),
        degree=2,
        domain_degree=2,
        weight=down(between(rng, 1.0, 4.0) * rho_y),
        support="roll",
        options={"stabilisation": pick(rng, "auto", "ghost", None)},
        steps=10,
        limit=300.0,
    )


@scene_class(30)
def one_particle(rng: Random, index: int) -> Scene:
    """A single domain, larger or smaller than a cell, held or not."""
    dim = 3 if index % 5 == 4 else 2
    size = between(rng, 1e-3, 1.0)
    return assembled(
        rng,
        dim,
        body=body(
            rng,
            dim,
            shape=pick(rng, "block", "turned"),
            cell=CELLS[dim][1],
            n=[1] * dim,
            size=[size] * dim,
        ),
        background=background(rng, dim, h=0.25, room=0.5),
        method=pick(rng, "cpdi2", "cpdi", "mpm"),
        material=pick(rng, hencky(rng), von_mises(rng)),
        weight=down(between(rng, 1e-8, 1e-2), dim),
        support=pick(rng, "clamp", "stand", "none"),
        steps=2,
    )


@scene_class(20)
def colliding(rng: Random, index: int) -> Scene:
    """Two bodies pressed against each other."""
    gap = float(pick(rng, 0.0, 1e-12, 0.05, 0.3))
    return assembled(
        rng,
        body=body(rng, shape=pick(rng, "block", "jitter"), size=[0.6, 0.5]),
        second=body(
            rng,
            shape=pick(rng, "block", "jitter"),
            size=[0.6, 0.5],
            origin=[0.6 + gap, float(rng.uniform(-0.2, 0.2))],
        ),
        material=pick(rng, hencky(rng), von_mises(rng, 2e-2)),
        support="grips",
        motion=[-gap - float(rng.uniform(0.02, 0.3)), 0.0],
        steps=8,
        limit=120.0,
    )


@scene_class(20)
def tearing(rng: Random, index: int) -> Scene:
    """Bodies pulled to many times their length."""
    return assembled(
        rng,
        body=body(rng, shape="block", size=[1.0, 0.4]),
        background=background(rng, room=4.5),
        material=pick(rng, hencky(rng), von_mises(rng, between(rng, 1e-3, 1e-2))),
        method=pick(rng, "cpdi2", "cpdi2", "cpdi", "mpm"),
        support="grips",
        motion=[float(rng.uniform(0.5, 4.0)), float(rng.uniform(-0.5, 0.5))],
        steps=int(pick(rng, 10, 20)),
        limit=180.0,
    )


@scene_class(15)
def too_coarse(rng: Random, index: int) -> Scene:
    """A background cell that holds the whole body."""
    return assembled(
        rng,
        background=background(rng, h=float(pick(rng, 1.0, 2.0, 5.0)), room=2.5),
        weight=down(between(rng, 1e-4, 1e-1)),
        support=pick(rng, "edge", "stand"),
    )


@scene_class(15)
def too_fine(rng: Random, index: int) -> Scene:
    """Many background cells in each domain."""
    return assembled(
        rng,
        body=body(rng, n=[2, 2]),
        background=background(rng, h=float(pick(rng, 0.02, 0.04, 0.08)), room=0.3),
        method=pick(rng, "cpdi2", "cpdi2", "cpdi", "mpm"),
        weight=down(between(rng, 1e-4, 1e-2)),
        support=pick(rng, "clamp", "stand"),
    )


@scene_class(15)
def leaving(rng: Random, index: int) -> Scene:
    """Bodies that run out of the background, with each policy."""
    rho_y = 1e-3
    return assembled(
        rng,
        body=body(rng, shape="block", size=[1.0, 1.0]),
        background=background(rng, room=0.3),
        material=von_mises(rng, rho_y),
        outside=("error", "stop", "delete")[index % 3],
        weight=down(between(rng, 2.0, 20.0) * rho_y),
        support="roll",
        steps=10,
        limit=180.0,
    )


@scene_class(3, well_posed=True)
def many_particles(rng: Random, index: int) -> Scene:
    """A hundred thousand particles."""
    n = [[320, 320], [224, 224], [320, 320]][index]
    return assembled(
        rng,
        body=body(
            rng,
            shape="block",
            size=[1.0, 1.0],
            n=n,
            cell=("quadrilateral", "triangle", "quadrilateral")[index],
            diagonal="left_right",
        ),
        background=background(rng, h=(0.02, 0.02, 0.1)[index], cell="quadrilateral", room=0.1),
        material=(hencky(rng), hencky(rng), von_mises(rng, 1e-2))[index],
        weight=down(5e-3),
        support="stand",
        steps=2,
        limit=600.0,
    )


# -- Added later -----------------------------------------------------------------------------


@scene_class(12, well_posed=True)
def revolution(rng: Random, index: int) -> Scene:
    """Bodies of revolution, hollow or not, with each F-bar and without."""
    kind = ("none", "domain", "patch", "patch")[index % 4]
    cell = "quadrilateral" if kind == "domain" else pick(rng, *CELLS[2])
    hollow = bool(rng.integers(2))
    plastic = index % 3 == 2
    return assembled(
        rng,
        body=body(
            rng,
            shape=pick(rng, "block", "jitter"),
            cell=cell,
            origin=[1.0 if hollow else 0.0, 0.0],
            diagonal=pick(rng, "left", "right", "left_right"),
        ),
        material=von_mises(rng, 1e-2)
        if plastic
        else hencky(rng, poisson=float(pick(rng, 0.3, 0.49, 0.499))),
        quadrature_degree=2 if kind == "domain" else pick(rng, None, 2),
        weight=down(between(rng, 1e-4, 5e-3)),
        support="stand" if hollow else "roll",
        options={"axisymmetric": True, "f_bar": kind},
    )


@scene_class(10, well_posed=True)
def staged(rng: Random, index: int) -> Scene:
    """A weight, then a path on which it grows, turns or goes."""
    plastic = index % 2 == 1
    first = down(between(rng, 1e-4, 5e-3), turn=float(rng.uniform(-0.5, 0.5)))
    second = down(float(pick(rng, 0.0, 1e-3, 6e-3)), turn=float(rng.uniform(-1.5, 1.5)))
    return assembled(
        rng,
        body=body(rng, shape=pick(rng, *FLAT)),
        material=von_mises(rng, 1e-2, hardening=0.05) if plastic else hencky(rng),
        weight=first,
        second_weight=second,
        second_steps=int(pick(rng, 1, 3, 5)),
        support="stand",
        steps=int(pick(rng, 1, 3)),
    )


@scene_class(10, well_posed=True)
def contrast(rng: Random, index: int) -> Scene:
    """Parts 1e6 to 1e12 times as stiff as the rest: on top, inside, checks, here and there."""
    where = ("top", "inside", "checks", "some")[index % 4]
    return assembled(
        rng,
        body=body(rng, shape=pick(rng, "block", "turned", "disc", "jitter"), size=[1.0, 1.0]),
        material=hencky(rng, law=pick(rng, "hencky", "hencky", "linear")),
        contrast=10.0 ** (6.0 + 6.0 * index / 9.0),
        stiff=where,
        weight=down(between(rng, 1e-6, 3e-3), turn=float(rng.uniform(-0.5, 0.5))),
        support="stand",
        steps=1,
    )


@scene_class(8, well_posed=True)
def folded(rng: Random, index: int) -> Scene:
    """Meshes with a cell that is inverted or crosses itself, which must be refused."""
    cell = CELLS[2][index % 2]
    given = {"cell": cell}
    return assembled(
        rng,
        body=body(rng, shape="block", **(given if index % 4 < 2 else {})),
        background=background(rng, **(given if index % 4 >= 2 else {})),
        fold="body" if index % 4 < 2 else "background",
        place=float(rng.uniform(0.3, 0.7)),
        weight=down(1e-4),
        support="stand",
        steps=1,
    )


# -- Contact -----------------------------------------------------------------------------------


def obstacle(rng: Random, dim: int, name: str, top: list[float], gap: float) -> Scene:
    """Return a shape that is a gap above a point."""
    size = float(rng.uniform(0.15, 0.6))
    data: Scene = {"shape": name, "radius": float(pick(rng, 0.02, 0.1)), "size": size}
    up = np.eye(dim)[1]
    middle = np.array(top) + gap * up
    if name == "plane":
        turn = float(rng.uniform(-0.3, 0.3)) if dim == 2 else 0.0
        normal = [np.sin(turn), -np.cos(turn), 0.0][:dim]
        middle = middle + up * 0.5 * abs(np.tan(turn))
        return {**data, "point": middle.tolist(), "normal": normal}
    if name == "cavity":
        # the body is inside of a large disc, which comes down on it
        size = float(rng.uniform(1.5, 3.0))
        low = middle - up * (size - size * (1.0 - np.sqrt(1.0 - (0.5 / size) ** 2)))
        return {**data, "size": size, "centre": low.tolist()}
    high = {"polygon": 1.0, "ellipse": 0.6}.get(name, 1.0)
    return {**data, "centre": (middle + high * size * up).tolist()}


def press(rng: Random, dim: int = 2) -> Scene:
    """Return how an obstacle goes on: slowly or in leaps, straight, sideways or turning."""
    depth = between(rng, 5e-3, 1.5)
    way = [float(rng.uniform(-1.0, 1.0)) * depth, -depth, 0.0][:dim]
    turn = float(pick(rng, 0.0, 0.0, rng.uniform(-1.0, 1.0)))
    return {"way": way, "turn": turn if dim == 2 else 0.0}


def rubbing(rng: Random) -> Scene:
    return {
        "friction": float(pick(rng, 0.0, 0.1, 0.3, 0.6, 1.0, 2.0)),
        "cohesion": float(pick(rng, 0.0, 0.0, 0.0, 1e-3)),
        "penalty": float(pick(rng, 1.0, 1.0, 1.0, 4.0)),
    }


ROUND = ("plane", "disc", "box", "polygon", "cavity", "ellipse")


#: Gaps between bodies at the beginning, of which some are refused.
GAPS = (0.0, 0.0, 1e-13, 0.01, 0.1, -0.01, -0.3)
#: Others, of which fewer are.
MILD = (0.0, 0.0, 0.0, 0.0, 1e-13, 0.01, 0.01, 0.05, -1e-3, -0.1)


@scene_class(40)
def obstacles(rng: Random, index: int, gaps: tuple[float, ...] = GAPS) -> Scene:
    """Obstacles of every shape, far into bodies or through them, at a gap or in overlap."""
    dim = 3 if index % 5 == 4 else 2
    name = ROUND[index % 6] if dim == 2 else ("plane", "disc", "cylinder", "box")[index // 5 % 4]
    height = 0.6
    size = [1.0, height, 0.5][:dim]
    gap = float(pick(rng, *gaps))
    plastic = bool(rng.integers(2))
    return assembled(
        rng,
        dim,
        body=body(rng, dim, shape=pick(rng, "block", "jitter"), size=size),
        material=von_mises(rng, between(rng, 3e-3, 3e-2)) if plastic else hencky(rng),
        method=pick(rng, "cpdi2", "cpdi2", "cpdi2", "cpdi", "mpm") if dim == 2 else "cpdi2",
        contact={
            **rubbing(rng),
            **press(rng, dim),
            "obstacle": obstacle(rng, dim, name, [0.5, height, 0.25][:dim], gap),
        },
        support=pick(rng, "stand", "roll"),
        path="contact",
        steps=int(pick(rng, 2, 6, 12)),
        limit=180.0,
    )


@scene_class(25)
def touching(rng: Random, index: int) -> Scene:
    """Two bodies with fields of their own, pressed on each other and dragged."""
    gap = float(pick(rng, 0.0, 0.0, 1e-13, 0.02, 0.1, -0.01, -0.3))
    lower = [1.0, 0.5]
    shape = pick(rng, "block", "jitter", "disc", "turned")
    height = {"turned": 0.25}.get(shape, 0.0)
    plastic = bool(rng.integers(2))
    return assembled(
        rng,
        body=body(rng, shape=pick(rng, "block", "jitter"), size=lower),
        second=body(rng, shape=shape, size=[0.5, 0.4], origin=[0.25, 0.5 + gap + height]),
        background=background(rng, room=1.0),
        material=von_mises(rng, between(rng, 3e-3, 3e-2)) if plastic else hencky(rng),
        contact={**rubbing(rng), **press(rng), "passes": int(pick(rng, 1, 2, 2))},
        support="press",
        path="contact",
        steps=int(pick(rng, 3, 8, 16)),
        limit=180.0,
    )


@scene_class(15)
def bouncing(rng: Random, index: int) -> Scene:
    """Bodies that hit an obstacle, or each other, at some speed."""
    pair = index % 2 == 1
    name = ROUND[index // 2 % 4]
    speed = between(rng, 1e-3, 1.0)
    second = body(rng, shape=pick(rng, "block", "disc"), size=[0.5, 0.4], origin=[0.25, 0.62])
    about = {**rubbing(rng), "way": [0.0, 0.0], "turn": 0.0}
    if pair:
        about["passes"] = int(pick(rng, 1, 2))
    else:
        about["obstacle"] = obstacle(rng, 2, name, [0.5, 0.5], 0.05)
    return assembled(
        rng,
        body=body(rng, shape=pick(rng, "block", "jitter"), size=[1.0, 0.5]),
        **({"second": second} if pair else {}),
        background=background(rng, room=1.2),
        material=pick(rng, hencky(rng), von_mises(rng, 1e-2)),
        contact=about,
        motion_of={
            "scheme": ("conserving", "midpoint", "euler")[index % 3],
            "out_of_range": pick(rng, "project", "reflect"),
            "speed": speed,
            "time": min(20.0, 0.6 / speed),
        },
        support="none",
        path="contact",
        steps=20,
        limit=180.0,
    )


@scene_class(100, well_posed=True)
def soils(rng: Random, index: int) -> Scene:
    """Columns of soil that yield at their base, below the limit load.

    The base yields from a height of 2 c/weight tan(45 + phi/2) on; a vertical cut stands up to 1.9
    times as high.
    """
    height = float(pick(rng, 0.5, 0.75, 1.0))
    law = ("tresca", "mohr_coulomb", "drucker_prager")[index % 3]
    cohesion, friction = between(rng, 1e-4, 3e-2), float(rng.uniform(5.0, 40.0))
    friction = 0.0 if law == "tresca" else friction
    limit = 2.0 * cohesion * float(np.tan(np.radians(45.0 + 0.5 * friction)))
    return assembled(
        rng,
        body=body(rng, shape=pick(rng, "block", "jitter"), size=[1.0, height]),
        material={
            "law": law,
            "poisson": float(pick(rng, 0.2, 0.3, 0.4)),
            "cohesion": cohesion,
            "friction": friction,
            "dilation": friction * float(pick(rng, 0.0, 0.3, 1.0)),
            "volume_correction": bool(pick(rng, 0, 1)),
        },
        weight=down(float(rng.uniform(1.2, 1.8)) * limit / height),
        support=pick(rng, "stand", "roll"),
    )


@scene_class(20)
def nitsche(rng: Random, index: int) -> Scene:
    """Obstacles at which the pressure is that of the stress behind the facet, as in motion."""
    made = bouncing(rng, 6 * (index // 5)) if index % 5 == 3 else obstacles(rng, index, MILD)
    made["contact"] |= {"law": "nitsche", "penalty": float(pick(rng, 0.5, 1.0, 1.0, 4.0))}
    if "motion_of" in made:
        # (whole steps have no stress at their end alone: all but "euler" is refused)
        made["motion_of"]["scheme"] = "midpoint" if index == 18 else "euler"
    return made


@scene_class(20)
def paired(rng: Random, index: int) -> Scene:
    """Two bodies on backgrounds of their own, at rest and in motion, in the plane and in space."""
    dim = 3 if index % 5 == 4 else 2
    moves = index % 2 == 1
    speed = between(rng, 1e-3, 0.3)
    ends = min(20.0, 0.6 / speed)
    # (what moves meets in the first third)
    gap = 0.3 * speed * ends * float(rng.uniform()) if moves else float(pick(rng, *MILD))
    shape = pick(rng, "block", "jitter", *(() if dim == 3 else ("disc", "trapezium")))
    upper = [0.5, 0.4, 0.3][:dim]
    start = [float(rng.uniform(0.1, 0.4)), 0.5 + gap, 0.1][:dim]
    room = 1.2 if moves else 1.0
    plastic = bool(rng.integers(2))
    about = {**rubbing(rng), **press(rng, dim), "passes": int(pick(rng, 1, 2, 2))}
    about |= {"friction": float(rng.uniform(0.0, 2.0)), "turn": 0.0}
    motion = {
        "scheme": ("conserving", "midpoint", "euler")[index // 2 % 3],
        "out_of_range": pick(rng, "project", "reflect"),
        "speed": speed,
        "time": ends,
    }
    return assembled(
        rng,
        dim,
        body=body(rng, dim, shape=pick(rng, "block", "jitter"), size=[1.0, 0.5, 0.5][:dim]),
        second=body(rng, dim, shape=shape, size=upper, origin=start),
        background=background(rng, dim, room=room),
        second_background=background(rng, dim, room=room, h=float(pick(rng, 0.2, 0.35))),
        material=von_mises(rng, between(rng, 3e-3, 3e-2)) if plastic else hencky(rng),
        contact=about,
        **({"motion_of": motion} if moves else {}),
        weight=down(0.0 if moves else float(pick(rng, 0.0, 1e-3)), dim),
        support="none" if moves else "press",
        path="contact",
        steps=12 if moves else int(pick(rng, 3, 8)),
        limit=180.0,
    )


@scene_class(24)
def driven(rng: Random, index: int) -> Scene:
    """Rigid bodies of every shape that forces drive, at rest and in motion."""
    dim = 3 if index % 4 > 1 else 2
    moves = index % 2 == 1
    names = {
        2: ("disc", "box", "polygon", "ellipse", "polyline", "cavity", "plane"),
        3: ("disc", "cylinder", "box", "triangles", "plane"),
    }[dim]
    name = names[index // 4 % len(names)]
    load, speed = between(rng, 1e-4, 3e-2), between(rng, 1e-3, 0.3)
    ends = min(20.0, 0.4 / speed)
    gap = 0.3 * speed * ends * float(rng.uniform()) if moves else float(pick(rng, *MILD))
    about = {**rubbing(rng), "obstacle": obstacle(rng, dim, name, [0.5, 0.6, 0.25][:dim], gap)}
    if name == "plane":
        about["obstacle"] |= {"normal": [0.0, -1.0, 0.0][:dim]}
    mass = load * between(rng, 0.1, 1.0) if not moves else between(rng, 1e-2, 10.0)
    fixed = pick(rng, (), (), (), ("rotation",), ("x",), ("x", "rotation"))
    about["rigid"] = {
        "mass": mass,
        "inertia": 0.4 * mass * about["obstacle"]["size"] ** 2 * float(rng.uniform(0.5, 1.0)),
        "gravity": down(float(pick(rng, 0.0, 1.0)) if not moves else 0.0, dim),
        "force": [0.0 if moves else v for v in down(load, dim, float(rng.uniform(-0.3, 0.3)))],
        "moment": 0.0 if moves else float(pick(rng, 0.0, rng.uniform(-0.05, 0.05))) * load,
        "velocity": [0.3 * speed, -speed, 0.0][:dim] if moves else None,
        "spin": float(pick(rng, 0.0, speed)) if moves else None,
        "fixed": () if moves else fixed,
        "way": [0.0] * dim,
    }
    motion = {
        "scheme": ("conserving", "midpoint", "euler")[index // 2 % 3],
        "out_of_range": pick(rng, "project", "reflect"),
        "speed": 0.0,
        "time": ends,
    }
    plastic = bool(rng.integers(2))
    return assembled(
        rng,
        dim,
        body=body(rng, dim, shape=pick(rng, "block", "jitter"), size=[1.0, 0.6, 0.5][:dim]),
        background=background(rng, dim, room=1.2 if moves else 0.75),
        material=von_mises(rng, between(rng, 3e-3, 3e-2)) if plastic else hencky(rng),
        contact=about,
        **({"motion_of": motion} if moves else {}),
        support="none" if moves else pick(rng, "stand", "roll"),
        path="contact",
        steps=12 if moves else int(pick(rng, 2, 6)),
        limit=180.0,
    )
