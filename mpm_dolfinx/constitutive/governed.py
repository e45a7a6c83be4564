# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A material at the points that it governs: what it is asked, and what its answers must be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._core import is_as_inherited
from ..errors import ConvergenceError, MPMError, as_ours
from ..materials.base import Material, State, StrainMaterial, Update
from ..materials.kinematics import KINEMATICS
from ..materials.mandel import num_components
from ..particles.particles import Particles
from .pressure import VolumeStrain

__all__ = ["Answer", "Carried", "Governed"]

FLOAT = np.dtype(np.float64)
no_tangent: NDArray[np.float64] = np.zeros((0, 3, 3, 3, 3))
#: What a law answers first of all.
STRESS = "stress P"
#: Parts of a state that updates of this package do not read, or that displacements tell.
TOLD = ("stress", "displacement_gradient")


class Answer(NamedTuple):
    """Answer of a material, with a tangent."""

    first_piola: NDArray[np.float64]
    tangent: NDArray[np.float64]
    state: State


class Carried(NamedTuple):
    """State of points that begin with a stress, or go on with it under another law.

    Attributes:
        stress: Cauchy stress, shape ``(n, 3, 3)``.
        gradient: ``F - I`` that laws see, shape ``(n, dim, dim)``.
        gap: Volume strain beyond that of the stress, shape ``(n,)``, where a pressure of its own
            stands for the mean stress, which is the law's on average alone; ``None`` for none.
    """

    stress: NDArray[np.float64]
    gradient: NDArray[np.float64]
    gap: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Governed:
    """A material and the points that it governs.

    Errors name ``particles`` by their global indices.

    Attributes:
        particles: The body.
        dim: Dimension of stress and strain.
        material: With its parameters at the points.
        points: Their numbers among all points of this rank, shape ``(n,)``.
        law: What is evaluated: the material, or it without its bulk modulus.
        at_pressure: Whether it is evaluated at a pressure, as its mean stress does not come apart.
    """

    particles: Particles
    dim: int
    material: Material
    points: NDArray[np.int64]
    law: Material
    at_pressure: bool = False

    @cached_property
    def is_own(self) -> bool:
        """Whether the law is one of this package, which gives its answers away for good."""
        return _of_package(type(self.material))

    @cached_property
    def inelastic_variables(self) -> tuple[str, ...]:
        """Internal variables that change where a point yields."""
        material = self.material
        return tuple(n for n in material.internal_variables if n not in material.reversible)

    def given_away(self, state: State) -> State:
        """Return an answered state that the law will not write into any more."""
        return state if self.is_own else {name: values.copy() for name, values in state.items()}

    def memory(self, state: State) -> State:
        """Return the part of a converged state that updates read and displacements do not tell.

        A law with an update of its own may read all of it.
        """
        told = TOLD if _of_package(type(self.material).update) else ()
        return {name: values for name, values in state.items() if name not in told}

    def recalled(self, memory: State, gradient: NDArray[np.float64], state: State) -> State:
        """Return a state that updates go on from as they would from that of a :meth:`memory`.

        Args:
            memory: The memory.
            gradient: ``F - I`` that the law saw then, shape ``(n, dim, dim)``.
            state: Any of this law.
        """
        seen = {"displacement_gradient": gradient} if "displacement_gradient" in state else {}
        return state | seen | memory

    def initial_state(self) -> State:
        """Return the state of the points where nothing is strained yet.

        Raises:
            MPMError: The law fails, or gives something else than a state.
        """
        what, count = f"initial_state of {type(self.material).__name__}", len(self.points)
        try:
            state = self.material.initial_state(count, self.dim)
        except MPMError:
            raise
        except Exception as error:
            raise as_ours(error, what) from error
        if not isinstance(state, dict) or "stress" not in state:
            raise MPMError(f"{what} must return a dictionary of arrays with 'stress' among them.")
        for name, values in state.items():
            if not isinstance(values, np.ndarray) or values.shape[:1] != (count,):
                raise MPMError(
                    f"{what} must return arrays of {count} rows, one for each point, but "
                    f"{name!r} is {_told(values)}."
                )
        stress = (count, num_components(self.dim))
        if state["stress"].shape != stress or state["stress"].dtype != np.float64:
            raise MPMError(
                f"{what} must return a 'stress' of shape {stress} and type float64, not "
                f"{_told(state['stress'])}."
            )
        return state

    def undeformed_tangent(self) -> NDArray[np.float64]:
        """Return dP/dF where nothing is strained, shape ``(n, dim, dim, dim, dim)``."""
        undeformed = np.zeros((len(self.points), self.dim, self.dim))
        return self.answer(undeformed, self.initial_state()).tangent

    def answer(self, gradient: NDArray[np.float64], state: State, tangent: bool = True) -> Answer:
        """Return the answer of the law, checked; the law cannot write into its input.

        Args:
            gradient: ``F - I``, shape ``(n, dim, dim)``.
            state: Of the last converged step.
            tangent: Whether the tangent is needed; it is empty otherwise.

        Raises:
            MPMError: The law fails, or its answer is not finite or of another shape or type.
        """
        received = _read_only(gradient), _protected(state)
        answer = self._asked(lambda: self.law.update(*received, tangent=tangent))
        if not isinstance(answer, Update):
            raise MPMError(
                f"The update of {type(self.material).__name__} must return a materials.Update, not "
                f"a {type(answer).__name__}."
            )
        return self._checked(state, answer if tangent else answer._replace(tangent=None), tangent)

    def answer_at(
        self,
        pressure: NDArray[np.float64],
        shear: NDArray[np.float64],
        gradient: NDArray[np.float64],
        state: State,
    ) -> tuple[Answer, VolumeStrain]:
        """Return the answer of the law at a pressure, and its volume strain.

        Args:
            pressure: Shape ``(n,)``.
            shear: Shear modulus of the unstrained points, shape ``(n,)``.
            gradient: As in :meth:`answer`.
            state: As there.

        Raises:
            MPMError: As there.
        """
        law, received = self.law, _protected(state)
        assert isinstance(law, StrainMaterial)
        found = self._asked(
            lambda: law.at_pressure(_read_only(gradient), received, pressure, shear)
        )
        answer = self._checked(state, Update(*found[:2], found.state))
        volume = found.gap + found.compliance * pressure
        return answer, VolumeStrain(volume, found.slope, found.compliance, found.by_pressure)

    def stressed_state(
        self, rows: NDArray[np.integer[Any]], carried: Carried, variables: State
    ) -> State:
        """Return the state of some of the points under a stress.

        Args:
            rows: Which of them.
            carried: What all points of this rank carry.
            variables: Internal variables that those have already, by name.

        Raises:
            MPMError: The law fails, or cannot bear the stress.
        """
        points = self.points[rows]
        law, gradient = self.material.at(rows), carried.gradient[points]
        try:
            state = law.stressed_state(carried.stress[points], gradient, variables)
        except MPMError as error:
            raise self._named(error, points) from error
        except Exception as error:
            what = f"stressed_state of {type(self.material).__name__}"
            raise as_ours(error, what) from error
        if carried.gap is not None:
            assert isinstance(law, StrainMaterial)
            strain = law.elastic_strain(state["stress"])
            strain[:, :3] += carried.gap[points, None] / 3.0
            state |= KINEMATICS[law.kinematics].history_of(strain, gradient)
        return state

    def cauchy_stress(self, gradient: NDArray[np.float64], state: State) -> NDArray[np.float64]:
        """Return the Cauchy stress of a state, shape ``(n, 3, 3)``.

        Args:
            gradient: ``F - I`` of the points, shape ``(n, dim, dim)``.
            state: At them.

        Raises:
            MPMError: The law fails, or gives something else.
        """
        received = _read_only(gradient), _protected(state)
        stress = self._asked(lambda: self.material.cauchy_stress(*received), "cauchy_stress")
        shape = (len(self.points), 3, 3)
        if np.shape(stress) != shape:
            raise MPMError(
                f"cauchy_stress of {type(self.material).__name__} gave {_told(stress)}; it "
                f"must have the shape {shape}."
            )
        return stress

    def strain_energy(self, state: State) -> NDArray[np.float64] | None:
        """Return the elastic energy per undeformed volume, shape ``(n,)``, where it is known.

        Raises:
            MPMError: The law fails, or gives something else.
        """
        return self._known("strain_energy", state)

    def plastic_work(self, state: State) -> NDArray[np.float64] | None:
        """Return the plastic work per undeformed volume, shape ``(n,)``, where it is known.

        It is not where an heir of the law that tells it has changed the law.

        Raises:
            MPMError: The law fails, or gives something else.
        """
        if not is_as_inherited(self.material, "plastic_work"):
            return None
        return self._known("plastic_work", state)

    def _known(self, method: str, state: State) -> NDArray[np.float64] | None:
        """Return numbers at the points, which must be that unless they are not known."""
        values: NDArray[np.float64] | None
        values = self._asked(lambda: getattr(self.material, method)(state), method)
        if values is not None:
            self._require(method.replace("_", " "), values, (len(self.points),))
        return values

    def _asked[T](self, law: Callable[[], T], method: str = "The update") -> T:
        """Return the answer of a law, with an error of its own raised as one of ours."""
        what = f"{method} of {type(self.material).__name__}"
        try:
            return law()
        except MPMError as error:
            raise self._named(error, self.points) from error
        except np.linalg.LinAlgError as error:
            raise ConvergenceError(f"{what} broke down ({error})") from error
        except Exception as error:
            ours = as_ours(error, what)
            if "read-only" in str(error):
                ours = MPMError(f"{ours.message}; a law must not write into what it receives.")
            raise ours from error

    def _checked(self, state: State, answer: Update, tangent: bool = True) -> Answer:
        """Return the answer of a law if it is finite, of the right shape and of the right type.

        Raises:
            MPMError: It is not.
        """
        n, dim = len(self.points), self.dim
        self._require(STRESS, answer.first_piola, (n, dim, dim))
        if tangent:
            self._require("tangent", answer.tangent, (n, dim, dim, dim, dim))
        if not isinstance(answer.state, dict) or answer.state.keys() != state.keys():
            raise MPMError(
                f"The update of {type(self.material).__name__} must return a state with the "
                f"variables of initial_state: {', '.join(state)}."
            )
        for name, values in answer.state.items():
            before = state[name]
            self._require(f"state {name!r}", values, before.shape, before.dtype)
        P = np.ascontiguousarray(answer.first_piola)
        A = no_tangent if answer.tangent is None else np.ascontiguousarray(answer.tangent)
        return Answer(P, A, answer.state)

    def _require(
        self, what: str, values: Any, shape: tuple[int, ...], dtype: np.dtype[Any] = FLOAT
    ) -> None:
        """Raise an error unless a part of an answer is finite, of a shape and type."""
        right = isinstance(values, np.ndarray) and values.shape == shape and values.dtype == dtype
        # The laws of this package are tested; their stress, a small part, is looked at all the
        # same. To read the rest takes a tenth of a step.
        known = dtype.kind != "f" or (self.is_own and what != STRESS)
        if right and (known or _all_finite(values)):
            return
        answered = f"The update of {type(self.material).__name__} gave a {what} that is"
        if not right:
            raise MPMError(
                f"{answered} {_told(values)}; it must have the shape {shape} and the type {dtype}."
            )
        bad = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
        if len(bad):
            raise self._named(ConvergenceError(f"{answered} not finite", bad), self.points)

    def _named(self, error: MPMError, points: NDArray[np.int64]) -> MPMError:
        """Return an error of a law with global indices for the numbers of its points."""
        own = np.array([p for p in error.particles if 0 <= p < len(points)], dtype=np.int64)
        domains = points[own] // self.particles.num_points
        particles = np.unique(self.particles.global_index[domains])
        where = " (at {particles})" if len(particles) else ""
        return type(error)(error.message.rstrip(".") + where, particles)


def _of_package(thing: Any) -> bool:
    """Return whether a class or function is of this package."""
    package = Material.__module__.rpartition(".")[0] + "."
    return str(thing.__module__).startswith(package)


def _read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Return a view of an array through which it cannot be changed."""
    view = values.view()
    view.flags.writeable = False
    return view


def _protected(state: State) -> State:
    """Return a state that cannot be written into."""
    return {name: _read_only(values) for name, values in state.items()}


def _all_finite(values: NDArray[np.float64]) -> bool:
    """Return whether all values are finite for sure, at the cost of reading them."""
    if not values.flags.c_contiguous:
        return bool(np.isfinite(values).all())
    flat = values.reshape(-1)
    with np.errstate(all="ignore"):
        return bool(np.isfinite(flat @ flat))


def _told(values: Any) -> str:
    """Return a description of a value, for an error."""
    if not isinstance(values, np.ndarray):
        return "None" if values is None else f"a {type(values).__name__}"
    return f"an array of shape {values.shape} and type {values.dtype}"
