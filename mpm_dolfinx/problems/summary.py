# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A problem in one line, and on a screen."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..history import History
from ..particles.particles import Particles

__all__ = ["counted", "in_one_line", "on_a_screen"]

#: Width of the names at the left, and of the whole.
NAMES, WIDTH = 12, 79


def counted(number: int, noun: str) -> str:
    """Return how many there are of something: ``1 body``, ``2 bodies``."""
    many = noun + "s"
    if noun.endswith("y"):
        many = noun[:-1] + "ies"
    elif noun.endswith("hedron"):
        many = noun[:-2] + "a"
    return f"{number} {noun if number == 1 else many}"


def in_one_line(problem: Any) -> str:
    """Return the ``repr`` of a problem."""
    count = sum(body.num_global for body in problem.bodies)
    parts = [counted(len(problem.bodies), "body"), counted(count, "particle")]
    if problem.bcs:
        parts.append(counted(len(problem.bcs), "Dirichlet condition"))
    if problem.terms:
        parts.append(counted(len(problem.terms), "term"))
    history: History = problem.history
    return f"<{type(problem).__name__}: {', '.join(parts)}; {history.in_words()}>"


def on_a_screen(
    problem: Any, comm: MPI.Comm, numerics: Mapping[str, str], laws: Sequence[str]
) -> str:
    """Return a summary of a problem and of its run, at most a screen of it (collective).

    Args:
        problem: The problem.
        comm: Its ranks.
        numerics: How it is solved, by name.
        laws: What each body is made of and loaded by, in words.
    """
    rows: list[tuple[str, str]] = []
    bodies: list[Particles] = problem.bodies
    for number, body in enumerate(bodies):
        rows.append((f"body {number}" if len(bodies) > 1 else "body", body.in_words()))
        rows.append(("", laws[number]))
        rows.append(("", _state(body, comm)))
    spaces: list[fem.FunctionSpace] = []
    for body in bodies:
        if not body.is_free and all(body.V is not V for V in spaces):
            spaces.append(body.V)
    rows += [("background", _space(V)) for V in spaces]
    if problem.bcs or problem.terms:
        names = sorted(type(term).__name__ for term in problem.terms)
        held = [counted(len(problem.bcs), "Dirichlet condition")] if problem.bcs else []
        rows.append(("held by", ", ".join([*held, *names])))
    chosen = _chosen(problem, numerics) if problem.history.steps else numerics
    rows.append(("solver", ", ".join(f"{name} {value}" for name, value in chosen.items())))
    rows.append(("run", _run(problem.history)))
    if problem.history.steps:
        rows.append(("seconds", _seconds(problem.history, comm)))
    title = f"{type(problem).__name__} on {counted(comm.size, 'rank')}"
    return "\n".join([title, *(line for row in rows for line in _wrapped(*row))])


def _state(body: Particles, comm: MPI.Comm) -> str:
    """Return how far a body has moved and what it has suffered (collective)."""
    d = body.displacement.x.array.reshape(-1, body.mesh.geometry.dim)
    parts = [f"displacement up to {_most(comm, np.linalg.norm(d, axis=1)):.4g}"]
    kept = ~body.deleted
    before, now = (comm.allreduce(float(v[kept].sum())) for v in (body.initial_volume, body.volume))
    parts.append(f"volume {before:.4g}, now {now:.4g}")
    if body.has_material:
        parts.append(f"plastic strain up to {_most(comm, body.plastic_strain[kept]):.3g}")
    if body.free_nodes is not None:
        layout = body.W.dofmap.index_map
        free = comm.allreduce(int(body.free[: layout.size_local].sum()))
        parts.append(f"{free} of {layout.size_global} nodes free")
    gone = comm.allreduce(int(np.count_nonzero(~kept)))
    return "; ".join([*parts, f"{gone} deleted"] if gone else parts)


def _most(comm: MPI.Comm, values: NDArray[Any]) -> float:
    return float(comm.allreduce(float(np.max(values, initial=0.0)), MPI.MAX))


def _chosen(problem: Any, numerics: Mapping[str, str]) -> dict[str, str]:
    """Return how a problem is solved, with what was chosen for the last step."""
    words = {"linear": problem.trial.newton.linear_solver, **numerics}
    if words["stabilisation"] == "auto":
        counts = problem.history.statistics
        acts = [
            counted(int(counts[name]), noun)
            for name, noun in (("ghost_facets", "ghost facet"), ("joint_nodes", "joint node"))
            if counts[name]
        ]
        words["stabilisation"] += f" ({' and '.join(acts) or 'nothing to hold'})"
    return words


def _space(V: fem.FunctionSpace) -> str:
    topology = V.mesh.topology
    cells = topology.index_map(topology.dim).size_global
    dofs = V.dofmap.index_map.size_global * V.dofmap.index_map_bs
    kind = V.mesh.basix_cell().name
    return f"{counted(cells, kind)}, {dofs} dofs of degree {V.ufl_element().degree}"


def _run(history: History) -> str:
    parts = [history.in_words()]
    if history.steps:
        free = int(history.statistics["free_dofs"])
        parts.append(f"{free} free dofs in the last step")
        parts.append(f"{int(history.statistics['factorisations'])} factorisations")
    if (error := history.time_error) is not None:
        parts.append(f"its steps in time leave about {100.0 * error:.2g} % of the motion uncertain")
    if history.losses:
        parts.append(f"{sum(len(loss.particles) for loss in history.losses)} particles lost")
    if history.stopped is not None:
        parts.append("stopped before its end")
    return "; ".join(parts)


def _seconds(history: History, comm: MPI.Comm) -> str:
    every = comm.allgather(history.statistics.seconds)
    mean = {name: sum(seconds[name] for seconds in every) / comm.size for name in every[0]}
    most = sorted(mean.items(), key=lambda item: -item[1])
    return f"{sum(mean.values()):.3g}: " + ", ".join(f"{name} {s:.2g}" for name, s in most if s > 0)


def _wrapped(name: str, text: str) -> Iterable[str]:
    """Yield the lines of a row, wrapped between words."""
    line = f"  {name:<{NAMES}}"
    empty = True
    for word in text.split():
        if not empty and len(line) + 1 + len(word) > WIDTH:
            yield line
            line, empty = " " * (NAMES + 2), True
        line += word if empty else " " + word
        empty = False
    yield line
