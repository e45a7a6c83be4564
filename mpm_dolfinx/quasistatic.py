# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quasi-static equilibrium of particles with a material."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from . import splitting, state
from .assembly import PointStress, is_fast
from .bodies import as_bodies
from .boundary import Support
from .checkpoint import Snapshot
from .constitutive import ConstitutiveHistory
from .errors import MPMError, agree
from .expressions import as_expression, carried, require_movable
from .f_bar import F_BARS, LowRankTangent
from .grouping import background_cells
from .particles import Particles
from .problem import Law, ParticleProblem
from .quadrature import depends_on
from .virtual_work import VirtualWork

__all__ = ["QuasiStaticProblem"]

#: Mean share of a background cell that a domain fills, from which one point is too few.
CROWDED = 0.5


class QuasiStaticProblem(ParticleProblem):
    """Equilibrium of bodies with materials, under body force, tractions and supports.

    ``int P : grad v dX - load (int density b . v dX + int t . v dS) = 0`` on the undeformed
    body; the first Piola stress P and its tangent dP/dF are Functions on a quadrature element,
    injected into the UFL forms. With several bodies, ``material``, ``density``,
    ``body_force``, ``tractions``, ``pressures``, ``cell_tags`` and ``facet_tags`` are each one
    for all, or a list with one for each body.

    Args:
        particles: The body, or a list of bodies on one V (no slip where they touch).
        material: A material, or ``{cell tag: material}`` with ``cell_tags``.
        density: Mass per undeformed volume: a number, Constant, Function or UFL expression.
        body_force: Force per mass at full load: a tuple, Constant, Function or UFL expression
            on the body mesh, or a function that makes one from the mesh.
        bcs: Dirichlet conditions on V, totals at full load.
        tractions: Pairs of a dead load per undeformed area at full load (tuple or UFL) and a
            tag of ``facet_tags``.
        pressures: Pairs of a pressure at full load (number or UFL) and a tag of
            ``facet_tags``; it acts on the deformed facets, against their normal, per deformed
            area (a follower load, whose tangent is not symmetric).
        cell_tags: Tags of the body's cells.
        facet_tags: Tags of the body's facets.
        axisymmetric: Whether ``x[0]`` is the radius of a body of revolution about ``x[0] = 0``;
            loads and reactions are then those of the whole circumference.
        supports: Supports on the bodies' own boundaries, of :mod:`mpm_dolfinx.boundary`.
        background: Form on the background, as in :class:`ParticleProblem`.
        f_bar: Average of the volume ratio that the material sees, against hourglass modes and
            locking: ``"none"``, ``"domain"`` (over a domain's points), ``"pair"`` (over the two
            triangles of a quadrilateral) or ``"patch"`` (over the domains of about one
            background cell).
        petsc_options_prefix: Prefix of the PETSc options.
        petsc_options: PETSc options, without prefix.
        assembly: As in :class:`ParticleProblem`; the reference route also updates the built-in
            materials by NumPy.
        shift: As in :class:`ParticleProblem`.
        line_search: As in :class:`ParticleProblem`.
        dependent_dofs: As in :class:`ParticleProblem`.
        predictor: As in :class:`ParticleProblem`.
        **options: ``stabilisation``, ``form_compiler_options`` and ``jit_options``, as there.

    Raises:
        MPMError: Materials, loads or conditions that do not go together.
    """

    def __init__(
        self,
        particles: Particles | Sequence[Particles],
        material: Any,
        density: Any = 1.0,
        body_force: Any = None,
        bcs: Sequence[fem.DirichletBC] = (),
        tractions: Sequence[Any] = (),
        pressures: Sequence[Any] = (),
        cell_tags: Any = None,
        facet_tags: Any = None,
        axisymmetric: bool = False,
        supports: Sequence[Support] = (),
        background: ufl.Form | None = None,
        f_bar: str = "none",
        petsc_options_prefix: str = "mpm_",
        petsc_options: dict[str, Any] | None = None,
        *,
        assembly: str = "auto",
        shift: float = 1e-13,
        line_search: bool = True,
        dependent_dofs: str = "shift",
        predictor: bool = True,
        **options: Any,
    ) -> None:
        self.arguments = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        if f_bar not in F_BARS:
            raise MPMError(
                f"Unknown f_bar={f_bar!r}; choose one of {', '.join(map(repr, F_BARS))}."
            )
        bodies = as_bodies(particles)
        if any(body.on_distortion == "split" for body in bodies):
            splitting.require_divisible(self.arguments)
        first = "history" not in self.__dict__  # not made anew on other meshes
        if first:
            self.splits_of_step = 0, 0
        count = len(bodies) if isinstance(particles, list | tuple) else 0
        # The particles forget the meshes of long ago, so what has moved is kept.
        for name, move in (
            ("material", carried),
            ("cell_tags", Particles.carry),
            ("facet_tags", Particles.carry),
        ):
            values = _for_each(self.arguments[name], count)
            moved = [move(body, value) for body, value in zip(bodies, values, strict=True)]
            self.arguments[name] = moved if count else moved[0]
        shares = zip(
            bodies,
            _for_each(self.arguments["material"], count),
            _for_each(density, count),
            _for_each(body_force, count),
            _for_each(tractions, count, pairs=True),
            _for_each(pressures, count, pairs=True),
            _for_each(self.arguments["cell_tags"], count),
            _for_each(self.arguments["facet_tags"], count),
            strict=True,
        )
        _validate_supports(supports, bodies)
        self._stresses: list[ConstitutiveHistory] = []
        self._injected: list[tuple[ConstitutiveHistory, fem.Function, fem.Function]] = []
        self._density: list[tuple[VirtualWork, Any]] = []
        fast = is_fast(assembly)
        self._by_loops = fast and not axisymmetric and f_bar in ("none", "domain")
        residuals: list[ufl.Form | None] = []
        tangents: list[ufl.Form | None] = []
        symmetric = True
        for body, law, mass, force, dead, following, cells, facets in shares:
            history = ConstitutiveHistory(body, law, cells, axisymmetric, f_bar, fast)
            self._stresses.append(history)
            work = VirtualWork(body, axisymmetric)
            mass = as_expression(mass, body, "density", ())
            self._density.append((work, mass))
            if body.mass_share is not None:
                mass = mass * body.mass_share
            terms: list[ufl.Form] = []
            if force is not None:
                terms.append(-work.body_force(mass, force))
            if dead:
                terms.append(-work.tractions(dead, facets))
                symmetric = symmetric and not depends_on(terms[-1], body.displacement)
            terms += [work.support(s, history) for s in supports if s.particles is body]
            if following:
                terms.append(work.pressures(following, facets))
            symmetric = symmetric and history.symmetric and not following
            slopes = [
                ufl.derivative(term, body.displacement)
                for term in terms
                if depends_on(term, body.displacement)
            ]
            if not self._by_loops:
                internal, tangent = work.internal(*self._inject(body, history))
                terms.append(internal)
                slopes.append(tangent)
            residuals.append(sum(terms[1:], terms[0]) if terms else None)
            tangents.append(sum(slopes[1:], slopes[0]) if slopes else None)
        super().__init__(
            residuals,
            particles,
            J=tangents,
            bcs=bcs,
            background=background,
            petsc_options_prefix=petsc_options_prefix,
            petsc_options=petsc_options,
            # The vectors of groups of domains are summed by PETSc.
            assembly="reference" if f_bar in ("pair", "patch") else assembly,
            symmetric=symmetric,
            shift=shift,
            line_search=line_search,
            dependent_dofs=dependent_dofs,
            predictor=predictor,
            **options,
        )
        for body, stress in zip(bodies, self._stresses, strict=True):
            body.attach(stress)
            if first:
                _warn_of_hourglass(body)
        for share, stress in zip(self.shares, self._stresses, strict=True):
            averaging = stress.averaging
            if averaging is not None and share.forms.stock:
                share.forms.low_rank = LowRankTangent(share.particles, averaging)

    def evaluate(self) -> MPMError | None:
        """Update the stress and its tangent for the present displacement."""
        failure: MPMError | None = None
        for stress in self._stresses:
            try:
                stress.update()
            except MPMError as error:
                failure = failure or error
        if failure is None:
            self._fill()
        return failure

    def smooth(self) -> bool:
        """See :meth:`ParticleProblem.smooth`."""
        if any(support.one_sided for support in self.arguments["supports"]):
            return False
        elastic = all(stress.elastic() for stress in self._stresses)
        return bool(self._comm.allreduce(elastic, MPI.LAND))

    def commit(self) -> None:
        """Make the last update the history."""
        for stress in self._stresses:
            stress.commit()

    def roll_back(self) -> None:
        """Return to the stress of the last converged step."""
        for stress in self._stresses:
            stress.roll_back()
        self._fill()

    def _inject(
        self, body: Particles, history: ConstitutiveHistory
    ) -> tuple[fem.Function, fem.Function]:
        """Return stress and tangent of a body as Functions on a quadrature element."""
        dim = history.dim
        injected = (
            body.quadrature_function("first_piola", (dim, dim)),
            body.quadrature_function("tangent", (dim,) * 4),
        )
        self._injected.append((history, *injected))
        return injected

    def _fill(self) -> None:
        """Set the injected Functions to the present stress and tangent."""
        for history, first_piola, tangent in self._injected:
            for function, values in zip((first_piola, tangent), history.on_mesh(), strict=True):
                function.x.array[: values.size] = values.ravel()

    def _internal_stress(self, number: int) -> PointStress | None:
        return self._stresses[number] if self._by_loops else None

    def _masses(self, number: int) -> NDArray[np.float64]:
        return self.nodal_masses(number).sum(axis=1)

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
        if not isinstance(threshold, float | int) or not 0.0 <= threshold <= 1.0:
            raise MPMError(f"threshold must be a share from 0 to 1, not {threshold!r}.")
        require_movable(self.arguments)
        ranks = [body.ranks_of_background() for body in self.bodies]
        leaving = sum(int(np.count_nonzero(r != self._comm.rank)) for r in ranks)
        share = self._comm.allreduce(leaving) / sum(body.num_global for body in self.bodies)
        if share <= threshold or share == 0.0:
            return False

        def move() -> None:
            for body, targets in zip(self.bodies, ranks, strict=True):
                body.move(targets)

        self.make_anew(move, lambda snapshot: snapshot)
        self.history.statistics.count("repartitions")
        return True

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
        if body not in range(len(self.bodies)):
            raise MPMError(f"There is no body {body!r}; there are {len(self.bodies)}.")
        chosen = [np.zeros(0, dtype=np.int64) for _ in self.bodies]
        with agree(self._comm):
            chosen[body] = splitting.as_indices(particles)
        splitting.split(self, chosen)

    def rebase(self) -> None:
        """Take the body as it is now for the mesh that displacements are counted from (collective).

        ``particles.displacement`` starts from zero. All else goes on: deformation gradient, stress
        and history, mass at each node, ``initial_volume`` and ``initial_centroid``, dead loads per
        undeformed area, and the undeformed shape in pictures and series. The objects on the body
        mesh are new ones as after :meth:`split`.

        Raises:
            MPMError: Domains or a problem that cannot be rebased. Nothing is changed.
        """
        splitting.rebase(self)

    def make_anew(self, change: Callable[[], None], carry: Callable[[Snapshot], Snapshot]) -> None:
        """Make the problem on other meshes of the same bodies, in the same state (collective).

        Args:
            change: Gives the particles their meshes.
            carry: Makes of the state before the one on these meshes.
        """
        snapshot = state.capture(self)
        seconds = self.history.statistics.seconds
        run, resume, output = self._run, self._resume, self._output
        arguments = dict(self.arguments)
        options = arguments.pop("options")
        self._release()
        change()
        QuasiStaticProblem.__init__(self, **arguments, **options)
        state.adopt(self, carry(snapshot), (), False, "The state before")
        self._run, self._resume, self._output = run, resume, output
        self.history.statistics.update(seconds)
        output.follow()

    def nodal_masses(self, number: int) -> NDArray[np.float64]:
        """Return ``int density Q_c dX`` of each owned domain of a body, ``(n, k)`` (collective)."""
        body, (work, density) = self.bodies[number], self._density[number]
        space = fem.functionspace(body.mesh, ("Discontinuous Lagrange", 1))
        test: Any = ufl.TestFunction(space)
        if body.mass_share is not None:
            test = body.mass_share * test
        vector = fem.assemble_vector(fem.form(work.mass(density, test)))
        return np.asarray(vector.array[space.dofmap.list[: body.num_local]])

    def mass_matrices(self, number: int) -> NDArray[np.float64]:
        """Return ``int density Q_c Q_d dX`` of each owned domain, ``(n, k, k)`` (collective)."""
        body, (work, density) = self.bodies[number], self._density[number]
        space = fem.functionspace(body.mesh, ("Discontinuous Lagrange", 1))
        product = ufl.TrialFunction(space) * ufl.TestFunction(space)
        matrix = fem.assemble_matrix(fem.form(work.mass(density, product)))
        n, k = body.num_local, space.dofmap.list.shape[1]
        return matrix.data[: n * k * k].reshape(n, k, k)

    def end_step(self) -> None:
        """See :meth:`ParticleProblem.end_step`."""
        splitting.split_concave(self)

    def mend(self, error: MPMError) -> bool:
        """See :meth:`ParticleProblem.mend`."""
        return splitting.split_failing(self, error)

    def cut_as(self, snapshot: Snapshot, functions: bool, source: str) -> None:
        """See :meth:`ParticleProblem.cut_as`."""
        splitting.repeat(self, snapshot, functions, source)

    def converged_state(self) -> list[dict[str, NDArray[Any]]]:
        """See :meth:`ParticleProblem.converged_state`."""
        return [stress.converged_state() for stress in self._stresses]

    def set_converged_state(self, states: list[dict[str, NDArray[Any]]]) -> None:
        """See :meth:`ParticleProblem.set_converged_state`."""
        for stress, arrays in zip(self._stresses, states, strict=True):
            stress.set_converged_state(arrays)

    def laws(self) -> list[list[Law]]:
        """See :meth:`ParticleProblem.laws`."""
        return [stress.laws() for stress in self._stresses]

    @property
    def yield_function(self) -> NDArray[np.float64]:
        """Largest yield function of each particle's points, shape ``(n,)``.

        In the unit of the material's own function; -1 where a material has none.
        With several bodies, their particles one body after the other.
        """
        values = [s.yield_function().max(axis=1, initial=-np.inf) for s in self._stresses]
        return np.concatenate(values)


def _for_each(value: Any, count: int, pairs: bool = False) -> list[Any]:
    """Return one value for each of ``count`` bodies (0: one body that is not in a list)."""
    if count == 0:
        return [value]
    listed = isinstance(value, list) and (
        not pairs or all(isinstance(entry, list) for entry in value)
    )
    if not listed or not value:
        return [value] * count
    if len(value) != count:
        raise MPMError(f"There are {count} bodies, but a list of {len(value)} for them.")
    return list(value)


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
    _, size = background_cells(particles)
    fill = particles.mesh.comm.allreduce(float((particles.initial_volume / size).sum()))
    if fill > CROWDED * particles.num_global and particles.mesh.comm.rank == 0:
        cure = "use two domains each way in a cell"
        if degree > 1:
            cure = f"use quadrature_degree={2 * degree}, or {cure[4:]}"
        elif particles.method == "cpdi2":
            cure = f"use quadrature_degree=2 with f_bar='domain', or {cure[4:]}"
        warnings.warn(
            f"The domains have {'one' if points == 1 else points} quadrature point"
            f"{'s'[: points > 1]} each and are about as large as the cells of the background, so "
            f"motions without strain (hourglass) meet no resistance; {cure}.",
            stacklevel=4,
        )


def _validate_supports(supports: Any, bodies: Sequence[Particles]) -> None:
    if not isinstance(supports, list | tuple) or not all(isinstance(s, Support) for s in supports):
        raise MPMError("supports must be a list of supports made by mpm.boundary.")
    if any(all(s.particles is not body for body in bodies) for s in supports):
        raise MPMError("A support was made with other particles than those of this problem.")
