# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quadrilaterals that fold, cut into triangles in the middle of a run.

The halves of a quadrilateral go on with its deformation gradient and history. Let F be its own,
``F_t`` that of the half as a part of the body mesh: from then on the material sees
``F_t(now) F_t^-1 F``, and the half's undeformed volume is that of the material in it, its present
area over det F. As the mean gradient over the quadrilateral is that of its outline, on which the
triangles have the same edges, the internal forces on the nodes do not change. Masses at nodes are
kept by a factor of the density, linear in each half.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .. import _compat
from ..errors import MPMError, agree, warn
from ..io.checkpoint import Snapshot, Table
from ..meshes.remesh import Column, Cuts, Remesh, diagonals
from ..parallel.exchange import RowExchange
from ..particles.options import validate_distortion
from ..particles.particles import Particles
from ..particles.reference import Reference
from ..reals import as_wholes
from .arguments import require_no_conditions_on_bodies
from .stages import Staged
from .state import ProblemState

__all__ = ["Remeshable", "Remeshing", "as_indices"]

#: How often a failing step may be mended: the last time, half of all quadrilaterals are split.
TRIES = 5


class Remeshable(Staged, Protocol):
    """A problem that can be made on other meshes of its bodies.

    Attributes:
        state: Its state.
    """

    state: ProblemState


def as_indices(particles: Any) -> NDArray[np.int64]:
    """Return global indices as an array.

    Raises:
        MPMError: They are no whole numbers.
    """
    try:
        return as_wholes(particles).ravel()
    except (TypeError, ValueError):
        raise MPMError(
            f"Particles to be split are global indices, whole numbers, not {particles!r}."
        ) from None


class Remeshing:
    """Takes a problem to other meshes of its bodies: cut where domains fold, or moved.

    Args:
        problem: The problem, which is not kept alive.
    """

    def __init__(self, problem: Remeshable) -> None:
        self._reference = weakref.ref(problem)
        self._tries_of_step = 0, 0

    @property
    def _problem(self) -> Remeshable:
        problem = self._reference()
        assert problem is not None
        return problem

    def after_step(self) -> None:
        """Split the quadrilaterals that the last step has made concave, where bodies want it so."""
        problem = self._problem
        chosen = []
        for body in problem.bodies:
            concave = np.zeros(0, dtype=np.int64)
            if body.on_distortion == "split":
                _, good = _diagonals(body)
                concave = body.global_index[(body.domain_distortion() <= 0.0) & good]
            chosen.append(concave)
        self._split_and_say_so(chosen)

    def mend(self, error: MPMError) -> bool:
        """Split the quadrilaterals that keep a step from converging; return whether there are any.

        They are those that the error names. Of several bodies, where it names none, and where that
        was not enough, they are the most distorted ones too, twice as many each time (collective).
        """
        problem = self._problem
        steps, tries = len(problem.history.steps), 1
        if self._tries_of_step[0] == steps:
            tries += self._tries_of_step[1]
        self._tries_of_step = (steps, tries) if tries <= TRIES else (0, 0)
        if tries > TRIES or all(body.on_distortion == "error" for body in problem.bodies):
            return False
        comm = problem.bodies[0].V.mesh.comm
        chosen = []
        for body in problem.bodies:
            whole = np.zeros(body.num_local, dtype=bool)
            if body.on_distortion == "split":
                _, whole = _diagonals(body)
            which = whole & np.isin(body.global_index, error.particles)
            several = len(problem.bodies) > 1
            if several or tries > 1 or not comm.allreduce(int(which.sum())):
                shape = body.domain_distortion()
                every = np.sort(np.concatenate(comm.allgather(shape[whole])))
                few = int(np.ceil(0.5 ** (TRIES + 1 - tries) * len(every)))
                worst = whole & (shape <= (every[few - 1] if few else -np.inf))
                which = worst if several else which | worst
            chosen.append(body.global_index[which])
        return self._split_and_say_so(chosen)

    def _split_and_say_so(self, chosen: Sequence[NDArray[np.int64]]) -> bool:
        problem = self._problem
        first = problem.history.statistics["split_domains"] == 0
        count = self.split(chosen)
        if first and count:
            warn(
                problem.bodies[0].mesh.comm,
                f"{count} quadrilaterals fold and are split into triangles, and others may be "
                "later; with quadrature_degree=2 and f_bar='domain' they would not.",
            )
        return count > 0

    def repeat(self, snapshot: Snapshot, functions: bool, source: str) -> None:
        """Make the cuts with which a state was made (collective).

        Raises:
            MPMError: The problem has others.
        """
        problem = self._problem
        present = [body.trail.cuts for body in problem.bodies]
        wanted = [
            np.array(cuts, dtype=np.int64).reshape(-1, 2) for cuts in snapshot.numbers["cuts"]
        ]
        for mine, theirs in zip(present, wanted, strict=True):
            if not np.array_equal(mine, theirs[: len(mine)]):
                raise MPMError(
                    f"{source} was made when other domains were split than now; restore it into a "
                    "problem that is made as at first."
                )
        own = snapshot.tables[: len(problem.bodies)]
        moved = ["mesh nodes" in table.columns for table in own]
        if any(
            body.undeformed.origin is not None and not new
            for body, new in zip(problem.bodies, moved, strict=True)
        ):
            raise MPMError(
                f"{source} was made before the body was rebased; restore it into a problem that is "
                "made as at first."
            )
        missing = [theirs[len(mine) :] for mine, theirs in zip(present, wanted, strict=True)]
        if not any(map(len, missing)) and not any(moved):
            return
        if functions:
            raise MPMError(
                f"{source} was made after domains were split or the body rebased, so functions= on "
                "the mesh of before cannot be restored; restore it without them."
            )
        problem.setup.require_movable("this checkpoint cannot be restored")
        if any(map(len, missing)):
            self._remesh(missing)
        if any(moved):
            comm = problem.bodies[0].V.mesh.comm
            positions = [
                RowExchange(comm, table.rows, body.global_index)(table.columns["mesh nodes"])
                if new
                else None
                for body, table, new in zip(problem.bodies, snapshot.tables, moved, strict=False)
            ]
            self._remesh([cuts[:0] for cuts in missing], positions)

    def split(self, chosen: Sequence[NDArray[np.int64]]) -> int:
        """Split domains; return how many (collective).

        Args:
            chosen: For each body global indices, which ranks may name apart or together.

        Raises:
            MPMError: They, or the problem, cannot be split.
        """
        problem = self._problem
        comm = problem.bodies[0].V.mesh.comm
        every = comm.allgather([part.tolist() for part in chosen])
        wanted = [sorted({p for parts in every for p in parts[i]}) for i in range(len(chosen))]
        if not any(wanted):
            return 0
        problem.setup.require_divisible()
        cuts = [_cuts(body, which) for body, which in zip(problem.bodies, wanted, strict=True)]
        gradients = [body.placement.gradient() for body in problem.bodies]
        masses = [problem.built.mass_matrices(number).sum(axis=2) for number in range(len(chosen))]
        moves = self._remesh(cuts)
        for number, (body, move, gradient, mass) in enumerate(
            zip(problem.bodies, moves, gradients, masses, strict=True)
        ):
            masses_of_nodes, matrices = move.masses(mass), _unshared(problem, number)
            gradient = move.of_cells(gradient)
            undeformed = body.undeformed
            if undeformed.mass_share is None:
                continue
            halves, reference = move.halves, undeformed.reference
            shares = undeformed.mass_shares()
            earlier = reference.gradient.copy()
            rule, gdim = body.geometry.rule(), earlier.shape[-1]
            nodal = body.of_domains(body.converged_displacement)
            in_mesh = rule.displacement_gradient(nodal)
            earlier[halves] = _earlier(gradient[halves], in_mesh[halves])
            volume = rule.weights / np.linalg.det(np.eye(gdim) + earlier)
            volume = np.where(halves, volume.sum(axis=1), reference.volume)
            averages = np.where(halves[:, None], body.geometry.averages, reference.averages)
            undeformed.refer(Reference(earlier, volume, averages, reference.domains))
            shares[halves] = _shares(matrices[halves], masses_of_nodes[halves])
            undeformed.set_mass_shares(shares)
        count = sum(map(len, cuts))
        problem.history.statistics["split_domains"] += count
        return count

    def rebase(self) -> None:
        """Take the present positions of all bodies for those of their meshes (collective).

        Raises:
            MPMError: They, or the problem, cannot be rebased.
        """
        problem = self._problem
        self._require_movable_nodes()
        built, count = problem.built, len(problem.bodies)
        masses = [built.mass_matrices(number).sum(axis=2) for number in range(count)]
        none = np.zeros((0, 2), dtype=np.int64)
        positions = [body.placement.domains for body in problem.bodies]
        moves = self._remesh([none] * len(positions), positions)
        for number, (body, move, mass) in enumerate(
            zip(problem.bodies, moves, masses, strict=True)
        ):
            body.undeformed.set_mass_shares(_shares(_unshared(problem, number), move.masses(mass)))

    def _require_movable_nodes(self) -> None:
        problem = self._problem
        setup, consequence = problem.setup, "the body cannot be rebased"
        for given in setup.bodies:
            given.require_movable_nodes(consequence)
        setup.require_no(setup.supports, consequence)
        require_no_conditions_on_bodies(problem.bcs, problem.bodies, consequence)
        setup.require_remeshable(consequence)
        for body in problem.bodies:
            degree, cells = body.W.ufl_element().degree, _compat.geometry_degree(body.mesh)
            if body.is_free or not body.shares_nodes or cells not in (1, degree):
                raise MPMError(
                    "rebase() needs method='cpdi2' without free nodes, and cells that are straight "
                    "or of the body's own degree."
                )
            with agree(body.mesh.comm):
                bad = np.union1d(body.folded(), body.global_index[body.deleted])
                if len(bad):
                    raise MPMError(
                        "{particles} are concave or deleted, so the body cannot be rebased; split "
                        "concave quadrilaterals first.",
                        bad,
                    )
            body.locate()

    def _remesh(
        self,
        cuts: Sequence[Cuts],
        positions: Sequence[NDArray[np.float64] | None] | None = None,
    ) -> list[Remesh]:
        """Make a problem anew on meshes with cuts or with moved nodes (collective).

        Args:
            cuts: For each body.
            positions: For each body, of its domains' nodes; displacements are zero then.
        """
        problem = self._problem
        places = [None] * len(cuts) if positions is None else list(positions)
        moves: list[Remesh] = []
        references = [
            body.undeformed.reference if x is None else body.present_reference()
            for body, x in zip(problem.bodies, places, strict=True)
        ]
        shares = [
            np.ones(body.domain_nodes.shape)
            if body.undeformed.mass_share is None
            else body.undeformed.mass_shares()
            for body in problem.bodies
        ]

        def change() -> None:
            for body, some, x in zip(problem.bodies, cuts, places, strict=True):
                own = body.W if x is not None and body.W.ufl_element().degree > 1 else None
                moves.append(Remesh(body.mesh, some, x, own))
                body.live_on(moves[-1], some, x)

        def carry(snapshot: Snapshot) -> Snapshot:
            tables = []
            for body, move, table, reference, share, x in zip(
                problem.bodies, moves, snapshot.tables, references, shares, places, strict=False
            ):
                before = {name: Column(v, table.places[name]) for name, v in table.columns.items()}
                if body.undeformed.mass_share is not None:
                    before |= {**reference.columns(), "mass share": Column(share, "nodes")}
                if x is not None:
                    before["mesh nodes"] = Column(x, "nodes")
                columns = {name: move.column(column).values for name, column in before.items()}
                if x is not None:
                    columns["displacement"] = np.zeros_like(columns["displacement"])
                tables.append(Table(move.index, columns))
            snapshot.numbers["cuts"] = [body.trail.cuts.tolist() for body in problem.bodies]
            return Snapshot(snapshot.numbers, [*tables, *snapshot.tables[len(tables) :]])

        problem.state.before_remeshing()
        problem.state.renew(change, carry)
        return moves


def _unshared(problem: Remeshable, number: int) -> NDArray[np.float64]:
    """Return the mass matrix of each domain of a body without shares of masses (collective)."""
    ratio = problem.bodies[number].undeformed.volume_ratio
    return problem.built.mass_matrices(number, ratio)


def _diagonals(body: Particles) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the diagonal of each owned domain, and whether it can be cut along it."""
    diagonal, least = diagonals(body.geometry.corner_jacobians(body.corners()))
    return diagonal, (least > 0.0) & ~body.geometry.triangular & ~body.deleted


def _cuts(body: Particles, which: list[int]) -> Cuts:
    """Return how domains of a body are to be cut (collective)."""
    if not which:
        return np.zeros((0, 2), dtype=np.int64)
    comm = body.mesh.comm
    validate_distortion(
        body.mesh,
        body.method,
        body.W.ufl_element().degree,
        body.geometry.quadrature_degree,
        "split",
    )
    diagonal, good = _diagonals(body)
    mine = np.isin(body.global_index, which) & good
    told = comm.allgather(np.column_stack([body.global_index, diagonal])[mine])
    cuts = np.concatenate(told)
    cuts = cuts[np.argsort(cuts[:, 0])]
    refused = np.setdiff1d(which, cuts[:, 0])
    if len(refused):
        raise MPMError(
            "{particles} cannot be split: there are no such particles, they are triangles or "
            "deleted, or cross themselves.",
            refused,
        )
    return np.asarray(cuts, dtype=np.int64)


def _earlier(gradient: NDArray[np.float64], h: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return E of ``(I + h) (I + E) = I + gradient``, arrays ``(n, nq, gdim, gdim)``."""
    return np.asarray(np.linalg.solve(np.eye(h.shape[-1]) + h, gradient - h))


def _shares(matrices: NDArray[np.float64], masses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the factors of the density at the nodes that make given masses there, ``(n, k)``.

    Args:
        matrices: ``int density Q_c Q_d dX``, shape ``(n, k, k)``.
        masses: Shape ``(n, k)``.
    """
    shares = np.ones_like(masses)
    heavy = matrices.sum(axis=(1, 2)) > 0.0
    shares[heavy] = np.linalg.solve(matrices[heavy], masses[heavy][:, :, None])[:, :, 0]
    return shares
