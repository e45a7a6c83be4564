# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Supports on the body's own boundary, which need not lie on lines of the background.

A support pushes back with a traction on facets of the body,

    t = -penalty M / h (n . d - value) n,

M a modulus of the material and h the thickness of the domain behind the facet (its volume over
the facet's area), so that ``penalty`` is a number without unit. The term is symmetric and its
error, a gap of ``strain h / penalty``, is far below that of the domains' displacement.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, override

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem
from ufl.algorithms.analysis import extract_coefficients, extract_constants

from ..errors import MPMError, agree, warn
from ..meshes.tags import require_on_boundary
from ..meshes.values import Value, as_ufl
from ..parallel.boundary import collective
from ..parallel.compilation import compiled_form
from ..parallel.given import as_positive
from ..particles.deletion import Deletion
from ..particles.particles import Particles

__all__ = ["Dashpot", "Support", "dashpot", "fixed", "roller"]

#: Stiffness of a support in units of the modulus over the thickness of a domain.
PENALTY = 1e3
#: Ratio of moduli from which a support is too soft for a material that came later.
STIFFER = 10.0


class Support:
    """A support on facets of a body, made by :func:`roller` or :func:`fixed`.

    Give it to ``QuasiStaticProblem(..., supports=[...])``, or add ``support.residual`` to a
    residual of your own.

    Args:
        particles: The body.
        gap: What the displacement lacks of the support's, UFL, shape ``(gdim,)``.
        facet_tags: Tags of the body's facets.
        tag: The tag of those on the support; ``None`` is the whole boundary.
        modulus: As for :func:`roller`.
        penalty: As for :func:`roller`.

    Attributes:
        particles: The body.
    """

    def __init__(
        self,
        particles: Particles,
        gap: Any,
        facet_tags: Any,
        tag: int | None,
        modulus: Any,
        penalty: float,
    ) -> None:
        self.particles = particles
        self._tagged = None if tag is None else (facet_tags, tag)
        body = particles.mesh
        metadata = particles.dx_exact.metadata()
        if tag is None:
            self._ds = ufl.Measure("ds", domain=body, metadata=metadata)
        else:
            require_on_boundary(body, facet_tags, [tag], "supports")
            self._ds = ufl.Measure(
                "ds", domain=body, subdomain_data=facet_tags, subdomain_id=tag, metadata=metadata
            )
        self._stiffness = fem.Function(
            fem.functionspace(body, ("Discontinuous Lagrange", 0)), name="stiffness of a support"
        )
        self._penalty = as_positive(penalty, "penalty")
        self._modulus = modulus is not None
        self._found: NDArray[np.float64] | None = None
        if modulus is not None:
            self.scale(as_ufl(modulus, body, "modulus"))
        self._traction = -self._stiffness * gap
        self._turn: Any = 1.0
        self._whole_step = False
        self._scale = fem.Constant(body, 1.0)
        self._share = 1.0
        self._sum: tuple[fem.Constant, fem.Form, Deletion | None] | None = None
        self._power: tuple[fem.Form, Deletion | None] | None = None
        self._works: tuple[fem.Function, fem.Form] | None = None

    def facets(self) -> NDArray[np.int32]:
        """Return this rank's facets of the body that are on the support (collective)."""
        if self._tagged is None:
            return self.particles.boundary()
        tags, tag = self._tagged
        return np.asarray(tags.find(tag))

    def scale(self, modulus: Any) -> None:
        """Set the modulus that the penalty is relative to (collective).

        Args:
            modulus: A UFL expression on the body mesh.
        """
        each = ufl.TestFunction(self._stiffness.function_space)
        area, volume, weighted = (
            fem.assemble_vector(compiled_form(form)).array
            for form in (
                each * self._ds,
                each * self.particles.dx_exact,
                modulus * each * self.particles.dx_exact,
            )
        )
        behind = area > 0.0
        self._stiffness.x.array[behind] = (
            self._penalty * weighted[behind] * area[behind] / volume[behind] ** 2
        )
        values = self._stiffness.x.array[behind]
        with agree(self.particles.mesh.comm):
            if not (np.isfinite(values).all() and (values > 0.0).all()):
                raise MPMError("modulus must be positive and finite where the support is.")
        self._stiffness.x.scatter_forward()
        self._modulus = True

    def revolve(self, turn: Any) -> None:
        """Take the support around the axis of a body of revolution.

        Args:
            turn: Length of the way around, UFL on the body mesh.
        """
        self._turn = turn

    def at_body(
        self,
        moduli: Callable[[], NDArray[np.float64]],
        turn: Any,
        share: float | None = None,
    ) -> ufl.Form:
        """Return minus the virtual work of the support on a body with a material (collective).

        Args:
            moduli: Returns the modulus of each domain this rank owns, shape ``(n,)``; asked where
                none was given.
            turn: As for :meth:`revolve`.
            share: In a motion, as in :meth:`mpm_dolfinx.Term.pace`; ``None`` where there is none.
        """
        self._whole_step = self._has_whole_step(share)
        self._power = None
        if not self._modulus:
            self._scale_by(moduli)
        elif self._found is not None:
            self._compare(np.asarray(self._each(moduli).x.array, dtype=np.float64))
        self.revolve(turn)
        return self.residual

    def _compare(self, moduli: NDArray[np.float64]) -> None:
        """Warn where the body is much stiffer than the stiffness was chosen for (collective)."""
        assert self._found is not None
        behind = self._stiffness.x.array > 0.0
        mine = float((moduli[behind] / self._found[behind]).max(initial=0.0))
        comm: MPI.Comm = self.particles.mesh.comm
        stiffer = comm.allreduce(mine, MPI.MAX)
        if stiffer > STIFFER:
            warn(
                comm,
                f"A support has the stiffness that the first material gave it, and the present one "
                f"is {stiffer:.3g} times as stiff, so that the support gives way as much more of "
                "its strain; give the support modulus=, that of the stiffest material.",
            )

    def follow(self, moduli: Callable[[], NDArray[np.float64]]) -> None:
        """Choose the stiffness again, unless a modulus was given (collective).

        Args:
            moduli: As for :meth:`at_body`.
        """
        if self._found is not None:
            self.forget_modulus()
            self._scale_by(moduli)

    @property
    def stiffness(self) -> NDArray[np.float64]:
        """The stiffness in each cell, to be set."""
        return np.asarray(self._stiffness.x.array)

    def _scale_by(self, moduli: Callable[[], NDArray[np.float64]]) -> None:
        """Set the modulus of the material that is there first; see :meth:`at_body`."""
        each = self._each(moduli)
        self.scale(each)
        self._found = np.array(each.x.array, dtype=np.float64)

    def _each(self, moduli: Callable[[], NDArray[np.float64]]) -> fem.Function:
        """Return the modulus of each domain as a Function."""
        each = fem.Function(self._stiffness.function_space)
        cells = each.function_space.dofmap.list[: self.particles.num_local, 0]
        each.x.array[cells] = moduli()
        return each

    def work_by_stiffness(self, motion: fem.Function) -> NDArray[np.float64]:
        """Return the derivative of the residual's work on a motion by :attr:`stiffness`.

        Args:
            motion: On W of the body (collective).

        Returns:
            Shape as :attr:`stiffness`, zero at ghosts.
        """
        if self._works is None:
            virtual = fem.Function(self.particles.W)
            work = ufl.replace(self.residual, {ufl.TestFunction(self.particles.W): virtual})
            self._works = virtual, compiled_form(ufl.derivative(work, self._stiffness))
        virtual, form = self._works
        virtual.x.array[:] = motion.x.array
        vector = fem.assemble_vector(form)
        return np.asarray(vector.array)

    def forget_modulus(self) -> None:
        """Take that of another problem's material, unless one was given."""
        if self._found is not None:
            self._modulus, self._found = False, None

    @property
    def residual(self) -> ufl.Form:
        """Residual of the support: minus the virtual work of its traction.

        Raises:
            MPMError: No modulus was given.
        """
        if not self._modulus:
            raise MPMError(
                "This support needs modulus=, since no material says how stiff the body is; give "
                "the confined modulus (lambda + 2 mu) or its like."
            )
        test = ufl.TestFunction(self.particles.W)
        traction = self._scale * self._of_step() if self._whole_step else self._traction
        form: ufl.Form = -self._turn * ufl.inner(traction, test) * self._ds
        return form

    # -- In a motion ----------------------------------------------------------------------

    def _has_whole_step(self, share: float | None) -> bool:
        """Return whether the traction is one of a whole step; see :meth:`at_body`."""
        return False

    def _of_step(self) -> Any:
        """Return the traction of a whole step, UFL."""
        raise NotImplementedError

    def pace(self, dt: float, share: float) -> None:
        """Set the share of a step's end in its force (:meth:`mpm_dolfinx.Term.pace`)."""
        self._share = share
        np.copyto(self._scale.value, 1.0 / share)

    def mute(self, muted: bool) -> None:
        """Leave out, or take in again, what belongs to the whole step."""
        np.copyto(self._scale.value, 0.0 if muted else 1.0 / self._share)

    def settle(self) -> None:
        """Take the present state for the beginning of the next step (collective)."""

    def beginning(self) -> list[NDArray[np.float64]]:
        """Return the arrays of :meth:`settle`, to be set."""
        return []

    def at_end(self) -> list[NDArray[np.float64]]:
        """Return the forces as :meth:`settle` would leave them."""
        return []

    def step_work(self) -> tuple[float, float]:
        """Return this rank's work done in the last step against the traction of the whole step.

        Returns:
            What is internal, and what is damping.
        """
        return 0.0, 0.0

    def _step_power(self, motion: Any) -> float:
        """Return this rank's work done by a motion, UFL, against the traction of the whole step."""
        deletion = self.particles.deletion
        if self._power is None or self._power[1] is not deletion:
            form = -self._turn * ufl.inner(self._of_step(), motion) * self._ds
            if deletion is not None:
                form = deletion.present_only(form)
            self._power = compiled_form(form), deletion
        return float(np.real(fem.assemble_scalar(self._power[0])))

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Force of the support on the body now, shape ``(gdim,)``, on all ranks (collective)."""
        gdim = self.particles.mesh.geometry.dim
        deletion = self.particles.deletion
        if self._sum is None or self._sum[2] is not deletion:
            along = fem.Constant(self.particles.mesh, np.zeros(gdim))
            form = self._turn * ufl.inner(self._traction, along) * self._ds
            if deletion is not None:
                form = deletion.present_only(form)
            self._sum = along, compiled_form(form), deletion
        along, total, _ = self._sum
        mine = np.zeros(gdim)
        for i, direction in enumerate(np.eye(gdim)):
            along.value[:] = direction
            mine[i] = np.real(fem.assemble_scalar(total))
        return np.asarray(self.particles.mesh.comm.allreduce(mine))


class Dashpot(Support):
    """A quiet boundary, made by :func:`dashpot`.

    Args:
        particles: The body.
        facet_tags: As for :class:`Support`.
        tag: As for :class:`Support`.
        normal: As for :func:`dashpot`.
        tangential: As for :func:`dashpot`.
    """

    def __init__(
        self, particles: Particles, facet_tags: Any, tag: int | None, normal: Any, tangential: Any
    ) -> None:
        gdim = particles.mesh.geometry.dim
        nothing = fem.Constant(particles.mesh, np.zeros(gdim))
        super().__init__(particles, nothing, facet_tags, tag, 1.0, 1.0)
        self._start = _Start()
        self._dt = fem.Constant(particles.mesh, 1.0)
        n = ufl.FacetNormal(particles.mesh)
        d = particles.displacement
        velocity = (d - self._start.of(d)) / self._dt
        along = ufl.dot(velocity, n) * n
        self._damping = -normal * along - tangential * (velocity - along)
        self._traction = self._damping
        self._last = np.zeros(gdim)

    def _has_whole_step(self, share: float | None) -> bool:
        if share is None:
            raise MPMError(
                "A dashpot resists velocities, which a problem of equilibrium has none of; give it "
                "to a DynamicProblem."
            )
        return True

    @property
    @override
    def residual(self) -> ufl.Form:
        if not self._whole_step:
            self._has_whole_step(None)
        return super().residual

    def _of_step(self) -> Any:
        return self._damping

    @override
    def pace(self, dt: float, share: float) -> None:
        super().pace(dt, share)
        np.copyto(self._dt.value, dt)

    @override
    def settle(self) -> None:
        self._start.settle()

    @override
    def beginning(self) -> list[NDArray[np.float64]]:
        return self._start.copies()

    @override
    def at_end(self) -> list[NDArray[np.float64]]:
        return self._start.present()

    @override
    def step_work(self) -> tuple[float, float]:
        d = self.particles.displacement
        self._last = super().reaction
        return 0.0, self._step_power(d - self._start.of(d))

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Mean force on the body over the last step, shape ``(gdim,)``, on all ranks."""
        return self._last.copy()


class _Start:
    """Values of Functions and Constants at the beginning of a step."""

    def __init__(self) -> None:
        self._copies: list[tuple[Any, Any]] = []

    def of(self, expression: Any) -> Any:
        """Return an expression as it was; all that it has is followed from now on."""
        for value in (*extract_coefficients(expression), *extract_constants(expression)):
            if all(value is not known for known, _ in self._copies):
                self._copies.append((value, _copy_of(value)))
        return ufl.replace(expression, dict(self._copies))

    def copies(self) -> list[NDArray[np.float64]]:
        """Return the values at the beginning, to be set."""
        return [_values_of(before) for _, before in self._copies]

    def present(self) -> list[NDArray[np.float64]]:
        """Return the values now."""
        return [_values_of(value).copy() for value, _ in self._copies]

    def settle(self) -> None:
        """Take the present values."""
        for value, before in self._copies:
            if isinstance(value, fem.Function):
                before.x.array[:] = value.x.array
            else:
                np.copyto(before.value, value.value)


def _values_of(value: Any) -> NDArray[np.float64]:
    """Return the values of a Function or Constant, to be set."""
    return np.asarray(value.x.array if isinstance(value, fem.Function) else value.value)


def _copy_of(value: Any) -> Any:
    """Return a Function or Constant that has another's values now."""
    if isinstance(value, fem.Function):
        copy = fem.Function(value.function_space)
        copy.x.array[:] = value.x.array
        return copy
    return fem.Constant(value.ufl_domain(), np.array(value.value))


@collective()
def roller(
    particles: Particles,
    facet_tags: Any,
    tag: int,
    normal: Value,
    value: Value = 0.0,
    *,
    modulus: Value | None = None,
    penalty: float = PENALTY,
) -> Support:
    """Hold facets of a body in one direction: ``n . d = value``.

    Args:
        particles: The body.
        facet_tags: Tags of its facets.
        tag: The tag of those that are held.
        normal: Direction in which they are held, shape ``(gdim,)``; numbers are made a unit
            vector.
        value: Displacement in that direction at full load; a path (``update=``) takes it as it
            is, as it does Dirichlet values.
        modulus: Modulus of the body that the penalty is relative to; in a QuasiStaticProblem the
            material's by default.
        penalty: Stiffness of the support in units of modulus over thickness of a domain.

    Returns:
        The support.

    Raises:
        MPMError: Tags, directions or numbers that make no sense.
    """
    n = _unit(normal, particles)
    g = as_ufl(value, particles.mesh, "value")
    gap = ufl.dot(n, particles.displacement) - _reached(particles) * g
    return Support(particles, gap * n, facet_tags, tag, modulus, penalty)


@collective()
def fixed(
    particles: Particles,
    facet_tags: Any,
    tag: int,
    value: Value | None = None,
    *,
    modulus: Value | None = None,
    penalty: float = PENALTY,
) -> Support:
    """Hold facets of a body in all directions: ``d = value``.

    Args:
        particles: The body.
        facet_tags: Tags of its facets.
        tag: The tag of those that are held.
        value: Their displacement, as for :func:`roller`, shape ``(gdim,)``; ``None`` is zero.
        modulus: As for :func:`roller`.
        penalty: As for :func:`roller`.

    Returns:
        The support.

    Raises:
        MPMError: Tags or numbers that make no sense.
    """
    gdim = _require(particles).mesh.geometry.dim
    held = np.zeros(gdim) if value is None else value
    g = as_ufl(held, particles.mesh, "value", (gdim,))
    gap = particles.displacement - _reached(particles) * g
    return Support(particles, gap, facet_tags, tag, modulus, penalty)


@collective()
def dashpot(
    particles: Particles,
    facet_tags: Any,
    tag: int,
    normal: Value,
    tangential: Value,
) -> Support:
    """Let waves leave a body through facets: a quiet boundary, in a DynamicProblem.

    The traction is ``-(normal n n + tangential (I - n n)) v`` per undeformed area, n being the
    normal of the undeformed facets. With ``normal = density c_p``, ``tangential = density c_s``,
    the speeds of waves of compression and of shear, waves that arrive along n leave nothing behind
    (Lysmer & Kuhlemeyer 1969). A wave of velocity g that comes in from behind is a traction of
    twice what that boundary would bear at g.

    Args:
        particles: The body.
        facet_tags: Tags of its facets.
        tag: The tag of those that are quiet.
        normal: Resistance to normal velocities.
        tangential: Resistance to tangential velocities.

    Returns:
        The boundary, for ``supports=[...]``.

    Raises:
        MPMError: Tags or numbers that make no sense.
    """
    _require(particles)
    resistances = []
    for name, value in (("normal", normal), ("tangential", tangential)):
        resistances.append(as_ufl(value, particles.mesh, name, negative=False))
    return Dashpot(particles, facet_tags, tag, *resistances)


def _reached(particles: Particles) -> Any:
    """Return the share of a support's displacement that is reached."""
    proportional = particles.proportional
    return particles.load * proportional + (1.0 - proportional)


def _require(particles: Any) -> Particles:
    if not isinstance(particles, Particles):
        raise MPMError(f"A support needs mpm.Particles, not {type(particles).__name__}.")
    return particles


def _unit(normal: Any, particles: Particles) -> Any:
    """Return a direction as UFL; numbers are made a unit vector."""
    body = _require(particles).mesh
    made = as_ufl(normal, body, "normal", (body.geometry.dim,))
    if not isinstance(made, fem.Constant) or made is normal:
        return made
    length = float(np.linalg.norm(made.value))
    if length == 0.0:
        raise MPMError("normal must not be zero.")
    return fem.Constant(body, made.value / length)
