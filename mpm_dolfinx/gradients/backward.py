# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""One step, gone through backward.

With the step of :mod:`~mpm_dolfinx.gradients.forward`, let l be the derivative of a functional by
the displacement at its end, and m that by what materials keep. With P the stress at the points, W
their weights, g the gradient there that laws see by a motion, and dashes for partial derivatives,

    l += g^T H_F^T m,   A^T z = T^T l,   q = T z,   v = l - K^T q,
    l_n = v + (grad y)^T v - (grad z)^T r,
    m_n = H_h^T m - P_h^T W g q,    dJ/dp += m . H_p - P_p . W g q - q . f_p,

where y and z are functions on the background, with their gradients at the body's nodes, r and f the
forces there, all and those of loads. Derivatives of laws are those of
:class:`~mpm_dolfinx.gradients.laws.Laws`, those of the forces by displacements the tangents that
Newton's method has.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError
from ..materials.base import State
from ..parallel.magnitudes import norm
from ..problems.quasistatic import QuasiStaticProblem
from ..solvers.newton import NewtonSolver
from ..tolerances import ROUND_OFF, SMALL
from .laws import Laws
from .nearby import add_product, varying, without_tangents
from .slopes import Slopes

__all__ = ["Backward", "Record", "Weights", "copied", "no_weights"]

type Array = NDArray[np.float64]


class Record(NamedTuple):
    """A step that was made.

    Attributes:
        before: Displacement at its beginning, of each body.
        after: That at its end.
        increments: Of the background, on own dofs of V of each field.
        memories: What materials kept at its beginning, for each body, where displacements do not
            tell it; nothing where it is to be found again (:meth:`Backward.remembered`).
        data: What the forms hold besides.
    """

    before: list[Array]
    after: list[Array]
    increments: list[Array]
    memories: list[list[State]]
    data: list[Array]


@dataclass
class Weights:
    """Derivatives of a functional by the state at the end of a step.

    Attributes:
        motion: By displacements, on W of each body.
        states: By what materials keep, for each body.
    """

    motion: list[fem.Function]
    states: list[list[State]]


class Gone(NamedTuple):
    """A step that was gone through.

    Attributes:
        moved: q on W of each body.
        backgrounds: z on own dofs of V of each field.
        laws: Derivatives of the materials of each body.
    """

    moved: list[fem.Function]
    backgrounds: list[PETSc.Vec]
    laws: list[Laws]


class Backward:
    """Goes through the steps of a run backward (collective).

    Args:
        problem: The problem.
        newton: Solves with its tangents.
    """

    def __init__(self, problem: QuasiStaticProblem, newton: NewtonSolver) -> None:
        self._problem, self._newton = problem, newton
        self._reduced = problem.reduced

    def remembered(self, records: Sequence[Record]) -> list[Record]:
        """Return successive steps, of which the first has memories, with the memories of all.

        Raises:
            MPMError: Materials do not answer as they did.
        """
        problem, found = self._problem, list(records[:1])
        for record in records[1:]:
            self._begin(found[-1])
            for body, after in zip(problem.bodies, found[-1].after, strict=True):
                body.displacement.x.array[:] = after
            with without_tangents(problem):
                if (failure := self._reduced.terms.update()) is not None:
                    raise failure
            trials = [points.trial.memories() for points in problem.points]
            found.append(record._replace(memories=copied(trials)))
        return found

    def _begin(self, record: Record) -> None:
        """Go to the beginning of a step."""
        for body, points, before, memories in zip(
            self._problem.bodies, self._problem.points, record.before, record.memories, strict=True
        ):
            body.restore(before.copy().reshape(-1, body.mesh.geometry.dim))
            body.roll_back()
            points.recall(memories)

    def go_to(self, record: Record, data: Sequence[Array]) -> None:
        """Go to the end of a step, where all is as it was when that was solved.

        Args:
            record: The step.
            data: What forms hold, to be set.

        Raises:
            MPMError: It is no equilibrium any more.
        """
        problem, reduced = self._problem, self._reduced
        for array, values in zip(data, record.data, strict=True):
            array[...] = values
        self._begin(record)
        reduced.unknowns.forget()
        none = [np.zeros(len(field.bodies[0].increment.x.array)) for field in reduced.fields]
        reduced.begin(none, 0.0)
        for field, y in zip(reduced.fields, record.increments, strict=True):
            field.u.array_w[:] = y
        for body, after in zip(problem.bodies, record.after, strict=True):
            body.displacement.x.array[:] = after
        if (failure := reduced.balance.evaluate()) is not None:
            raise failure
        rest = norm(reduced.unknowns.restricted(reduced.unknowns.forces))
        if rest > SMALL * reduced.scale() and rest > SMALL * reduced.balance.internal_scale():
            raise MPMError(
                "A step that an Adjoint goes through again is no equilibrium: what the forms hold "
                "has changed, other than Constants, loads and parameters of materials."
            )

    def step(self, record: Record, weights: Weights) -> Gone:
        """Take derivatives by a step's end to those by its beginning; :meth:`go_to` comes first.

        Args:
            record: The step.
            weights: At its end; its motion is changed, states are for the caller to change.

        Raises:
            MPMError: The end of the step cannot be evaluated.
        """
        problem, reduced = self._problem, self._reduced
        laws = [Laws(points) for points in problem.points]
        r = reduced.terms.last_nodal_forces()
        tangents = []
        for law, points, term, motion, own in zip(
            laws,
            problem.points,
            problem.built.body_terms,
            weights.motion,
            weights.states,
            strict=True,
        ):
            slope, tangent = law.by_gradient(own)
            tangents.append(tangent)
            size = points.strain.weights.ravel()[:, None, None]
            stress = law.effective(np.divide(slope, size, where=size > 0.0, out=0.0 * slope))
            _add_to(motion, term.forms.force_of(stress))
        with ExitStack() as blocks:
            for points, tangent in zip(problem.points, tangents, strict=True):
                blocks.enter_context(points.asked.with_tangent(tangent))
            # (F-bar has been asked for other stresses since the step was evaluated)
            averages = any(p.averaging is not None for p in problem.points)
            if averages or any(tangent is not None for tangent in tangents):
                if (failure := reduced.balance.evaluate()) is not None:
                    raise failure
            z = self._solved([_vector(motion) for motion in weights.motion])
            backgrounds = [field.on_background(z) for field in reduced.fields]
            moved = self._moved(backgrounds)
            forces = self._stiffness(moved)
        for number, (body, motion) in enumerate(zip(problem.bodies, weights.motion, strict=True)):
            place = reduced.fields.index(reduced.unknowns.place(body)[0])
            gdim = body.mesh.geometry.dim
            v = (_vector(motion).array_r - forces[number]).reshape(-1, gdim)
            forces_here = r[number].reshape(-1, gdim)
            total = v.copy()
            y = backgrounds[place].duplicate()
            y.array_w[:] = record.increments[place]
            slopes = Slopes(body)
            total += np.einsum("nci,nc->ni", slopes.of(y), v)
            total -= np.einsum("nci,nc->ni", slopes.of(backgrounds[place]), forces_here)
            motion.x.array[: total.size] = total.ravel()
            motion.x.scatter_forward()
        return Gone(moved, backgrounds, laws)

    def _solved(self, motion: Sequence[PETSc.Vec]) -> PETSc.Vec:
        """Return z of ``A^T z = T^T l`` in the unknowns."""
        reduced = self._reduced
        totals = reduced.unknowns.zeros()
        for body, force in zip(self._problem.bodies, motion, strict=True):
            reduced.unknowns.add([body], [force], totals)
        right = reduced.unknowns.restricted(totals)
        z = right.duplicate()
        self._newton.linearise(anew=True, tolerance=ROUND_OFF)(right, z)
        return z

    def _moved(self, backgrounds: Sequence[PETSc.Vec]) -> list[fem.Function]:
        """Return ``T z`` on W of each body."""
        reduced, found = self._reduced, []
        for body in self._problem.bodies:
            place = reduced.fields.index(reduced.unknowns.place(body)[0])
            found.append(fem.Function(body.W))
            add_product(found[-1], body.T, backgrounds[place])
        return found

    def _stiffness(self, motion: Sequence[fem.Function]) -> list[Array]:
        """Return the tangent times a motion, on own dofs of W of each body."""
        found = []
        for term, function in zip(self._problem.built.body_terms, motion, strict=True):
            (force,) = term.stiffness_force([_vector(function)])
            found.append(force.array_r.copy())
        return found


def copied(memories: Sequence[Sequence[State]]) -> list[list[State]]:
    """Return the states of the bodies' materials, as arrays that nobody else changes."""
    return [[{name: v.copy() for name, v in own.items()} for own in body] for body in memories]


def _vector(function: fem.Function) -> PETSc.Vec:
    """Return the values of a Function as a vector of this rank's own dofs."""
    dofs = function.function_space.dofmap
    count = dofs.index_map.size_local * dofs.index_map_bs
    vector = PETSc.Vec().createMPI((count, None), comm=function.function_space.mesh.comm)
    vector.array_w[:] = function.x.array[:count]
    return vector


def _add_to(function: fem.Function, vector: PETSc.Vec) -> None:
    """Add a vector to a Function (collective)."""
    function.x.array[: vector.getLocalSize()] += vector.array_r
    function.x.scatter_forward()


def no_weights(problem: QuasiStaticProblem) -> Weights:
    """Return derivatives of nothing."""
    states = [
        [{k: np.zeros_like(v) for k, v in varying(one).items()} for one in points.last.states]
        for points in problem.points
    ]
    return Weights([fem.Function(body.W) for body in problem.bodies], states)
