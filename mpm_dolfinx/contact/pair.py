# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact of two deformable bodies: points of one against facets of the other.

With two passes each body's points meet the other's facets, at half the stiffness each where facets
are alike in size, at more of it for the points of much finer ones. The reaction
acts on the facet as if the point were fixed to it by a rigid arm along its normal, so that forces
and moments of both bodies balance, also where friction acts at a gap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..assembly.petsc import MatrixSum
from ..errors import ConvergenceError, MPMError, agreed
from ..io.snapshot import Taken
from ..meshes.remesh import Column
from ..parallel.boundary import collective
from ..parallel.given import as_positive
from ..particles.particles import Particles
from ..system.term import PointMaterial
from .contact import Contact, Outcome, require_apart, stiffness
from .law import Friction, as_friction
from .meeting import Meeting
from .nitsche import Nitsche, require_stress
from .one_pass import Pass
from .pair_matrices import PairMatrices
from .surface import Surface

__all__ = ["Pair"]

#: Ratio of the sizes of facets up to which two passes bear the same, and the least that one bears.
ALIKE, LEAST = 1.5, 0.2
#: Degree of the rule on a facet, by the dimension of space: the other body's facets have kinks.
DEGREES = {2: 9, 3: 5}
#: What is said of bodies that overlap from the beginning.
OVERLAPS = (
    "The bodies of a Pair overlap at the beginning: {particles} are up to {depth:.3g} deep in the "
    "other body; move the bodies apart."
)
#: Columns of what points remember, and of what acted, by its names there.
MEMORY = ("touches", "anchor", "offset", "friction")
OUTCOME = {"inside": "touches", "slips": "slips", "pressure": "pressure", "traction": "traction"}


class _Pattern(NamedTuple):
    """Matrices whose blocks are those of facets that have met.

    Attributes:
        matrices: Of forces on one body by nodes of the other, and of each by its own.
        sums: Of these and of those by the stress behind points.
        learned: How often each pass had learned of other facets.
    """

    matrices: PairMatrices
    sums: dict[tuple[int, int], MatrixSum]
    learned: list[int]


class Pair(Contact):
    """Contact of two bodies, each on a background of its own, with friction.

    Bodies on the same V stick where they touch; give them different ones, which may be made on the
    same mesh. Then they feel each other by contact alone, where their facets meet::

        touch = mpm.contact.Pair(a, b, friction=0.2)
        problem = mpm.QuasiStaticProblem([a, b], law, terms=[touch])

    Points on the facets of each body meet the facets of the other, with the pressure of
    :class:`Rigid` for the stiffness of both bodies one behind the other.

    Args:
        a: A body; what the contact tells is told at its points first.
        b: The other body.
        friction: As for :class:`Rigid`.
        facet_tags: Tags of the facets of a and of b, where not all of their boundaries may touch.
        tags: The tags of those that may.
        moduli: Moduli of a and b; those of their materials by default.
        passes: 2, or 1: points of a (best the body with the finer facets) against facets of b.
        penalty: As for :class:`Rigid`.
        tangential_penalty: As there.
        quadrature_degree: Degree of the rule on each facet; ``None`` is 9 in the plane and 5 in
            space, since the facets on the other side have kinks.
        axisymmetric: As there.
        law: As there: with ``"nitsche"`` each pass takes the stress of its own points' body.

    Raises:
        MPMError: What makes no sense.
    """

    @collective()
    def __init__(
        self,
        a: Particles,
        b: Particles,
        friction: float | Friction = 0.0,
        *,
        facet_tags: Sequence[mesh.MeshTags | None] = (None, None),
        tags: Sequence[int | None] = (None, None),
        moduli: Sequence[float | None] = (None, None),
        passes: int = 2,
        penalty: float = 1.0,
        tangential_penalty: float = 1.0,
        quadrature_degree: int | None = None,
        axisymmetric: bool = False,
        law: str = "penalty",
    ) -> None:
        for body in (a, b):
            if not isinstance(body, Particles):
                raise MPMError(f"A contact needs mpm.Particles, not {type(body).__name__}.")
        if a is b:
            raise MPMError(
                "A Pair needs two bodies, not the same one twice: places of one body that are in "
                "one cell of its V move together and never meet. Cut the body in two where it is "
                "to touch itself, with a V for each part, and tie them where they hang together."
            )
        if a.V is b.V:
            raise MPMError(
                "The bodies of a Pair are on the same V, which makes them stick; give each its "
                "own, such as a second function space on the same mesh."
            )
        if isinstance(passes, bool) or passes not in (1, 2):
            raise MPMError(f"A Pair has 1 or 2 passes, not {passes!r}.")
        for name, value in (("facet_tags", facet_tags), ("tags", tags), ("moduli", moduli)):
            if not isinstance(value, list | tuple) or len(value) != 2:
                raise MPMError(f"{name} of a Pair must be two, one for each body, not {value!r}.")
        rubs = as_friction(friction)
        super().__init__([a, b], rubs, axisymmetric, law)
        self._moduli = [None if m is None else as_positive(m, "modulus") for m in moduli]
        self._penalties = (
            as_positive(penalty, "penalty"),
            as_positive(tangential_penalty, "tangential_penalty"),
        )
        degree = DEGREES[a.mesh.geometry.dim] if quadrature_degree is None else quadrature_degree
        self._surfaces = [
            Surface(body, some, tag, degree, axisymmetric, "A Pair")
            for body, some, tag in zip((a, b), facet_tags, tags, strict=True)
        ]
        self._count, self._begins = passes, True
        self._passes: list[Pass] = []
        self._stiffnesses: list[NDArray[np.float64]] = []
        self._pattern: _Pattern | None = None

    # -- The term -------------------------------------------------------------------------------

    @override
    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        super().take_part(number, bodies, materials)
        if self._nitsche:
            for material in self._materials[: self._count]:
                require_stress(material, "a Pair")
        self._settle(self._joins)
        self._take_stress()
        if self._joins:
            gone = [contact for contact in self._gone if isinstance(contact, Pair)]
            self._stand_in([one for one in gone if set(one.bodies) == set(self.bodies)])
            for each in self._passes:
                require_apart(each.source, each.state.outcome, OVERLAPS)
            self._has_joined()

    def _stand_in(self, gone: Sequence[Pair]) -> None:
        """Take over where points stick from contacts that are gone (collective).

        Args:
            gone: Contacts of the same bodies.
        """
        every: list[dict[str, NDArray[Any]]] = []
        for before in gone:
            columns = [before.columns(place) for place in self._places]
            own = [{name: column.values for name, column in one.items()} for one in columns]
            alike = [one["area"].shape[2] for one in own] == [s.nq for s in self._surfaces]
            if alike and all("anchor" in one for one in own[: self._count]):
                every = [_both(*pair) for pair in zip(every, own, strict=True)] if every else own
        if not every:
            return
        self._take_over(every)
        for each, surface, mine in zip(self._passes, self._surfaces, every, strict=False):
            told = each.state.outcome._replace(**_told(surface, mine))
            each.state = each.state._replace(outcome=told)

    def _take_over(self, every: Sequence[dict[str, NDArray[Any]]]) -> None:
        """Take areas, and where points stick (collective).

        Args:
            every: What :meth:`columns` has of each body.
        """
        for surface, columns in zip(self._surfaces, every, strict=True):
            surface.restore(columns)
        self._settle(again=True)
        for each, surface, columns in zip(self._passes, self._surfaces, every, strict=False):
            known = [name for name in MEMORY if name in columns]
            each.restore(*(surface.of_column(columns[name]) for name in known))

    def _settle(self, again: bool = False) -> None:
        """Take the present meshes of the bodies (collective)."""
        new = [surface.settle() for surface in self._surfaces]
        if not any(new) and not again:
            return
        k = self._stiffnesses = [
            stiffness(surface, modulus, material, "A Pair")
            for surface, modulus, material in zip(
                self._surfaces, self._moduli, self._materials, strict=True
            )
        ]
        shares, surfaces = _shares(self._surfaces, self._count), self._surfaces
        self._passes = [
            Pass(
                surfaces[i],
                surfaces[1 - i],
                self.friction,
                self._penalties,
                (k[i], k[1 - i]),
                shares[i],
            )
            for i in range(self._count)
        ]
        self._begins = True
        self._take_stress()
        self._new_pattern()

    @override
    def pace(self, dt: float, share: float) -> None:
        super().pace(dt, share)
        if self._nitsche:
            k = [
                own + self._inertial(i, surface, dt)
                for i, (own, surface) in enumerate(
                    zip(self._stiffnesses, self._surfaces, strict=True)
                )
            ]
            for i, each in enumerate(self._passes):
                each.stiffen(k[i], k[1 - i])

    def _take_stress(self) -> None:
        """Take the stress behind the points of each pass, where the pressure is that."""
        if not self._nitsche:
            return
        spaces = [body.W for body in self.bodies]
        for each, material in zip(self._passes, self._materials, strict=False):
            assert material is not None
            each.stress = Nitsche(each.source, material, spaces)
            spaces = spaces[::-1]
        self._begins = True

    def _new_pattern(self) -> None:
        self._pattern = _Pattern(
            PairMatrices([body.W for body in self.bodies]),
            {(i, j): MatrixSum() for i in (0, 1) for j in (0, 1)},
            [each.learned for each in self._passes],
        )
        for each in self._passes:
            if each.stress is not None:
                each.stress.new_pattern()

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        """Begin a step; the last evaluation stays until the next, and may still be committed."""
        self._settle()
        for surface in self._surfaces:
            surface.look_at_deleted()
        self._begins = True
        return ()

    def _look(self) -> None:
        """Learn where facets are now (collective)."""
        if self._begins:
            self._begins = False
            for each in self._passes:
                each.of_step = self._of_step
                each.begin()
            self._new_pattern()
        for each in self._passes:
            each.look()

    @override
    def update(self) -> MPMError | None:
        self._look()
        try:
            for each in self._passes:
                each.evaluate()
        except np.linalg.LinAlgError:
            return ConvergenceError("Facets of a Pair collapse; take smaller steps")
        except MPMError as error:
            return error
        return None

    @override
    def smooth(self) -> bool:
        """Return false: contact is not smooth."""
        return not any(each.touches() for each in self._passes)

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        if self._begins or any(each.meeting is None for each in self._passes):
            self._look()
            for each in self._passes:
                each.evaluate()
        (first, second), *others = [meeting.forces() for meeting in self._meetings]
        for on_b, on_a in others:
            first.axpy(1.0, on_a)
            second.axpy(1.0, on_b)
        for force in (first, second):
            force.scale(-1.0 / self._share)
        return [first, second]

    @property
    def _meetings(self) -> list[Meeting]:
        """The last evaluation of each pass."""
        return [each.meeting for each in self._passes if each.meeting is not None]

    @override
    def _works(self) -> tuple[float, float]:
        normal, shear = np.sum([meeting.works for meeting in self._meetings], axis=0)
        return float(normal), float(shear)

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        if self._pattern is None or self._pattern.learned != [e.learned for e in self._passes]:
            self._new_pattern()
        assert self._pattern is not None
        matrices, sums, _ = self._pattern
        meetings = self._meetings
        groups = matrices.groups([meeting.met() for meeting in meetings])
        for meeting, (group, positions) in zip(meetings, groups, strict=True):
            meeting.add_tangents(1.0 / self._share, group, positions, matrices.values)
        found = {place: [K] for place, K in matrices.assembled().items()}
        for own, (each, meeting) in enumerate(zip(self._passes, meetings, strict=True)):
            if each.stress is not None:
                parts = each.stress.tangents(*meeting.by_stress(1.0 / self._share))
                for row, K in enumerate(parts if own == 0 else parts[::-1]):
                    if K is not None:
                        found.setdefault((row, own), []).append(K)
        return {place: sums[place].of(parts) for place, parts in found.items()}

    # -- What it remembers ----------------------------------------------------------------------

    @override
    def commit(self) -> Callable[[], None]:
        """Commit the step.

        Raises:
            ConvergenceError: One body has gone through the other.
        """
        failure: MPMError | None = None
        if any([each.leaks() for each in self._passes]):
            failure = ConvergenceError(
                "A body goes through the other one of a Pair in one step; take smaller steps"
            )
        if (failure := agreed(self._comm, failure)) is not None:
            raise failure
        passes = self._passes
        before = [each.state for each in passes]
        for each in passes:
            each.state = each.after()

        def undo() -> None:
            for each, state in zip(passes, before, strict=True):
                each.state = state

        return undo

    def _outcome(self) -> tuple[Surface, Outcome]:
        """Return the outcome at the points of a: with two passes they bear their share alone."""
        if not self._passes:
            raise MPMError("A contact belongs to no problem yet; give it as terms=[contact].")
        told, share = self._passes[0].state.outcome, self._passes[0].share
        return self._surfaces[0], told._replace(
            pressure=told.pressure / share, traction=told.traction / share
        )

    def _forces(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Return positions of all points, and the forces there on a."""
        if not self._passes:
            raise MPMError("A contact belongs to no problem yet; give it as terms=[contact].")
        found = []
        for number, each in enumerate(self._passes):
            outcome, surface, sign = each.state.outcome, each.source, 1.0 - 2.0 * number
            force = sign * surface.weights[:, :, None] * outcome.traction
            gdim = surface.gdim
            found.append((outcome.positions.reshape(-1, gdim), force.reshape(-1, gdim)))
        return found

    @property
    @override
    def friction_memory(self) -> NDArray[np.float64]:
        """Memory of the law of friction at the points of a."""
        self._outcome()
        return self._passes[0].state.memory.friction

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Force on a, shape ``(gdim,)``, on all ranks (collective); that on b is the opposite."""
        mine = np.sum([force.sum(axis=0) for _, force in self._forces()], axis=0)
        return np.asarray(self._comm.allreduce(mine))

    def moment(self, about: Any) -> NDArray[np.float64]:
        """Return the moment on a: see :meth:`Contact.moment`; that on b is the opposite."""
        parts = self._forces()
        return self._moment([x for x, _ in parts], [force for _, force in parts], about)

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        if body is None or body not in self._places:
            return {}
        number = self._places.index(body)
        surface = self._surfaces[number]
        columns = surface.columns()
        if number < len(self._passes):
            memory, outcome = self._passes[number].state
            shape = outcome.inside.shape
            columns["anchor"] = surface.column(memory.anchors.reshape(*shape, surface.gdim))
            columns["touches"] = surface.column(memory.touched.reshape(shape))
            columns["offset"] = surface.column(memory.offset.reshape(shape))
            if self.friction.memory:
                columns["friction"] = surface.column(memory.friction.reshape(*shape, -1))
            columns["slips"] = surface.column(outcome.slips)
            columns["pressure"] = surface.column(outcome.pressure)
            columns["traction"] = surface.column(outcome.traction)
        return columns

    @override
    def take(self, taken: Taken) -> None:
        self._settle()
        every = [taken.columns[place] for place in self._places]
        self._take_over(every)
        self.update()
        for each, surface, columns in zip(self._passes, self._surfaces, every, strict=False):
            told = each.after().outcome._replace(**_told(surface, columns))
            each.state = each.state._replace(outcome=told)

    @override
    def known_by(self) -> list[Any]:
        return [type(self).__name__, self._places, self._count]


def _both(one: dict[str, NDArray[Any]], other: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the columns of two contacts as one: what the second alone has, or touches."""
    found = {}
    for name, values in one.items():
        new = one["area"] == 0.0
        if name in MEMORY or name in OUTCOME.values():
            new = other["touches"] & ~one["touches"]
        found[name] = values
        if name in other and other[name].shape == values.shape:
            more = (1,) * (values.ndim - new.ndim)
            found[name] = np.where(new.reshape(*new.shape, *more), other[name], values)
    return found


def _told(surface: Surface, columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the outcome at the points of a surface, from columns."""
    return {name: surface.of_column(columns[column]) for name, column in OUTCOME.items()}


def _shares(surfaces: Sequence[Surface], count: int) -> list[float]:
    """Return the share of the load that each pass bears (collective).

    Points on facets of a size h see kinks of the other body's shape functions with an error of the
    order of h^2, so that the points of facets that are much finer bear more.
    """
    if count == 1:
        return [1.0]
    comm: MPI.Comm = surfaces[0].particles.mesh.comm
    squares = [
        float(np.median(np.concatenate(comm.allgather(surface.sizes)))) ** 2 for surface in surfaces
    ]
    if max(squares) < ALIKE**2 * min(squares):
        return [0.5, 0.5]
    first = float(np.clip(squares[1] / sum(squares), LEAST, 1.0 - LEAST))
    return [first, 1.0 - first]
