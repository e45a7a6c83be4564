# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The contract between a material and the problem, and laws written in strain space."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self, cast, override

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError, agree
from ..parallel.given import not_a_value
from ..parallel.kinds import explaining
from ..reals import as_reals
from .given_pressure import AtPressure, at_pressure
from .kinematics import KINEMATICS, LogarithmicStrain, SmallStrain
from .mandel import norm, num_components, to_tensor, to_vector

__all__ = [
    "Field",
    "Integration",
    "Material",
    "Parameter",
    "Refused",
    "State",
    "StrainMaterial",
    "Update",
    "check_parameter",
    "checked",
    "exceeds",
    "per_row",
]

#: What a parameter of a material may be besides a number.
PARAMETERS = "one number per point, a scalar Constant or a DG0 Function on the body mesh"

type Parameter = float | NDArray[np.float64]
"""One value for all points, or an array ``(n,)`` with one per point."""

type State = dict[str, NDArray[np.float64]]
"""Internal state variables by name, each of shape ``(n, ...)`` and any memory order."""


class Field(Protocol):
    """A piecewise constant ``dolfinx.fem.Function``, whose values are ``x.array``.

    Or a ``dolfinx.fem.Constant``, whose value is ``value``.
    """

    @property
    def x(self) -> Any:
        """The vector of values."""


class Parameters(Mapping[str, Parameter]):
    """Parameters of a material by name, which cannot be set.

    Args:
        values: The parameters.
    """

    def __init__(self, values: Mapping[str, Parameter]) -> None:
        self._values = dict(values)

    def __getitem__(self, name: str) -> Parameter:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return repr(self._values)

    def __setitem__(self, name: str, value: Parameter) -> None:
        raise MPMError(
            f"The parameter {name} of a material cannot be set; give a DG0 Function or a Constant, "
            f"whose values problems follow, or make another material: "
            f"material.with_parameters({name}=...)."
        )


class Update(NamedTuple):
    """Answer of a material.

    Attributes:
        first_piola: First Piola stress P, shape ``(n, dim, dim)``, C order.
        tangent: dP_iJ/dF_kL consistent with the update, shape ``(n, dim, dim, dim, dim)``, C
            order; ``None`` if not asked for.
        state: New state, to be kept if the step converges.
    """

    first_piola: NDArray[np.float64]
    tangent: NDArray[np.float64] | None
    state: State


class Material(ABC):
    """A constitutive law: a function of displacement gradient and state, for many points.

    A new law needs ``symmetric``, :meth:`initial_state`, :meth:`update` and
    :meth:`cauchy_stress`; laws in strain space are easier to write as a
    :class:`StrainMaterial`. Example, the St. Venant-Kirchhoff law P = lame tr(E) F::

        class VolumetricStVenantKirchhoff(Material):
            symmetric = True

            def __init__(self, lame):
                self.parameters = {"lame": lame}

            def initial_state(self, n, dim):
                return {"stress": np.zeros((n, num_components(dim)))}

            def update(self, displacement_gradient, state, tangent=True):
                H, lame = displacement_gradient, self.parameters["lame"]
                eye = np.eye(H.shape[1])
                F = eye + H
                quadratic = 0.5 * np.sum(H * H, axis=(1, 2))
                p = lame * (np.trace(H, axis1=1, axis2=2) + quadratic)
                P = p[:, None, None] * F
                A = p[:, None, None, None, None] * np.einsum("ik,JL->iJkL", eye, eye)
                A += lame * np.einsum("niJ,nkL->niJkL", F, F)
                stress = ...  # Mandel vector of the stress to be reported
                return Update(P, A if tangent else None, {"stress": stress})

    Attributes:
        symmetric: Whether the tangent has major symmetry, dP_iJ/dF_kL = dP_kL/dF_iJ, always.
        linear_in_volume: Whether the mean stress is the bulk modulus times the elastic volume
            strain, and nothing else in the law depends on either; each class says so for itself,
            as ``mixed="pressure"`` needs it (with ``young``, ``poisson``, ``bulk``, ``shear``).
        limits: What the values of a parameter must be: keywords of ``check_parameter`` by name.
        kinematics: ``"small"`` where its strain is, else that of a :class:`StrainMaterial` or
            ``None``.
        inelastic: Whether it keeps a history that yielding changes, as far as is known.
        internal_variables: Shape per point of each of its own internal variables.
        reversible: Internal variables that change where nothing yields.
        parameters: Parameters by name: numbers, or arrays ``(n,)`` with one value per point.
            A piecewise constant Function or a Constant may stand here; the problem works with
            a copy of the material that has its values instead (:meth:`with_parameters`).
    """

    symmetric: bool
    linear_in_volume: ClassVar[bool] = False
    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType({})
    kinematics: ClassVar[str | None] = None
    inelastic: ClassVar[bool] = True
    internal_variables: ClassVar[Mapping[str, tuple[int, ...]]] = MappingProxyType({})
    reversible: ClassVar[tuple[str, ...]] = ()
    _parameters: Parameters = Parameters({})

    def __init_subclass__(cls, **options: Any) -> None:
        """Let its constructor explain what does not fit."""
        super().__init_subclass__(**options)
        if "__init__" in vars(cls):
            explaining(cls)

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Parameters by name; a material that is made sets them as a whole."""
        return self._parameters

    @parameters.setter
    def parameters(self, values: Mapping[str, Parameter]) -> None:
        self._parameters = Parameters(values)

    def __repr__(self) -> str:
        values = (f"{name}={_in_words(value)}" for name, value in self.parameters.items())
        return f"{type(self).__name__}({', '.join(values)})"

    @abstractmethod
    def initial_state(self, n: int, dim: int) -> State:
        """Return the state of ``n`` unstrained points of a body of dimension ``dim``.

        Returns:
            Always with ``"stress"``, Mandel vectors ``(n, m)`` of the law's own stress measure.
        """

    @abstractmethod
    def update(
        self, displacement_gradient: NDArray[np.float64], state: State, tangent: bool = True
    ) -> Update:
        """Return stress, consistent tangent and new state.

        It is called for each Newton iteration and each try of a line search, always with the
        state of the last converged step.

        Args:
            displacement_gradient: H = dd/dX = F - I of the total displacement, shape
                ``(n, dim, dim)``; plane strain in two dimensions.
            state: State of the last converged step; never modified.
            tangent: Whether the tangent is asked for.

        Raises:
            MPMError: The update fails; ``particles`` are the numbers of the points.
        """

    @abstractmethod
    def cauchy_stress(
        self, displacement_gradient: NDArray[np.float64], state: State
    ) -> NDArray[np.float64]:
        """Return Cauchy stresses, shape ``(n, 3, 3)``.

        Args:
            displacement_gradient: Shape ``(n, dim, dim)``.
            state: The state that belongs to it.
        """

    def strain_energy(self, state: State) -> NDArray[np.float64] | None:
        """Return the elastic energy per undeformed volume of points, shape ``(n,)``.

        Args:
            state: Their state.

        Returns:
            The energy; ``None``, as here, where the law does not know it. A law without other
            internal variables than the stress that knows it keeps the energy of a motion to
            round-off (``DynamicProblem(scheme="conserving")``).
        """
        return None

    def plastic_work(self, state: State) -> NDArray[np.float64] | None:
        """Return the energy used by yielding, per undeformed volume of points, shape ``(n,)``.

        It is for laws whose stress after an update is the derivative of it and of the strain energy
        together, the history being as it was: those of associated flow and isotropic hardening,
        integrated by backward Euler (Ortiz & Stainier 1999, Comput. Methods Appl. Mech. Engrg 171,
        section 2). In a motion with ``scheme="conserving"`` they lose what yielding takes up and
        nothing else. An heir that changes something of such a law must tell its own.

        Args:
            state: Their state.

        Returns:
            The work; ``None``, as here, where the law is no such one.
        """
        return None

    def stressed_state(
        self,
        cauchy_stress: NDArray[np.float64],
        displacement_gradient: NDArray[np.float64],
        variables: Mapping[str, NDArray[np.float64]] = MappingProxyType({}),
    ) -> State:
        """Return the state of points that carry a stress at a displacement gradient.

        An update of it at that gradient, which is zero where a body has not moved, gives this
        stress.

        Args:
            cauchy_stress: Shape ``(n, 3, 3)``, symmetric; in plane strain xz and yz are zero.
            displacement_gradient: Shape ``(n, dim, dim)``.
            variables: Internal variables that the points have already, by name; others are those
                of unstrained points.

        Raises:
            MPMError: The material cannot carry it; ``particles`` are the numbers of the points.
        """
        raise MPMError(
            f"{type(self).__name__} cannot begin with a stress; give it a method stressed_state."
        )

    def with_parameters(self, **parameters: Parameter) -> Self:
        """Return a copy of this material with other values of some parameters.

        Raises:
            MPMError: It has no such parameter, or a value is not allowed.
        """
        known = {*self.parameters, *self.limits}
        for name in parameters:
            if name not in known:
                raise MPMError(
                    f"A {type(self).__name__} has no parameter {name!r}; there are "
                    f"{', '.join(sorted(known))}."
                )
        other = copy.copy(self)
        other.parameters = {**self.parameters, **checked(self.limits, **parameters)}
        return other

    def weakened(self, factor: float) -> Self:
        """Return this material with its strength divided by a factor, and all else the same.

        Args:
            factor: Positive.

        Raises:
            MPMError: The material does not say what its strength is.
        """
        raise MPMError(
            f"The strength of a {type(self).__name__} cannot be reduced; give it a method weakened."
        )

    def in_time(self, duration: float) -> Self:
        """Return this material for updates over steps of a duration.

        That is the material itself, unless a law whose stress depends on rates says otherwise.

        Args:
            duration: Not negative; infinite where no time passes, as in quasi-static problems.
        """
        return self

    @property
    def needs_time(self) -> bool:
        """Whether it is for steps with a duration alone."""
        return False

    @property
    def softens(self) -> bool:
        """Whether its strength falls with its plastic strain, so that a body may have a length."""
        return False

    def softening_by(self, average: NDArray[np.float64]) -> Self:
        """Return this material with a strength that follows an average of the plastic strain.

        Args:
            average: That of ``"plastic_strain"`` over the length of a body, shape ``(n,)``.
        """
        return self

    def at(self, points: NDArray[np.integer[Any]]) -> Self:
        """Return this material restricted to points, given by their numbers.

        Arrays among the parameters are restricted; without any it is this material itself.
        """
        arrays = {k: v for k, v in self.parameters.items() if isinstance(v, np.ndarray)}
        if not arrays:
            return self
        return self.with_parameters(**{name: values[points] for name, values in arrays.items()})


def _in_words(value: Any) -> str:
    """Return a parameter as ``repr`` of its material shows it; no rank waits for others."""
    if hasattr(value, "function_space"):
        return f"<Function '{value.name}'>"
    held = getattr(value, "value", value)
    if np.ndim(held) == 0 and isinstance(held, float | int | np.ndarray | np.number):
        return f"{float(held):g}"
    if isinstance(held, np.ndarray):
        ends = f" from {held.min():g} to {held.max():g}" if held.size else ""
        return f"<{held.size} values{ends}>"
    return repr(held)


class Integration(NamedTuple):
    """Answer of a law in strain space.

    Attributes:
        stress: Stress, shape ``(n, m)``.
        tangent: Its derivative by the trial strain, shape ``(n, m, m)``; ``None`` if not asked
            for.
        elastic_strain: Elastic strain at the end of the step, shape ``(n, m)``.
        variables: The law's internal variables at the end of the step.
    """

    stress: NDArray[np.float64]
    tangent: NDArray[np.float64] | None
    elastic_strain: NDArray[np.float64]
    variables: State


class StrainMaterial(Material):
    """A law written in strain space, for small and for finite strain alike.

    A new law gives the attributes below and :meth:`integrate`. With logarithmic kinematics it
    must be isotropic in the strain: the elastic left Cauchy-Green tensor is its only memory of
    direction.

    Attributes:
        kinematics: ``"small"``: infinitesimal strain, Cauchy stress; ``"logarithmic"``: trial
            elastic logarithmic strain, Kirchhoff stress.
        inelastic: Whether elastic strain and strain may differ, so that history is kept.
        internal_variables: Shape per point of each of the law's own internal variables.
        rises_with_volume: Whether the mean stress never falls as volume grows in a step of the same
            shape, so that a pressure may stand for it (``mixed="pressure"``).
    """

    kinematics: ClassVar[Literal["small", "logarithmic"]] = "logarithmic"
    inelastic: ClassVar[bool] = False
    internal_variables: ClassVar[Mapping[str, tuple[int, ...]]] = MappingProxyType({})
    rises_with_volume: ClassVar[bool] = True

    @abstractmethod
    def integrate(
        self, trial_strain: NDArray[np.float64], variables: State, tangent: bool
    ) -> Integration:
        """Return the stress at the end of a step.

        Args:
            trial_strain: Elastic strain if the step were elastic, Mandel vectors ``(n, m)``.
            variables: The law's internal variables at the last converged step; not to be
                modified.
            tangent: Whether the tangent is asked for.
        """

    def stored_energy(self, elastic_strain: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the elastic energy per undeformed volume of elastic strains.

        Args:
            elastic_strain: Shape ``(n, m)``.

        Returns:
            Shape ``(n,)``.
        """
        raise MPMError(f"{type(self).__name__} does not know its stored energy of a strain.")

    @override
    def weakened(self, factor: float) -> Self:
        """Return this material with its strength divided by a factor: an elastic law as it is."""
        return self if self.is_elastic else super().weakened(factor)

    @property
    def is_elastic(self) -> bool:
        """Whether its stress is a function of the strain alone."""
        return not self.inelastic and not self.internal_variables

    @property
    def _kinematics(self) -> type[SmallStrain] | type[LogarithmicStrain]:
        """The strain measure at work."""
        return KINEMATICS[self.kinematics]

    @override
    def initial_state(self, n: int, dim: int) -> State:
        for value in self.parameters.values():
            if isinstance(value, Refused):
                raise MPMError(value.message)
        state: State = {"stress": np.zeros((n, num_components(dim)))}
        if self.inelastic:
            unstrained = np.zeros_like(state["stress"]), np.zeros((n, dim, dim))
            state |= self._kinematics.history_of(*unstrained)
        for name, shape in self.internal_variables.items():
            state[name] = np.zeros((n, *shape))
        return state

    def elastic_strain(self, stress: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the elastic strain of a stress: the law without its plastic part, turned round.

        Args:
            stress: Shape ``(n, m)``.

        Returns:
            Shape ``(n, m)``; not a number where there is none.
        """
        raise MPMError(
            f"{type(self).__name__} cannot begin with a stress; give it a method elastic_strain, "
            "which returns the elastic strain of stresses (n, m)."
        )

    @override
    def stressed_state(
        self,
        cauchy_stress: NDArray[np.float64],
        displacement_gradient: NDArray[np.float64],
        variables: Mapping[str, NDArray[np.float64]] = MappingProxyType({}),
    ) -> State:
        """State with the elastic strain of this stress, which must not be beyond yield."""
        dim = displacement_gradient.shape[-1]
        ratio = self._kinematics.volume_ratio(displacement_gradient)[:, None, None]
        own = ratio * cauchy_stress
        stress = to_vector(own, dim)
        state = self.initial_state(len(stress), dim) | dict(variables)
        known = {name: state[name] for name in self.internal_variables}
        strain = self.elastic_strain(stress)
        size = norm(stress)
        lost = np.abs(own - to_tensor(stress)).max(axis=(1, 2), initial=0.0)
        possible = (lost <= 1e-12 * size) & np.isfinite(strain).all(axis=1)
        with np.errstate(invalid="ignore"):
            answer = self.integrate(np.where(possible[:, None], strain, 0.0), known, False)
        possible &= norm(answer.stress - stress) <= 1e-9 * size
        if not possible.all():
            points = np.flatnonzero(~possible)
            raise MPMError(
                f"{type(self).__name__} cannot bear the initial stress of {len(points)} of "
                f"{len(stress)} points: it is beyond yield, not finite, not symmetric, or shears "
                "out of the plane; give a stress that the material can bear.",
                points,
            )
        history = self._kinematics.history_of(strain, displacement_gradient)
        return state | {"stress": stress} | history

    @override
    def update(
        self, displacement_gradient: NDArray[np.float64], state: State, tangent: bool = True
    ) -> Update:
        remembers = "displacement_gradient" in state  # elastic points that began with a stress too
        frame = self._kinematics(displacement_gradient, state if remembers else None)
        variables = {name: state[name] for name in self.internal_variables}
        stress, D, elastic_strain, variables = self.integrate(
            frame.trial_strain, variables, tangent
        )
        new = {"stress": stress, **variables}
        if remembers:
            new |= frame.history(elastic_strain)
        A = None if D is None else frame.tangent(stress, D)
        return Update(frame.first_piola(stress), A, new)

    def at_pressure(
        self,
        displacement_gradient: NDArray[np.float64],
        state: State,
        pressure: NDArray[np.float64],
        shear: NDArray[np.float64],
    ) -> AtPressure:
        """Return the answer of the law at a given mean stress, for ``mixed="pressure"``.

        Args:
            displacement_gradient: As in :meth:`update`.
            state: As in :meth:`update`.
            pressure: Mean of the law's own stress, shape ``(n,)``, positive in tension.
            shear: Shear modulus of the unstrained points, shape ``(n,)``.

        Raises:
            MPMError: As :meth:`update`.
        """
        return at_pressure(self, displacement_gradient, state, pressure, shear)

    @override
    def cauchy_stress(
        self, displacement_gradient: NDArray[np.float64], state: State
    ) -> NDArray[np.float64]:
        ratio = self._kinematics.volume_ratio(displacement_gradient)
        return to_tensor(state["stress"]) / ratio[:, None, None]


def per_row(value: Parameter) -> Parameter:
    """Return a number, or an array ``(n,)`` as a column ``(n, 1)``, to scale arrays ``(n, m)``."""
    return value[:, None] if isinstance(value, np.ndarray) else value


def checked(
    limits: Mapping[str, Mapping[str, float]], **values: ArrayLike | Field | None
) -> dict[str, Parameter]:
    """Return parameters by name, those that are given, if their values are within limits.

    Args:
        limits: Keywords of :func:`check_parameter` by name.
        **values: The parameters; ``None``: not given.

    Raises:
        MPMError: A value is not finite or out of range.
    """
    given = {name: value for name, value in values.items() if value is not None}
    return {name: check_parameter(name, v, **limits.get(name, {})) for name, v in given.items()}


def exceeds(
    parameters: Mapping[str, Any], one: str, other: str, wrong: np.ufunc = np.greater
) -> bool:
    """Return whether a parameter is above another at some point, as far as that is known.

    Fields have no values yet, and arrays of other lengths are refused where they are used.

    Args:
        parameters: Parameters by name; one that is missing is 0.
        one: Name of the one that should be at most the other.
        other: Name of that.
        wrong: How they compare where it is.
    """
    small, large = (parameters.get(name, 0.0) for name in (one, other))
    known = all(isinstance(value, float | np.ndarray) for value in (small, large))
    apart = np.ndim(small) and np.ndim(large) and np.shape(small) != np.shape(large)
    return bool(known and not apart and np.any(wrong(small, large)))


class Refused(np.ndarray):
    """An array of parameters with a value that is not allowed, on this rank.

    A material does not know its body's ranks; the problem, which does, raises the error on all.

    Attributes:
        message: What is wrong with it.
    """

    message: str


def check_parameter(
    name: str,
    value: ArrayLike | Field,
    *,
    above: float | None = None,
    below: float | None = None,
    least: float | None = None,
) -> Parameter:
    """Return a parameter as a number or an array ``(n,)``, if its values are allowed.

    Ranks agree on the values of a Function (collective), as each sees its own part. An array is
    a rank's own: where there are several ranks, the error is raised when it is used.

    Args:
        name: Name for the message.
        value: Number, array ``(n,)``, of which a copy is returned that cannot be written to,
            or Function or Constant, which is returned as it is.
        above: The values are greater than this.
        below: The values are smaller than this.
        least: The values are not smaller than this.

    Raises:
        MPMError: A value is not finite or out of range.
    """
    held = isinstance(getattr(value, "value", None), np.ndarray)  # a Constant
    given: Any = value.x.array if hasattr(value, "x") else getattr(value, "value", value)
    try:
        if isinstance(given, bool):
            raise TypeError("a truth is no number")
        values = as_reals(given)
    except (TypeError, ValueError):
        raise not_a_value(name, value, (), PARAMETERS) from None
    if held and values.ndim > 0:
        raise MPMError(f"{name} must be a scalar Constant, not one of shape {values.shape}")
    if values.ndim > 1:
        raise not_a_value(name, value, (), PARAMETERS)
    allowed = np.isfinite(values)
    words = ["finite"]
    if above is not None:
        allowed &= values > above
        words.append(f"greater than {above:g}")
    if least is not None:
        allowed &= values >= least
        words.append(f"at least {least:g}")
    if below is not None:
        allowed &= values < below
        words.append(f"less than {below:g}")
    space = getattr(value, "function_space", None)
    with nullcontext() if space is None else agree(space.mesh.comm):
        if not allowed.all():
            worst = values[~allowed].flat[0]
            message = f"{name} is {worst:g} but must be {', '.join(words)}"
            if values.ndim == 1 and not hasattr(value, "x") and MPI.COMM_WORLD.size > 1:
                refused = values.view(Refused)
                refused.message = message
                return refused
            raise MPMError(message)
    if held or hasattr(value, "x"):
        return cast(Parameter, value)
    values.flags.writeable = False
    return float(values) if values.ndim == 0 else values
