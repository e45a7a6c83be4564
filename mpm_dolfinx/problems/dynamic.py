# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Motion of particles with a material, or with a UFL residual, step by step through time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from ..assembly.density import Density
from ..boundary.supports import Support
from ..constitutive.beginning import take_over
from ..constitutive.points import MaterialPoints
from ..constitutive.step_stress import StepStress
from ..errors import MPMError, not_with, warn
from ..meshes.values import Value
from ..parallel.boundary import collective
from ..parallel.given import is_number, require_same
from ..particles.particles import Particles
from ..system.body import StepForce
from ..system.inertia import Inertia
from ..system.schemes import Scheme, as_scheme
from ..system.term import Term
from ..tolerances import UNCERTAIN
from .arguments import as_bodies, as_supports, as_terms
from .body import Body, as_given
from .motion import (
    MovingProblem,
    initial_velocities,
    initial_velocity,
    rayleigh_of,
    require_motion,
)
from .particle_problem import ParticleProblem
from .parts import Contribution
from .physics import Physics
from .quasistatic import QuasiStaticProblem
from .setup import Setup
from .stages import join

__all__ = ["DynamicParticleProblem", "DynamicProblem"]


class _Motion(Physics):
    """Stress and forces of bodies that move.

    Args:
        inertia: The term that has the velocities.
        viscosity: Damping in proportion to the stiffness, a time.

    Attributes:
        stresses: Of each body.
    """

    further = ("velocity",)
    gradual = False
    takes_time = True

    def __init__(self, inertia: Inertia, viscosity: float) -> None:
        self._inertia, self._viscosity = inertia, viscosity
        self.stresses: list[StepStress] = []

    @override
    def not_for_cracks(self) -> dict[str, bool]:
        # (that stress makes up for any change of the energy, also that which goes into cracks, and
        # this damping is that of bodies which are whole)
        scheme = self._inertia.scheme
        return {
            f"scheme={scheme.name!r}; use 'euler'": scheme.stress_of_step,
            "a part of the stiffness in rayleigh=; omit it": self._viscosity > 0.0,
        }

    @override
    def require(self, bodies: Sequence[Body], kind: str) -> None:
        super().require(bodies, kind)
        if any(body.density is None for body in bodies):
            raise MPMError("A body that moves needs a density; give density= to its mpm.Body.")

    @override
    def begin(self, setup: Setup) -> None:
        self.stresses = []

    @override
    def acting(
        self, points: MaterialPoints, supports: Sequence[Support]
    ) -> tuple[StepStress, Sequence[StepForce]]:
        body = points.strain.particles
        whole = self._inertia.scheme.stress_of_step and not self.is_static(body)
        stress = StepStress(points, whole, self._viscosity, self.share(body))
        self.stresses.append(stress)
        return stress, (stress, *supports)

    @override
    def share(self, body: Particles) -> float:
        return 1.0 if self.is_static(body) else self._inertia.scheme.share

    @override
    def is_static(self, body: Particles) -> bool:
        return self._inertia.state.is_static(body)


class DynamicProblem(MovingProblem, QuasiStaticProblem):
    """Motion of bodies with materials: the balance of momentum, implicit in time.

    A :class:`QuasiStaticProblem` with inertia. Velocities live at the bodies' nodes, with the
    consistent mass; what a step's background cannot follow of them is lost (``"project"``), or
    comes back with the other sign (``"reflect"``), and never adds energy. Momentum is kept to
    round-off. See the page on dynamics for what else is kept, and by which scheme.

    Loads act in full from the beginning, unless the path says otherwise.

    Args:
        bodies: One :class:`Body`, or a list: each with a positive density that does not change in
            time, and a velocity (``None``: at rest).
        bcs: As in :class:`QuasiStaticProblem`.
        scheme: ``"midpoint"``: second order; the force of a step is the mean of those at its
            ends. ``"conserving"``: second order; stress is one of the whole step, by which angular
            momentum is kept to round-off, and the energy of elastic materials too; for what
            spins fast or long. ``"euler"``: first order, with much loss of energy, for motions
            that shall come to rest. Or a :class:`Scheme` of your own.
        out_of_range: ``"project"`` or ``"reflect"``; no matter with ``scheme="euler"``.
        rayleigh: Damping ``(alpha, beta)`` in proportion to mass (one over a time) and to the
            stiffness of the undeformed bodies (a time); not negative.
        after: A quasi-static problem of the same particles, from the state of which the motion
            begins: equilibrium under loads, supports and terms that should be given here too, the
            same contacts, which know where points stick. Materials come in place of those of before
            as in :meth:`stage`. That problem cannot go on then.
        quasi_static: Bodies among these that have no inertia, beside others that move: they are in
            equilibrium at the end of each step, whatever the scheme, and have no velocity.
        terms: As in :class:`QuasiStaticProblem`.
        **options: All else that :class:`QuasiStaticProblem` has but ``background``.

    Attributes:
        inertia: The term that has the velocities.

    Raises:
        MPMError: As there; and what does not go with inertia.
    """

    @collective()
    def __init__(
        self,
        bodies: Body | Sequence[Body],
        bcs: Sequence[fem.DirichletBC] = (),
        *,
        scheme: str | Scheme = "midpoint",
        out_of_range: str = "project",
        rayleigh: tuple[float, float] = (0.0, 0.0),
        after: QuasiStaticProblem | None = None,
        quasi_static: Sequence[Particles] = (),
        terms: Sequence[Term] = (),
        **options: Any,
    ) -> None:
        given = as_given(bodies)
        particles = as_bodies([body.particles for body in given])
        static = _static_among(given, quasi_static, options)
        if after is not None:
            self._require_before(after, given, options)
        numbers = [number for number, body in enumerate(particles) if body in static]
        require_same(particles[0].V.mesh.comm, quasi_static=numbers)
        self._goes_on = after is not None
        damping = rayleigh_of(rayleigh)
        require_motion("DynamicProblem", options)
        rule = as_scheme(scheme, out_of_range)
        if rule.reflects and options.get("mixed") == "stabilised pressure":
            warn(
                particles[0].V.mesh.comm,
                "With mixed='stabilised pressure' a motion with out_of_range='reflect' may gain "
                "energy, as points come into other cells; use out_of_range='project'.",
            )
        start = _at_first(given)
        self._energies = []
        self.inertia = Inertia(particles, start, rule, damping, self._energies, static)
        self._physics = self._motion = _Motion(self.inertia, damping[1])
        own = as_terms(terms, particles)
        if after is not None:
            join(own, after.terms)
        governed = [body.governed_by for body in particles]
        try:
            super().__init__(bodies, bcs, terms=[self.inertia, *own], **options)
            self.history.energies = self._energies
            self.inertia.mass()
            if after is not None:
                for points, before in zip(self.points, after.points, strict=True):
                    take_over(points, before)
        except BaseException:
            for body, by in zip(particles, governed, strict=True):
                body.governed_by = by
            raise

    @staticmethod
    def _require_before(
        after: QuasiStaticProblem, bodies: Sequence[Body], options: dict[str, Any]
    ) -> None:
        """Raise an error unless a motion of these bodies can begin with the state of a problem."""
        if not isinstance(after, QuasiStaticProblem) or isinstance(after, MovingProblem):
            raise MPMError(
                f"after= needs a QuasiStaticProblem of these particles, not a "
                f"{type(after).__name__}."
            )
        same = len(after.bodies) == len(bodies) and all(
            one is other.particles for one, other in zip(after.bodies, bodies, strict=True)
        )
        if not same:
            raise MPMError("after= needs a problem of the same particles, in the same order.")
        if not after.reign.holds:
            raise MPMError(
                "after= is a problem that no longer governs its particles, as another one was made "
                "of them since; begin from that, or make all of them anew."
            )
        for mine, its in zip(bodies, after.setup.given, strict=True):
            if mine.initial_stress is not None and mine.initial_stress is not its.initial_stress:
                raise MPMError("after= brings its stress with it; omit another initial_stress=.")
            if mine.f_bar != its.f_bar:
                raise MPMError(f"after= is a problem with f_bar={its.f_bar!r}; give the same here.")
        for name, default in (("axisymmetric", False), ("mixed", None)):
            its_own = getattr(after.setup, name)
            if options.get(name, default) != its_own:
                raise MPMError(f"after= is a problem with {name}={its_own!r}; give the same here.")

    @override
    def _initial_velocities(self) -> list[fem.Function]:
        return _at_first(self.setup.given)

    @override
    def _carry_stress(self, stresses: Sequence[Any]) -> None:
        """Let bodies carry a stress, but for those of a problem that goes on with its own."""
        if not self._goes_on:
            super()._carry_stress(stresses)

    def add(self, body: Body, name: str | None = None, *, sudden: bool = False) -> None:
        """Add a body: see :meth:`QuasiStaticProblem.add`; what changes does so at once."""
        (given,) = as_given(body)
        start = initial_velocity(given.velocity, given.particles)
        super().add(given, name, sudden=sudden)
        self.inertia.velocities[-1].x.array[:] = start.x.array

    @override
    def _own_terms(self) -> list[Term]:
        return [*super()._own_terms(), self.inertia]

    def stored_and_done(self) -> tuple[float, float]:
        """Return elastic energy, and the work done against stress in the last step (collective)."""
        own = [(s.strain_energy(), s.stress_work) for s in self._motion.stresses]
        energy, work = self._comm.allreduce(np.sum(own, axis=0))
        return float(energy), float(work)

    _most_dissipated, _told_of_gain = 0.0, False

    @override
    def end_step(self) -> None:
        """Say so, once, where stress has done much more work than the materials had stored."""
        super().end_step()
        now, scheme = self._energies[-1], self.inertia.scheme
        self._most_dissipated = most = max(self._most_dissipated, now.dissipated)
        gain = most - now.dissipated
        if self._told_of_gain or scheme.share == 1.0:
            return
        if gain > UNCERTAIN * (now.kinetic + now.strain + most):
            self._told_of_gain = True
            warn(
                self._comm,
                f"By the time {now.time:.3g} stress has done {gain:.2g} more work on the bodies "
                f"than they had stored, as scheme={scheme.name!r} lets it; take scheme='euler'.",
            )


class DynamicParticleProblem(MovingProblem, ParticleProblem):
    """Motion of bodies whose forces are a UFL residual: a :class:`ParticleProblem` with inertia.

    The residual has no inertia itself; the force of a step is the mean of what it is at the step's
    ends, or with ``scheme="euler"`` that at its end. Loads act in full from the beginning
    (``particles.load`` is 1) unless the path says otherwise. All else is as in
    :class:`DynamicProblem`.

    Args:
        R: As in :class:`ParticleProblem`: internal less external forces.
        particles: As there.
        density: Mass per volume of the body mesh, positive; a list has one for each body.
        velocity: At the beginning: as that of a :class:`Body`; a list has one for each body.
        scheme: ``"midpoint"``, ``"euler"`` or a :class:`Scheme`. Stress of a whole step
            (``"conserving"``) is for materials: write the law as one.
        out_of_range: As in :class:`DynamicProblem`.
        damping: Damping in proportion to the mass, one over a time; not negative.
        supports: Supports with a modulus, of :mod:`mpm_dolfinx.boundary`. One-sided ones and
            dashpots must be given here, not be written into R.
        **options: All else that :class:`ParticleProblem` has, as ``J``, ``bcs`` and ``terms``, but
            ``background`` and ``fields``.

    Raises:
        MPMError: As there; and what does not go with inertia.
    """

    @collective()
    def __init__(
        self,
        R: ufl.Form | Sequence[ufl.Form],
        particles: Particles | Sequence[Particles],
        density: Value | list[Value],
        *,
        velocity: Value | list[Value] | None = None,
        scheme: str | Scheme = "midpoint",
        out_of_range: str = "project",
        damping: float = 0.0,
        supports: Sequence[Support] = (),
        **options: Any,
    ) -> None:
        bodies = as_bodies(particles)
        if not is_number(damping) or not 0.0 <= damping < np.inf:
            raise MPMError(f"damping must be a number that is not negative, not {damping!r}.")
        rayleigh = float(damping), 0.0
        require_motion("DynamicParticleProblem", options)
        rule = as_scheme(scheme, out_of_range)
        if rule.stress_of_step:
            raise MPMError(
                f"scheme={rule.name!r} needs the stress at points, which a residual in UFL does "
                "not tell; write the law as a material, and make a DynamicProblem."
            )
        self.supports = tuple(as_supports(supports, bodies))
        self._velocity = velocity
        start = initial_velocities(velocity, particles)
        given = density if isinstance(density, list) else [density] * len(bodies)
        if len(given) != len(bodies):
            raise MPMError(f"There are {len(bodies)} bodies, but a list of {len(given)} densities.")
        self._densities = [Density(rho, body) for rho, body in zip(given, bodies, strict=True)]
        self._energies = []
        self.inertia = Inertia(bodies, start, rule, rayleigh, self._energies)
        every = [self.inertia, *as_terms(options.pop("terms", ()), bodies)]
        super().__init__(R, particles, terms=every, **options)
        self.history.energies = self._energies
        self.inertia.mass()

    @override
    def _contributions(self) -> list[Contribution]:
        every = zip(super()._contributions(), self.bodies, self._densities, strict=True)
        return [self._with_inertia(given, body, density) for given, body, density in every]

    @override
    def _initial_velocities(self) -> list[fem.Function]:
        return initial_velocities(self._velocity, self.particles)

    def _with_inertia(self, given: Contribution, body: Particles, density: Density) -> Contribution:
        """Return a body's contribution with its mass and its supports (collective)."""
        given = given._replace(mass=lambda product: density.value * product * body.dx_exact)
        supports = [s for s in self.supports if s.particles is body]
        if not supports:
            return given
        forms = [s.at_body(_no_moduli, 1.0, self.inertia.scheme.share) for s in supports]
        form, d = sum(forms[1:], forms[0]), body.displacement
        return given._replace(
            residual=form if given.residual is None else given.residual + form,
            tangent=None if given.tangent is None else given.tangent + ufl.derivative(form, d),
            of_step=tuple(supports),
            supports=tuple(supports),
        )

    @override
    def begin_step(self) -> None:
        super().begin_step()
        for density in self._densities:
            density.require()


def _at_first(bodies: Sequence[Body]) -> list[fem.Function]:
    """Return the velocities that bodies begin with, on W of each (collective)."""
    return [initial_velocity(body.velocity, body.particles) for body in bodies]


def _static_among(
    bodies: Sequence[Body], given: Any, options: dict[str, Any]
) -> tuple[Particles, ...]:
    """Return the bodies without inertia.

    Raises:
        MPMError: They are no bodies of the problem, all of them, or do not go with what is given.
    """
    if isinstance(given, Particles):
        given = [given]
    if not isinstance(given, list | tuple) or not all(
        any(body.particles is one for body in bodies) for one in given
    ):
        raise MPMError("quasi_static= needs a list of some of the problem's own particles.")
    if given and options.get("mixed") is not None:
        raise not_with(f"mixed={options['mixed']!r}", "quasi_static=", "use f_bar=")
    static = [any(body.particles is one for one in given) for body in bodies]
    if all(static):
        raise MPMError(
            "With quasi_static= at least one body must move; where none does, make a "
            "QuasiStaticProblem, or a PorousProblem if laws take time."
        )
    if any(still and body.velocity is not None for still, body in zip(static, bodies, strict=True)):
        raise MPMError("A body of quasi_static= has no velocity; omit it.")
    return tuple(given)


def _no_moduli() -> NDArray[np.float64]:
    raise MPMError(
        "This support needs modulus=, since no material says how stiff the body is; give the "
        "confined modulus (lambda + 2 mu) or its like."
    )
