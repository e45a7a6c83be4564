# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contributions of bodies with materials, at rest, in motion, or with water in their pores."""

from __future__ import annotations

from collections.abc import Sequence

import ufl
from dolfinx import fem

from ..assembly.density import Density
from ..assembly.loads import VirtualWork, changeable
from ..assembly.rules import depends_on
from ..boundary.supports import Support
from ..constitutive.points import MaterialPoints
from ..constitutive.step_stress import StepStress
from ..constitutive.strain import Strain, strain_of
from ..errors import MPMError, not_with
from ..particles.field import CarriedField, ParticleField
from ..particles.particles import Particles
from ..system.body import StepForce
from ..system.damage import Damage
from ..system.pressure import PressureTerm
from ..system.smoothing import PressureSmoothing
from ..system.values import FieldTerm
from .body import Body
from .parts import Contribution
from .pore_water import water_in
from .setup import Setup
from .summary import counted

__all__ = ["MaterialBodies", "Physics", "damages"]


class Physics:
    """Laws of bodies besides that of equilibrium, which motion and water add; here nothing.

    Attributes:
        further: Names of what a :class:`Body` may have, which is for some problems alone.
        gradual: Whether loads and stages act little by little.
        takes_time: Whether steps have a duration.
    """

    further: tuple[str, ...] = ()
    gradual = True
    takes_time = False

    @property
    def field_spaces(self) -> list[fem.FunctionSpace]:
        """Background spaces of unknowns besides displacements."""
        return []

    def not_for_cracks(self) -> dict[str, bool]:
        """Return options that cracks do not go with, by name, and whether they are there."""
        return {}

    def begin(self, setup: Setup) -> None:
        """Begin to build on the present meshes (collective)."""

    def acting(
        self, points: MaterialPoints, supports: Sequence[Support]
    ) -> tuple[MaterialPoints | StepStress, Sequence[StepForce]]:
        """Return the stress that acts on a body, and its forces that act over a whole step."""
        return points, ()

    def share(self, body: Particles) -> float | None:
        """Return the share of force in a body's last residual; ``None`` without motion."""
        return None

    def is_static(self, body: Particles) -> bool:
        """Return whether a body is in equilibrium at each step's end, in a motion of others."""
        return False

    def work(self, given: Body, strain: Strain) -> tuple[list[ufl.Form], bool]:
        """Return forms of the residual besides those of stress and loads (collective).

        Args:
            given: The body, what it is made of and loaded by.
            strain: What it is strained in.

        Returns:
            The forms, and whether the tangent of all that they belong to is symmetric.
        """
        return [], True

    def require(self, bodies: Sequence[Body], kind: str) -> None:
        """Raise an error where bodies have what is for other problems alone.

        Args:
            bodies: The bodies.
            kind: Name of the problem's class.
        """
        if not self.takes_time and any(body.takes_time for body in bodies):
            raise MPMError(
                f"A law with a relaxation_time needs steps with a duration, which a {kind} does "
                "not have; make a PorousProblem, of dry bodies too, or a DynamicProblem; or omit "
                "it: that is the law of loads that last."
            )
        for name, other in (("velocity", "DynamicProblem"), ("pore_fluid", "PorousProblem")):
            if name not in self.further and any(getattr(b, name) is not None for b in bodies):
                raise MPMError(f"{name}= of a Body is for a {other}; omit it in a {kind}.")


def damages(setup: Setup, physics: Physics) -> list[Damage]:
    """Return the damage of each body that may crack (collective).

    Raises:
        MPMError: Something does not go with cracks.
    """
    found = []
    for body in setup.given:
        if not body.may_crack:
            continue
        refused = {
            "mixed=": setup.mixed is not None,
            "f_bar=": body.f_bar != "none",
            "axisymmetric=True": setup.axisymmetric,
            "initial_stress=": body.initial_stress is not None,
            f"method={body.particles.method!r}": not body.particles.shares_nodes,
            "outside='delete'": body.particles.deletion is not None,
            "on_distortion='split'": body.particles.on_distortion == "split",
            **physics.not_for_cracks(),
        }
        for what, given in refused.items():
            if given:
                raise not_with("Fracture", what, "omit it")
        found.append(Damage(body.particles, body.material, body.cell_tags))
    return found


class MaterialBodies:
    """Bodies with materials on their present meshes, as the system needs them.

    Args:
        physics: Laws besides that of equilibrium.

    Attributes:
        pressure: With ``mixed``, the pressure of each body.
        densities: Of each body.
    """

    def __init__(self, physics: Physics) -> None:
        self._physics = physics
        self.pressure: list[ParticleField] = []
        self.densities: list[Density] = []
        self._spaces: list[tuple[Particles, fem.FunctionSpace]] = []

    def contributions(self, setup: Setup) -> list[Contribution]:
        """Return the contribution of each body to the system, on its present mesh (collective)."""
        known, self.densities = self.pressure, []
        bodies = [given.particles for given in setup.bodies]
        self.pressure = [self._pressure_of(body) for body in bodies if setup.mixed]
        new = [field for field in self.pressure if all(field is not other for other in known)]
        self._physics.begin(setup)
        return [self._contribution(given, setup, new) for given in setup.bodies]

    def _pressure_of(self, body: Particles) -> ParticleField:
        """Return the pressure of a body, a new one where its mesh is (collective)."""
        for known in self.pressure:
            if known.particles is body and known.W.mesh is body.mesh:
                return known
        V = next((V for its, V in self._spaces if its is body), None)
        if V is None:
            degree = max(body.V.ufl_element().degree - 1, 1)
            V = fem.functionspace(body.V.mesh, ("Lagrange", degree))
            self._spaces.append((body, V))
        kind = "body" if body.is_free else "total"
        return ParticleField(body, V, at="points", kind=kind, name="pressure")

    def _contribution(
        self, given: Body, setup: Setup, new: Sequence[ParticleField]
    ) -> Contribution:
        """Return the contribution of one body (collective).

        Args:
            given: The body.
            setup: All of them.
            new: Pressures in place of mean stresses that were not there before.
        """
        body, physics = given.particles, self._physics
        supports = setup.supports_of(body)
        strain = strain_of(body, setup.axisymmetric)
        pressure = next((field for field in self.pressure if field.particles is body), None)
        points = MaterialPoints(
            strain, given.material, given.cell_tags, given.f_bar, pressure, given.length
        )
        if any(field is pressure for field in new):
            assert points.mean_stress is not None
            points.mean_stress.begin_with(points.last.mean_stress())
        body.fill_pores(water_in(body, given.pore_pressure, points))
        work = VirtualWork(strain)
        density = Density(1.0 if given.density is None else given.density, body)
        density.require()
        self.densities.append(density)
        acting, of_step = physics.acting(points, supports)
        share = physics.share(body)
        changing = _loads(given, work, density)
        follows = [work.pressures(given.pressures, given.facet_tags)] if given.pressures else []
        further, plain = physics.work(given, strain)
        held = [s.at_body(points.initial_modulus, strain.turn, share) for s in supports]
        every = [*changing, *held, *follows, *further]
        d = body.displacement
        slopes = [ufl.derivative(load, d) for load in every if depends_on(load, d)]
        turns = given.tractions and depends_on(changing[-1], d)
        return Contribution(
            sum(every[1:], every[0]) if every else None,
            sum(slopes[1:], slopes[0]) if slopes else None,
            acting.symmetric and not given.pressures and not turns and plain,
            acting,
            points,
            of_step,
            physics.is_static(body),
            supports,
            [one for load in (*changing, *follows) for one in changeable(load, body)],
            lambda product: work.mass(density.value, product),
            [] if pressure is None else _couplings(pressure, acting, points, setup, share),
            lambda: _in_words(given, setup),
        )


def _loads(given: Body, work: VirtualWork, density: Density) -> list[ufl.Form]:
    """Return the dead loads of a body, tractions last (collective)."""
    found: list[ufl.Form] = []
    if given.body_force is not None:
        mass = density.value * given.particles.undeformed.mass_ratio
        found.append(-work.body_force(mass, given.body_force))
    if given.pore_pressure is not None:
        found.append(-work.seepage(given.pore_pressure))
    if given.tractions:
        found.append(-work.tractions(given.tractions, given.facet_tags))
    return found


def _couplings(
    pressure: ParticleField,
    acting: MaterialPoints | StepStress,
    points: MaterialPoints,
    setup: Setup,
    share: float | None,
) -> list[FieldTerm]:
    """Return the terms of a body whose pressure is an unknown (collective)."""
    carried = CarriedField(pressure)
    found: list[FieldTerm] = [PressureTerm(points.strain.particles, carried, acting)]
    if setup.mixed == "stabilised pressure":
        found.append(PressureSmoothing(carried, points, share or 1.0))
    return found


def _in_words(given: Body, setup: Setup) -> str:
    """Return the material of a body and its loads."""
    held = setup.supports_of(given.particles)
    more = [counted(len(held), "support")] if held else []
    more += [] if setup.mixed is None else [f"mixed with a {setup.mixed}"]
    return "; ".join([given.in_words(), *more, *(["body of revolution"] * setup.axisymmetric)])
