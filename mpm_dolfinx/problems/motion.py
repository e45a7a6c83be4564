# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What problems of motion share: the way through time, velocities and the account of energies."""

from __future__ import annotations

import math
from abc import abstractmethod
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
from ..assembly.petsc import of_same_components
from ..boundary.supports import Support
from ..contact.contact import Contact
from ..errors import MPMError, agree, as_ours, on_all_ranks
from ..history import Energy, History, Step
from ..parallel.garbage import weakly
from ..parallel.given import require_same
from ..particles.particles import Particles
from ..stepping.progress import with_bar
from ..system.inertia import Followed, Inertia
from ..system.term import PointMaterial
from .arguments import as_bodies
from .particle_problem import ParticleProblem

__all__ = ["MovingProblem", "initial_velocities", "rayleigh_of", "require_motion"]

type Path_ = Callable[[float], None]

#: How much shorter than asked for, relative to it, a last step may be that is not taken apart.
SHORT = 1e-9


class MovingProblem(ParticleProblem):
    """A problem with inertia, made by its heirs, which set what is below before they begin.

    Attributes:
        inertia: The term that has the velocities.
    """

    inertia: Inertia
    _energies: list[Energy]

    def _build(self) -> None:
        """See :meth:`ParticleProblem._build`."""
        self.inertia.join(self.bodies)
        super()._build()
        self._stepper.newton.lets_go = True
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

    def _let_take_part(self, materials: Sequence[PointMaterial | None]) -> None:
        """See :meth:`ParticleProblem._let_take_part`; terms learn that there is motion."""
        super()._let_take_part(materials)
        for term in self.terms:
            if term is not self.inertia:
                term.pace(self.inertia.dt, self.inertia.share)

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
        """Return elastic energy, and the work done against stress in the last step (collective).

        No number, and zero, where forms do not say what they store.
        """
        return math.nan, 0.0

    @abstractmethod
    def _mass_form(self, number: int, product: Any) -> ufl.Form:
        """Return the integral of a body's density times a product of functions."""

    def _mass_matrix(self, number: int) -> PETSc.Mat:
        """Return the consistent mass of a body on its W (collective)."""
        body = self.bodies[number]
        product = ufl.inner(ufl.TrialFunction(body.W), ufl.TestFunction(body.W))
        if body.mass_share is not None:
            product = body.mass_share * product
        form = self._mass_form(number, product)
        if body.deletion is not None:
            form = body.deletion.present_only(form)
        compiled = fem.form(form, **self._numerics.of_forms)
        matrix = fem_petsc.create_matrix(compiled)
        fem_petsc.assemble_matrix(matrix, compiled)
        matrix.assemble()
        return of_same_components(matrix, body.W.dofmap.index_map_bs)

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

        path(now)
        if resumes:
            self.inertia.resume()
        else:
            self._stepper.resume(None)
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

        That is the mean over the step, but with ``scheme="euler"``, as is that of a contact;
        supports of :mod:`mpm_dolfinx.boundary` have that at its end. See
        :meth:`ParticleProblem.reaction`.
        """
        force = super().reaction(bc)
        return force if isinstance(bc, Support | Contact) else self.inertia.share * force


def initial_velocities(
    velocity: Any, particles: Particles | Sequence[Particles]
) -> list[fem.Function]:
    """Return the velocities that bodies begin with, on W of each (collective).

    Args:
        velocity: What the user gives.
        particles: The body, or a list of bodies.

    Raises:
        MPMError: They are something else, or not finite.
    """
    bodies = as_bodies(particles)
    count = len(bodies) if isinstance(particles, list | tuple) else 0
    velocities = _for_each(velocity, count)
    return [_velocity(v, body) for v, body in zip(velocities, bodies, strict=True)]


def require_motion(name: str, options: dict[str, Any]) -> None:
    """Raise an error where options of a problem of equilibrium make no sense in motion."""
    if options.get("background") is not None:
        raise MPMError(
            f"A form on the background has no past, so it cannot act in a {name}; write it as a "
            "term on the bodies."
        )
    if options.get("fields"):
        raise MPMError(f"fields= are for mpm.ParticleProblem; a {name} has displacements alone.")
    if "predictor" in options:
        raise MPMError(f"A {name} starts each step from the velocities; leave predictor= out.")


def _for_each(value: Any, count: int) -> list[Any]:
    """Return one value for each of ``count`` bodies (0: one body that is not in a list)."""
    if not isinstance(value, list) or count == 0:
        return [value] * max(count, 1)
    if len(value) != count:
        raise MPMError(f"There are {count} bodies, but a list of {len(value)} velocities.")
    return value


def rayleigh_of(values: Any) -> tuple[float, float]:
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
