# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles: a body mesh whose displacement is carried by a background space."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NoReturn

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from ..background.basis import BackgroundBasis, PointBasis
from ..background.ownership import ranks_of_background
from ..errors import MPMError, ParticleOutsideError, agree
from ..meshes.boxes import mesh_of_boxes
from ..meshes.quadrature import default_degree
from ..meshes.redistribution import Carrier, Redistribution, cell_centres
from ..meshes.remesh import Column, Cuts, Remesh
from ..meshes.trail import Trail
from ..parallel.boundary import collective
from ..parallel.given import require_same
from ..reals import is_one_of
from ..transfer.cpdi import CPDI2
from ..transfer.elements import FiniteElements
from ..transfer.method import CornerBasis, DomainState, ParticleState
from ..transfer.methods import METHODS
from ..transfer.transfer import Transfer
from ..transfer.weights import Weights, domain_weights, sum_by_particle
from .field import ParticleField
from .free import FreeNodes, chosen_nodes
from .geometry import Geometry
from .options import (
    Coordinates,
    validate_cells,
    validate_distortion,
    validate_free,
    validate_options,
    validate_spaces,
)
from .reference import Reference
from .response import MaterialDomains
from .undeformed import Undeformed

__all__ = ["LoadFactor", "Particles"]


class LoadFactor(fem.Constant):
    """The load factor of one body, which the problem of that body sets."""


class Particles(MaterialDomains):
    """A body as particles with finite domains, moved by a background space.

    Each cell of ``body`` is the domain of one particle. The body mesh is the undeformed body
    and never moves; where the particles are is ``displacement``. A step's increment u in V
    moves the nodes of the domains by ``T u``. The methods differ in T alone:

    - ``"cpdi2"``: corners ride on the background (Sadeghirad, Brannon & Guilkey 2013);
    - ``"cpdi"``: parallelograms that the particle's F deforms (Sadeghirad, Brannon &
      Burghardt 2011);
    - ``"gimp"``: axis-aligned boxes (Bardenhagen & Kober 2004), on structured backgrounds of
      rectangles or boxes;
    - ``"mpm"``: points (Sulsky, Chen & Schreyer 1994).

    Without V there is no background: the nodes have unknowns of their own, T is the identity, and
    the body is one of total Lagrangian finite elements, with Dirichlet conditions on ``W`` as in
    any DOLFINx script. It goes on as long as its mesh does.

    With V and ``free=`` both kinds are in one body: nodes that are free have unknowns of their own,
    the others are carried by the background. The elements between are those of the body's mesh, so
    that nothing couples the two but what they share. Conditions on ``W`` hold free nodes; where a
    condition on V holds all of the background around a free node, it holds the node too.

    Args:
        body: Undeformed body: triangles or quadrilaterals in the plane, tetrahedra or
            hexahedra in space. Its cells are the particles.
        V: Vector Lagrange space on the background mesh, on the same ranks; ``None``: finite
            elements.
        method: ``"cpdi2"`` (default), ``"cpdi"``, ``"gimp"`` or ``"mpm"``; without V ``"fem"``.
        degree: Degree of the domains' shape functions.
        quadrature_degree: Degree of the rule that carries the history; ``None`` is one point
            per domain for degree 1, and for finite elements the least without hourglass modes.
        outside: What happens when a step takes a corner of a domain out of the background:
            ``"error"`` ends the run with an error, ``"stop"`` without one (both before that
            step), ``"delete"`` goes on without the domain and adds up what is lost. What has passed
            a boundary whose nodes are held, by less than a cell, stays there and has not left.
        domain_update: For ``"gimp"``: ``"stretch"`` (half-lengths follow the diagonal of the
            right stretch) or ``"fixed"`` (the box only translates).
        partition: ``"given"`` leaves the cells of ``body`` on their ranks; ``"background"``
            makes ``mesh`` a copy of it whose cells are on the ranks that own the background
            where they lie, or in even compact parts where a rank would get too many.
        on_distortion: What a problem with a material does about quadrilaterals that a step has
            made concave: ``"error"`` nothing, until one crosses itself; ``"split"`` cuts them into
            two triangles each.
        free: Which nodes are free at the beginning: a function of undeformed coordinates, shape
            ``(3, n)``, such as ``mpm.region(...)``; ``(cell_tags, tag)``, or with a list of tags:
            all nodes of these cells; or local nodes of W, ``[]`` for none yet. ``"auto"``: all are,
            each until the domains around it are distorted or about to leave the background.
            ``None``: no node is ever free.

    Attributes:
        mesh: The body mesh, undeformed: ``body``, or its copy with ``partition="background"``.
        V: The background space; of finite elements ``W``.
        W: Space of the domains' displacement.
        displacement: Total displacement d in W.
        increment: The background displacement u in V of the step being solved.
        load: The load factor, a Constant on the body mesh.
        proportional: A Constant, 1 as long as displacements of supports grow with the load factor,
            0 from the first path on, which takes them as they are.
        dx: Measure with the rule that carries the history.
        dx_exact: Measure exact for body force and mass.
        num_local: Number of particles this rank owns.
        num_global: Number of particles of all ranks.
        global_index: Input index of each owned particle, shape ``(n,)``, the same on any number
            of ranks.
        domain_nodes: Local nodes of W of each owned domain, shape ``(n, k)``.
        outside: The policy for domains that leave the background.
        deletion: Which domains are deleted, with ``outside="delete"``, otherwise ``None``.
        on_distortion: As given.
        undeformed: The undeformed body, where its mesh does not show it too.
        shares_nodes: Whether neighbours share their nodes, as with ``"cpdi2"``.
        rebases: How often the nodes of the mesh were moved.
        free_nodes: The free nodes as the system moves them; ``None`` without ``free=``.
        frees_by_itself: Whether nodes are free as long as the domains around them are good.

    Raises:
        MPMError: Spaces, meshes, method or degrees that do not go together.
        ParticleOutsideError: The body does not lie inside the background.
        DomainDistortionError: A cell of the body is degenerate.
    """

    @collective("free")
    def __init__(
        self,
        body: mesh.Mesh,
        V: fem.FunctionSpace | None = None,
        method: str | None = None,
        degree: int = 1,
        quadrature_degree: int | None = None,
        outside: str = "error",
        domain_update: str = "stretch",
        partition: str = "given",
        on_distortion: str = "error",
        free: Any = None,
    ) -> None:
        validate_spaces(body, V)
        if method is None:
            method = (FiniteElements if V is None else CPDI2).name
        require_same(body.comm, free=free is not None)
        own = V is None or free is not None
        validate_options(body, V, method, degree, quadrature_degree, outside, domain_update, own)
        validate_distortion(body, method, degree, quadrature_degree, on_distortion)
        if free is not None:
            validate_free(V, method, on_distortion)
        if not is_one_of(partition, ("given", "background")) or (
            V is None and partition != "given"
        ):
            raise MPMError(
                f"Unknown partition={partition!r}; choose 'given'"
                + (" or 'background'." if V is not None else ", as there is no background.")
            )
        validate_cells(body, "body")
        self.method = method
        self.outside = outside
        self.on_distortion = on_distortion
        if own:
            quadrature_degree = quadrature_degree or default_degree(
                body.basix_cell().name, degree, free=True
            )
        self._degrees = degree, quadrature_degree
        self._domain_update = domain_update
        self._trail = Trail()
        if V is not None:
            validate_cells(V.mesh, "background")
            self._ride_on(V)
        if partition == "background":
            ranks = ranks_of_background(self.V, self._background, cell_centres(body))
            self._trail.append(move := Redistribution(body, ranks))
            body = move.mesh
        self._has_free, self.frees_by_itself = free is not None, _is_auto(free)
        self._settle(body, outside == "delete")
        if self.free_nodes is not None:
            if isinstance(free, tuple):
                free = tuple(self.carry(part) for part in free)
            self.choose_free(chosen_nodes(self.W, free))
        self._method.require(body, self.initial_domains, self.global_index)
        self.geometry.require_volume(self.quadrature)
        self.locate()

    def _ride_on(self, V: fem.FunctionSpace) -> None:
        """Take the space that moves the nodes (collective)."""
        self.V = V
        self.increment = fem.Function(V, name="increment")
        self._background = BackgroundBasis(V)
        self._background_coordinates = Coordinates(V.mesh, "background")
        self._method = METHODS[self.method](V, self._domain_update)

    def __copy__(self) -> NoReturn:
        """Raise an error: a copy would have the mesh, the load and the displacement in common."""
        raise MPMError("Particles cannot be copied; make others: mpm.Particles(body, V, ...).")

    def __deepcopy__(self, memo: Any) -> NoReturn:
        """Raise an error: a body cannot be copied."""
        self.__copy__()

    def __del__(self) -> None:
        """Let go of the meshes here, where no exception is on its way.

        A call that Python refuses, as one with a misspelt keyword, drops its arguments while the
        exception is set. mpi4py's clean-up of a mesh's communicator then leaves a lock shut, and
        the next one that needs it waits for ever.
        """
        if not sys.is_finalizing():
            vars(self).clear()

    def __repr__(self) -> str:
        return f"<Particles: {self.in_words()}>"

    def in_words(self) -> str:
        """Return a short description of the particles and the method that carries them."""
        cells, degree = self.V.mesh.topology, self.W.ufl_element().degree
        kind = self.V.mesh.basix_cell().name
        kinds = kind.removesuffix("on") + "a" if kind.endswith("hedron") else kind + "s"
        points = f"{self.num_points} point{'s' if self.num_points > 1 else ''} each"
        if self.is_free:
            return (
                f"{self.num_global} {self.mesh.basix_cell().name} finite elements of degree "
                f"{degree}, {points}"
            )
        own = "" if self.free_nodes is None else ", some nodes free"
        return (
            f"{self.num_global} {self.mesh.basix_cell().name} domains ({self.method}, degree "
            f"{degree}, {points}{own}) in a background of {cells.index_map(cells.dim).size_global} "
            f"{kinds} of degree {self.V.ufl_element().degree}"
        )

    def _settle(
        self, body: mesh.Mesh, deletable: bool, cut: bool = False, moved: bool = False
    ) -> None:
        """Live on a body mesh, where nothing is displaced: at the start and after each move.

        Args:
            body: The mesh (collective).
            deletable: Whether domains may be deleted.
            cut: Whether domains were cut since the start.
            moved: Whether the mesh's nodes are elsewhere than in the undeformed body.
        """
        family = "Lagrange" if METHODS[self.method].shares_nodes else "Discontinuous Lagrange"
        geometry = Geometry(body, family, *self._degrees)
        self._live_on(geometry, Undeformed(geometry, cut, moved), deletable)
        self._coordinates = Coordinates(body, "body")
        if METHODS[self.method].free:
            self._ride_on(self.W)
        self.load = LoadFactor(body, 0.0)
        self.proportional = fem.Constant(body, 1.0)
        self._converged = np.zeros_like(self.geometry.nodes)
        self.free_nodes = FreeNodes(self) if self._has_free else None
        self._transfer: Transfer | None = None

    @classmethod
    def from_points(
        cls,
        points: NDArray[np.float64],
        lengths: NDArray[np.float64] | float,
        V: fem.FunctionSpace,
        method: str = "gimp",
        **options: Any,
    ) -> Particles:
        """Make particles of a cloud of axis-aligned boxes, without a mesh.

        Args:
            points: Centres of this rank's boxes, shape ``(n, gdim)``; each box is given by
                one rank.
            lengths: Side lengths, a number or shape ``(n, gdim)``.
            V: As for :class:`Particles`.
            method: As for :class:`Particles`. With ``"cpdi2"`` neighbours are not connected.
            **options: As for :class:`Particles`.

        Raises:
            MPMError: Shapes that do not fit, or lengths that are not positive.
        """
        if not isinstance(V, fem.FunctionSpace):
            raise MPMError(
                f"V must be a dolfinx FunctionSpace on the background, not {type(V).__name__}."
            )
        body = mesh_of_boxes(V.mesh.comm, points, lengths, V.mesh.geometry.dim)
        return cls(body, V, method=method, **options)

    def carry(self, thing: Any) -> Any:
        """Return tags or a DG0 Function on ``mesh``, to which cells have moved (collective).

        Args:
            thing: ``MeshTags`` or a piecewise constant Function on the body mesh that was given,
                or on a ``mesh`` of before one of the last eight moves; anything else is returned
                as it is.

        Raises:
            MPMError: A Function that is not piecewise constant.
        """
        return self._trail.carry(thing)

    def boundary(self) -> NDArray[np.int32]:
        """Return this rank's own facets of ``mesh`` on the body's boundary (collective).

        Where quadrilaterals were cut in two, halves do not share their diagonal: DOLFINx takes it
        for a boundary, and this does not.
        """
        return self._trail.boundary(self.mesh)

    def ranks_of_background(self) -> NDArray[np.int64]:
        """Return the rank on which each particle would best be now, shape ``(n,)`` (collective).

        That which owns the background where the particle is; where a rank would get more than
        5 % above an even share, that of the compact part that the particle is in. Finite elements
        stay where they are.
        """
        if self.is_free:
            return np.full(self.num_local, self.mesh.comm.rank, dtype=np.int64)
        return ranks_of_background(self.V, self._background, self.centroid)

    def move(self, ranks: NDArray[np.int64]) -> None:
        """Move particles to other ranks, undeformed (collective).

        ``mesh``, ``W``, ``displacement`` and ``load`` are new ones then. What else there is to
        be moved is the business of :meth:`QuasiStaticProblem.repartition`.

        Args:
            ranks: New rank of each particle this rank owns, shape ``(n,)``.
        """
        self._take(Redistribution(self.mesh, ranks), self.undeformed.origin is not None)

    def rebase(self, cuts: Cuts, positions: NDArray[np.float64] | None = None) -> Remesh:
        """Cut quadrilaterals of the mesh in two, or move its nodes (collective).

        As in :meth:`move`, the rest is the business of :meth:`QuasiStaticProblem.split` and
        :meth:`QuasiStaticProblem.rebase`.

        Args:
            cuts: Which are cut, the same on all ranks.
            positions: Where the domains' nodes are to be, shape ``(n, k, gdim)``, if elsewhere.
        """
        own = self.W if positions is not None and self.W.ufl_element().degree > 1 else None
        move = Remesh(self.mesh, cuts, positions, own)
        self._take(
            move, positions is not None or self.undeformed.origin is not None, cuts, positions
        )
        return move

    def _take(
        self,
        move: Carrier,
        moved: bool,
        cuts: Cuts | None = None,
        positions: NDArray[np.float64] | None = None,
    ) -> None:
        """Live on another mesh (collective)."""
        before: Reference | None = None
        if positions is not None:
            before = self.present_reference()
        elif cuts is None and self.undeformed.differs:
            before = self.undeformed.reference
        self._trail.append(move, cuts, positions is not None)
        self._settle(move.mesh, self.deletion is not None, len(self.cuts) > 0, moved)
        if before is not None:  # at once, for what is made of the undeformed body
            self.undeformed.refer(Reference(*(move.of_cells(values) for values in before)))

    def require_meshes_as_they_were(self) -> None:
        """Raise an error where coordinates of body or background have changed on this rank.

        Raises:
            MPMError: They have.
        """
        for coordinates in (self._coordinates, self._background_coordinates):
            coordinates.require_same()

    @property
    def cuts(self) -> Cuts:
        """Which quadrilaterals were cut, in the order of the cuts, shape ``(m, 2)``."""
        return self._trail.cuts

    @property
    def rebases(self) -> int:
        """How often the nodes of the mesh were moved."""
        return self._trail.rebases

    @property
    def origin_index(self) -> NDArray[np.int64]:
        """Input index of the domain that each particle is, or is half of, shape ``(n,)``."""
        return self._trail.origin_index(self.global_index, self.num_global)

    @property
    def halves(self) -> NDArray[np.bool_]:
        """Whether each particle is half of a quadrilateral, shape ``(n,)``."""
        return self._trail.halves(self.global_index, self.num_global)

    @property
    def shares_nodes(self) -> bool:
        """Whether neighbours share their nodes, so that the body hangs together."""
        return self._method.shares_nodes

    @property
    def is_free(self) -> bool:
        """Whether all nodes have unknowns of their own, without a background."""
        return self._method.free

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which of this rank's nodes of W have unknowns of their own, ghosts too, shape ``(N,)``.

        With ``free=`` it can be set between runs, to what that takes (collective): where a node is
        carried from now on nothing changes, as what is in equilibrium stays so with fewer unknowns;
        where one becomes free the next step finds a better equilibrium.
        """
        if self.free_nodes is not None:
            return self.free_nodes.chosen.copy()
        return np.full(len(self.geometry.nodes), self.is_free)

    @free.setter
    @collective("where")
    def free(self, where: Any) -> None:
        with agree(self.mesh.comm):
            if self.free_nodes is None:
                raise MPMError(
                    "Nodes can be free where the particles were made so; make them with free=[] if "
                    "none is to be free at first."
                )
        self.frees_by_itself = _is_auto(where)
        self.choose_free(chosen_nodes(self.W, where))

    def choose_free(
        self, chosen: NDArray[np.bool_], spent: NDArray[np.bool_] | None = None
    ) -> None:
        """Let others of this rank's nodes of W, ghosts too, be free from the next step on.

        Args:
            chosen: The free ones.
            spent: Those that stay carried, as the domains around them were bad; ``None``: none.
        """
        assert self.free_nodes is not None
        self.free_nodes.choose(chosen, np.zeros_like(chosen) if spent is None else spent)
        self._transfer = None

    @property
    def moves_at_nodes(self) -> bool:
        """Whether the rows of T are values of the background at the domains' corners."""
        return self._method.at_nodes

    def locate(self) -> None:
        """Find the background cells of all domain nodes, unless that is done (collective).

        Raises:
            ParticleOutsideError: A domain of the last converged step is not wholly inside the
                background.
        """
        if self._transfer is not None:
            return
        rows = self._rows()
        self._require_inside(
            rows,
            self._lost(rows),
            "The domains of {particles} are",
            "make the background larger or the load smaller",
        )
        self._transfer = self._transfer_by(rows)

    @property
    def transfer(self) -> Transfer:
        """T and what follows from it, at the last converged positions (collective)."""
        self.locate()
        assert self._transfer is not None
        return self._transfer

    def forget_transfer(self) -> None:
        """Drop T, which is made anew when it is needed."""
        self._transfer = None

    def _state(
        self, displacement: NDArray[np.float64], gradient: Callable[[], NDArray[np.float64]]
    ) -> DomainState:
        """Return where nodes displaced ``(N, gdim)`` and ``F - I`` at points put the domains."""
        nodes, corners = self.geometry.nodes, self.geometry.corners

        def centred() -> ParticleState:
            return ParticleState(
                self.initial_centroid,
                self.mean(corners + self.of_domains(displacement)),
                # methods that ask for it have one point
                np.eye(self.geometry.gdim) + gradient()[:, 0],
            )

        return DomainState(nodes, displacement, self.domain_nodes, self.of_domains, centred)

    def _at_converged(self) -> DomainState:
        """Return where the domains are at the last converged step."""
        return self._state(self._converged, self.converged_gradient)

    def _rows(self) -> CornerBasis:
        """Return the rows of T at the last converged step, zero for free nodes (collective)."""
        rows = self._method.rows(self._at_converged(), self._background)
        if self.free_nodes is not None:
            self.free_nodes.take(rows.basis)
        return rows

    def _converged_corners(self) -> NDArray[np.float64]:
        """Return the positions of the domains' nodes, last converged, ``(n, k, gdim)``."""
        return np.asarray(self.geometry.corners + self.of_domains(self._converged))

    def _lost(self, rows: CornerBasis) -> NDArray[np.int64]:
        """Return the local domains that are not wholly in the background."""
        lost = (~rows.basis.found)[self.domain_nodes].any(axis=1)
        return np.flatnonzero(lost & ~self.deleted)

    def _transfer_by(self, rows: CornerBasis) -> Transfer:
        """Return the transfer by rows, without the weight of deleted domains' own nodes."""
        if self.deletion is not None:
            values = rows.basis.values.copy()
            values[self.deletion.dead[: len(values)]] = 0.0
            rows = rows._replace(basis=rows.basis._replace(values=values))
            if rows.corners is not None:
                rows.corners[self.deleted] = self.converged_domains[self.deleted]
            if self.free_nodes is not None:
                self.free_nodes.leave(self.deletion.dead)
        return Transfer(rows, self.W, self.V)

    def _require_inside(
        self, rows: CornerBasis, lost: NDArray[np.int64], what: str, advice: str
    ) -> None:
        with agree(self.mesh.comm):
            if len(lost):
                corners = self.converged_domains if rows.corners is None else rows.corners
                out = ~rows.basis.found[self.domain_nodes[lost[0]]]
                where = corners[lost[0]][out][0]
                where = np.where(np.abs(where) < 1e-12 * np.abs(where).max(), 0.0, where)
                place = tuple(float(f"{c:.6g}") for c in where)
                error = ParticleOutsideError(
                    f"{what} outside the background mesh, e.g. at {place}; {advice}",
                    self.global_index[lost],
                )
                error.where = place
                raise error

    @collective()
    def field(
        self, V: fem.FunctionSpace, at: str = "points", kind: str = "total", name: str = "field"
    ) -> ParticleField:
        """Return another unknown on this body, for ``ParticleProblem(..., fields=[...])``.

        Its values are those of a background space where the body is: ``p = T_p x``. The space may
        have another degree, shape and mesh than that of the displacement.

        Args:
            V: Background space: scalar, vector or tensor Lagrange elements, continuous or not.
            at: Where the body has values: at the ``"points"`` of ``particles.dx``, for forms
                without the gradient of the field, or at the ``"nodes"`` of a Lagrange space of
                the same degree on the body mesh, for those with it.
            kind: ``"total"``: the background has the values themselves; ``"increment"``: it has
                the change in each step, ``p = p_n + T_p x``, for what does not diffuse;
                ``"body"``: T_p is that of the undeformed body in all steps.
            name: Its name: an identifier, another one for each field of a body.

        Raises:
            MPMError: A space or options that do not go together.
        """
        return ParticleField(self, V, at, kind, name)

    def converged_points(self) -> NDArray[np.float64]:
        """Return positions of all history's points, last converged, ``(n, nq, gdim)``."""
        return self.at_points(self._converged_corners())

    def present_reference(self) -> Reference:
        """Return the undeformed body as a mesh shows it that has the last converged positions."""
        return self.undeformed.reference._replace(gradient=self.converged_gradient())

    def converged_gradient(self) -> NDArray[np.float64]:
        """Return ``F - I`` at the history's points, last converged, ``(n, nq, gdim, gdim)``."""
        return self.undeformed.gradient_of(self.of_domains(self._converged))

    def leaving(self) -> NDArray[np.int64]:
        """Return which of this rank's particles the last step took out (collective).

        Returns:
            Their local indices, with ``outside="delete"``; without it there are none.

        Raises:
            ParticleOutsideError: Some are outside and shall not be deleted, or all would be.
        """
        if self.deletion is None or self.outside != "delete":
            self.locate()
            return np.zeros(0, dtype=np.int64)
        rows = self._rows()
        lost = self._lost(rows)
        left = self.num_local - int(self.deleted.sum()) - len(lost)
        if self.mesh.comm.allreduce(left) == 0:
            self._require_inside(
                rows,
                lost,
                "The domains of {particles}, the last that were not deleted, are",
                "make the background larger or the load smaller",
            )
        self._transfer = self._transfer_by(rows)
        return lost

    def delete(self, domains: NDArray[np.int64]) -> None:
        """Delete domains (collective), after :meth:`leaving`.

        Args:
            domains: Local indices of this rank's particles.
        """
        assert self.deletion is not None
        self.deletion.add(domains, self.of_domains(self._converged))
        self._transfer = self._transfer_by(self.transfer.rows)

    def remove(self, domains: NDArray[np.int64]) -> None:
        """Delete domains that the user takes away, whatever ``outside`` is (collective).

        The rest is the business of :meth:`QuasiStaticProblem.remove`.

        Args:
            domains: Local indices of this rank's particles.
        """
        self.allow_deletion(True)
        self.delete(domains)

    @property
    def T(self) -> PETSc.Mat:
        """The transfer: all dofs of W by all dofs of V, at the last converged positions.

        Rows of free nodes are zero.
        """
        return self.transfer.T

    @property
    def active_nodes(self) -> NDArray[np.int32]:
        """Nodes of V with weight that this rank owns, local numbers, sorted."""
        return self.transfer.active_nodes

    @property
    def active_dofs(self) -> NDArray[np.int64]:
        """Global dofs of V with weight that this rank owns, sorted."""
        bs = self.V.dofmap.index_map_bs
        start = self.V.dofmap.index_map.local_range[0]
        return np.asarray(
            ((self.active_nodes + start)[:, None] * bs + np.arange(bs)).ravel(), dtype=np.int64
        )

    def weights(self) -> Weights:
        """Return the published weights S_ip and grad S_ip of the current configuration.

        Returns:
            Compressed rows, one for each particle this rank owns (Sadeghirad, Brannon &
            Guilkey 2013; their body force uses these, ours integrates over the undeformed
            body, which is the same for triangles and undistorted quadrilaterals).
        """
        _, average, gradient = self._domain_averages()
        weights = sum_by_particle(average, gradient, self.node_basis, self.domain_nodes)
        return weights if self.deletion is None else weights.without(self.deleted)

    @property
    def domains(self) -> NDArray[np.float64]:
        """Corners of the particles' own domains at the present displacement, ``(n, k, gdim)``.

        For cpdi2 they are those of the displaced body mesh, for cpdi parallelograms, for gimp
        boxes; for mpm, whose particles are points, parallelograms of their volume.
        """
        present = np.asarray(self.displacement.x.array, dtype=np.float64)
        present = present.reshape(-1, self.geometry.gdim)
        return self._method.domains(self._state(present, self.displacement_gradient))

    @property
    def converged_domains(self) -> NDArray[np.float64]:
        """Corners of the particles' own domains at the last converged step, ``(n, k, gdim)``."""
        return self._method.domains(self._at_converged())

    @property
    def converged_displacement(self) -> NDArray[np.float64]:
        """Displacement at the last converged step, on the local dofs of W."""
        return self._converged.ravel()

    @property
    def node_positions(self) -> NDArray[np.float64]:
        """Positions of this rank's nodes of W at the last converged step, shape ``(N, gdim)``."""
        return np.asarray(self.geometry.nodes + self._converged)

    def _domain_averages(
        self,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        corners = self.transfer.rows.corners
        return domain_weights(
            self.converged_domains if corners is None else corners,
            self.geometry.shape_functions,
            self.mesh.basix_cell(),
            self.geometry.exact_degree,
        )

    @property
    def node_basis(self) -> PointBasis:
        """The background basis at the local nodes of W, at the last converged positions."""
        return self.transfer.rows.basis

    def beside(self, nodes: NDArray[np.int64]) -> tuple[PointBasis, NDArray[np.float64]]:
        """Return the basis at nodes of W of the cells beside theirs, continued (collective).

        Args:
            nodes: Local nodes of W.

        Returns:
            See :meth:`BackgroundBasis.beside`.
        """
        return self._background.beside(self._at_converged().positions[nodes])

    def node_gradients(self) -> PointBasis:
        """Return :attr:`node_basis` with gradients (collective)."""
        rows = self.node_basis
        if self.is_free:
            return rows._replace(gradients=np.zeros((*rows.nodes.shape, self.geometry.gdim)))
        basis = self._background.at(self.node_positions[: len(rows.nodes)], gradients=True)
        assert basis.gradients is not None
        other = np.flatnonzero((basis.nodes != rows.nodes).any(axis=1))
        if self.mesh.comm.allreduce(len(other)) > 0:  # rows by carry_by
            beside, _ = self.beside(other)
            assert beside.gradients is not None
            same = (beside.nodes == rows.nodes[other, None]).all(axis=2).argmax(axis=1)
            basis.gradients[other] = beside.gradients[np.arange(len(other)), same]
        return rows._replace(gradients=basis.gradients)

    def carried_by(self, motion: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a motion on the local dofs of W as one of nodes, shape ``(N, gdim)``."""
        return motion.reshape(self._converged.shape)

    def carry_by(self, nodes: NDArray[np.int64], rows: PointBasis) -> None:
        """Let nodes of W have other rows of T, until the body has moved (collective).

        Args:
            nodes: Local nodes of W.
            rows: Their rows.
        """
        whole = self.transfer.rows
        for known, other in zip(whole.basis, rows, strict=True):
            if known is not None and other is not None:
                known[nodes] = other
        self._transfer = self._transfer_by(whole)

    @property
    def background_basis(self) -> BackgroundBasis:
        """Evaluator of the basis of V at points."""
        return self._background

    def options(self) -> dict[str, Any]:
        """Return method and degrees, for a checkpoint to know these particles by."""
        return {
            "method": self.method,
            "degree": self.W.ufl_element().degree,
            "quadrature_degree": self.quadrature_degree,
            "domain_update": self._domain_update,
            "delete": self.deletion is not None,
            **({} if self.free_nodes is None else {"free": True}),
        }

    def converged_state(self) -> dict[str, Column]:
        """Return the last converged step cell by cell, for a checkpoint."""
        nodal = self._converged[self.domain_nodes]
        columns = {"displacement": Column(nodal, "nodes")}
        if self.free_nodes is not None:
            state = self.free_nodes.chosen.astype(np.float64) - self.free_nodes.spent
            columns["free"] = Column(state[self.domain_nodes], "nodes")
        if self.deletion is not None:
            columns["deleted"] = Column(self.deletion.mask, "cells")
            columns["kept"] = Column(self.deletion.kept(nodal), "nodes")
        if self.undeformed.mass_share is not None:
            columns |= self.undeformed.reference.columns()
            columns["mass share"] = Column(self.undeformed.mass_shares(), "nodes")
        if self.undeformed.origin is not None:
            columns["mesh nodes"] = Column(self.geometry.corners, "nodes")
        return columns

    def set_converged_state(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Make what :meth:`converged_state` once returned the last converged step (collective)."""
        d = self.displacement.x
        d.array.reshape(-1, self.geometry.gdim)[self.domain_nodes] = arrays["displacement"]
        d.scatter_forward()
        if self.free_nodes is not None:
            states = (arrays["free"] > 0.5, arrays["free"] < -0.5)
            nodes = (np.unique(self.domain_nodes[state]) for state in states)
            self.choose_free(*(chosen_nodes(self.W, some) for some in nodes))
        if self.deletion is not None:
            self.deletion.restore(np.zeros_like(self.deletion.mask), arrays["kept"])
            self.deletion.restore(arrays["deleted"], arrays["kept"])
            self._transfer = None
        if self.undeformed.mass_share is not None:
            reference = (arrays[f"reference {name}"] for name in Reference._fields)
            self.undeformed.refer(Reference(*reference))
            self.undeformed.set_mass_shares(arrays["mass share"])
        self.commit()

    def commit(self) -> NDArray[np.float64]:
        """Make the present displacement the converged one; return what that was before."""
        before = self._converged
        present = self.displacement.x.array.reshape(-1, self.geometry.gdim)
        self.restore(np.array(present, dtype=np.float64))
        return before

    def restore(self, converged: NDArray[np.float64]) -> None:
        """Set the converged displacement, shape ``(N, gdim)`` at the local nodes of W."""
        self._converged = converged
        if not self.is_free:  # T of finite elements stays as it is
            self._transfer = None

    def begin_from(self, displacement: NDArray[np.float64]) -> None:
        """Let a step begin from a displacement on the local dofs of W; T stays as it is."""
        self._converged[...] = displacement.reshape(self._converged.shape)

    def roll_back(self) -> None:
        """Restore the converged displacement."""
        self.displacement.x.array[:] = self._converged.ravel()
        self.increment.x.array[:] = 0.0
        if self.free_nodes is not None:
            self.free_nodes.roll_back()


def _is_auto(free: Any) -> bool:
    """Return whether nodes are to be free as long as the domains around them are good."""
    return isinstance(free, str) and free == "auto"
