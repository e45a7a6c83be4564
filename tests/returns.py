# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The returns of this package's laws in NumPy, with which the compiled ones are compared."""

from typing import NamedTuple

import numpy as np

from mpm_dolfinx.materials import (
    DruckerPrager,
    Integration,
    IsotropicElastic,
    ModifiedCamClay,
    MohrCoulomb,
    MuIRheology,
    NeoHooke,
    VonMises,
)
from mpm_dolfinx.materials.base import per_row
from mpm_dolfinx.materials.mandel import (
    deviator,
    deviatoric_projector,
    identity,
    norm,
    to_tensor,
    to_vector,
    trace,
)
from mpm_dolfinx.materials.neo_hooke import _spectral
from mpm_dolfinx.materials.principal import axes_in_order, from_axes, tangent_from_axes
from mpm_dolfinx.materials.softening import SofteningMaterial
from mpm_dolfinx.tolerances import EQUAL, LAST_PLACES, LOCAL_ITERATIONS, NEGLIGIBLE

#: Newton steps of Cam clay before the bounded search.
STEPS = 40
#: Step of the derivatives by the strain that softens, over that in which strength falls by 1/e.
STRIDE = 1e-5


def integrate(law, trial_strain, variables, tangent):
    """Return the answer of a law to strains of its own, as its method ``integrate`` does."""
    if isinstance(law, SofteningMaterial):
        if law.softens and "average" not in law.parameters:
            law = law.softened(variables["plastic_strain"])
        return_ = _averaged if law.softens else give_back
        return over_time(
            law, return_(law, trial_strain, variables, tangent), trial_strain, variables
        )
    for kind, known in KINDS.items():
        if isinstance(law, kind):
            return known(law, trial_strain, variables, tangent)
    return IsotropicElastic.integrate(law, trial_strain, variables, tangent)


def give_back(law, trial_strain, variables, tangent):
    """Return the answer of a law that may soften, without softening and time."""
    kinds = {VonMises: von_mises, MohrCoulomb: mohr_coulomb, DruckerPrager: drucker_prager}
    known = next(its for kind, its in kinds.items() if isinstance(law, kind))
    return known(law, trial_strain, variables, tangent)


def over_time(law, answer, trial_strain, variables):
    """Return the answer of the law over a step from that without time.

    Args:
        answer: Of the law without time.
        trial_strain: As in :meth:`integrate`.
        variables: As there.
    """
    share = law._share()
    if isinstance(share, float) and share == 1.0:
        return answer

    def left(before, after):
        part = np.reshape(share, (-1,) + (1,) * (after.ndim - 1))
        return np.asarray(before + part * (after - before))

    D = answer.tangent
    if D is not None:
        D = left(law.elastic_tangent(*trial_strain.shape), D)
    return Integration(
        left(law.elastic_stress(trial_strain), answer.stress),
        D,
        left(trial_strain, answer.elastic_strain),
        {name: left(variables[name], values) for name, values in answer.variables.items()},
    )


def von_mises(law, trial_strain, variables, tangent):
    n, m = trial_strain.shape
    stress = law.elastic_stress(trial_strain)
    f = law.yield_function(stress, variables["plastic_strain"])
    D = law.elastic_tangent(n, m) if tangent else None
    (points,) = np.nonzero(f > law.yield_tolerance)
    if len(points) == 0:
        return Integration(stress, D, trial_strain, variables)

    elastic_strain = trial_strain.copy(order="K")
    plastic_strain = variables["plastic_strain"].copy()
    stress.T[:, points], elastic_strain.T[:, points], plastic_strain[points], D_plastic = (
        _radial_return(law.at(points), trial_strain.T[:, points], plastic_strain[points], tangent)
    )
    if D is not None:
        everywhere = np.empty((m, m, n))
        everywhere[...] = np.moveaxis(D, 0, -1)
        everywhere[:, :, points] = D_plastic
        D = np.moveaxis(everywhere, -1, 0)
    return Integration(stress, D, elastic_strain, {"plastic_strain": plastic_strain})


def _radial_return(
    law,
    trial_strain,
    plastic_strain,
    tangent,
):
    """Return plastic points to the yield surface; arrays have their points last."""
    m = len(trial_strain)
    dev, size = deviator(trial_strain.T).T, norm(deviator(trial_strain.T))
    direction = dev / size
    hardening, shear = 2.0 / 3.0 * law.parameters["hardening"], 2.0 * law.shear
    rho = law.strength(plastic_strain)
    flow = (shear * size - rho) / (shear + hardening)
    rho = rho + hardening * flow
    # The deviator is scaled to rho, not reduced by the flow: f = 0 to round-off.
    stress = rho * direction
    stress[:3] += law.bulk * trace(trial_strain.T)
    D = None
    if tangent:
        # K I x I + rho/|e| (P - n x n) + 2 G h/(2 G + h) n x n, with the projector P
        one = identity(m)[:, None, None]
        secant = rho / size
        along = shear * hardening / (shear + hardening) - secant
        D = (along * direction)[:, None] * direction
        D += secant * deviatoric_projector(m)[:, :, None]
        D += law.bulk * (one * one.transpose(1, 0, 2))
    return (
        stress,
        trial_strain - flow * direction,
        plastic_strain + np.sqrt(2.0 / 3.0) * flow,
        D,
    )


def mohr_coulomb(law, trial_strain, variables, tangent):
    n, m = trial_strain.shape
    stress = law.elastic_stress(trial_strain)
    D = law.elastic_tangent(n, m) if tangent else None
    strain, axes = axes_in_order(trial_strain)
    surface = _Pyramid.of(law._constants(), n)
    points = np.flatnonzero(surface.yields(strain, law.yield_tolerance))
    if len(points) == 0:
        return Integration(stress, D, trial_strain, variables)
    surface, strain, axes = surface.at(points), strain[:, points], axes[:, :, points]
    answer = surface.give_back(strain, law.yield_tolerance)
    elastic, kappa = trial_strain.copy(), variables["plastic_strain"].copy()
    stress[points] = from_axes(answer.stress, axes, m)
    elastic[points] = from_axes(answer.elastic, axes, m)
    kappa[points] += np.sqrt(2.0 / 3.0 * np.sum((strain - answer.elastic) ** 2, axis=0))
    if D is not None:
        D = D.copy()
        quotients = shear_quotients(strain, answer.elastic, answer.normal, surface.shear)
        D[points] = tangent_from_axes(answer.normal, quotients, axes, m)
    return Integration(stress, D, elastic, {"plastic_strain": kappa})


class _Answer(NamedTuple):
    """Principal values at the end of a step: ``(3, n)``, the derivatives ``(3, 3, n)``."""

    stress: np.ndarray
    elastic: np.ndarray
    normal: np.ndarray

    def put(self, where, other):
        """Take over another answer at some points."""
        for mine, theirs in zip(self, other, strict=True):
            mine[..., where] = theirs[..., where]


AVERAGES = {
    "plane": np.eye(3),
    "compression": np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]),
    "extension": np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.0, 0.5, 0.5]]),
}
"""Principal values on a plane and on the two edges, where two of them are equal."""


class _Pyramid(NamedTuple):
    """Constants of a number of points, shape ``(n,)`` each.

    The yield function is (1 + sin phi) s1 - (1 - sin phi) s3 - strength here.
    """

    bulk: np.ndarray
    shear: np.ndarray
    friction: np.ndarray
    dilation: np.ndarray
    strength: np.ndarray
    tension: np.ndarray
    corrects: np.ndarray

    @classmethod
    def of(cls, constants, n):
        """Return the constants at n points."""
        return cls(*(np.broadcast_to(value, n) for value in constants))

    def at(self, points):
        """Return the constants of some of the points."""
        return type(self)(*(value[points] for value in self))

    def stiffness(self):
        """Return the elastic stiffness of principal values, shape ``(3, 3, n)``."""
        lame = self.bulk - 2.0 / 3.0 * self.shear
        return np.asarray(lame + 2.0 * self.shear * np.eye(3)[:, :, None])

    def _stress(self, elastic):
        lame = self.bulk - 2.0 / 3.0 * self.shear
        return np.asarray(lame * elastic.sum(axis=0) + 2.0 * self.shear * elastic)

    def _excess(self, stress):
        """Return the yield function, and what it is small against."""
        tension, pressure = (1.0 + self.friction) * stress[0], (1.0 - self.friction) * stress[2]
        size = np.abs(tension) + np.abs(pressure) + self.strength
        return tension - pressure - self.strength, size

    def yields(self, strain, tolerance):
        """Return whether the stress of strains ``(3, n)`` is beyond yield."""
        stress = self._stress(strain)
        f, size = self._excess(stress)
        return np.asarray((f > tolerance * size) | (stress[0] - self.tension > tolerance * size))

    def give_back(self, strain, tolerance):
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

    def to_pyramid(self, strain, apex):
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

    def _along(self, where, strain):
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

    def at_stress(self, strain, which, values):
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

    def with_volume(self, strain, answer):
        """Return the answer at a point of the hydrostatic axis, with the volume correction.

        What opens there stays in the elastic strain, to close again before there is pressure.
        """
        third = np.broadcast_to(strain.sum(axis=0) / 3.0, strain.shape)
        return answer._replace(elastic=np.where(self.corrects != 0.0, third, answer.elastic))

    def to_cutoff(self, strain):
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


def shear_quotients(strain, elastic, normal, shear):
    """Return the quotients of differences of stress and strain, shape ``(3, 3, n)``.

    Of laws with linear elasticity, where differences of stress are 2 G times those of the elastic
    strain. They are between 0 and 2 G, as the return keeps the order of the principal values;
    where two strains are equal, the quotient is its limit.

    Args:
        strain: Trial strains, shape ``(3, n)``.
        elastic: Elastic strains, shape ``(3, n)``.
        normal: Derivatives of the stresses by the trial strains, shape ``(3, 3, n)``.
        shear: Shear modulus G, shape ``(n,)``.
    """
    result = np.zeros_like(normal)
    near = EQUAL * np.abs(strain).max(axis=0)
    for a, b in ((0, 1), (1, 2), (0, 2)):
        difference = strain[a] - strain[b]
        equal = np.abs(difference) <= near
        limit = 0.5 * (normal[a, a] - normal[a, b] - normal[b, a] + normal[b, b])
        ratio = (elastic[a] - elastic[b]) / np.where(equal, 1.0, difference)
        quotient = np.clip(np.where(equal, limit, 2.0 * shear * ratio), 0.0, 2.0 * shear)
        result[a, b] = result[b, a] = quotient
    return result


def drucker_prager(law, trial_strain, variables, tangent):
    n, m = trial_strain.shape
    stress = law.elastic_stress(trial_strain)
    D = law.elastic_tangent(n, m) if tangent else None
    constants = _Cone(*(np.broadcast_to(c, n) for c in law._constants()))
    bulk, shear, eta, _, strength, top, _ = constants
    mean = bulk * trace(trial_strain)
    root = np.sqrt(2.0) * shear * norm(deviator(trial_strain))
    room = law.yield_tolerance * (root + np.abs(mean) + strength)
    beyond = (root + eta * mean - strength > room) | (mean - top > room)
    points = np.flatnonzero(beyond)
    if len(points) == 0:
        return Integration(stress, D, trial_strain, variables)
    elastic, kappa = trial_strain.copy(), variables["plastic_strain"].copy()
    stress[points], elastic[points], D_plastic = _to_cone(
        _Cone(*(values[points] for values in constants)), trial_strain[points], tangent
    )
    kappa[points] += np.sqrt(2.0 / 3.0) * norm(trial_strain[points] - elastic[points])
    if D is not None:
        D = D.copy()
        D[points] = D_plastic
    return Integration(stress, D, elastic, {"plastic_strain": kappa})


class _Cone(NamedTuple):
    """Constants of a number of points, shape ``(n,)`` each."""

    bulk: np.ndarray
    shear: np.ndarray
    eta: np.ndarray
    flow: np.ndarray
    strength: np.ndarray
    top: np.ndarray
    corrects: np.ndarray


def _to_cone(constants, strain, tangent):
    """Return stress, elastic strain and tangent of trial strains ``(n, m)`` that yield."""
    n = len(strain)
    bulk, shear, eta, flow, strength, top, corrects = constants
    mean, dev = bulk * trace(strain), deviator(strain)
    size = norm(dev)
    root = np.sqrt(2.0) * shear * size
    # The cone, and where its mean stress is too large, the cap.
    stiffness = shear + bulk * eta * flow
    multiplier = np.maximum(root + eta * mean - strength, 0.0) / stiffness
    returned = mean - bulk * flow * multiplier
    cap = returned > top
    with np.errstate(invalid="ignore"):
        limit = np.where(cap, np.maximum(strength - eta * top, 0.0), np.inf)
    p = np.where(cap, top, returned)
    held = cap & (root < limit)
    q = np.where(cap, np.minimum(root, limit), root - shear * multiplier)
    ratio = np.divide(q, root, out=np.ones(n), where=root > 0.0)
    ratio = np.where(cap & ~held & (root == 0.0), 0.0, ratio)
    elastic = ratio[:, None] * dev
    volume = np.where(cap & (corrects != 0.0), trace(strain), p / bulk)
    elastic[:, :3] += (volume / 3.0)[:, None]
    stress = (2.0 * shear * ratio)[:, None] * dev
    stress[:, :3] += p[:, None]
    if not tangent:
        return stress, elastic, None
    answer = Returned(
        p,
        q,
        p_trace=np.where(cap, 0.0, bulk * (1.0 - bulk * eta * flow / stiffness)),
        p_size=np.where(cap, 0.0, -np.sqrt(2.0) * shear * bulk * flow / stiffness),
        q_trace=np.where(cap, 0.0, -shear * bulk * eta / stiffness),
        q_size=np.sqrt(2.0) * shear * np.where(cap, held, 1.0 - shear / stiffness),
    )
    return stress, elastic, returned_tangent(answer, strain, shear, ratio)


class Returned(NamedTuple):
    """Result of a return in p and q, the root of J2, with derivatives, shape ``(n,)`` each.

    Derivatives are those by the trace and by the size of the deviator of the trial strain.
    """

    p: np.ndarray
    q: np.ndarray
    p_trace: np.ndarray
    p_size: np.ndarray
    q_trace: np.ndarray
    q_size: np.ndarray


def returned_tangent(law, strain, shear, ratio):
    """Return the tangent of a law of two invariants, shape ``(n, m, m)``.

    Args:
        law: What it returns to.
        strain: Trial strains, shape ``(n, m)``.
        shear: Shear modulus, shape ``(n,)``.
        ratio: q over that of the trial state, shape ``(n,)``.
    """
    m = strain.shape[1]
    one, dev = identity(m), deviator(strain)
    size = norm(dev)[:, None]
    direction = np.divide(dev, size, out=np.zeros_like(dev), where=size > 0.0)
    along = np.sqrt(2.0) * law.q_size - 2.0 * shear * ratio
    D = np.einsum("n,ij->nij", 2.0 * shear * ratio, deviatoric_projector(m))
    D += np.einsum("n,ni,nj->nij", along, direction, direction)
    D += np.einsum("n,i,j->nij", law.p_trace, one, one)
    D += np.einsum("n,i,nj->nij", law.p_size, one, direction)
    D += np.einsum("n,ni,j->nij", np.sqrt(2.0) * law.q_trace, direction, one)
    return np.asarray(D)


def mu_i(law, trial_strain, variables, tangent):
    n, m = trial_strain.shape
    stress = law.elastic_stress(trial_strain)
    D = law.elastic_tangent(n, m) if tangent else None
    constants = [np.broadcast_to(c, n) for c in law._constants()]
    bulk, shear, friction = constants[:3]
    pressure = -bulk * trace(trial_strain)
    root = np.sqrt(2.0) * shear * norm(deviator(trial_strain))
    room = law.yield_tolerance * (root + np.abs(pressure))
    points = np.flatnonzero((root - friction * pressure > room) | (-pressure > room))
    if len(points) == 0:
        return Integration(stress, D, trial_strain, variables)
    constants = [values[points] for values in constants]
    strain, shear = trial_strain[points], shear[points]
    answer = _slipped(constants, pressure[points], root[points])
    ratio = np.divide(answer.q, root[points], out=np.zeros(len(points)), where=root[points] > 0.0)
    part = ratio[:, None] * deviator(strain)
    stress[points] = 2.0 * shear[:, None] * part
    stress[points, :3] += answer.p[:, None]
    elastic, kappa = trial_strain.copy(), variables["plastic_strain"].copy()
    part[:, :3] += trace(strain)[:, None] / 3.0
    elastic[points] = part
    kappa[points] += np.sqrt(2.0 / 3.0) * norm(strain - part)
    if D is not None:
        D = D.copy()
        D[points] = returned_tangent(answer, strain, shear, ratio)
    return Integration(stress, D, elastic, {"plastic_strain": kappa})


def _slipped(constants, pressure, root):
    """Return the stresses that yielding trial states return to.

    The plastic shear of a step is the positive root of G k x^2 + b x = f w, with w = dt sqrt(P),
    k = d sqrt(rho_s)/I_0, f the excess over mu_s P, and b = G w + k ((mu_2 - mu_s) P - f).

    Args:
        constants: As :meth:`MuIRheology._constants` gives them, shape ``(n,)`` each.
        pressure: P of the trial state.
        root: Its root of J2.
    """
    bulk, shear, friction, span, lag, time = constants
    apart = ~(pressure > 0.0)
    P = np.where(apart, 1.0, pressure)
    f = np.where(apart, 1.0, root - friction * P)
    wait = time * np.sqrt(P)
    b = shear * wait + lag * (span * P - f)
    slope = np.sqrt(b**2 + 4.0 * shear * lag * f * wait)
    with np.errstate(divide="ignore", invalid="ignore"):
        slip = np.where(b > 0.0, 2.0 * f * wait / (b + slope), 0.5 * (slope - b) / (shear * lag))
    q = np.clip(root - shear * slip, friction * P, (friction + span) * P)
    by_root = 1.0 - shear * (lag * slip + wait) / slope
    by_pressure = slip * lag * (friction + span) + wait * (1.5 * friction - 0.5 * q / P)
    return Returned(
        p=np.where(apart, 0.0, -P),
        q=np.where(apart, 0.0, q),
        p_trace=np.where(apart, 0.0, bulk),
        p_size=np.zeros_like(P),
        q_trace=np.where(apart, 0.0, -bulk * shear * by_pressure / slope),
        q_size=np.where(apart, 0.0, np.sqrt(2.0) * shear * by_root),
    )


def cam_clay(law, trial_strain, variables, tangent):
    n, m = trial_strain.shape
    p_c = variables["preconsolidation"]
    clay = _Clay.of(law.parameters, p_c)
    dev = deviator(trial_strain)
    size = norm(dev)
    volume, shape = -trace(trial_strain), np.sqrt(2.0 / 3.0) * size
    x, y = volume.copy(), np.zeros(n)
    residual = clay.residual(volume, shape, x, y)[1]
    points = np.flatnonzero(residual > law.yield_tolerance)
    if len(points):
        x[points], y[points] = clay.at(points).solve(volume[points], shape[points])
    ratio = 1.0 / (1.0 + clay.softness * y)
    pressure = clay.pressure(x)
    stress = (2.0 * clay.shear * p_c * ratio)[:, None] * dev
    stress[:, :3] -= (pressure * p_c)[:, None]
    elastic = trial_strain.copy()
    elastic[points] = ratio[points, None] * dev[points]
    elastic[points, :3] -= (x[points] / 3.0)[:, None]
    new = {name: values.copy() for name, values in variables.items()}
    new["plastic_strain"] += np.sqrt(2.0 / 3.0) * norm(trial_strain - elastic)
    new["preconsolidation"][points] *= clay.at(points).growth(volume[points], x[points])
    if not tangent:
        return Integration(stress, None, elastic, new)

    plastic = np.zeros(n, dtype=bool)
    plastic[points] = True
    p_v, p_s, q_v, q_s = clay.slopes(volume, shape, x, y, plastic) * p_c
    direction = np.divide(dev, size[:, None], out=np.zeros_like(dev), where=size[:, None] > 0.0)
    one, secant = identity(m), 2.0 * clay.shear * p_c * ratio
    D = np.einsum("n,ij->nij", secant, deviatoric_projector(m))
    D += np.einsum("n,ni,nj->nij", 2.0 / 3.0 * q_s - secant, direction, direction)
    D += np.einsum("n,i,j->nij", p_v, one, one)
    D -= np.einsum("n,i,nj->nij", np.sqrt(2.0 / 3.0) * p_s, one, direction)
    D -= np.einsum("n,ni,j->nij", np.sqrt(2.0 / 3.0) * q_v, direction, one)
    return Integration(stress, D, elastic, new)


class _Clay(NamedTuple):
    """Constants of a number of points, shape ``(n,)`` each; stresses over the old p_c.

    The unknowns are the elastic strain of volume x and the multiplier y (times the old p_c).
    """

    plastic: np.ndarray
    swelling: np.ndarray
    ratio: np.ndarray
    shear: np.ndarray
    reference: np.ndarray

    @classmethod
    def of(cls, parameters, p_c):
        """Return the constants of points with preconsolidation p_c."""
        plastic = parameters["compression"] - parameters["swelling"]
        names = ("swelling", "critical_ratio")
        values = (plastic, *(parameters[name] for name in names))
        stresses = (parameters["shear_modulus"] / p_c, parameters["reference_pressure"] / p_c)
        return cls(*(np.broadcast_to(value, len(p_c)) for value in (*values, *stresses)))

    def at(self, points):
        """Return the constants of some of the points."""
        return type(self)(*(value[points] for value in self))

    @property
    def softness(self):
        """The strain of shape is 1/(1 + softness y) of its trial value."""
        return 6.0 * self.shear / self.ratio**2

    def pressure(self, x):
        """Return p."""
        return np.asarray(self.reference * np.exp(x / self.swelling))

    def growth(self, volume, x):
        """Return p_c."""
        return np.asarray(np.exp((volume - x) / self.plastic))

    def residual(self, volume, shape, x, y):
        """Return the residuals of the flow rule and of the yield function."""
        p, p_c = self.pressure(x), self.growth(volume, x)
        q = 3.0 * self.shear * shape / (1.0 + self.softness * y) / self.ratio
        return x - volume + y * (2.0 * p - p_c), q**2 + p * (p - p_c)

    def jacobian(self, volume, shape, x, y):
        """Return the derivatives of the residuals: flow by x, by y, yield by x, by y."""
        p, p_c = self.pressure(x), self.growth(volume, x)
        q = 3.0 * self.shear * shape / (1.0 + self.softness * y) / self.ratio
        slope, hardening = p / self.swelling, p_c / self.plastic
        return (
            1.0 + y * (2.0 * slope + hardening),
            2.0 * p - p_c,
            (2.0 * p - p_c) * slope + p * hardening,
            -2.0 * q**2 * self.softness / (1.0 + self.softness * y),
        )

    def step(self, volume, shape, x, y):
        """Return Newton's step."""
        flow, f = self.residual(volume, shape, x, y)
        a, b, c, d = self.jacobian(volume, shape, x, y)
        with np.errstate(divide="ignore", invalid="ignore"):
            det = a * d - b * c
            return -(d * flow - b * f) / det, -(a * f - c * flow) / det

    def range(self, volume):
        """Return the bounds of x: the trial value and that of the critical state."""
        rates = 1.0 / self.swelling + 1.0 / self.plastic
        critical = (volume / self.plastic - np.log(2.0 * self.reference)) / rates
        return np.minimum(volume, critical), np.maximum(volume, critical)

    def solve(self, volume, shape):
        """Return the unknowns of points that yield."""
        low, high = self.range(volume)
        x, y = volume.copy(), np.zeros_like(volume)
        active = np.arange(len(x))
        for _ in range(STEPS):
            law, there = self.at(active), (volume[active], shape[active], x[active], y[active])
            dx, dy = law.step(*there)
            x[active] = np.clip(x[active] + dx, low[active], high[active])
            y[active] = np.maximum(y[active] + dy, 0.0)
            flow, f = law.residual(volume[active], shape[active], x[active], y[active])
            size = law.pressure(x[active]) + law.growth(volume[active], x[active])
            done = (np.abs(flow) <= NEGLIGIBLE * self.swelling[active]) & (
                np.abs(f) <= NEGLIGIBLE * size**2
            )
            active = active[~(done & (y[active] > 0.0))]
            if len(active) == 0:
                break
        if len(active):
            x[active], y[active] = self.at(active).search(volume[active], shape[active])
        dx, dy = self.step(volume, shape, x, y)
        finite = np.isfinite(dx) & np.isfinite(dy)
        return np.where(finite, x + dx, x), np.where(finite, y + dy, y)

    def search(self, volume, shape):
        """Return the unknowns by bisection of y, with x by bisection for each."""
        largest = np.ones_like(volume)
        for _ in range(LOCAL_ITERATIONS):
            x = self.volume_at(volume, shape, largest)
            largest = np.where(
                self.residual(volume, shape, x, largest)[1] > 0.0, 4.0 * largest, largest
            )
        least = np.zeros_like(volume)
        for _ in range(LOCAL_ITERATIONS):
            middle = 0.5 * (least + largest)
            x = self.volume_at(volume, shape, middle)
            beyond = self.residual(volume, shape, x, middle)[1] > 0.0
            least, largest = np.where(beyond, middle, least), np.where(beyond, largest, middle)
        return self.volume_at(volume, shape, largest), largest

    def volume_at(self, volume, shape, y):
        """Return x for a given y."""
        low, high = self.range(volume)
        for _ in range(LOCAL_ITERATIONS):
            middle = 0.5 * (low + high)
            above = self.residual(volume, shape, middle, y)[0] > 0.0
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        return 0.5 * (low + high)

    def slopes(self, volume, shape, x, y, plastic):
        """Return the derivatives of p and q by the trial strains of volume and shape, (4, n)."""
        p, p_c = self.pressure(x), self.growth(volume, x)
        left = 1.0 + self.softness * y
        q, hardening = 3.0 * self.shear * shape / left, p_c / self.plastic
        a, b, c, d = self.jacobian(volume, shape, x, y)
        det = np.where(plastic, a * d - b * c, 1.0)
        # What the residuals change by with the trial strains, with the sign turned.
        flow_v, f_v = 1.0 + y * hardening, p * hardening
        f_s = -2.0 * q / self.ratio**2 * 3.0 * self.shear / left
        x_v, y_v = (d * flow_v - b * f_v) / det, (a * f_v - c * flow_v) / det
        x_s, y_s = -b * f_s / det, a * f_s / det
        slope, fall = p / self.swelling, -q * self.softness / left
        result = np.stack(
            (slope * x_v, slope * x_s, fall * y_v, 3.0 * self.shear / left + fall * y_s)
        )
        zero = np.zeros_like(p)
        return np.where(plastic, result, np.stack((slope, zero, zero, 3.0 * self.shear)))


def neo_hooke(law, trial_strain, variables, tangent):
    m = trial_strain.shape[1]
    strains, axes = np.linalg.eigh(to_tensor(trial_strain))
    stress = per_row(law.shear) * _spectral(np.expm1(2.0 * strains), axes, m)
    stress[:, :3] += (law.lame * trace(trial_strain))[:, None]
    D = None
    if tangent:
        shear, lame = (np.reshape(p, (-1, 1, 1)) for p in (law.shear, law.lame))
        D = 2.0 * shear * _slopes(strains, axes, m) + lame * np.outer(identity(m), identity(m))
    return Integration(stress, D, trial_strain, variables)


def _slopes(strains, axes, m):
    """Half the derivative of exp(2 eps) by eps, shape ``(n, m, m)``.

    Args:
        strains: Principal values of eps, shape ``(n, 3)``.
        axes: Their directions as columns, shape ``(n, 3, 3)``.
        m: Number of components.
    """
    result = np.zeros((len(strains), m, m))
    for a in range(3):
        for b in range(a, 3):
            pair = np.einsum("ni,nj->nij", axes[:, :, a], axes[:, :, b])
            scale = 0.5 if a == b else np.sqrt(0.5)
            vector = to_vector(scale * (pair + pair.swapaxes(1, 2)), 2 if m == 4 else 3)
            gap = strains[:, a] - strains[:, b]
            ratio = np.where(gap == 0.0, 1.0, np.sinh(gap) / np.where(gap == 0.0, 1.0, gap))
            factor = np.exp(strains[:, a] + strains[:, b]) * ratio
            result += factor[:, None, None] * np.einsum("ni,nj->nij", vector, vector)
    return result


def _averaged(law, trial, variables, tangent):
    """Return the stress of a law that softens by an average; see `SofteningMaterial`."""
    before = variables["plastic_strain"]

    def returned(rows, kappa, tangent=False):
        softer = law.at(rows).softened(kappa)
        return give_back(softer, trial[rows], {"plastic_strain": before[rows]}, tangent)

    every = np.arange(len(trial))
    answer = returned(every, before, tangent)
    points = np.flatnonzero(answer.variables["plastic_strain"] > before)
    if len(points) == 0:
        return answer

    def excess(rows, kappa):
        return returned(points[rows], kappa).variables["plastic_strain"] - kappa

    kappa = _root(excess, before[points], answer.variables["plastic_strain"][points])
    found = returned(points, kappa, tangent)
    stress, elastic = answer.stress.copy(), answer.elastic_strain.copy()
    plastic_strain, D = before.copy(), answer.tangent
    stress[points], elastic[points] = found.stress, found.elastic_strain
    plastic_strain[points] = found.variables["plastic_strain"]
    if D is not None:
        decay = np.broadcast_to(law.parameters["decay"], len(trial))[points]
        stride = STRIDE / np.maximum(decay, 1.0)
        sides = [returned(points, kappa - k * stride) for k in (1, 2)]
        by_kappa, growth = (
            (3.0 * a - 4.0 * b + c) / (2.0 * stride[:, None])
            for a, b, c in (
                [one.stress for one in (found, *sides)],
                [one.variables["plastic_strain"][:, None] for one in (found, *sides)],
            )
        )
        assert found.tangent is not None
        D = D.copy()
        flow = trial[points] - found.elastic_strain
        size = np.sqrt(np.einsum("ni,ni->n", flow, flow))
        direction = np.sqrt(2.0 / 3.0) * flow / size[:, None]
        rows = found.tangent.swapaxes(1, 2).reshape(-1, trial.shape[1])
        local = law.at(np.repeat(points, trial.shape[1])).elastic_strain(rows)
        compliant = local.reshape(len(points), trial.shape[1], -1).swapaxes(1, 2)
        slope = direction - np.einsum("ni,nij->nj", direction, compliant)
        D[points] = found.tangent + np.einsum("ni,nj->nij", by_kappa, slope / (1.0 - growth))
    return Integration(stress, D, elastic, {"plastic_strain": plastic_strain})


def _root(excess, low, high):
    """Return where functions vanish that are positive at first, by regula falsi with halvings.

    Args:
        excess: Returns the values of some of them, by their numbers.
        low: Where they are positive, shape ``(n,)``.
        high: By how much beyond that they are there, as they fall; looked further where not.
    """
    low, high = low.copy(), high.copy()
    size = LAST_PLACES * high
    rows = np.arange(len(low))
    f_low, f_high = high - low, excess(rows, high)
    for _ in range(LOCAL_ITERATIONS):
        far = np.flatnonzero(f_high > 0.0)
        if len(far) == 0:
            break
        low[far], f_low[far] = high[far], f_high[far]
        high[far] += 2.0 * f_high[far]
        f_high[far] = excess(far, high[far])
    best, least = high.copy(), np.abs(f_high)
    side = np.zeros(len(low), dtype=np.int64)
    for _ in range(LOCAL_ITERATIONS):
        rows = np.flatnonzero((least > size) & (high - low > size))
        if len(rows) == 0:
            break
        a, b, fa, fb = low[rows], high[rows], f_low[rows], f_high[rows]
        x = (a * fb - b * fa) / (fb - fa)
        f = excess(rows, x)
        closer = np.abs(f) < least[rows]
        best[rows[closer]], least[rows[closer]] = x[closer], np.abs(f[closer])
        up = f > 0.0
        low[rows], f_low[rows] = np.where(up, x, a), np.where(up, f, fa)
        high[rows], f_high[rows] = np.where(up, b, x), np.where(up, fb, f)
        f_high[rows[up & (side[rows] == 1)]] *= 0.5
        f_low[rows[~up & (side[rows] == -1)]] *= 0.5
        side[rows] = np.where(up, 1, -1)
    return best


KINDS = {MuIRheology: mu_i, ModifiedCamClay: cam_clay, NeoHooke: neo_hooke}
