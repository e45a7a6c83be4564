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
forces there, all and those of loads. Derivatives of laws are central differences, those of the
forces by displacements the tangents that Newton's method has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..constitutive.points import MaterialPoints
from ..errors import MPMError
from ..materials.base import State
from ..parallel.magnitudes import norm
from ..particles.particles import Particles
from ..problems.quasistatic import QuasiStaticProblem
from ..solvers.newton import NewtonSolver
from ..transfer.matrix import transfer_matrix
from .nearby import add_product, varying
from .parameters import CHANGE

__all__ = ["Backward", "Laws", "Record", "Weights", "no_weights", "slope_of"]

type Array = NDArray[np.float64]

#: Second difference from which values bend, relative to the first and to the largest of these; by
#: what differences are smaller then.
BENDS, NOTICED, FINER = 1e-3, 1e-6, 1e-3
#: What a residual may be when a step is gone through again, relative to the forces; what a linear
#: solve leaves, and how often it is corrected; what tangents may differ by from differences.
AGAIN, SOLVED, CORRECTIONS, TANGENT = 1e-6, 1e-13, 5, 1e-6


class Record(NamedTuple):
    """A step that was made.

    Attributes:
        before: Displacement at its beginning, of each body.
        after: That at its end.
        increments: Of the background, on own dofs of V of each field.
        memories: What materials kept at its beginning, for each body, where displacements do not
            tell it.
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


class Laws:
    """Derivatives of the materials at the points of a body, in one step.

    Args:
        points: The points, after the update of the step.
    """

    def __init__(self, points: MaterialPoints) -> None:
        self._points = points
        self._gradient = points.trial.gradient.copy()
        self._states = points.last.states
        self._after = points.trial.states
        self._own = self.answers()
        particles = points.strain.particles
        self._shape = (particles.num_local, particles.num_points)

    def by_gradient(self, weights: list[State]) -> tuple[Array, Array | None]:
        """Return ``H_F^T m`` at the points, shape ``(n nq, dim, dim)``, and ``P_F^T``.

        A point between two branches of a law has the slope of differences, as in a
        :class:`Sensitivity`, where the tangent that it tells is another one.

        Args:
            weights: m.

        Returns:
            The second is ``None`` where the law's own tangent is as good.
        """
        found = np.zeros(self._gradient.shape)
        if not any(np.any(values) for own in weights for values in own.values()) and not any(
            self.have_history()
        ):
            return found, None
        tangent = self._points.laws.tangents(self._gradient, self._states)
        slopes = np.empty(tangent.shape)
        for i, J in np.ndindex(found.shape[1:]):
            way = np.zeros(found.shape[1:])
            way[i, J] = 1.0

            def at(amount: float, way: Array = way) -> Array:
                P, states = self._points.laws.answers(self._gradient + amount * way, self._states)
                kept = self._weighed(weights, states, self._own[1])
                return np.column_stack([kept, (P - self._own[0]).reshape(len(P), -1)])

            both = slope_of(at, CHANGE)
            found[:, i, J] = both[:, 0]
            slopes[..., i, J] = both[:, 1:].reshape(found.shape)
        axes = tuple(range(1, tangent.ndim))
        size = np.abs(tangent).max(axis=axes, initial=0.0)
        apart = np.abs(slopes - tangent).max(axis=axes, initial=0.0) > TANGENT * size
        comm = self._points.strain.particles.mesh.comm
        if self._points.symmetric and not comm.allreduce(bool(apart.any())):
            return found, None
        tangent[apart] = slopes[apart]
        return found, np.ascontiguousarray(tangent.transpose(0, 3, 4, 1, 2))

    def have_history(self) -> list[bool]:
        """Return whether the answer of each material depends on what it keeps."""
        return [bool(memory) for memory in self._points.last.memories()]

    def by_states(self, weights: list[State], work: Array) -> list[State]:
        """Return ``H_h^T m - P_h^T W g q``, as states are.

        Args:
            weights: m.
            work: ``W g q``, shape ``(n nq, dim, dim)``.
        """
        found = [{name: np.zeros_like(values) for name, values in own.items()} for own in weights]
        for law, own in enumerate(found):
            for name, values in own.items():
                size = max(
                    float(np.abs(side[law][name]).max(initial=0.0))
                    for side in (self._states, self._after)
                )
                amount = CHANGE * (size or 1.0)
                if not self._matters(law, name, amount):
                    continue
                for place in np.ndindex(values.shape[1:]):

                    def at(
                        change: float,
                        law: int = law,
                        name: str = name,
                        place: tuple[int, ...] = place,
                    ) -> Array:
                        states = self._with(law, name, place, change)
                        answer = self._points.laws.answers(self._gradient, states)
                        return self.change(weights, work, answer)

                    slope = slope_of(at, amount)
                    values[:, *place] = slope[self._points.laws.governed[law].points]
        return found

    def _matters(self, law: int, name: str, amount: float) -> bool:
        """Return whether anything depends on a part of the state, on this rank."""
        whole = self._points.laws.answers(self._gradient, self._with(law, name, (), amount))
        own = self._own
        same = np.array_equal(whole[0], own[0])
        return not same or any(
            not np.array_equal(values, its[key])
            for one, its in zip(whole[1], own[1], strict=True)
            for key, values in one.items()
        )

    def _with(self, law: int, name: str, place: tuple[int, ...], amount: float) -> list[State]:
        """Return the states with one number of each point changed, or all of them."""
        states = list(self._states)
        values = states[law][name].copy()
        every: Any = (slice(None), *place)
        values[every] += amount
        states[law] = states[law] | {name: values}
        return states

    def change(self, weights: list[State], work: Array, answer: tuple[Array, list[State]]) -> Array:
        """Return the change of ``m . H - P : W g q`` to an answer beside the state."""
        found = self._weighed(weights, answer[1], self._own[1])
        return np.asarray(found - np.einsum("niJ,niJ->n", answer[0] - self._own[0], work))

    def answers(self) -> tuple[Array, list[State]]:
        """Return the answers of the laws, with the numbers that they have now."""
        return self._points.laws.answers(self._gradient, self._states)

    def _weighed(self, weights: list[State], after: list[State], before: list[State]) -> Array:
        """Return the products of weights and differences of states, at all points."""
        found = np.zeros(len(self._gradient))
        laws = self._points.laws.governed
        for part, own, one, other in zip(laws, weights, after, before, strict=True):
            points = part.points
            for name, values in own.items():
                product = (one[name] - other[name]) * values
                found[points] += product.reshape(len(points), -1).sum(axis=1)
        return found

    # -- F-bar -----------------------------------------------------------------------------

    def seen(self, motion: fem.Function) -> tuple[Array, Array]:
        """Return a motion as laws see it (collective).

        Args:
            motion: On W.

        Returns:
            ``g q`` at the points, and the derivative of the energy of deviations over its modulus,
            which is zero without F-bar.
        """
        points, d = self._points, self._points.strain.particles.displacement.x
        own, averaging = d.array.copy(), self._points.averaging
        d.array[:] = motion.x.array
        direction = points.strain.gradient().copy()
        d.array[:] = own
        shape = self._gradient.shape
        if averaging is None:
            return direction.reshape(shape), np.zeros(self._shape)
        gradient, sides, energies = points.strain.gradient().copy(), [], []
        amount = CHANGE / max(float(np.abs(direction).max(initial=0.0)), 1e-300)
        comm = points.strain.particles.mesh.comm
        amount = min(comm.allgather(amount))
        modulus = averaging.modulus[:, None]
        for sign in (1.0, -1.0):
            sides.append(averaging.average(gradient + sign * amount * direction).copy())
            energies.append(averaging.energy() / modulus)
        averaging.average(gradient)
        rate = (sides[0] - sides[1]) / (2.0 * amount)
        return rate.reshape(shape), (energies[0] - energies[1]) / (2.0 * amount)

    def effective(self, stress: Array) -> Array:
        """Return ``g^T`` of a stress that works on what laws see (collective)."""
        averaging = self._points.averaging
        if averaging is None:
            return stress
        shape = (*self._shape, *stress.shape[1:])
        none = np.zeros((*shape, *stress.shape[1:]))
        whole = averaging.effective(stress.reshape(shape), none)[0]
        own = averaging.effective(np.zeros(shape), none)[0]
        return (whole - own).reshape(stress.shape)


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
        for body, points, before, memories in zip(
            problem.bodies, problem.points, record.before, record.memories, strict=True
        ):
            body.restore(before.copy().reshape(-1, body.mesh.geometry.dim))
            body.roll_back()
            points.recall(memories)
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
        if rest > AGAIN * reduced.scale() and rest > AGAIN * reduced.balance.internal_scale():
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
            problem.body_terms,
            weights.motion,
            weights.states,
            strict=True,
        ):
            slope, tangent = law.by_gradient(own)
            tangents.append(tangent)
            size = points.weights.ravel()[:, None, None]
            stress = law.effective(np.divide(slope, size, where=size > 0.0, out=0.0 * slope))
            _add_to(motion, term.forms.force_of(stress))
        with ExitStack() as blocks:
            for points, tangent in zip(problem.points, tangents, strict=True):
                blocks.enter_context(points.with_tangent(tangent))
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
            for i, matrix in enumerate(_gradients(body)):
                slope_y, slope_z = matrix.createVecLeft(), matrix.createVecLeft()
                matrix.mult(y, slope_y)
                matrix.mult(backgrounds[place], slope_z)
                total[:, i] += (slope_y.array_r.reshape(-1, gdim) * v).sum(axis=1)
                total[:, i] -= (slope_z.array_r.reshape(-1, gdim) * forces_here).sum(axis=1)
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
        z, rest = right.duplicate(), right.copy()
        z.set(0.0)
        solve, size = self._newton.linearise(anew=True), norm(right)
        K = self._newton.K
        assert K is not None
        for _ in range(CORRECTIONS):
            if norm(rest) <= SOLVED * size:
                break
            part = rest.duplicate()
            solve(rest, part)
            z.axpy(1.0, part)
            K.mult(z, rest)
            rest.aypx(-1.0, right)
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
        for term, function in zip(self._problem.body_terms, motion, strict=True):
            (force,) = term.stiffness_force([_vector(function)])
            found.append(force.array_r.copy())
        return found


def slope_of(at: Callable[[float], Array], amount: float) -> Array:
    """Return the derivative of values at points, which may be near another branch of a law.

    Args:
        at: Returns the change of values by an amount, shape ``(n, ...)``, not collective.
        amount: For the difference; points that bend within it have a smaller one.
    """
    plus, minus = at(amount), at(-amount)
    slope = (plus - minus) / (2.0 * amount)
    first, second = np.abs(plus - minus), np.abs(plus + minus)
    bends = (second > BENDS * first) & (second > NOTICED * first.max(axis=0, initial=0.0))
    if bends.any():
        finer = FINER * amount
        fine = (at(finer) - at(-finer)) / (2.0 * finer)
        slope[bends] = fine[bends]
    return np.asarray(slope)


def _gradients(body: Particles) -> list[PETSc.Mat]:
    """Return matrices of derivatives of functions on V, in each direction, at a body's nodes."""
    basis = body.node_gradients()
    assert basis.gradients is not None
    return [
        transfer_matrix(
            basis._replace(values=np.ascontiguousarray(basis.gradients[:, :, i])), body.W, body.V
        )
        for i in range(basis.gradients.shape[2])
    ]


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
