# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Consolidation: bodies with water in their pores, whose materials are laws of effective stress.

On the undeformed body, with the pore pressure p (compression is positive), the deformation gradient
F and J = det F, a step of the duration dt solves (Biot 1941; Carter, Small & Booker 1977)

    int P'(F) : grad v - p J F^-T : grad v dX = loads . v
    int q (J - J_n) + q S (p - p_n) - dt W . grad q dX = dt (what flows in) . q
    W = -J F^-1 k F^-T (grad p - rho_f F^T b),

which is backward Euler. Laws of small strains have ``1 + div d`` for J and the unit tensor for F.
A pressure of p_D on a drained part of the body's own boundary is asked for in the sense of Nitsche
(1971); where nothing is said the boundary is impervious.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem
from ufl.algorithms import extract_coefficients
from ufl.core.expr import Expr

from ..assembly.density import NotNegative
from ..assembly.loads import facet_measure
from ..constitutive.strain import Strain
from ..errors import MPMError, agree, not_with
from ..materials.base import Material
from ..meshes.values import as_ufl, interpolated, is_function
from ..parallel.boundary import collective
from ..parallel.given import require_same
from ..particles.field import ParticleField
from ..particles.particles import Particles
from .body import Body, PoreFluid, as_given
from .parts import Contribution
from .physics import Physics
from .problem import Law
from .quasistatic import QuasiStaticProblem
from .setup import Setup
from .through_time import TimeProblem

__all__ = ["PorousProblem"]

#: Factor of Nitsche's penalty ``k m / h``, h the size of the domains across the boundary and m the
#: degree of the pressure; inverse inequalities ask for up to 4 in simplices.
PENALTY = 5.0


@dataclass
class _Filled:
    """The water in a body on its present mesh.

    Attributes:
        particles: The body.
        field: Its pressure.
        before: The displacement at the last converged step.
        dt: Duration of the step.
        residual: The balance of mass.
        checked: Permeability and storage, which must not be negative.
    """

    particles: Particles
    field: ParticleField
    before: fem.Function
    dt: fem.Constant
    residual: ufl.Form | None = None
    checked: Sequence[NotNegative] = ()


class _Water(Physics):
    """The flow of water through bodies, and its pressure.

    Args:
        spaces: Bodies with water, and the background spaces of their pressure.

    Attributes:
        spaces: As given.
        filled: The water of each body that has any.
    """

    further = ("pore_fluid",)
    gradual = False
    takes_time = True

    def __init__(self, spaces: list[tuple[Particles, fem.FunctionSpace]]) -> None:
        self.spaces = spaces
        self.filled: list[_Filled] = []

    @property
    @override
    def field_spaces(self) -> list[fem.FunctionSpace]:
        return list({id(V): V for _, V in self.spaces}.values())

    @override
    def not_for_cracks(self) -> dict[str, bool]:
        return {"a PorousProblem": True}

    @override
    def begin(self, setup: Setup) -> None:
        before = self.filled
        wet = [body.particles for body in setup.bodies if body.pore_fluid is not None]
        self.filled = [self._of(body, before) for body in wet]

    def _of(self, body: Particles, before: Sequence[_Filled]) -> _Filled:
        """Return the water of a body, with the same pressure while its mesh is the same.

        Raises:
            MPMError: The body may lose particles.
        """
        if body.deletion is not None:
            water = "water, whose pressure lives at nodes"
            raise not_with("Deletion of particles", water, "use outside='stop', and omit remove()")
        for known in before:
            if known.particles is body and known.field.W.mesh is body.mesh:
                return known
        V = next(V for its, V in self.spaces if its is body)
        kind = "body" if body.is_free else "total"
        return _Filled(
            body,
            ParticleField(body, V, at="nodes", kind=kind, name="pore_pressure"),
            fem.Function(body.W, name="displacement before"),
            fem.Constant(body.mesh, 1.0),
        )

    @override
    def work(self, given: Body, strain: Strain) -> tuple[list[ufl.Form], bool]:
        body = given.particles
        filled = next((f for f in self.filled if f.particles is body), None)
        if filled is None:
            return [], True
        pores = given.pore_fluid
        assert pores is not None
        small = [_is_small(law) for law in _laws(given.material)]
        if any(small) != all(small):
            raise MPMError(
                "The materials of a body with water must be all of small strains or all of finite "
                "ones, as the change of its volume is either."
            )
        flow = _Flow(filled, strain, all(small))
        filled.checked = [
            NotNegative(pores.storage, body, "storage"),
            NotNegative(_evaluated(pores.permeability, body, flow.J), body, "permeability"),
        ]
        storage, k = (one.value for one in filled.checked)
        given_values = [storage, k, *(value for value, _ in (*pores.drained, *pores.inflow))]
        filled.residual = self._balance(given, pores, flow, storage, k)
        held = [c for v in given_values if isinstance(v, Expr) for c in extract_coefficients(v)]
        follows = any(c is unknown for c in held for unknown in (body.displacement, flow.p))
        return [flow.work_of_pressure()], all(small) and not follows

    def _balance(
        self, given: Body, pores: PoreFluid, flow: _Flow, storage: Any, k: Any
    ) -> ufl.Form:
        """Return the balance of mass, with the other sign, in which small strains are symmetric."""
        body, p, q, dt = given.particles, flow.p, flow.q, flow.dt
        weight = None
        if given.body_force is not None and pores.density:
            dim = body.mesh.geometry.dim
            b = as_ufl(given.body_force, body.mesh, "body_force", (dim,))
            weight = body.load * pores.density * b
        stored = q * (flow.J - flow.J_n) + q * storage * (p - flow.p_n)
        flux = flow.flux(k, p, weight)
        turn = flow.strain.turn
        slope = flow.undeformed.grad(q)
        own = flow.undeformed.volume_ratio * turn
        R: ufl.Form = own * (-stored + dt * ufl.dot(flux, slope)) * body.dx
        normal, area = flow.undeformed.normal(), body.undeformed.area_ratio * turn
        if pores.drained:
            ds = facet_measure(body, given.facet_tags, pores.drained, "drained")
            inside = flow.conductivity(k) * normal
            degree = flow.p.W.ufl_element().degree
            penalty = PENALTY * degree * flow.undeformed.inverse_size(normal)
            for value, tag in pores.drained:
                gap = p - as_ufl(value, body.mesh, "a drained pressure")
                out = -q * ufl.dot(flux, normal) + gap * ufl.dot(slope, inside)
                out -= penalty * ufl.dot(normal, inside) * gap * q
                R += area * dt * out * ds(tag)
        if pores.inflow:
            ds = facet_measure(body, given.facet_tags, pores.inflow, "inflow")
            for value, tag in pores.inflow:
                R += area * dt * as_ufl(value, body.mesh, "an inflow") * q * ds(tag)
        return R


class PorousProblem(TimeProblem, QuasiStaticProblem):
    """Consolidation of saturated bodies: equilibrium, and the flow of water through their pores.

    Displacement and pore pressure are unknowns together (the pair of Taylor & Hood 1973), in finite
    strain where the materials are of finite strain. ``material`` is the law of the effective stress
    (Terzaghi 1943): total stress is that of the law less the pore pressure. Loads act in full from
    the beginning unless a path sets others: ``problem.solve(time=..., dt=..., update=...)``.

    Args:
        bodies: One :class:`Body`, or a list, of degree 2 or 3 on a background of degree 2 or 3
            where they have a ``pore_fluid``. Bodies without, such as a footing, are dry; all may
            be, if a law has a ``relaxation_time``: that is equilibrium through time.
        bcs: As in :class:`QuasiStaticProblem`, and on the space of the pore pressure.
        pressure_space: Background space of the pore pressure, for Dirichlet conditions on it in
            ``bcs``; ``None``: continuous, of one degree less than V on its mesh.
        **options: All else that :class:`QuasiStaticProblem` has but ``mixed`` and ``background``.

    Attributes:
        pore_pressure: Of each body with water, a :class:`mpm_dolfinx.ParticleField` at its nodes.

    Raises:
        MPMError: As there; and what does not go with water.
    """

    @collective()
    def __init__(
        self,
        bodies: Body | Sequence[Body],
        bcs: Sequence[fem.DirichletBC] = (),
        *,
        pressure_space: fem.FunctionSpace | None = None,
        **options: Any,
    ) -> None:
        given = as_given(bodies)
        for name in ("mixed", "background", "fields"):
            if name in options:
                raise MPMError(f"A PorousProblem has no {name}=; omit it.")
        if not any(body.pore_fluid is not None or body.takes_time for body in given):
            raise MPMError(
                "A PorousProblem needs a body with a pore_fluid=, or a law by with_relaxation()."
            )
        self._physics = self._water = _Water(_spaces(given, pressure_space))
        super().__init__(bodies, bcs, **options)
        for filled in self._water.filled:
            fluid = self.body(filled.particles).pore_fluid
            assert fluid is not None
            begin = interpolated(fluid.pressure, filled.field.W, "pressure of a PoreFluid")
            filled.field.set(begin.x.array)

    @override
    def laws(self) -> list[list[Law]]:
        """Laws of the bodies; the pore fluid goes with the material."""
        found = super().laws()
        for own, body in zip(found, self.setup.bodies, strict=True):
            if body.pore_fluid is not None:
                water: dict[str, Any] = {
                    name: value
                    if isinstance(value, float | int | np.number)
                    else type(value).__name__  # it may have changed since, as loads may
                    for name, value in (
                        ("permeability", body.pore_fluid.permeability),
                        ("storage", body.pore_fluid.storage),
                        ("fluid_density", body.pore_fluid.density),
                    )
                }
                own.append(("water", water))
        return found

    @property
    def pore_pressure(self) -> list[ParticleField]:
        """The pore pressure of each body with water; new Functions after a repartition."""
        return [filled.field for filled in self._water.filled]

    @override
    def beginning(self) -> list[NDArray[np.float64]]:
        before = [np.asarray(f.before.x.array, np.float64) for f in self._water.filled]
        return [*super().beginning(), *before]

    @override
    def at_end(self) -> list[NDArray[np.float64]]:
        moved = [
            np.asarray(f.particles.displacement.x.array, np.float64) for f in self._water.filled
        ]
        return [*super().at_end(), *moved]

    # -- The system -----------------------------------------------------------------------

    @override
    def _require_change(self, body: Body) -> None:
        super()._require_change(body)
        if (body.pore_fluid is None) != (self.body(body.particles).pore_fluid is None):
            raise MPMError("Water cannot come to a dry body in a stage, nor leave a wet one.")

    @override
    def _contributions(self) -> list[Contribution]:
        contributions = super()._contributions()
        filled = self._water.filled
        wet = [one.particles for one in filled]
        for term in self.terms:
            if term.takes_stress and any(body is its for body in wet for its in term.bodies):
                raise not_with(
                    f"law='nitsche' of a {type(term).__name__}",
                    "water, whose pressure the stress of the material does not know",
                    "use law='penalty'",
                )
        self.fields = self.pore_pressure
        self._of_fields = [one.residual for one in filled if one.residual is not None]
        return contributions

    @override
    def build(self) -> None:
        super().build()
        for filled in self._water.filled:
            filled.particles.fill_pores([filled.field])

    # -- Through time ---------------------------------------------------------------------

    @override
    def _aim(self, t: float) -> None:
        for filled in self._water.filled:
            np.copyto(filled.dt.value, t - self.history.time)
        for points in self.points:
            points.laws.pace(t - self.history.time)

    @override
    def begin_step(self) -> None:
        super().begin_step()
        for filled in self._water.filled:
            before = filled.particles.converged_displacement
            filled.before.x.array[:] = before.ravel()
            for one in filled.checked:
                one.require()

    @collective()
    def add(self, body: Body, name: str | None = None, *, sudden: bool = False) -> None:
        """Add a body: see :meth:`QuasiStaticProblem.add`; what changes does so at once."""
        (given,) = as_given(body)
        self._physics.require([given], type(self).__name__)
        before = list(self._water.spaces)
        known = {id(particles.V): V for particles, V in before}
        self._water.spaces = before + _spaces([given], None, known)
        try:
            super().add(given, name, sudden=sudden)
        except BaseException:
            self._water.spaces = before
            raise


class _Undeformed:
    """The undeformed body in UFL on its mesh, which is another shape of it after a rebase.

    Args:
        strain: What the body is strained in.

    Attributes:
        volume_ratio: Volume in the undeformed body over that in the mesh.
    """

    def __init__(self, strain: Strain) -> None:
        self._strain, self._body = strain, strain.particles
        origin = self._origin = self._body.undeformed.origin
        self._to_mesh = None if origin is None else ufl.inv(ufl.grad(origin))
        self.volume_ratio = self._body.undeformed.volume_ratio

    def grad(self, w: Any) -> Any:
        """Return the gradient of a field on the mesh."""
        return ufl.grad(w) if self._to_mesh is None else ufl.dot(ufl.grad(w), self._to_mesh)

    def strained(self, w: Any) -> Any:
        """Return the gradient of :meth:`Strain.ufl_gradient`."""
        return self._strain.with_turn(self.grad(w), w)

    def displacement_gradient(self, d: Any) -> Any:
        """Return ``F - I`` for a displacement of the mesh, shape ``(dim, dim)``."""
        if self._origin is None:
            return self.strained(d)
        return self.strained(d + ufl.SpatialCoordinate(self._body.mesh) - self._origin)

    def normal(self) -> Any:
        """Return the outward unit normal of the undeformed body."""
        normal = ufl.FacetNormal(self._body.mesh)
        if self._to_mesh is None:
            return normal
        turned = ufl.dot(normal, self._to_mesh)
        return turned / ufl.sqrt(ufl.dot(turned, turned))

    def inverse_size(self, normal: Any) -> Any:
        """Return one over the size of domains across their facets.

        It is that across, whatever the length along: what Nitsche's penalty must outweigh is the
        derivative across the facet, which is large in flat domains. It is one over the height in a
        parallelogram whose sides are normal to each other, and at least that elsewhere.

        Args:
            normal: That of :meth:`normal`.
        """
        across = ufl.JacobianInverse(self._body.mesh)
        across *= normal if self._to_mesh is None else ufl.dot(self._to_mesh, normal)
        return ufl.sqrt(ufl.dot(across, across))


class _Flow:
    """Quantities of the balance of a body's water.

    Args:
        filled: The water.
        strain: What the body is strained in.
        small: Whether strains are small.
    """

    def __init__(self, filled: _Filled, strain: Strain, small: bool) -> None:
        body = strain.particles
        self.strain, self._small = strain, small
        self.p, self.p_n, self.dt = filled.field, filled.field.previous, filled.dt
        self.q = ufl.TestFunction(filled.field.W)
        self._v = ufl.TestFunction(body.W)
        d, unit = body.displacement, ufl.Identity(strain.dim)
        self.undeformed = _Undeformed(strain)
        self._gradient = self.undeformed.displacement_gradient(d)
        before = self.undeformed.displacement_gradient(filled.before)
        self.J, self.J_n = (
            1.0 + ufl.tr(g) if small else ufl.det(unit + g) for g in (self._gradient, before)
        )
        dim = body.mesh.geometry.dim
        g = self._gradient
        plane = (
            g if dim == strain.dim else ufl.as_tensor([[g[i, j] for j in (0, 1)] for i in (0, 1)])
        )
        self._F = ufl.Identity(dim) + plane

    def work_of_pressure(self) -> ufl.Form:
        """Return the virtual work of the pore pressure."""
        test = self.undeformed.strained(self._v)
        if self._small:
            change = ufl.tr(test)
        else:
            change = ufl.inner(_cofactors(ufl.Identity(self.strain.dim) + self._gradient), test)
        own = self.undeformed.volume_ratio * self.strain.turn
        work: ufl.Form = -own * self.p * change * self.strain.particles.dx
        return work

    def conductivity(self, k: Any) -> Any:
        """Return the permeability with respect to the undeformed body, a tensor."""
        if self._small:
            return k * ufl.Identity(self._F.ufl_shape[0])
        cofactors, ratio = _cofactors(self._F), ufl.det(self._F)
        return k * self.J / ratio**2 * cofactors.T * cofactors

    def flux(self, k: Any, p: Any, weight: Any) -> Any:
        """Return the flux of water through the undeformed body.

        Args:
            k: Permeability.
            p: Pore pressure.
            weight: Weight of water per volume, or ``None``.
        """
        drive = self.undeformed.grad(p)
        if weight is not None:
            drive = drive - (weight if self._small else self._F.T * weight)
        return -self.conductivity(k) * drive


def _cofactors(F: Any) -> Any:
    """Return ``det(F) F^-T`` without a quotient, which compiles to less code."""
    if F.ufl_shape[0] == 2:
        return ufl.as_tensor([[F[1, 1], -F[1, 0]], [-F[0, 1], F[0, 0]]])
    rows = [[F[i, j] for j in range(3)] for i in range(3)]
    return ufl.as_tensor([_cross(rows[(i + 1) % 3], rows[(i + 2) % 3]) for i in range(3)])


def _cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    return [a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3] for i in range(3)]


def _evaluated(permeability: Any, body: Particles, J: Any) -> Any:
    """Return a permeability, what it is at a volume ratio where it is a function (collective).

    Raises:
        MPMError: The function that gives it fails.
    """
    if not is_function(permeability):
        return permeability
    comm = body.mesh.comm
    with agree(comm, "The function that gives permeability"):
        made = permeability(J)
    require_same(comm, permeability=made)
    return made


# -- What is given ---------------------------------------------------------------------------


def _laws(material: Any) -> list[Material]:
    """Return the laws among what is given as a material, or as one for each body."""
    if isinstance(material, list | tuple):
        return [law for one in material for law in _laws(one)]
    if isinstance(material, Mapping):
        return list(material.values())
    return [material]


def _is_small(material: Material) -> bool:
    """Return whether a law is of small strains."""
    return getattr(material, "kinematics", None) == "small"


def _spaces(
    bodies: Sequence[Body],
    given: fem.FunctionSpace | None,
    known: Mapping[int, fem.FunctionSpace] | None = None,
) -> list[tuple[Particles, fem.FunctionSpace]]:
    """Return the background space of the pressure of each body with water (collective).

    Bodies that move by one V have one, so that water flows from one to the other.

    Args:
        bodies: All bodies.
        given: A space of the user's.
        known: Spaces by the identity of V.

    Raises:
        MPMError: The user's space cannot be that of the pressure, or a body is of degree 1.
    """
    if given is not None:
        _require_space(given, [body.particles.V for body in bodies])
    made = dict(known or {})
    found = []
    for body in (body.particles for body in bodies if body.pore_fluid is not None):
        V, degrees = body.V, [space.ufl_element().degree for space in (body.V, body.W)]
        if min(degrees) < 2:
            raise MPMError(
                "A PorousProblem needs a background and particles of degree 2 or 3 (degree=2), not "
                f"{degrees[0]} and {degrees[1]}: with displacements of degree 1 the pressure would "
                "oscillate while no water can leave."
            )
        if id(V) not in made:
            if given is not None and made:
                raise MPMError("pressure_space= is for bodies that share one V.")
            made[id(V)] = given or fem.functionspace(
                V.mesh, ("Lagrange", V.ufl_element().degree - 1)
            )
        found.append((body, made[id(V)]))
    return found


def _require_space(given: Any, spaces: Sequence[fem.FunctionSpace]) -> None:
    """Raise an error unless a space can be that of the pore pressure."""
    if not isinstance(given, fem.FunctionSpace):
        raise MPMError(
            f"pressure_space= must be a dolfinx FunctionSpace, not {type(given).__name__}."
        )
    element = given.ufl_element()
    least = min(V.ufl_element().degree for V in spaces)
    mine = any(given.mesh is V.mesh for V in spaces)
    if not mine or element.reference_value_shape or element.degree >= least:
        raise MPMError(
            "pressure_space= must be a scalar space on the background mesh, of a degree below "
            f"{least}, that of the displacement; with as many degrees the pressure would oscillate."
        )
