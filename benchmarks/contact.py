# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What contact takes of a load step: CPU time of its calls over that of whole steps, in one run.

A block is pressed by a round obstacle with friction, by one of triangles, by one that forces drive,
or by another block. In the plane 160 000 domains on 100 cells each way, in space 97 336 on 10.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

KINDS = ("rigid", "triangles", "rigid_body", "pair")
YOUNG, POISSON, FRICTION = 1e3, 0.3, 0.3
#: How far obstacles go into the block, 1 high, and along it.
DEPTH, WAY = 0.02, 0.01
#: Radius of obstacles.
RADIUS = 0.4
#: Calls of a term that a problem makes within steps.
CALLS = (
    "begin",
    "update",
    "smooth",
    "residuals",
    "tangents",
    "reduced_tangents",
    "commit",
    "roll_back",
    "end_forces",
    "step_work",
)
#: Domains and cells along an edge of the block, by the dimension.
SIZES, SMALL = {2: (400, 100), 3: (46, 10)}, {2: (24, 6), 3: (8, 4)}


class Account:
    """CPU time of the calls of a term, those within others counted once.

    Attributes:
        seconds: What each has taken.
    """

    def __init__(self, term: Any) -> None:
        self.seconds = dict.fromkeys(CALLS, 0.0)
        self._within = False
        for name in CALLS:
            setattr(term, name, self._timed(name, getattr(term, name)))

    def _timed(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any) -> Any:
            if self._within:
                return call(*args)
            self._within, begin = True, time.process_time()
            try:
                return call(*args)
            finally:
                self._within = False
                self.seconds[name] += time.process_time() - begin

        return timed


def box(low: list[float], high: list[float], counts: list[int]) -> mesh.Mesh:
    """A box of quadrilaterals or hexahedra."""
    if len(counts) == 2:
        kind = mesh.CellType.quadrilateral
        return mesh.create_rectangle(MPI.COMM_WORLD, [low, high], counts, kind)
    return mesh.create_box(MPI.COMM_WORLD, [low, high], counts, mesh.CellType.hexahedron)


def space(dim: int, cells: int) -> fem.FunctionSpace:
    """Displacements of a background with a margin around the block and room above it."""
    h = 1.0 / cells
    low, high = [-1.37 * h] * (dim - 1) + [0.0], [1.0 + 1.63 * h] * (dim - 1) + [1.7]
    counts = [cells + 3] * (dim - 1) + [round(1.7 * cells)]
    return fem.functionspace(box(low, high, counts), ("Lagrange", 1, (dim,)))


def ball(dim: int, kind: str) -> mpm.contact.Shape:
    """A ball on the middle of the block, or one of triangles or segments."""
    centre = np.array([0.5] * (dim - 1) + [1.0 + RADIUS])
    if kind != "triangles":
        return (mpm.contact.disc if dim == 2 else mpm.contact.sphere)(tuple(centre), RADIUS)
    if dim == 2:
        angle = np.linspace(0.0, 2.0 * np.pi, 721)
        return mpm.contact.polyline(
            centre + RADIUS * np.column_stack([np.cos(angle), np.sin(angle)])
        )
    turn, rise = np.meshgrid(
        np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False), np.linspace(0.0, np.pi, 61)[1:-1]
    )
    ring = np.stack([np.sin(rise) * np.cos(turn), np.sin(rise) * np.sin(turn), np.cos(rise)], -1)
    points = np.concatenate([ring.reshape(-1, 3), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    at = np.arange(59 * 60).reshape(59, 60)
    after = np.roll(at, -1, axis=1)
    a, b, c, d = at[:-1], at[1:], after[1:], after[:-1]
    sides = [np.stack([a, b, c], -1), np.stack([a, c, d], -1)]
    top = np.stack([np.full(60, 3540), at[0], after[0]], -1)
    low = np.stack([np.full(60, 3541), after[-1], at[-1]], -1)
    triangles = np.concatenate([side.reshape(-1, 3) for side in [*sides, top, low]])
    return mpm.contact.triangulated(centre + RADIUS * points, triangles)


def held(V: fem.FunctionSpace, value: Any, where: Callable[..., Any]) -> fem.DirichletBC:
    """A condition on all of the displacement."""
    return fem.dirichletbc(value, fem.locate_dofs_geometrical(V, where), V)


def obstacle(
    dim: int, kind: str, sizes: tuple[int, int]
) -> tuple[mpm.QuasiStaticProblem, Any, Callable[[float], None]]:
    """A block and an obstacle; return its problem, its contact, and its path."""
    domains, cells = sizes
    V = space(dim, cells)
    block = mpm.Particles(box([0.0] * dim, [1.0] * dim, [domains] * dim), V)
    shape = ball(dim, kind)
    up = np.eye(dim)[-1]
    contact: Any
    if kind == "rigid_body":
        # (a ball whose weight is in its middle is at rest wherever it rolls)
        force = 0.25 * YOUNG * DEPTH if dim == 2 else YOUNG * DEPTH**1.5
        low = shape.pivot - 0.5 * RADIUS * up
        contact = mpm.contact.RigidBody(block, shape, friction=FRICTION, centre=low)
    else:
        contact = mpm.contact.Rigid(block, shape, FRICTION)

    def path(t: float) -> None:
        if kind == "rigid_body":
            contact.push(tuple(-force * t * up))
        else:
            contact.move(tuple(WAY * t * np.eye(dim)[0] - DEPTH * t * up))

    problem = mpm.QuasiStaticProblem(
        mpm.Body(block, mpm.materials.Hencky(YOUNG, POISSON)),
        bcs=[held(V, np.zeros(dim), lambda x: x[dim - 1] < 1e-9)],
        terms=[contact],
    )
    return problem, contact, path


def pair(
    dim: int, sizes: tuple[int, int]
) -> tuple[mpm.QuasiStaticProblem, Any, Callable[[float], None]]:
    """A block 0.7 high and one half as wide on top, whose upper face goes down and along."""
    domains, cells = sizes
    spaces = [space(dim, cells) for _ in range(2)]
    wide, high = round(0.65 * domains), round(0.75 * domains)
    low = box(
        [0.0] * dim, [1.0] * (dim - 1) + [0.7], [domains] * (dim - 1) + [round(0.7 * domains)]
    )
    top = box([0.19] * (dim - 1) + [0.7], [0.81] * (dim - 1) + [1.4], [wide] * (dim - 1) + [high])
    above, below = (mpm.Particles(m, V) for m, V in zip((top, low), spaces, strict=True))
    contact = mpm.contact.Pair(above, below, FRICTION)
    way = fem.Constant(spaces[0].mesh, np.zeros(dim))
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(p, mpm.materials.Hencky(YOUNG, POISSON)) for p in (above, below)],
        bcs=[
            held(spaces[0], way, lambda x: x[dim - 1] > 1.4 - 1e-9),
            held(spaces[1], np.zeros(dim), lambda x: x[dim - 1] < 1e-9),
        ],
        terms=[contact],
    )

    def path(t: float) -> None:
        way.value[0], way.value[-1] = WAY * t, -DEPTH * t

    return problem, contact, path


def measure(dim: int, kind: str, sizes: tuple[int, int], steps: int) -> dict[str, Any]:
    """Run a scene; return what its contact takes."""
    problem, contact, path = pair(dim, sizes) if kind == "pair" else obstacle(dim, kind, sizes)
    account = Account(contact)
    begin = time.process_time()
    problem.solve(steps, update=path)
    whole = time.process_time() - begin
    seconds = {name: s / steps for name, s in account.seconds.items() if s > 0.0}
    contacts = contact.contacts if kind == "rigid_body" else [contact]
    return {
        "dim": dim,
        "contact": kind,
        "particles": sum(body.num_global for body in problem.bodies),
        "touching": int(sum(c.touches.sum() for c in contacts)),
        "solves_per_step": problem.history.total_iterations / steps,
        "seconds_per_step": whole / steps,
        "seconds_of_contact": seconds,
        "share": sum(seconds.values()) * steps / whole,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--contacts", default=",".join(KINDS), help="which, with commas between")
    parser.add_argument("--dims", default="2,3", help="dimensions of space")
    parser.add_argument("--steps", type=int, default=3, help="load steps")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it run?")
    args = parser.parse_args()
    sizes = SMALL if args.smoke else SIZES
    rows = []
    for dim in map(int, args.dims.split(",")):
        for kind in args.contacts.split(","):
            rows.append(row := measure(dim, kind, sizes[dim], args.steps))
            if not args.json:
                print(
                    f"{dim} {kind:12s}{row['particles']:8d} domains{row['touching']:7d} points"
                    f"{row['solves_per_step']:6.1f} solves{row['seconds_per_step']:8.2f} s a step"
                    f"{100.0 * row['share']:7.1f} % contact",
                    flush=True,
                )
    if args.json:
        print(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
