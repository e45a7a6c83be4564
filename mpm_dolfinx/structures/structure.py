# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A structure of lower dimension, as a term on the bodies that it lies in.

A node of it is where the body displaces the point that it lies in; B interpolates. With a bond it
slips from there besides, by ``z t`` in a step, t being the bar's direction and z an unknown. With f
the forces of stretches on the nodes, K their tangent and w those of the bond, the residual has
``B^T f`` on the bodies and ``t . f + w`` on z, and the tangent follows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, agree
from ..io.series import Drawing, drawing
from ..io.snapshot import Kept, Taken
from ..parallel.given import require_same, require_whole
from ..particles.particles import Particles, require_shared_nodes
from ..system.own import OwnUnknowns
from ..system.term import PointMaterial, Term
from .bond import Bond, Grip, Skin
from .hosts import Hosts, find_hosts
from .laws import Law
from .layout import Layout, chosen, layout_of
from .matrices import Matrices
from .stretching import Nodal, Rule, rule_of, stretched

__all__ = ["State", "Structure"]

type Array = NDArray[np.float64]


class State(NamedTuple):
    """A structure at the last converged step.

    Attributes:
        reference: Displacement of its nodes where it has no stretch, shape ``(N, gdim)``.
        offset: Force at no stretch, shape ``(m, q)``.
        slip: Of its nodes from the body; of those that are held their path, shape ``(N, gdim)``.
        bond: Force of the bond per length, zero at nodes without one, shape ``(N,)``.
        forces: Principal forces at its points, shape ``(m, q, c)``.
        reaction: Force that holds the nodes which are held, shape ``(gdim,)``.
    """

    reference: Array
    offset: Array
    slip: Array
    bond: Array
    forces: Array
    reaction: Array


class _Now(NamedTuple):
    """A structure in an evaluation.

    Attributes:
        nodal: What its stretches do.
        forces: The same on all nodes, shape ``(N, gdim)``.
        skin: What its bond does, if it has one.
        slip: See :class:`State`.
    """

    nodal: Nodal
    forces: Array
    skin: Skin | None
    slip: Array


class _Step(NamedTuple):
    """A structure at the beginning of a step.

    Attributes:
        present: 1 for each cell that is there, 0 for one in deleted particles, shape ``(m,)``.
        along: Directions in which nodes slip, shape ``(b, gdim)``.
    """

    present: Array
    along: Array


class Structure(Term):
    """A thin structure in bodies: what all its subclasses have (collective).

    Args:
        bodies: The body that it lies in, or several.
        shape: A mesh of lower dimension, or the points of a polyline.
        law: Forces by stretches.
        degree: Of shape functions in its cells; ``None``: that of the bodies.
        surfaces: Whether it may be a surface.
        held: A function of undeformed coordinates: which of its nodes are held in space.
        axisymmetric: Whether ``x[0]`` is a radius.
        bond: What holds it along its length; ``None``: its nodes do not slip.

    Attributes:
        results: What the principal forces at a point are called.
        layout: All its nodes, also within cells, and its cells.
        nodes: Its nodes as they are drawn, in the undeformed bodies, shape ``(N, gdim)``.
        cells: Nodes at the corners of its cells, shape ``(m, k)``.
        law: As given.
        state: At the last converged step.
        comm: The ranks.
        label: What it is called in checkpoints and files: its name, or its number among terms.
    """

    results: ClassVar[tuple[str, ...]]
    evaluation = "The structure"
    symmetric = True
    movable = True  # it finds its nodes on other ranks

    def __init__(
        self,
        bodies: Particles | Sequence[Particles],
        shape: Any,
        law: Law,
        degree: int | None,
        surfaces: bool,
        held: Callable[..., Any] | None,
        axisymmetric: bool,
        bond: Bond | None = None,
    ) -> None:
        super().__init__(_as_bodies(bodies, type(self).__name__))
        self.comm: MPI.Comm = self.bodies[0].mesh.comm
        gdim, what = self.bodies[0].mesh.geometry.dim, type(self).__name__
        self.axisymmetric, self.law, self.label = axisymmetric, law, ""
        drawn = layout_of(shape, self.comm, gdim, what, surfaces)
        self.nodes: Array = drawn.nodes
        self.cells: NDArray[np.int64] = drawn.cells
        if degree is None:
            degree = max(body.W.ufl_element().degree for body in self.bodies)
        require_whole(f"degree of a {what}", degree, 3, 1)
        self.layout: Layout = drawn.raised(degree)
        with agree(self.comm):
            if axisymmetric:
                _require_around(drawn, what)
            self._alone = _held(self.layout, held, what)
            self._grip = None if bond is None else Grip(bond, self.layout, axisymmetric, self.comm)
            if self._grip is not None and self._alone[self._grip.nodes].any():
                raise MPMError("Nodes that are held have no bond; leave them out by where=.")
        self.own = None if self._grip is None else self._grip.own
        where = None if self._grip is None else self._grip.nodes
        require_same(
            self.comm, **{"held=, where it holds,": self._alone, "where= of a Bond": where}
        )
        self._hosts: Hosts = find_hosts(self.bodies, self.layout.nodes, self._alone, what)
        self._path = np.zeros(gdim)
        whole, count = self.layout, len(self.results)

        def ruled(reference: Array) -> Rule:
            """Return its points where it is displaced to have no stretch."""
            return rule_of(whole, whole.nodes + reference, count, axisymmetric)

        self._ruled = ruled
        self.state = self._drawn()
        self._rule = self._ruled(self.state.reference)
        self._now: _Now | None = None
        bonded = 0 if self._grip is None else len(self._grip.nodes)
        self._slipped = np.zeros(bonded)
        self._matrices: Matrices | None = None
        self._step = _Step(np.ones(len(self.cells)), np.zeros((bonded, gdim)))

    # -- What it is -------------------------------------------------------------------------------

    @property
    def positions(self) -> Array:
        """Places of its nodes at the last converged step, shape ``(N, gdim)`` (collective)."""
        return self.places()[: len(self.nodes)]

    def places(self) -> Array:
        """Return the places of all nodes, also within cells; see :attr:`positions`."""
        return self.layout.nodes + self._hosts.displacement() + self.state.slip

    def grid(self) -> Drawing:
        """Return this rank's part of it for a file: the first has all (collective)."""
        now, rank = self.positions, self.comm.rank
        cells = self.cells if rank == 0 else self.cells[:0]
        places = (now, self.nodes) if rank == 0 else (now[:0], now[:0])
        fields = {name: values[: len(cells)] for name, values in self.fields().items()}
        return drawing(self.layout.kind, cells, places, fields)

    def fields(self) -> dict[str, Array]:
        """Return fields of its cells at the last converged step, ``(m,)``, by name."""
        return dict(zip(self.results, self._rule.means(self.state.forces).T, strict=True))

    def move(self, offset: Any) -> None:
        """Say where the nodes that are held are to be at the end of the next step.

        Args:
            offset: From where they are drawn, shape ``(gdim,)``.

        Raises:
            MPMError: No finite numbers, or no node is held.
        """
        given = np.asarray(offset, dtype=np.float64)
        if given.shape != self._path.shape or not np.isfinite(given).all():
            raise MPMError(f"offset must be {len(self._path)} finite numbers, not {offset!r}.")
        if not self._alone.any():
            raise MPMError(f"No node of this {type(self).__name__} is held (held=).")
        self._path = given.copy()

    @property
    def reaction(self) -> Array:
        """Force that holds the nodes which are held at the last converged step, ``(gdim,)``."""
        return self.state.reaction.copy()

    # -- Its state --------------------------------------------------------------------------------

    def _drawn(self) -> State:
        """Return the state of a structure without stress where its bodies are now (collective)."""
        reference = self._hosts.displacement()
        rule = self._ruled(reference)
        return State(
            reference,
            np.zeros(rule.weights.shape),
            np.zeros_like(self.layout.nodes),
            np.zeros(len(self.layout.nodes)),
            np.zeros((*rule.weights.shape, len(self.results))),
            np.zeros(self.layout.nodes.shape[1]),
        )

    def take(self, state: State) -> None:
        """Take a state for that of the last converged step."""
        self.state, self._now = state, None
        self._rule = self._ruled(state.reference)
        if state.slip[self._alone].any():
            self._path = state.slip[self._alone][0].copy()

    def continued(self, other: Self) -> State:
        """Return the state with which it goes on in place of one that is drawn alike (collective).

        Args:
            other: The other, at its last converged step.
        """
        bonded = np.zeros(len(self.layout.nodes))
        if self._grip is not None:
            bonded[self._grip.nodes] = 1.0
        return other.state._replace(bond=bonded * other.state.bond)

    @override
    def come_after(self, gone: Sequence[Term]) -> None:
        """Begin without stress where the bodies are, or as the one in whose place it comes.

        That is one of the same kind that is drawn in the same way; of several the one that is
        called so, or has the same law.

        Raises:
            MPMError: It is not to be told which of several, or what it is cannot go on.
        """
        alike = [one for one in gone if isinstance(one, type(self))]
        alike = [one for one in alike if one.layout.is_same(self.layout)]
        called = [one for one in alike if one.name == self.name is not None]
        alike = called or [one for one in alike if one.law == self.law] or alike
        if any(not _is_same(one.state, alike[0].state) for one in alike):
            raise MPMError(
                f"Several of {type(self).__name__} were drawn like this one, and it is not to be "
                "told in whose place it comes; give it the name of that one."
            )
        self.take(self.continued(alike[0]) if alike else self._drawn())

    @override
    def kept(self) -> Sequence[Kept]:
        return [_KeptState(self, self.own, self.label)]

    @override
    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        """Take note of its number, and find its nodes where bodies have other meshes."""
        self.label = self.name or f"structure{number}"
        if not self._hosts.known:
            what = type(self).__name__
            self._hosts = find_hosts(self.bodies, self.layout.nodes, self._alone, what)
            self._matrices = None

    # -- A step -----------------------------------------------------------------------------------

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        """Begin a step; the last evaluation stays until the next, and may still be committed."""
        require_same(self.comm, offset=self._path)
        there = self._hosts.present()[self.layout.cells].all(axis=1)
        along = self._step.along
        if self._grip is not None:
            along = self._grip.directions(self.places())
        self._step = _Step(there.astype(np.float64), along)
        return ()

    def _evaluated(self) -> _Now:
        """Return the structure at the present displacements (collective)."""
        if self._now is not None:
            return self._now
        slip, skin = self.state.slip.copy(), None
        slip[self._alone] = self._path
        if self._grip is not None:
            slip[self._grip.nodes] += self._slipped[:, None] * self._step.along
        places = self.layout.nodes + self._hosts.displacement() + slip
        nodal = stretched(self._rule, self.law, places, self.state.offset, self._step.present)
        if self._grip is not None:
            before = self.state.bond[self._grip.nodes]
            resists = (self._step.present > 0.0) & ~nodal.special.all(axis=1)
            skin = self._grip.skin(before, self._slipped, resists)
        forces = np.zeros_like(self.layout.nodes)
        np.add.at(forces, self.layout.cells, nodal.forces)
        self._now = _Now(nodal, forces, skin, slip)
        return self._now

    @override
    def update(self) -> MPMError | None:
        if self._grip is not None:
            self._slipped = self._grip.own.values.copy()
        self._now = None
        now = self._evaluated()
        if self._grip is not None and now.skin is not None:
            pull = np.sum(now.forces[self._grip.nodes] * self._step.along, axis=1)
            sizes = np.zeros(len(self.layout.nodes))
            np.add.at(sizes, self.layout.cells, np.linalg.norm(now.nodal.forces, axis=2))
            own = self._grip.own
            own.residual = pull + now.skin.forces
            own.size = float(np.linalg.norm(sizes[self._grip.nodes] + np.abs(now.skin.forces)))
        return None

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        return self._hosts.forces(self._evaluated().forces)

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        now, grip = self._evaluated(), self._grip
        if self._matrices is None:
            slips = np.zeros(0, dtype=np.int64) if grip is None else grip.nodes
            layout = None if grip is None else grip.own.layout
            self._matrices = Matrices(self._hosts, self.layout.cells, slips, layout, self.comm)
        bond = np.zeros(0) if now.skin is None else now.skin.tangent
        return self._matrices.of(now.nodal.tangent, self._step.along, bond)

    @override
    def commit(self) -> Callable[[], None]:
        before, now = self.state, self._evaluated()
        bond = before.bond.copy()
        if self._grip is not None and now.skin is not None:
            bond[self._grip.nodes] = now.skin.bears
        self.state = State(
            before.reference,
            now.nodal.offset,
            now.slip,
            bond,
            now.nodal.principal,
            now.forces[self._alone].sum(axis=0),
        )
        self.roll_back()

        def undo() -> None:
            self.state, self._now = before, None

        return undo

    @override
    def roll_back(self) -> None:
        self._slipped, self._now = np.zeros_like(self._slipped), None

    @property
    @override
    def one_sided(self) -> bool:
        return not self.law.compression

    @override
    def smooth(self) -> bool:
        now = self._evaluated()
        return not (now.nodal.special.any() or (now.skin is not None and now.skin.slips.any()))

    @override
    def drives(self) -> bool:
        return bool(np.any(self.state.slip[self._alone] != self._path))


def _is_same(one: State, other: State) -> bool:
    return all(map(np.array_equal, one, other))


def _require_around(drawn: Layout, what: str) -> None:
    """Raise an error unless all cells lie around the axis of a body of revolution."""
    if drawn.nodes.shape[1] != 2:
        raise MPMError(f"An axisymmetric {what} lies in the (r, z) plane.")
    radius = drawn.nodes[:, 0]
    if radius.min() < 0.0:
        raise MPMError(f"A node of an axisymmetric {what} has a negative radius.")
    if (radius[drawn.cells] == 0.0).all(axis=1).any():
        raise MPMError(
            f"A cell of an axisymmetric {what} lies on the axis, with nothing around it."
        )


def _held(layout: Layout, held: Callable[..., Any] | None, what: str) -> NDArray[np.bool_]:
    """Return which nodes are held."""
    if held is None:
        return np.zeros(len(layout.nodes), dtype=bool)
    alone = chosen(held, layout, "held=")
    if not alone.any():
        raise MPMError(f"held= holds at no node of the {what}.")
    return alone


def _as_bodies(bodies: Any, what: str) -> list[Particles]:
    """Return the bodies that a structure lies in."""
    every: list[Any] = list(bodies) if isinstance(bodies, list | tuple) else [bodies]
    for body in every:
        require_shared_nodes(f"A {what}", body)
        if body.trail.rebases > 0:
            raise MPMError(f"A {what} cannot be drawn in a body whose mesh was rebased.")
    if not every or len({id(body) for body in every}) < len(every):
        raise MPMError(f"A {what} needs one body or several that differ.")
    return every


class _KeptState(Kept):
    """The state of a structure, the same on all ranks.

    Args:
        structure: The structure.
        own: Its unknowns, if it has any.
        key: See :class:`Kept`.
    """

    def __init__(self, structure: Structure, own: OwnUnknowns | None, key: str) -> None:
        self._structure, self._own, self.key = structure, own, key

    @override
    def numbers(self) -> dict[str, Any]:
        state = self._structure.state
        past = [] if self._own is None else self._own.past
        known = [[size, *(part.tolist() for part in parts)] for size, parts in past]
        return {
            **{name: value.tolist() for name, value in state._asdict().items()},
            "shapes": [list(value.shape) for value in state],
            "past": known,
        }

    @override
    def require(self, source: str, taken: Taken) -> None:
        shapes = [list(value.shape) for value in self._structure.state]
        if taken.numbers.get("shapes") != shapes:
            raise MPMError(f"{source} holds another structure under the key {self.key!r}.")

    @override
    def restore(self, taken: Taken) -> None:
        values = zip(State._fields, taken.numbers["shapes"], strict=True)
        state = [np.array(taken.numbers[name], dtype=float).reshape(n) for name, n in values]
        self._structure.take(State(*state))
        if self._own is not None:
            self._own.past = [(size, [np.array(part)]) for size, part in taken.numbers["past"]]
