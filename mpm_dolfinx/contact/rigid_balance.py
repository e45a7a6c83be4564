# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Balance of the forces on a rigid body in a step, in unknowns of its own.

Its displacement and rotation in a step are unknowns beside those of the backgrounds
(:mod:`~mpm_dolfinx.system.own`), rotations times, and moments over, a length by which they have the
units of displacements and forces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import ConvergenceError, MPMError, agree, agreed
from ..system.own import OwnUnknowns
from ..tolerances import HALF_DIGITS, INEXACT, LAST_PLACES, LOCAL_ITERATIONS, NEGLIGIBLE
from .body_contact import BodyContact
from .rigid_motion import RigidMotion, State
from .rotation import QUARTER, Pose

__all__ = ["RigidBalance"]

#: Drag on a body that creeps to its balance, over the largest stiffness, to begin with; by how much
#: it rises where the residual becomes larger than by a factor.
DRAG, RISES, GROWS = 0.1, 4.0, 2.0
#: What is said where forces and moments on a body at rest are left.
ADVICE = (
    "{} of the forces on a RigidBody do not balance: where it slides or rolls away, hold more of "
    "it (fixed=), or give it a mass in a DynamicProblem"
)


class Forces(NamedTuple):
    """Forces on a rigid body somewhere.

    Attributes:
        left: Forces and moments in the units of its unknowns, shape ``(n,)``.
        size: Size of all that these are the sum of.
        touches: Whether anything touches it.
    """

    left: NDArray[np.float64]
    size: float
    touches: bool


class RigidBalance:
    """The balance of a rigid body that contacts and other forces act on.

    Args:
        contacts: Its contacts.
        motion: How it moves.
        comm: The ranks.

    Attributes:
        own: Its unknowns: what is not held; ``None`` where all is.
        share: What forces of contact are divided by; see :meth:`.Term.pace`.
    """

    def __init__(
        self, contacts: Sequence[BodyContact], motion: RigidMotion, comm: MPI.Comm
    ) -> None:
        self._contacts, self._motion, self._comm = contacts, motion, comm
        self._free = ~motion.held
        count = int(np.count_nonzero(self._free))
        self.own = OwnUnknowns(comm, count) if count else None
        self.share = 1.0
        self._span = self._stiffness = 1.0
        self._units = np.eye(len(motion.held))
        self._path = np.zeros(len(motion.held))
        self._unsettled, self._creeps = False, True
        self._attempt: tuple[State, NDArray[np.float64]] | None = None

    def take_part(self) -> None:
        """Take the bodies as they are, at rest (collective)."""
        self.share, motion = 1.0, self._motion
        motion.dt, motion.whole = None, False
        self._span = max([contact.layout.span for contact in self._contacts])
        length = self._span if motion.gyration is None else motion.gyration
        turns = np.arange(len(motion.held)) >= len(motion.start)
        self._units = np.diag(np.where(turns, 1.0 / length, 1.0))

    def begin(self) -> None:
        """Begin a step, after its contacts (collective)."""
        motion = self._motion
        guess = motion.guess()
        self._path = np.where(motion.held, guess, 0.0)
        if (own := self.own) is None:
            return
        for contact in self._contacts:
            contact.couple(own.layout)
        stiffness = sum(contact.whole_stiffness for contact in self._contacts)
        self._stiffness = self._comm.allreduce(stiffness)
        own.start = np.zeros(own.total)
        before, aim = self._attempt, np.concatenate([*motion.push, self._path])
        self._attempt = motion.last, aim
        again = before is not None and before[0] is motion.last and np.array_equal(before[1], aim)
        self._creeps = not (again and self._creeps)
        self._unsettled = motion.dt is None
        own.expected, own.advice = None, ADVICE
        if not self._unsettled:
            own.expected, own.advice = self._unknowns(guess), ""

    @property
    def _each(self) -> NDArray[np.float64]:
        """Displacement and Cayley vector by each unknown, shape ``(gdim + nr, n)``."""
        return self._units[:, self._free]

    def _unknowns(self, step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unknowns of a step, in the units of displacements."""
        return np.asarray(step[self._free] / self._each.sum(axis=0))

    def update(self) -> MPMError | None:
        """Put the body where its unknowns say, and balance what acts on it there (collective)."""
        own = self.own
        if own is None:
            return agreed(self._comm, self._put(self._path))
        if self._unsettled:
            own.start = self._unknowns(self._approached(self._path))
            self._unsettled = False
        step = self._path + self._each @ (own.start + own.values)
        if (failure := agreed(self._comm, self._put(step))) is not None:
            return failure
        now = self._forces()
        own.residual, own.size = now.left / self.share, now.size / self.share
        if self._motion.dt is None and not now.touches and now.left.any():
            return _not_held(1.0)
        return None

    def _put(self, step: NDArray[np.float64]) -> MPMError | None:
        """Put the body where a step leads to, on this rank; return why that cannot be."""
        motion = self._motion
        motion.go(step)
        turn = 2.0 * np.arctan(0.5 * float(np.linalg.norm(motion.theta)))
        if not motion.held[-1] and turn > QUARTER:
            return ConvergenceError("A RigidBody turns too far in one step; take smaller ones")
        try:
            for contact in self._contacts:
                contact.put(self._pose())
        except MPMError as error:
            return error
        return None

    def _pose(self) -> Pose:
        """Return where the shape is, which turns about its pivot, and not about the centre."""
        state, arm = self._motion.trial, self._contacts[0].shape.pivot - self._motion.start
        return Pose(state.place + state.Q @ arm - arm, state.turn.angle)

    def _forces(self) -> Forces:
        """Return the forces on the body where it is (collective)."""
        motion, each = self._motion, self._each
        own = np.sum([contact.total(motion.centres) for contact in self._contacts], axis=0)
        *total, size, touching = self._comm.allreduce(own)
        parts = [each.T @ part for part in (motion.given(), motion.inertial())]
        whole = size + motion.swing() + sum(float(np.linalg.norm(part)) for part in parts)
        left = each.T @ np.array(total) + parts[1] - parts[0]
        return Forces(left, float(whole), bool(touching > 0.0))

    # -- Tangents ---------------------------------------------------------------------------------

    def tangents(self, secants: bool) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return the tangents of all contacts, with those of the unknowns (collective).

        Args:
            secants: Whether points that have changed their slip take secants instead.
        """
        if (unknowns := self.own) is None:
            every = [c.tangents() if secants else c.derivatives() for c in self._contacts]
            return {(i, i): K for i, each in enumerate(every) for K in each.values()}
        last, motion = len(self._contacts), self._motion
        found: dict[tuple[int, int], PETSc.Mat | None] = {}
        own = np.zeros_like(self._units)
        for i, contact in enumerate(self._contacts):
            part = contact.coupled(motion.centres, motion.theta, self._each, secants)
            found |= {(i, i): part.nodes, (last, i): part.of_motion, (i, last): part.by_motion}
            own += part.own
        found[last, last] = unknowns.matrix(self._firm(*self._whole(own)))
        return {pair: K for pair, K in found.items() if K is not None}

    def _whole(self, own: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Return the derivative of the balance by the unknowns, and the largest (collective).

        The largest may be one by what is held: round-off is small beside that.

        Args:
            own: Derivative of forces of contact by the step, on this rank.
        """
        every = self._comm.allreduce(own) + self._motion.slopes() / self.share
        K = self._each.T @ every @ self._each
        return K, float(np.linalg.norm(self._units @ every @ self._units, 2))

    def _firm(self, K: NDArray[np.float64], largest: float) -> NDArray[np.float64]:
        """Return a tangent that is as stiff as can be where nothing holds the body.

        Args:
            K: The tangent.
            largest: The largest stiffness there is, zero where nothing touches.
        """
        U, sizes, V = np.linalg.svd(K)
        most = largest or self._stiffness
        return np.asarray(U * np.where(sizes > NEGLIGIBLE * most, sizes, most) @ V)

    # -- Where it begins at rest ------------------------------------------------------------------

    def _approached(self, step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a step by which a body at rest comes near to its balance (collective).

        Others stay as they are. It creeps there against a drag: where points come to touch and lift
        off on its way, Newton's method goes to and fro between places of no balance, and what
        creeps goes downhill (pseudo-transient continuation). What it lies on does not give way
        meanwhile; where the step fails from there, it is tried again from where it touches first.

        Raises:
            MPMError: There is nothing on its way.
        """
        each, motion = self._each, self._motion
        drag, now = 0.0, self._tried(step)
        for _ in range(LOCAL_ITERATIONS):
            norm = float(np.linalg.norm(now.left))
            if norm <= INEXACT * now.size or (now.touches and not self._creeps):
                break
            with agree(self._comm):  # of the slopes of a user's shape
                parts = [contact.of_own(motion.centres, motion.theta) for contact in self._contacts]
            K, largest = self._whole(np.sum(parts, axis=0))
            if not now.touches or np.linalg.norm(K, 2) <= NEGLIGIBLE * largest:
                step = self._fallen(step, now)
                now = self._tried(step)
                continue
            drag = drag or DRAG * float(np.linalg.norm(K, 2))
            change = each @ np.linalg.solve(K + drag * np.eye(len(K)), now.left)
            tried = self._tried(step - change)
            if float(np.linalg.norm(tried.left)) > GROWS * norm:
                drag *= RISES
                now = self._tried(step)
                continue
            step, now = step - change, tried
        return step

    def _tried(self, step: NDArray[np.float64]) -> Forces:
        """Put the body where a step leads to; return the forces on it there (collective)."""
        with agree(self._comm):
            if (failure := self._put(step)) is not None:
                raise failure
        return self._forces()

    def _fallen(self, step: NDArray[np.float64], now: Forces) -> NDArray[np.float64]:
        """Return a step by which the body touches something, along a force that nothing holds.

        It goes on by the least distance of any point, within which there is nothing to touch.

        Raises:
            ConvergenceError: It touches already, or there is nothing on its way (collective).
        """
        way = -self._each @ now.left
        way[len(self._motion.start) :] = 0.0
        size = float(np.linalg.norm(way))
        extent = max(contact.layout.extent for contact in self._contacts)
        # (where it falls to: into what it falls on, by more than round-off of coordinates)
        close = HALF_DIGITS * self._span + LAST_PLACES * extent
        gap, gone = self._least_gap(step), 0.0
        far = 2.0 * (self._span + gap)
        while size > 0.0 and 0.0 < gap and gone < far:
            gone += gap
            step = step + gap / size * way
            before, gap = gap, self._least_gap(step)
            if gap < close:
                return np.asarray(step + (max(gap, 0.0) + close) / size * way)
            if gap > before:
                break
        raise _not_held(float(np.linalg.norm(now.left)) / now.size)

    def _least_gap(self, step: NDArray[np.float64]) -> float:
        """Return the least gap of all points after some step (collective)."""
        self._motion.go(step)
        with agree(self._comm):
            least = min(contact.least(self._pose()) for contact in self._contacts)
        return float(self._comm.allreduce(least, MPI.MIN))


def _not_held(share: float) -> MPMError:
    return ConvergenceError(
        f"Nothing holds a RigidBody against {share:.1e} of its forces; let it begin in touch, or "
        "give it a mass in a DynamicProblem"
    )
