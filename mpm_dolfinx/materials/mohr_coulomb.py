# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plasticity of Mohr and Coulomb, and of Tresca, returned in closed form."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, Self, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from .base import Field, Integration, Parameter, State, check_parameter
from .mandel import to_tensor
from .plastic import PlasticMaterial
from .principal import axes_in_order, from_axes, shear_quotients, tangent_from_axes
from .softening import SofteningMaterial, require_softening

__all__ = ["FrictionalMaterial", "MohrCoulomb", "Tresca"]

Array = NDArray[np.float64]


class FrictionalMaterial(SofteningMaterial):
    """Base of laws with a cohesion and angles of friction and dilation.

    Hencky elasticity at finite strain; the state holds the accumulated plastic strain kappa, the
    sum of sqrt(2/3) |d eps_p|, as ``"plastic_strain"``, shape ``(n,)``. Plasticity is perfect, or
    softens: cohesion and angle of friction fall as c_r + (c - c_r) exp(-decay kappa). A step has
    the strength of its beginning, so returns stay closed forms and tangents exact.

    Attributes:
        volume_correction: Whether volume that opens at the apex closes again before there is
            pressure.
        symmetric: Whether flow is associated: both angles are the same number or object.
        yield_tolerance: Excess of the yield function over the strength that counts as round-off.
    """

    kinematics: ClassVar[Literal["small", "logarithmic"]] = "logarithmic"
    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {
            **PlasticMaterial.limits,
            "cohesion": {"least": 0.0},
            "friction_angle": {"least": 0.0, "below": 90.0},
            "dilation_angle": {"least": 0.0, "below": 90.0},
            "tension_cutoff": {"least": 0.0},
            "cohesion_residual": {"least": 0.0},
            "friction_residual": {"least": 0.0, "below": 90.0},
            "decay": {"least": 0.0},
        }
    )
    yield_tolerance: ClassVar[float] = 1e-13

    def __init__(
        self,
        young: ArrayLike | Field,
        poisson: ArrayLike | Field,
        cohesion: ArrayLike | Field,
        friction_angle: ArrayLike | Field,
        dilation_angle: ArrayLike | Field = 0.0,
        tension_cutoff: ArrayLike | Field | None = None,
        *,
        cohesion_residual: ArrayLike | Field | None = None,
        friction_residual: ArrayLike | Field | None = None,
        decay: ArrayLike | Field | None = None,
        relaxation_time: ArrayLike | Field | None = None,
        volume_correction: bool = False,
    ) -> None:
        """Set the parameters.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.
            cohesion: Shear strength where there is no pressure, in units of stress.
            friction_angle: Angle of friction phi in degrees.
            dilation_angle: Angle of dilation psi in degrees, at most that of friction; where it
                is the same (the same number or the same object) flow is associated and the
                tangent symmetric.
            tension_cutoff: Largest tension that is borne, in units of stress; ``None``: as far as
                cohesion and friction go.
            cohesion_residual: Cohesion after much plastic strain; ``None``: as before.
            friction_residual: Angle of friction after much plastic strain; ``None``: as before.
                The angle of dilation falls with it where it is larger.
            decay: How fast strength falls: by 1/e in a plastic strain of 1/decay.
            relaxation_time: Time in which stress beyond yield falls by 1/e; ``None``: at once.
            volume_correction: Whether volume that opens at the apex (or at the corner of the
                cut-off on the hydrostatic axis) is kept in mind, and closes again at the stress
                of the apex, before there is pressure: for soils that part and come together
                again. Without it, it is plastic and stays.

        Raises:
            MPMError: A value is out of range; a residual strength without decay, decay without a
                residual strength, or one that is larger than the strength at first.
        """
        super().__init__(young, poisson)
        given: dict[str, Any] = {
            "cohesion": cohesion,
            "friction_angle": friction_angle,
            "dilation_angle": dilation_angle,
        }
        optional = {
            "tension_cutoff": tension_cutoff,
            "cohesion_residual": cohesion_residual,
            "friction_residual": friction_residual,
            "decay": decay,
            "relaxation_time": relaxation_time,
        }
        given |= {name: value for name, value in optional.items() if value is not None}
        checked = {name: check_parameter(name, v, **self.limits[name]) for name, v in given.items()}
        self.parameters = {**self.parameters, **checked}
        friction, dilation = (checked[angle] for angle in _ANGLES)
        numbers = isinstance(friction, float) and isinstance(dilation, float)
        self.symmetric = friction == dilation if numbers else friction_angle is dilation_angle
        _require_less_dilation(checked["friction_angle"], checked["dilation_angle"])
        _require_softening(checked)
        self.volume_correction = bool(volume_correction)

    @override
    def with_share(self, left: Array) -> Self:
        values = dict(self.parameters)
        for name in ("decay", "average"):
            values.pop(name, None)
        for name, residual in _RESIDUALS.items():
            if residual in values:
                last = values.pop(residual)
                values[name] = last + (values[name] - last) * left
        values["friction_angle"] = np.minimum(values["friction_angle"], STEEPEST)
        friction, dilation = (values[angle] for angle in _ANGLES)
        values["dilation_angle"] = np.minimum(dilation, friction)
        other = copy.copy(self)
        other.parameters = values
        return other

    @override
    def softening_by(self, average: Array) -> Self:
        other = super().softening_by(average)
        if other is not self:
            other.symmetric = False
        return other

    @override
    def with_parameters(self, **parameters: Parameter) -> Self:
        other = super().with_parameters(**parameters)
        replaced = [angle for angle in _ANGLES if angle in parameters]
        angles = [law.parameters[angle] for law in (self, other) for angle in _ANGLES]
        if replaced and all(isinstance(angle, float) for angle in angles):
            other.symmetric = angles[2] == angles[3]
        elif len(replaced) == 1:
            other.symmetric = False
        return other

    @override
    def weakened(self, factor: float) -> Self:
        """Divide c, tan(phi), their residual values and a cut-off; psi stays, up to phi."""
        values: dict[str, Any] = {}
        for name in ("cohesion", "cohesion_residual", "tension_cutoff"):
            if name in self.parameters:
                values[name] = self.parameters[name] / factor
        for name in ("friction_angle", "friction_residual"):
            if name in self.parameters:
                slope = np.tan(np.radians(self.parameters[name])) / factor
                values[name] = np.degrees(np.arctan(slope))
        values["dilation_angle"] = np.minimum(
            self.parameters["dilation_angle"], values["friction_angle"]
        )
        known = {n: v if isinstance(v, np.ndarray) else float(v) for n, v in values.items()}
        return self.with_parameters(**known)

    @override
    def initial_state(self, n: int, dim: int) -> State:
        _require_less_dilation(*(self.parameters[angle] for angle in _ANGLES))
        _require_softening(self.parameters)
        return super().initial_state(n, dim)

    def _sines(self) -> tuple[Parameter, Parameter, Parameter]:
        """Return sin(phi), sin(psi) and cos(phi)."""
        phi, psi = (np.radians(self.parameters[angle]) for angle in _ANGLES)
        return np.sin(phi), np.sin(psi), np.cos(phi)

    def _averaged_constants(self, match: int = 0) -> tuple[Parameter, ...]:
        """Return the constants of a compiled law that softens by an average, angles in radians.

        Args:
            match: Number of the cone.
        """
        values = self.parameters
        cohesion, friction, dilation = (values[n] for n in ("cohesion", *_ANGLES))
        last = values.get("cohesion_residual", cohesion), values.get("friction_residual", friction)
        angles = (np.radians(angle) for angle in (friction, last[1], dilation))
        strength = (cohesion, last[0], *angles, self._tension())
        corrects = float(self.volume_correction)
        return self.bulk, self.shear, *strength, corrects, float(match), *self._driven()

    def _tension(self) -> Parameter:
        """Return the cut-off; infinite without."""
        return self.parameters.get("tension_cutoff", np.inf)


_ANGLES = ("friction_angle", "dilation_angle")
#: Angle of friction that a strength which grows goes up to, in degrees.
STEEPEST = 89.0
_RESIDUALS = {"cohesion": "cohesion_residual", "friction_angle": "friction_residual"}


def _require_softening(parameters: Mapping[str, Parameter]) -> None:
    """Raise an error where what is said of softening is not whole, or is hardening."""
    require_softening(parameters, _RESIDUALS)
    for name, residual in _RESIDUALS.items():
        first, last = parameters[name], parameters.get(residual, 0.0)
        if not all(isinstance(value, float | np.ndarray) for value in (first, last)):
            continue
        if np.shape(first) and np.shape(last) and np.shape(first) != np.shape(last):
            continue  # said where they are used
        if np.any(np.asarray(last) > np.asarray(first)):
            raise MPMError(f"{residual} is larger than {name}; give at most that.")


def _require_less_dilation(friction: Any, dilation: Any) -> None:
    """Raise an error where values that are known dilate more than associated flow does."""
    if not all(isinstance(value, float | np.ndarray) for value in (friction, dilation)):
        return
    if np.shape(friction) and np.shape(dilation) and np.shape(friction) != np.shape(dilation):
        return  # said where they are used
    if np.any(np.asarray(dilation) > np.asarray(friction)):
        raise MPMError(
            "dilation_angle is larger than friction_angle: plastic flow would create energy; give "
            "at most the angle of friction."
        )


class MohrCoulomb(FrictionalMaterial):
    """Elastoplasticity of Mohr and Coulomb at finite strain, with its edges, apex and cut-off.

    With the principal Kirchhoff stresses s1 >= s2 >= s3, tension positive, yield is where
    (s1 - s3)/2 + (s1 + s3)/2 sin(phi) = c cos(phi), or where s1 is the tension cut-off. Flow has
    the angle of dilation in place of that of friction, and is associated at the cut-off.

    Backward Euler in closed form, in sorted principal strains: the plane; an edge where the
    plane's return has left the order; the apex where the edge's has (de Souza Neto, Peric & Owen
    2008, chapter 8; Clausen, Damkilde & Andersen 2006). The apex and the corners of the cut-off
    are points, to which a trial stress goes that has no other answer: without dilation the apex
    is returned to along the hydrostatic axis too.
    """

    _loop: ClassVar[str] = "mohr_coulomb"

    def yield_function(self, stress: Array, plastic_strain: Array) -> Array:
        """Return f, shape ``(n,)``, in units of stress, of stresses ``(n, m)``.

        The larger one of (s1 - s3)/2 + (s1 + s3)/2 sin(phi) - c cos(phi) and s1 less the
        cut-off.
        """
        if "decay" in self.parameters:
            return self.softened(plastic_strain).yield_function(stress, plastic_strain)
        largest, smallest = np.linalg.eigvalsh(to_tensor(stress))[:, [2, 0]].T
        sine, _, cosine = self._sines()
        shear = 0.5 * (largest - smallest) + 0.5 * (largest + smallest) * sine
        strength = self.parameters["cohesion"] * cosine
        return np.asarray(np.maximum(shear - strength, largest - self._tension()))

    def _constants(self) -> tuple[Parameter, ...]:
        """Return the moduli, sin(phi), sin(psi), 2 c cos(phi), the cut-off, and the correction.

        Where an average softens it, those of :meth:`_averaged_constants`.
        """
        if "average" in self.parameters:
            return self._averaged_constants()
        friction, dilation, cosine = self._sines()
        strength = 2.0 * self.parameters["cohesion"] * cosine
        corrects = float(self.volume_correction)
        return self.bulk, self.shear, friction, dilation, strength, self._tension(), corrects

    @override
    def give_back(self, trial_strain: Array, variables: State, tangent: bool) -> Integration:
        n, m = trial_strain.shape
        stress = self.elastic_stress(trial_strain)
        D = self.elastic_tangent(n, m) if tangent else None
        strain, axes = axes_in_order(trial_strain)
        law = _Law.of(self._constants(), n)
        points = np.flatnonzero(law.yields(strain, self.yield_tolerance))
        if len(points) == 0:
            return Integration(stress, D, trial_strain, variables)
        law, strain, axes = law.at(points), strain[:, points], axes[:, :, points]
        answer = law.give_back(strain, self.yield_tolerance)
        elastic, kappa = trial_strain.copy(), variables["plastic_strain"].copy()
        stress[points] = from_axes(answer.stress, axes, m)
        elastic[points] = from_axes(answer.elastic, axes, m)
        kappa[points] += np.sqrt(2.0 / 3.0 * np.sum((strain - answer.elastic) ** 2, axis=0))
        if D is not None:
            D = D.copy()
            quotients = shear_quotients(strain, answer.elastic, answer.normal, law.shear)
            D[points] = tangent_from_axes(answer.normal, quotients, axes, m)
        return Integration(stress, D, elastic, {"plastic_strain": kappa})


class Tresca(MohrCoulomb):
    """:class:`MohrCoulomb` without friction and dilation: (s1 - s3)/2 = c."""

    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {**MohrCoulomb.limits, "cohesion": {"above": 0.0}}
    )
    _loop: ClassVar[str] = "mohr_coulomb"

    def __init__(
        self,
        young: ArrayLike | Field,
        poisson: ArrayLike | Field,
        cohesion: ArrayLike | Field,
        tension_cutoff: ArrayLike | Field | None = None,
        *,
        cohesion_residual: ArrayLike | Field | None = None,
        decay: ArrayLike | Field | None = None,
        relaxation_time: ArrayLike | Field | None = None,
    ) -> None:
        """Set the parameters.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.
            cohesion: Shear strength, half the uniaxial one, in units of stress.
            tension_cutoff: Largest tension that is borne, in units of stress; ``None``: any.
            cohesion_residual: Cohesion after much plastic strain; ``None``: as before.
            decay: How fast it falls: by 1/e in a plastic strain of 1/decay.
            relaxation_time: Time in which stress beyond yield falls by 1/e; ``None``: at once.

        Raises:
            MPMError: A value is out of range; see :class:`FrictionalMaterial`.
        """
        super().__init__(
            young,
            poisson,
            cohesion,
            0.0,
            0.0,
            tension_cutoff,
            cohesion_residual=cohesion_residual,
            decay=decay,
            relaxation_time=relaxation_time,
        )


class _Answer(NamedTuple):
    """Principal values at the end of a step: ``(3, n)``, the derivatives ``(3, 3, n)``."""

    stress: Array
    elastic: Array
    normal: Array

    def put(self, where: NDArray[np.bool_], other: _Answer) -> None:
        """Take over another answer at some points."""
        for mine, theirs in zip(self, other, strict=True):
            mine[..., where] = theirs[..., where]


AVERAGES = {
    "plane": np.eye(3),
    "compression": np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]),
    "extension": np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.0, 0.5, 0.5]]),
}
"""Principal values on a plane and on the two edges, where two of them are equal."""


class _Law(NamedTuple):
    """Constants of a number of points, shape ``(n,)`` each.

    The yield function is (1 + sin phi) s1 - (1 - sin phi) s3 - strength here.
    """

    bulk: Array
    shear: Array
    friction: Array
    dilation: Array
    strength: Array
    tension: Array
    corrects: Array

    @classmethod
    def of(cls, constants: tuple[Parameter, ...], n: int) -> Self:
        """Return the constants at n points."""
        return cls(*(np.broadcast_to(value, n) for value in constants))

    def at(self, points: NDArray[np.integer[Any]] | NDArray[np.bool_]) -> Self:
        """Return the constants of some of the points."""
        return type(self)(*(value[points] for value in self))

    def stiffness(self) -> Array:
        """Return the elastic stiffness of principal values, shape ``(3, 3, n)``."""
        lame = self.bulk - 2.0 / 3.0 * self.shear
        return np.asarray(lame + 2.0 * self.shear * np.eye(3)[:, :, None])

    def _stress(self, elastic: Array) -> Array:
        lame = self.bulk - 2.0 / 3.0 * self.shear
        return np.asarray(lame * elastic.sum(axis=0) + 2.0 * self.shear * elastic)

    def _excess(self, stress: Array) -> tuple[Array, Array]:
        """Return the yield function, and what it is small against."""
        tension, pressure = (1.0 + self.friction) * stress[0], (1.0 - self.friction) * stress[2]
        size = np.abs(tension) + np.abs(pressure) + self.strength
        return tension - pressure - self.strength, size

    def yields(self, strain: Array, tolerance: float) -> NDArray[np.bool_]:
        """Return whether the stress of strains ``(3, n)`` is beyond yield."""
        stress = self._stress(strain)
        f, size = self._excess(stress)
        return np.asarray((f > tolerance * size) | (stress[0] - self.tension > tolerance * size))

    def give_back(self, strain: Array, tolerance: float) -> _Answer:
        """Return trial strains ``(3, n)``, of which all yield, to the yield surface."""
        stress = self._stress(strain)
        answer = _Answer(stress, strain.copy(), self.stiffness())
        with np.errstate(divide="ignore", invalid="ignore"):
            apex = self.strength / (2.0 * self.friction)
        f, size = self._excess(stress)
        shears = f > tolerance * size
        if shears.any():
            law = self.at(shears)
            part = law.to_pyramid(strain[:, shears], apex[shears])
            for mine, theirs in zip(answer, part, strict=True):
                mine[..., shears] = theirs
        # The cut-off lies beyond the apex where it is larger.
        cut = (answer.stress[0] - self.tension > tolerance * size) & ~(self.tension >= apex)
        if cut.any():
            part = self.at(cut).to_cutoff(strain[:, cut])
            for mine, theirs in zip(answer, part, strict=True):
                mine[..., cut] = theirs
        return answer

    def to_pyramid(self, strain: Array, apex: Array) -> _Answer:
        """Return strains to Mohr-Coulomb's pyramid without cut-off."""
        answer = self._along("plane", strain)
        e = answer.elastic
        low, high = e[0] < e[1], e[1] < e[2]
        compression = self._along("compression", strain)
        extension = self._along("extension", strain)
        first = low & (compression.elastic[0] >= compression.elastic[2])
        second = high & ~first & (extension.elastic[0] >= extension.elastic[2])
        neither = (low | high) & ~first & ~second
        answer.put(first, compression)
        answer.put(second, extension)
        if neither.any():
            law, corner = self.at(neither), np.broadcast_to(apex[neither], (3, neither.sum()))
            part = law.at_stress(strain[:, neither], (0, 1, 2), corner)
            part = law.with_volume(strain[:, neither], part)
            for mine, theirs in zip(answer, part, strict=True):
                mine[..., neither] = theirs
        return answer

    def _along(self, where: str, strain: Array) -> _Answer:
        """Return strains to the plane or an edge, as if these went on for ever."""
        average = AVERAGES[where]
        yield_, flow = (
            average @ np.stack((1.0 + sine, np.zeros_like(sine), sine - 1.0))
            for sine in (self.friction, self.dilation)
        )
        averaged = average @ strain
        f = np.sum(yield_ * self._stress(averaged), axis=0) - self.strength
        push, pull = self._stress(flow), self._stress(yield_)
        curvature = np.sum(yield_ * push, axis=0)
        elastic = averaged - f / curvature * flow
        lame = self.bulk - 2.0 / 3.0 * self.shear
        normal = lame + 2.0 * self.shear * average[:, :, None]
        normal = normal - push[:, None] * pull[None] / curvature
        return _Answer(self._stress(elastic), elastic, normal)

    def at_stress(self, strain: Array, which: tuple[int, ...], values: Array) -> _Answer:
        """Return the answer with some stresses given and no plastic strain along the other axes.

        Args:
            strain: Trial strains, shape ``(3, n)``.
            which: Numbers of the stresses that are given.
            values: Their values, shape ``(3, n)``; the others are not looked at.
        """
        given = np.isin(np.arange(3), which)[:, None]
        lame, shear = self.bulk - 2.0 / 3.0 * self.shear, 2.0 * self.shear
        slope = 1.0 / (1.0 + len(which) * lame / shear)
        trace = slope * np.where(given, values / shear, strain).sum(axis=0)
        elastic = np.where(given, (values - lame * trace) / shear, strain)
        stress = np.where(given, values, lame * trace + shear * strain)
        free = (~given & ~given.T)[:, :, None]
        normal = free * (lame * slope + shear * np.eye(3)[:, :, None])
        return _Answer(stress, elastic, normal)

    def with_volume(self, strain: Array, answer: _Answer) -> _Answer:
        """Return the answer at a point of the hydrostatic axis, with the volume correction.

        What opens there stays in the elastic strain, to close again before there is pressure.
        """
        third = np.broadcast_to(strain.sum(axis=0) / 3.0, strain.shape)
        return answer._replace(elastic=np.where(self.corrects != 0.0, third, answer.elastic))

    def to_cutoff(self, strain: Array) -> _Answer:
        """Return strains to the cut-off, its edges and corners: what fits best, or fits."""
        t = self.tension
        with np.errstate(divide="ignore"):
            least = ((1.0 + self.friction) * t - self.strength) / (1.0 - self.friction)
            ratio = (1.0 + self.dilation) / (1.0 - self.dilation)
        unit = 2.0 * self.shear
        candidates = (
            ((0,), (t, t, t)),
            ((0, 1), (t, t, t)),
            ((0, 1, 2), (t, t, t)),
            ((0, 2), (t, t, least)),
            ((0, 1, 2), (t, t, least)),
            ((0, 1, 2), (t, least, least)),
        )
        best = np.full(strain.shape[1], np.inf)
        answer = _Answer(np.empty_like(strain), np.empty_like(strain), np.empty((3, *strain.shape)))
        for number, (which, values) in enumerate(candidates):
            candidate = self.at_stress(strain, which, np.stack(values))
            s, p = candidate.stress, strain - candidate.elastic
            # By how much the answer is not one, as a strain.
            misfits = {
                0: (-p[0], (s[1] - t) / unit, (least - s[2]) / unit),
                1: (-p[0], -p[1], (s[2] - t) / unit, (least - s[2]) / unit),
                2: (-p[0], -p[1], -p[2]),
                3: (p[2], -ratio * p[2] - p[0], (s[1] - t) / unit, (least - s[1]) / unit),
                4: (p[2], -p[0], -p[1], -ratio * p[2] - p[0] - p[1]),
                5: (p[1], p[2], -ratio * (p[1] + p[2]) - p[0]),
            }[number]
            if number == 2:
                candidate = self.with_volume(strain, candidate)
            misfit = np.max(misfits, axis=0)
            better = misfit < best
            best = np.where(better, misfit, best)
            answer.put(better, candidate)
        return answer
