# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quasi-static equilibrium of particles with a material."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, override

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from ..boundary.supports import Support
from ..constitutive.assignment import equal_laws
from ..constitutive.beginning import begin_unstrained, begin_with_stress
from ..constitutive.groups import background_cells
from ..constitutive.identity import identity
from ..errors import MPMError, agree, not_with, warn
from ..meshes.quadrature import cell_volumes
from ..meshes.redistribution import Redistribution
from ..parallel.boundary import collective
from ..parallel.given import is_number
from ..particles.field import ParticleField
from ..particles.particles import Particles
from ..system.term import Term
from .arguments import (
    as_bodies,
    as_supports,
    as_terms,
    functions_of,
    require_no_conditions_on_bodies,
)
from .body import INITIAL, Body, as_given
from .initial_stress import initial_stress_at_points, warn_of_other_ground
from .parts import Contribution
from .physics import MaterialBodies, Physics, damages
from .problem import Law, Problem
from .remeshing import Remeshing, as_indices
from .setup import Setup
from .solver import Solver, as_solver
from .stages import Addition, Given, Removal, chosen_cells

__all__ = ["QuasiStaticProblem"]

#: Mean share of a background cell that a domain fills, from which one point is too few.
CROWDED = 0.5


class QuasiStaticProblem(Problem):
    """Equilibrium of bodies with materials, under body force, tractions and supports.

    ``int P : grad v dX - load (int density b . v dX + int t . v dS) = 0`` on the undeformed
    body; the first Piola stress P and its tangent dP/dF come from the materials at the points.

    Args:
        bodies: One :class:`Body`, or a list. Those whose particles are on the same V do not slip
            where they touch; those on a V of their own meet by ``terms`` alone.
        bcs: Dirichlet conditions on V, totals at full load.
        supports: Supports on the bodies' own boundaries, of :mod:`mpm_dolfinx.boundary`.
        terms: What else acts on the bodies: contacts, ties, any :class:`mpm_dolfinx.Term`.
        background: Form on the background, as in :class:`ParticleProblem`.
        axisymmetric: Whether ``x[0]`` is the radius of a body of revolution about ``x[0] = 0``;
            loads and reactions are then those of the whole circumference.
        mixed: ``"pressure"``: the pressure is an unknown besides the displacement, continuous and
            of one degree less on the same background mesh (the pair of Taylor & Hood 1973), so that
            nothing locks however little volume changes; for laws in strain space (Hencky,
            von Mises, Mohr-Coulomb, Drucker-Prager, your own), backgrounds and particles of degree
            2 or 3, instead of ``f_bar``.
            ``"stabilised pressure"``: displacement and pressure are both of degree 1, and what the
            pressure deviates by from its mean in each cell counts as compliance (Bochev, Dohrmann &
            Gunzburger 2006).
        solver: How it is solved.

    Attributes:
        particles: The particles of the body, or of each in a list.
        damage: The :class:`mpm_dolfinx.Damage` of each body whose law is a
            :class:`mpm_dolfinx.materials.Fracture`.

    Raises:
        MPMError: Materials, loads or conditions that do not go together.
    """

    @collective()
    def __init__(
        self,
        bodies: Body | Sequence[Body],
        bcs: Sequence[fem.DirichletBC] = (),
        *,
        supports: Sequence[Support] = (),
        terms: Sequence[Term] = (),
        background: ufl.Form | Sequence[ufl.Form] | None = None,
        axisymmetric: bool = False,
        mixed: str | None = None,
        solver: Solver | None = None,
    ) -> None:
        given = as_given(bodies)
        self._physics.require(given, type(self).__name__)
        listed = [body.particles for body in given]
        particles = as_bodies(listed if isinstance(bodies, list | tuple) else listed[0])
        supports = as_supports(supports, particles)
        terms = as_terms(terms, particles)
        setup = Setup(tuple(given), tuple(supports), tuple(terms), axisymmetric, mixed)
        self.damage = damages(setup, self._physics)
        terms = [*terms, *self.damage]
        setup = replace(setup, terms=tuple(terms))
        if any(body.on_distortion == "split" for body in particles):
            setup.require_divisible()
        for body in particles:
            moved = particles[0].V.mesh.comm.allreduce(int(np.any(body.converged_displacement)))
            for support in supports:
                if support.particles is body and not moved:
                    support.forget_modulus()
        self.setup = setup
        self._parameters = _Parameters(setup)
        self._materials = MaterialBodies(self._physics)
        self._remeshing = Remeshing(self)
        one = particles if isinstance(bodies, list | tuple) else particles[0]
        super().__init__(
            one,
            bcs,
            background,
            as_solver(solver),
            terms,
            mender=self._remeshing,
            spaces=self._physics.field_spaces,
        )
        self._carry_stress([body.initial_stress for body in given])
        warn_of_other_ground(given, given)
        for body in particles:
            _warn_of_hourglass(body)

    #: Laws besides that of equilibrium.
    _physics: Physics = Physics()

    @property
    def pressure(self) -> list[ParticleField]:
        """With ``mixed``, the pressure of each body: a :class:`mpm_dolfinx.ParticleField`.

        It lives at the body's points and is the mean of the laws' own stress, positive in tension.
        """
        return self._materials.pressure

    @property
    def supports(self) -> tuple[Support, ...]:
        """The supports on the bodies' own boundaries."""
        return self.setup.supports

    def body(self, particles: Particles | None = None) -> Body:
        """Return the body of particles, as it was given last.

        Args:
            particles: Its particles; ``None`` where there is one body.

        Raises:
            MPMError: There is no such body, or there are several.
        """
        if particles is None and len(self.setup.given) == 1:
            return self.setup.given[0]
        for body in self.setup.given:
            if body.particles is particles:
                return body
        count = len(self.setup.given)
        raise MPMError(f"There are {count} bodies; name one of them by its particles.")

    def _carry_stress(self, stresses: Sequence[Any]) -> None:
        """Let bodies that have not moved carry a stress (collective).

        Args:
            stresses: For each body, or ``None``.
        """
        if all(stress is None for stress in stresses):
            return
        for body, points, stress in zip(self.bodies, self.points, stresses, strict=True):
            if stress is not None:
                begin_with_stress(points, initial_stress_at_points(stress, body))
        if self._physics.gradual:
            self.staging.hold_all()

    @override
    def begin_anew(self) -> None:
        super().begin_anew()
        self._held.let_go()
        for body, points in zip(self.bodies, self.points, strict=True):
            points.numbers.follow()
            begin_unstrained(points)
            for support in self.setup.supports_of(body):
                support.follow(points.initial_modulus)
        self._carry_stress([body.initial_stress for body in self.setup.given])

    @override
    def beginning(self) -> list[NDArray[np.float64]]:
        return [*super().beginning(), *self._constant_arrays()]

    @override
    def at_end(self) -> list[NDArray[np.float64]]:
        return [*super().at_end(), *self._constant_arrays()]

    def _constant_arrays(self) -> list[NDArray[np.float64]]:
        """Return arrays that forces begin with: of supports, averages, and those held back.

        The last are there as long as they are held.
        """
        supports = [one for body in self.bodies for one in self.setup.supports_of(body)]
        averaged = [one.averaging.uneven for one in self.points if one.averaging is not None]
        return [*(support.stiffness for support in supports), *averaged, *self._held.held]

    @override
    def build(self) -> None:
        self.setup = self.setup.carried()
        self._parameters.carry(self.setup)
        super().build()
        for body, points in zip(self.bodies, self.points, strict=True):
            body.attach(points)

    @override
    def _contributions(self) -> list[Contribution]:
        return self._materials.contributions(self.setup)

    # -- Stages ---------------------------------------------------------------------------

    @collective()
    def stage(
        self,
        name: str | None = None,
        bodies: Body | Sequence[Body] = (),
        *,
        bcs: Any = ...,
        supports: Any = ...,
        terms: Any = ...,
        sudden: bool = False,
    ) -> None:
        """Begin a stage: change what is given, and keep the rest, in the same state (collective).

        What is taken away is unloaded over the next run, and what is new is loaded over it. Points
        whose law equals that of before go on as they were; others carry their stress on, and where
        the law is of the same class the internal variables that both begin with the same value.

        Args:
            name: Name of the stage, for ``history.stages``.
            bodies: Bodies that are made of or loaded by something else from now on, each in place
                of the one of the same particles: ``problem.body().replace(tractions=[...])``. New
                tags are of the present ``particles.mesh``.
            bcs: All Dirichlet conditions that hold from now on; ``...`` keeps what there is, as
                below.
            supports: All supports that hold from now on.
            terms: All that act from now on.
            sudden: Whether the whole change acts from the first step on.

        Raises:
            MPMError: What does not go together. Nothing is changed then.
        """
        changed = as_given(bodies) if bodies != () else []
        if changed:
            as_bodies([body.particles for body in changed])
        self._physics.require(changed, type(self).__name__)
        for body in changed:
            self._require_change(body)
        setup = self.setup.with_bodies(*changed)
        if supports is not ...:
            setup = replace(setup, supports=tuple(as_supports(supports, self.bodies)))
        change = Given(
            self,
            setup,
            self.bcs if bcs is ... else bcs,
            self.terms if terms is ... else terms,
            self._own_terms(),
        )
        self._go_on(name, change, sudden)

    def _require_change(self, body: Body) -> None:
        """Raise an error unless a body can be put in place of the one of the same particles."""
        before = self.body(body.particles)
        other = [name for name in INITIAL if getattr(body, name) is not getattr(before, name)]
        for name in [*other, *(["f_bar"] if body.f_bar != before.f_bar else [])]:
            raise MPMError(f"{name} cannot change in a stage; a body begins with it.")
        same = body.cell_tags is before.cell_tags and equal_laws(body.material, before.material)
        if not same and (body.may_crack or before.may_crack):
            raise MPMError(
                "A body with a law of fracture keeps its laws in a stage, as it begins with them; "
                "give parameters that are to change as Constants or Functions."
            )

    @collective("particles")
    def remove(
        self,
        particles: Any = None,
        *,
        tags: Any = None,
        body: int = 0,
        name: str | None = None,
        sudden: bool = False,
    ) -> None:
        """Begin a stage in which cells are taken away: an excavation (collective).

        Their forces on the rest go over the next run. They are deleted then (``deleted``), but no
        loss: what they weighed is not in ``history.losses``.

        Args:
            particles: Global indices, or a function of undeformed centroids ``(3, n)`` that returns
                a bool for each.
            tags: One tag of ``cell_tags`` or several, instead.
            body: Number of the body, where there are several.
            name: As in :meth:`stage`.
            sudden: As in :meth:`stage`.

        Raises:
            MPMError: There are none of them, or nothing would be left. Nothing is changed then.
        """
        if not isinstance(body, int | np.integer) or body not in range(len(self.bodies)):
            raise MPMError(f"There is no body {body!r}; there are {len(self.bodies)}.")
        if self.setup.bodies[body].may_crack:
            raise not_with("Fracture", "remove()", "choose cells of another body")
        own = self.setup.bodies[body]
        cells = chosen_cells(self.bodies[body], particles, tags, own.cell_tags)
        self._go_on(name, Removal(self, body, cells), sudden)

    @collective()
    def add(self, body: Body, name: str | None = None, *, sudden: bool = False) -> None:
        """Begin a stage in which a body comes: a lift, or a structure (collective).

        It is undeformed where it is placed; on the same V it sticks to the bodies that it touches.
        Where it overlaps one of those they are welded: both fill the same space with their weight
        and stiffness; take away what was there first (:meth:`remove`), unless that is meant.
        Its loads come over the next run. ``problem.particles`` is a list from then on.

        Args:
            body: The body.
            name: As in :meth:`stage`.
            sudden: As in :meth:`stage`.

        Raises:
            MPMError: What does not go together. Nothing is changed then.
        """
        given, *more = as_given(body)
        if more:
            raise MPMError("add() takes one mpm.Body; call it again for the next.")
        self._physics.require([given], type(self).__name__)
        if given.may_crack:
            raise MPMError("A body with a law of fracture cannot be added; begin with it.")
        particles = given.particles
        if particles.on_distortion == "split":
            replace(
                self.setup, given=(*self.setup.given, given), bodies=(*self.setup.bodies, given)
            ).require_divisible()
        np.copyto(particles.load.value, float(self.bodies[0].load.value))
        np.copyto(particles.proportional.value, float(self.bodies[0].proportional.value))
        self._go_on(name, Addition(self, given), sudden)

    def _own_terms(self) -> list[Term]:
        """Return the terms that the problem itself has."""
        return list(self.damage)

    def _go_on(self, name: str | None, change: Any, sudden: bool) -> None:
        """Begin a stage."""
        self.reign.require()
        name = f"stage {len(self.history.stages) + 1}" if name is None else name
        self.staging.begin(name, change, bool(sudden) or not self._physics.gradual)
        self._parameters.replace(self.setup)

    @override
    def begin_step(self) -> None:
        """Begin a step, in which parameters of materials have new values."""
        super().begin_step()
        with agree(self._comm):
            self._parameters.require()
        for density in self._materials.densities:
            density.require()
        for points in self.points:
            points.numbers.follow()

    @collective()
    def repartition(self, threshold: float = 0.1) -> bool:
        """Move particles with their history to where they are best now (collective).

        A particle is best on the rank that owns the background around it, unless that has 5 %
        more than an even share already. Tags and DG0 parameters move too; the answer does not
        change. Afterwards ``particles.mesh``, ``W``, ``displacement`` and ``load`` are new
        ones, and what was made on those before is out of use: take tags over by
        ``particles.carry``.

        Args:
            threshold: Share of the particles that must be better elsewhere.

        Returns:
            Whether particles have moved.

        Raises:
            MPMError: The problem holds what cannot move: UFL expressions, supports or arrays of
                parameters on the present body mesh. Nothing is changed.
        """
        self.reign.require()
        if not is_number(threshold) or not 0.0 <= threshold <= 1.0:
            raise MPMError(f"threshold must be a share from 0 to 1, not {threshold!r}.")
        self.setup.require_movable()
        require_no_conditions_on_bodies(self.bcs, self.bodies, "the particles cannot move")
        ranks = [body.best_ranks() for body in self.bodies]
        leaving = sum(int(np.count_nonzero(r != self._comm.rank)) for r in ranks)
        share = self._comm.allreduce(leaving) / sum(body.num_global for body in self.bodies)
        if share <= threshold or share == 0.0:
            return False

        def move() -> None:
            for body, targets in zip(self.bodies, ranks, strict=True):
                if not body.is_free:
                    body.live_on(Redistribution(body.mesh, targets))

        self.state.renew(move, lambda snapshot: snapshot)
        self.history.statistics.count("repartitions")
        return True

    @collective("particles")
    def split(self, particles: Sequence[int], body: int = 0) -> None:
        """Cut quadrilaterals with one point in two, as they are now (collective).

        Each is cut along the diagonal that makes the better triangles; the halves have its
        deformation gradient, stress and history. Mass at each node, and with it momentum, does
        not change, nor do the forces: what was in equilibrium still is. The first half keeps the
        global index, the second ones follow after all others (``particles.origin_index``). As
        after :meth:`repartition`, ``particles.mesh``, ``W``, ``displacement`` and ``load`` are
        new ones then; ``particles.carry`` takes tags and DG0 Functions over.

        Args:
            particles: Global indices; each on one rank or on several.
            body: Number of the body, where there are several.

        Raises:
            MPMError: Domains or a problem that cannot be split. Nothing is changed.
        """
        self.reign.require()
        if body not in range(len(self.bodies)):
            raise MPMError(f"There is no body {body!r}; there are {len(self.bodies)}.")
        chosen = [np.zeros(0, dtype=np.int64) for _ in self.bodies]
        with agree(self._comm):
            chosen[body] = as_indices(particles)
        self._remeshing.split(chosen)

    @collective()
    def rebase(self) -> None:
        """Take the body as it is now for the mesh that displacements are counted from (collective).

        ``particles.displacement`` starts from zero. All else goes on: deformation gradient, stress
        and history, mass at each node, ``initial_volume`` and ``initial_centroid``, dead loads per
        undeformed area, and the undeformed shape in pictures and series. The objects on the body
        mesh are new ones as after :meth:`split`.

        Raises:
            MPMError: Domains or a problem that cannot be rebased. Nothing is changed.
        """
        self.reign.require()
        self._remeshing.rebase()

    history_at = None

    @override
    def converged_state(self) -> list[dict[str, Any]]:
        return [dict(points.columns()) for points in self.points]

    @override
    def set_converged_state(self, states: list[dict[str, NDArray[Any]]]) -> None:
        for stress, arrays in zip(self.points, states, strict=True):
            stress.restore(arrays)

    @override
    def laws(self) -> list[list[Law]]:
        return [identity(stress) for stress in self.points]

    @property
    def yield_function(self) -> NDArray[np.float64]:
        """Largest yield function of each particle's points, shape ``(n,)``.

        In the unit of the material's own function; -1 where a material has none.
        With several bodies, their particles one body after the other.
        """
        values = [s.last.yield_function().max(axis=1, initial=-np.inf) for s in self.points]
        return np.concatenate(values)


class _Parameters:
    """Functions that are parameters of materials, on the present meshes and on those of before.

    Args:
        setup: The bodies.
    """

    def __init__(self, setup: Setup) -> None:
        self._present = _functions(setup)
        self._left: dict[int, tuple[fem.Function, NDArray[np.float64]]] = {}

    def carry(self, setup: Setup) -> None:
        """Take bodies on other meshes, and note the values on those that they leave."""
        present = _functions(setup)
        for function in self._present:
            if id(function) not in self._left and all(function is not f for f in present):
                self._left[id(function)] = function, function.x.array.copy()

    def replace(self, setup: Setup) -> None:
        """Take other parameters: those that are gone do not matter any more."""
        present = _functions(setup)
        for function in self._present:
            if all(function is not f for f in present):
                self._left.pop(id(function), None)
        self._present = present

    def require(self) -> None:
        """Raise an error where values on a mesh of before have changed."""
        for function, values in self._left.values():
            if not np.array_equal(function.x.array, values):
                raise MPMError(
                    f"A parameter of a material ('{function.name}') was changed on a mesh that "
                    "the particles have left; make a new problem with a Function on "
                    "particles.mesh."
                )


def _functions(setup: Setup) -> list[fem.Function]:
    """Return the parameters of materials that are Functions."""
    return [f for body in setup.bodies for f in functions_of(body.material)]


def _warn_of_hourglass(particles: Particles) -> None:
    """Say so where the points of a domain leave motions without strain (collective).

    Those are as many as Gauss points of the background's degree, in domains as large as its cells.
    """
    cell = particles.mesh.topology.cell_name()
    degree = particles.V.ufl_element().degree
    points = particles.num_points
    few = points <= degree**particles.mesh.geometry.dim
    if not few or cell not in ("quadrilateral", "hexahedron"):
        return
    comm, volume = particles.mesh.comm, particles.initial_volume
    least = comm.allreduce(cell_volumes(particles.V.mesh).min(initial=np.inf), MPI.MIN)
    if comm.allreduce(float(volume.sum())) <= CROWDED * particles.num_global * least:
        return  # wherever they are
    _, size = background_cells(particles)
    fill = comm.allreduce(float((volume / size).sum()))
    if fill > CROWDED * particles.num_global:
        cure = "use two domains each way in a cell"
        if degree > 1:
            cure = f"use quadrature_degree={2 * degree}, or {cure[4:]}"
        elif particles.shares_nodes:
            cure = f"use quadrature_degree=2 with f_bar='domain', or {cure[4:]}"
        warn(
            comm,
            f"The domains have {'one' if points == 1 else points} quadrature point"
            f"{'s'[: points > 1]} each and are about as large as the cells of the background, so "
            f"motions without strain (hourglass) meet no resistance; {cure}.",
        )
