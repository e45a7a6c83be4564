# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plasticity of Mohr and Coulomb, and of Tresca, returned in closed form."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError, warn_alone
from .base import Field, Parameter, State, checked, exceeds
from .mandel import to_tensor
from .plastic import PlasticMaterial
from .softening import SofteningMaterial

__all__ = ["FrictionalMaterial", "MohrCoulomb", "Tresca"]

Array = NDArray[np.float64]


class FrictionalMaterial(SofteningMaterial):
    """Base of laws with a cohesion and angles of friction and dilation.

    Hencky elasticity at finite strain; the state holds the accumulated plastic strain kappa, the
    sum of sqrt(2/3) |d eps_p|, as ``"plastic_strain"``, shape ``(n,)``. Plasticity is perfect, or
    softens: cohesion and angles fall as c_r + (c - c_r) exp(-decay kappa). A step has the strength
    of its beginning, so returns stay closed forms and tangents exact.

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
            "dilation_residual": {"least": 0.0, "below": 90.0},
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
        volume_correction: bool = False,
    ) -> None:
        """Set the parameters.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.
            cohesion: Shear strength where there is no pressure, in units of stress.
            friction_angle: Angle of friction phi in degrees; below 1, as one in radians is, but not
                0, there is a warning.
            dilation_angle: Angle of dilation psi in degrees, at most that of friction; where it
                is the same (the same number or the same object) flow is associated and the
                tangent symmetric.
            tension_cutoff: Largest tension that is borne, in units of stress; ``None``: as far as
                cohesion and friction go.
            volume_correction: Whether volume that opens at the apex (or at the corner of the
                cut-off on the hydrostatic axis) is kept in mind, and closes again at the stress
                of the apex, before there is pressure: for soils that part and come together
                again. Without it, it is plastic and stays.

        Raises:
            MPMError: A value is out of range.
        """
        super().__init__(young, poisson)
        own = checked(
            self.limits,
            cohesion=cohesion,
            friction_angle=friction_angle,
            dilation_angle=dilation_angle,
            tension_cutoff=tension_cutoff,
        )
        self.parameters = {**self.parameters, **own}
        friction, dilation = (own[angle] for angle in _ANGLES)
        numbers = isinstance(friction, float) and isinstance(dilation, float)
        self.symmetric = friction == dilation if numbers else friction_angle is dilation_angle
        _require_less_dilation(own)
        _warn_of_units(own)
        self.volume_correction = bool(volume_correction)

    def with_softening(
        self,
        decay: ArrayLike | Field,
        *,
        cohesion: ArrayLike | Field | None = None,
        friction_angle: ArrayLike | Field | None = None,
        dilation_angle: ArrayLike | Field | None = None,
    ) -> Self:
        """Return this law with a strength, or a dilation, that falls as plastic strain accumulates.

        Where dilation alone falls, to nothing, soil grows by some sqrt(3) psi/decay of its volume
        in plane strain, with psi in radians, and then shears at constant volume.

        Args:
            decay: How fast: by 1/e in a plastic strain of 1/decay.
            cohesion: Cohesion after much plastic strain, the parameter ``"cohesion_residual"``;
                ``None``: as before.
            friction_angle: Angle of friction after much plastic strain, the parameter
                ``"friction_residual"``; ``None``: as before. The angle of dilation falls with it
                where it is larger.
            dilation_angle: Angle of dilation after much plastic strain, ``"dilation_residual"``;
                ``None``: as before.

        Raises:
            MPMError: A value is out of range, none falls, or one rises.
        """
        strengths = {
            "cohesion_residual": cohesion,
            "friction_residual": friction_angle,
            "dilation_residual": dilation_angle,
        }
        given: dict[str, Any] = {"decay": decay}
        given |= {name: value for name, value in strengths.items() if value is not None}
        other = self.with_parameters(**given)
        _require_softening(other.parameters)
        return other

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
        if "dilation_residual" in self.parameters:
            raise MPMError(
                "In a Body with length= the dilation of its law does not fall: leave out length=, "
                "or the dilation_angle of with_softening()."
            )
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
        if "dilation_residual" in other.parameters:
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
        for name in ("dilation_angle", "dilation_residual"):
            if name in self.parameters:
                values[name] = np.minimum(self.parameters[name], values["friction_angle"])
        known = {n: v if isinstance(v, np.ndarray) else float(v) for n, v in values.items()}
        return self.with_parameters(**known)

    @override
    def initial_state(self, n: int, dim: int) -> State:
        _require_less_dilation(self.parameters)
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
_RESIDUALS = {
    "cohesion": "cohesion_residual",
    "friction_angle": "friction_residual",
    "dilation_angle": "dilation_residual",
}


def _require_softening(parameters: Mapping[str, Parameter]) -> None:
    """Raise an error where what is said of softening is not whole, or is hardening."""
    given = [name for name in _RESIDUALS.values() if name in parameters]
    if ("decay" in parameters) != bool(given):
        raise MPMError(
            f"Softening needs decay and a residual strength, {' or '.join(_RESIDUALS.values())}; "
            f"given: {', '.join(given) or 'decay'}."
        )
    for name, residual in _RESIDUALS.items():
        if exceeds(parameters, residual, name):
            raise MPMError(f"{residual} is larger than {name}; give at most that.")


def _require_less_dilation(parameters: Mapping[str, Parameter]) -> None:
    """Raise an error where values that are known dilate more than associated flow does."""
    if exceeds(parameters, "dilation_angle", "friction_angle"):
        raise MPMError(
            "dilation_angle is larger than friction_angle: plastic flow would create energy; give "
            "at most the angle of friction."
        )


def _warn_of_units(parameters: Mapping[str, Parameter]) -> None:
    """Warn where numbers that are given are those of another unit, or have no effect."""
    given = {name: getattr(value, "value", value) for name, value in parameters.items()}
    known = {n: np.asarray(v) for n, v in given.items() if isinstance(v, float | np.ndarray)}
    friction = known.get("friction_angle", np.zeros(1))
    steepest = friction.max(initial=0.0)
    if 0.0 < steepest < 1.0:
        warn_alone(
            f"friction_angle is {steepest:g} degrees; if these are radians, give "
            f"{np.degrees(steepest):.4g}."
        )
    flattest = np.radians(friction.min(initial=90.0))
    if {"tension_cutoff", "cohesion"} <= known.keys() and flattest > 0.0:
        least = known["tension_cutoff"].min(initial=np.inf)
        most = known["cohesion"].max(initial=0.0) / np.tan(flattest)
        if least > most:
            warn_alone(
                f"tension_cutoff={least:g} has no effect, as cohesion and friction bear a tension "
                f"of {most:.4g} at most; give less than that, or omit it."
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

    def davis(self) -> Self:
        """Return the law with associated flow that slides at the stresses at which this one does.

        Along a plane that does not change its length soil bears b (c + s tan(phi)) under a pressure
        s, with b = cos(psi) cos(phi) / (1 - sin(psi) sin(phi)) (Davis 1968). The law that is
        returned has this strength, and dilates as it rubs: its limit loads are unique and its
        tangents symmetric. A cut-off stays as it is.

        Raises:
            MPMError: It softens, or has parameters that are Functions or Constants.
        """
        angles = tuple(self.parameters[angle] for angle in _ANGLES)
        if not all(
            isinstance(v, float | np.ndarray) for v in (self.parameters["cohesion"], *angles)
        ):
            raise MPMError(
                "davis() needs a cohesion and angles that are numbers or arrays; give the strength "
                "of each layer to a law of its own, by cell_tags."
            )
        if "decay" in self.parameters:
            raise MPMError("davis() is for strength that stays; ask it before with_softening().")
        sine, other, cosine = self._sines()
        share = np.sqrt(1.0 - other**2) * cosine / (1.0 - other * sine)
        angle = np.degrees(np.arctan(share * np.tan(np.radians(angles[0]))))
        values = {"cohesion": share * self.parameters["cohesion"]}
        values |= dict.fromkeys(_ANGLES, angle)
        law = self.with_parameters(
            **{n: v if isinstance(v, np.ndarray) else float(v) for n, v in values.items()}
        )
        law.symmetric = True
        return law

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
    ) -> None:
        """Set the parameters.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.
            cohesion: Shear strength, half the uniaxial one, in units of stress.
            tension_cutoff: Largest tension that is borne, in units of stress; ``None``: any.

        Raises:
            MPMError: A value is out of range; see :class:`FrictionalMaterial`.
        """
        super().__init__(young, poisson, cohesion, 0.0, 0.0, tension_cutoff)
