# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Motion of particles with a material, step by step through time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc

from .. import _compat
from ..assembly.inputs import as_expression
from ..boundary.supports import Support
from ..constitutive.points import MaterialPoints
from ..constitutive.step_stress import StepStress
from ..contact.contact import Contact
from ..errors import MPMError, agree, as_ours, on_all_ranks
from ..history import Energy, History, Step
from ..parallel.garbage import weakly
from ..parallel.given import require_same
from ..particles.particles import Particles
from ..stepping.progress import with_bar
from ..system.body import StepForce
from ..system.inertia import Followed, Inertia
from ..system.term import Term
from .arguments import as_bodies, as_terms
from .particle_problem import Contribution
from .quasistatic import QuasiStaticProblem

__all__ = ["DynamicProblem"]

type Path_ = Callable[[float], None]

#: How much shorter than asked for, relative to it, a last step may be that is not taken apart.
SHORT = 1e-9


class DynamicProblem(QuasiStaticProblem):
    """Motion of bodies with materials: the balance of momentum, implicit in time.

    A :class:`QuasiStaticProblem` with inertia. Velocities live at the bodies' nodes, with the
    consistent mass; what a step's background cannot follow of them is lost (``"project"``), or
    comes back with the other sign (``"reflect"``), and never adds energy. Momentum is kept to
    round-off. See the page on dynamics for what else is kept, and by which scheme.

    Loads act in full from the beginning, unless the path says otherwise.

    Args:
        particles: The body, or a list of bodies.
        material: As in :class:`QuasiStaticProblem`.
        density: Mass per undeformed volume, positive; it must not change in time.
        velocity: At the beginning: a tuple, a function of coordinates ``(3, n)`` that returns
            ``(gdim, n)``, a Function, or a UFL expression on the body mesh; ``None``: at rest. A
            list has one for each body.
        scheme: ``"midpoint"``: second order; the force of a step is the mean of those at its
            ends. ``"conserving"``: second order; stress is one of the whole step, by which angular
            momentum is kept to round-off, and the energy of elastic materials too; for what
            spins fast or long. ``"euler"``: first order, with much loss of energy, for motions
            that shall come to rest.
        out_of_range: ``"project"`` or ``"reflect"``; no matter with ``scheme="euler"``.
        rayleigh: Damping ``(alpha, beta)`` in proportion to mass (one over a time) and to the
            stiffness of the undeformed bodies (a time); not negative.
        terms: As in :class:`QuasiStaticProblem`.
        **options: All else that :class:`QuasiStaticProblem` has but ``background`` and
            ``predictor``: ``body_force``, ``bcs``, ``tractions``, ``supports``, ``f_bar``, ...

    Attributes:
        inertia: The term that has the velocities.

    Raises:
        MPMError: As there; and what does not go with inertia.
    """

    def __init__(
        self,
        particles: Particles | Sequence[Particles],
        material: Any,
        density: Any,
        *,
        velocity: Any = None,
        scheme: str = "midpoint",
        out_of_range: str = "project",
        rayleigh: tuple[float, float] = (0.0, 0.0),
        terms: Sequence[Term] = (),
        **options: Any,
    ) -> None:
        bodies = as_bodies(particles)
        require_same(
            bodies[0].V.mesh.comm,
            velocity=velocity,
            scheme=scheme,
            out_of_range=out_of_range,
            rayleigh=rayleigh,
        )
        alpha, self._viscosity = _rayleigh(rayleigh)
        if options.get("background") is not None:
            raise MPMError(
                "A form on the background has no past, so it cannot act in a DynamicProblem; "
                "write it as a term on the bodies."
            )
        if "predictor" in options:
            raise MPMError(
                "A DynamicProblem starts each step from the velocities; leave predictor= out."
            )
        count = len(bodies) if isinstance(particles, list | tuple) else 0
        velocities = _for_each(velocity, count)
        start = [_velocity(v, body) for v, body in zip(velocities, bodies, strict=True)]
        self._energies: list[Energy] = []
        self.inertia = Inertia(bodies, start, scheme, out_of_range, alpha, self._energies)
        given = as_terms(terms, bodies)
        if options.get("mixed") is not None:
            raise MPMError("mixed= is for mpm.QuasiStaticProblem; use f_bar= in dynamics.")
        super().__init__(
            particles,
            material,
            density,
            predictor=False,
            terms=[self.inertia, *given],
            **options,
        )
        self.history.energies = self._energies
        self.inertia.settle()

    def _build(self) -> None:
        """See :meth:`ParticleProblem._build`."""
        self.inertia.join(self.bodies)
        super()._build()
        others = [*self.body_terms, *(term for term in self.terms if term is not self.inertia)]
        followed = Followed(
            others,
            weakly(self._mass_matrix),
            weakly(self._works),
            weakly(self._stored),
            weakly(self._changes),
            weakly(self._driven),
        )
        self.inertia.follow(followed)

    def _in_time(
        self, history: MaterialPoints, supports: Sequence[Support]
    ) -> tuple[StepStress, Sequence[StepForce]]:
        """See :meth:`QuasiStaticProblem._in_time`."""
        stress = StepStress(history, self.inertia.scheme == "conserving", self._viscosity)
        self._step_stresses.append(stress)
        return stress, (stress, *supports)

    def _contributions(self) -> list[Contribution]:
        """See :meth:`ParticleProblem._contributions`."""
        self._step_stresses: list[StepStress] = []
        return super()._contributions()

    @property
    def _force_share(self) -> float:
        """See :attr:`QuasiStaticProblem._force_share`."""
        return self.inertia.share

    def _works(self) -> NDArray[np.float64]:
        """Return the works of the last increment on the backgrounds (collective)."""
        return self.reduced.works()

    def _changes(self) -> list[NDArray[np.float64]]:
        """Return the changes of Dirichlet values in the step, on own dofs of each background."""
        return self.reduced.changes()

    def _driven(self, particles: Particles, values: Sequence[NDArray[np.float64]]) -> PETSc.Vec:
        """Return how Dirichlet values move a body (collective)."""
        return self.reduced.driven(particles, values)

    def _stored(self) -> tuple[float, float]:
        """Return elastic energy, and the work done against stress in the last step (collective)."""
        own = [(s.strain_energy(), s.stress_work) for s in self._step_stresses]
        energy, work = self._comm.allreduce(np.sum(own, axis=0))
        return float(energy), float(work)

    def _mass_matrix(self, number: int) -> PETSc.Mat:
        """Return the consistent mass of a body on its W (collective)."""
        body, (work, density) = self.bodies[number], self._density[number]
        product = ufl.inner(ufl.TrialFunction(body.W), ufl.TestFunction(body.W))
        if body.mass_share is not None:
            product = body.mass_share * product
        form = work.mass(density.value, product)
        if body.deletion is not None:
            form = body.deletion.present_only(form)
        compiled = fem.form(form, **self._numerics.of_forms)
        matrix = fem_petsc.create_matrix(compiled)
        fem_petsc.assemble_matrix(matrix, compiled)
        matrix.assemble()
        return matrix

    _gradual = False

    def add(self, particles: Particles, *args: Any, velocity: Any = None, **options: Any) -> None:
        """Add a body: see :meth:`QuasiStaticProblem.add`; what changes does so at once.

        Args:
            particles: The body.
            *args: As there.
            velocity: As in the constructor.
            **options: As there.
        """
        if not isinstance(particles, Particles):
            raise MPMError(f"add() needs mpm.Particles, not a {type(particles).__name__}.")
        start = _velocity(velocity, particles)
        super().add(particles, *args, **options)
        self.inertia.velocities[-1].x.array[:] = start.x.array

    def _own_terms(self) -> list[Term]:
        """See :meth:`QuasiStaticProblem.stage`."""
        return [self.inertia]

    # -- Velocities ---------------------------------------------------------------------------

    @property
    def velocity(self) -> fem.Function | list[fem.Function]:
        """Velocity on W at the last converged step; a list where particles are one.

        As ``particles.displacement`` it is a new Function after a split, rebase or repartition.
        """
        several = isinstance(self.particles, list | tuple)
        return list(self.inertia.velocities) if several else self.inertia.velocities[0]

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy at the last converged step (collective)."""
        return self.inertia.kinetic()

    @property
    def momentum(self) -> NDArray[np.float64]:
        """Momentum of all bodies at the last converged step, shape ``(gdim,)`` (collective)."""
        return self.inertia.momentum()

    @property
    def angular_momentum(self) -> NDArray[np.float64]:
        """Angular momentum about the origin (collective).

        Shape ``(1,)`` in the plane, about the axis normal to it, or ``(3,)``.
        """
        return self.inertia.angular_momentum()

    # -- Through time -------------------------------------------------------------------------

    def solve(  # type: ignore[override]
        self,
        time: float,
        dt: float,
        update: Path_ | None = None,
        output_at: Sequence[float] = (),
        output: str | Path | None = None,
        progress: bool = False,
        repartition: float | None = None,
    ) -> History:
        """Go on to a time.

        Args:
            time: Where to end, counted from the beginning of the first run (``history.time``).
            dt: Largest duration of a step; all steps up to each of the times asked for are equal.
                A step that fails is halved; later ones grow again.
            update: The user's path: ``update(t)`` sets values of Dirichlet conditions, Constants
                and Functions to what they are at the time t. It is called at the run's
                beginning too, and again with a smaller t after a failure. The load factor is 1
                unless it sets another.
            output_at: Times that steps end at, to the last bit, besides the last one.
            output: A ``.pvd`` file, to which the states at these times and the last one are
                written, and before the first step the state that is there.
            progress: Whether rank 0 shows a progress bar.
            repartition: As in :meth:`QuasiStaticProblem.solve`.

        Returns:
            The history of the run; ``history.energies`` has what became of the energy.

        Raises:
            MPMError: The run cannot go on; the state is that of the last converged step.
        """
        began = self.history.time
        path = self.steps(time, dt, update, output_at, repartition)
        if output is not None and not self.history.steps:
            self.write(output)

        def done(_: Step) -> float:
            return (self.history.time - began) / (time - began)

        wanted = {float(time), *map(float, output_at)}
        count = math.ceil((time - began) / dt)
        for step in with_bar(path, count, done) if progress and self._comm.rank == 0 else path:
            if output is not None and step.time in wanted:
                self.write(output)
        return self.history

    def steps(  # type: ignore[override]
        self,
        time: float,
        dt: float,
        update: Path_ | None = None,
        output_at: Sequence[float] = (),
        repartition: float | None = None,
    ) -> Iterator[Step]:
        """Go on to a time, one converged step at a time.

        After :meth:`restore` it goes on with the run that was interrupted, if it ends at one of
        the times asked for.

        Args:
            time: As in :meth:`solve`.
            dt: As in :meth:`solve`.
            update: As in :meth:`solve`.
            output_at: As in :meth:`solve`.
            repartition: As in :meth:`solve`.

        Yields:
            Each converged step; ``step.load`` and ``step.time`` are the time at its end.

        Raises:
            MPMError: As in :meth:`solve`.
        """
        self._require_governing()
        require_same(
            self._comm,
            time=time,
            dt=dt,
            update=update,
            output_at=output_at,
            repartition=repartition,
        )
        now = self.history.time
        for name, value in (("time", time), ("dt", dt)):
            known = isinstance(value, float | int | np.number) and not isinstance(value, bool)
            if not known or not math.isfinite(value):
                raise MPMError(f"{name} must be a finite number, not {value!r}.")
        if time <= now:
            raise MPMError(f"It is {now:g} already; give a later time than {time:g}.")
        if dt <= 0.0:
            raise MPMError(f"dt must be positive, not {dt:g}.")
        try:
            wanted = sorted({*map(float, output_at), float(time)})
        except (TypeError, ValueError):
            raise MPMError(f"output_at must be a list of times, not {output_at!r}.") from None
        if not all(math.isfinite(t) and t <= time for t in wanted):
            raise MPMError(f"output_at must not have times later than the end, {time:g}.")
        return self._through(now, [t for t in wanted if t > now], float(dt), update, repartition)

    def _through(
        self,
        now: float,
        ends: list[float],
        dt: float,
        update: Path_ | None,
        repartition: float | None,
    ) -> Iterator[Step]:
        """Go from one of the times to the next."""
        if update is not None:
            update = on_all_ranks(self._comm, update)
        interrupted = self._stepper.interrupted
        resumes = interrupted is not None and interrupted.end == ends[0]

        def path(t: float) -> None:
            self.inertia.aim(t)
            self._apply_loads()
            if update is not None:
                update(t)

        if not resumes:
            self._stepper.resume(None)
            path(now)
            self.inertia.begin_run(now)
        for end in ends:
            count, began = max(1, math.ceil((end - now) / dt * (1.0 - SHORT))), now
            if resumes and interrupted is not None:
                count, began = interrupted.control.steps, interrupted.began
                resumes = False
            yield from self._stepper.steps(count, path, repartition, None, (began, end))
            if self.history.time != end:
                return
            now = end

    def _apply_loads(self) -> None:
        """Apply loads in full, and supports as they are given."""
        for body in self.bodies:
            np.copyto(body.load.value, 1.0)
            np.copyto(body.proportional.value, 0.0)

    def step(self, dt: float) -> Step:  # type: ignore[override]
        """Go on by a duration, with loads as they are set now all through it.

        Args:
            dt: The duration; where that fails it is gone through in several steps.

        Returns:
            The last converged step.

        Raises:
            MPMError: As in :meth:`solve`.
        """
        if not isinstance(dt, float | int | np.number) or not dt > 0.0:
            raise MPMError(f"dt must be positive, not {dt!r}.")
        for _ in self.steps(self.history.time + dt, 2.0 * dt):
            pass
        return self.history.steps[-1]

    def reaction(self, bc: fem.DirichletBC | Support | Contact) -> NDArray[np.float64]:
        """Return the force of a support on the body: of a Dirichlet condition in the last step.

        That is the mean over the step, but with ``scheme="euler"``; supports of
        :mod:`mpm_dolfinx.boundary` and contacts have that at its end. See
        :meth:`ParticleProblem.reaction`.
        """
        force = super().reaction(bc)
        return force if isinstance(bc, Support | Contact) else self.inertia.share * force


def _for_each(value: Any, count: int) -> list[Any]:
    """Return one value for each of ``count`` bodies (0: one body that is not in a list)."""
    if not isinstance(value, list) or count == 0:
        return [value] * max(count, 1)
    if len(value) != count:
        raise MPMError(f"There are {count} bodies, but a list of {len(value)} velocities.")
    return value


def _rayleigh(values: Any) -> tuple[float, float]:
    """Return alpha and beta of Rayleigh damping.

    Raises:
        MPMError: They are not two numbers, or negative.
    """
    try:
        alpha, beta = map(float, values)
    except (TypeError, ValueError):
        raise MPMError(f"rayleigh must be (alpha, beta), two numbers, not {values!r}.") from None
    if not (0.0 <= alpha < math.inf and 0.0 <= beta < math.inf):
        raise MPMError(f"rayleigh must have finite numbers that are not negative, not {values!r}.")
    return alpha, beta


def _velocity(value: Any, body: Particles) -> fem.Function:
    """Return an initial velocity on W (collective).

    Raises:
        MPMError: It is something else, or not finite.
    """
    velocity = fem.Function(body.W, name="velocity")
    if value is None:
        return velocity
    if isinstance(value, fem.Function) and value.function_space.mesh is not body.mesh:
        raise MPMError("velocity lives on another mesh; give a Function on particles.mesh.")
    if isinstance(value, fem.Function) or (
        callable(value) and not isinstance(value, ufl.core.expr.Expr)
    ):
        with agree(body.mesh.comm):
            _interpolate(velocity, value)
    else:
        expression = as_expression(value, body, "velocity", (body.mesh.geometry.dim,))
        points = _compat.interpolation_points(body.W)
        velocity.interpolate(fem.Expression(expression, points))
    velocity.x.scatter_forward()
    finite = bool(np.isfinite(velocity.x.array).all())
    if body.mesh.comm.allreduce(not finite):
        raise MPMError("velocity must be finite everywhere on the body.")
    return velocity


def _interpolate(velocity: fem.Function, value: Any) -> None:
    """Interpolate a Function, or a function of coordinates."""
    try:
        velocity.interpolate(value)
    except MPMError:
        raise
    except Exception as error:
        raise as_ours(error, "The function that gives velocity") from error
