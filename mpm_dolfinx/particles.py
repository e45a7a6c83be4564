# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles: a body mesh whose displacement is carried by a background space."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from .clouds import mesh_of_boxes
from .deletion import without_deleted
from .domains import Reference
from .errors import MPMError, ParticleOutsideError, agree
from .layout import TouchedNodes
from .location import BackgroundBasis, PointBasis
from .material_domains import MaterialDomains
from .methods import BoxGrid, DomainState, Rows, boxes, cpdi, cpdi2, gimp, mpm, require_boxes
from .partition import Carrier, Redistribution, cell_centres, ranks_of_background
from .rebase import Cuts, Rebase
from .transfer import Weights, domain_weights, sum_by_particle, transfer_matrix
from .validation import validate_distortion, validate_options, validate_spaces

__all__ = ["Particles"]


#: How many of the meshes that a body has left are known to :meth:`Particles.carry`, but the first.
REMEMBERED = 8


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

    Args:
        body: Undeformed body: triangles or quadrilaterals in the plane, tetrahedra or
            hexahedra in space. Its cells are the particles.
        V: Vector Lagrange space on the background mesh, on the same ranks.
        method: ``"cpdi2"``, ``"cpdi"``, ``"gimp"`` or ``"mpm"``.
        degree: Degree of the domains' shape functions.
        quadrature_degree: Degree of the rule that carries the history; ``None`` is one point
            per domain for degree 1.
        outside: What happens when a step takes a corner of a domain out of the background:
            ``"error"`` ends the run with an error, ``"stop"`` without one (both before that
            step), ``"delete"`` goes on without the domain and adds up what is lost.
        domain_update: For ``"gimp"``: ``"stretch"`` (half-lengths follow the diagonal of the
            right stretch) or ``"fixed"`` (the box only translates).
        partition: ``"given"`` leaves the cells of ``body`` on their ranks; ``"background"``
            makes ``mesh`` a copy of it whose cells are on the ranks that own the background
            where they lie, or in even compact parts where a rank would get too many.
        on_distortion: What a problem with a material does about quadrilaterals that a step has
            made concave: ``"error"`` nothing, until one crosses itself; ``"split"`` cuts them into
            two triangles each.

    Attributes:
        mesh: The body mesh, undeformed: ``body``, or its copy with ``partition="background"``.
        V: The background space.
        W: Space of the domains' displacement.
        displacement: Total displacement d in W.
        increment: The background displacement u in V of the step being solved.
        load: The load factor, a Constant on the body mesh.
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
        mass_share: Factor of the density that keeps the mass at each node where domains were
            split or the body rebased, otherwise ``None``.
        rebases: How often the nodes of the mesh were moved.
        origin: Undeformed positions of the nodes of W where the body was rebased, otherwise
            ``None``.

    Raises:
        MPMError: Spaces, meshes, method or degrees that do not go together.
        ParticleOutsideError: The body does not lie inside the background.
        DomainDistortionError: A cell of the body is degenerate.
    """

    def __init__(
        self,
        body: mesh.Mesh,
        V: fem.FunctionSpace,
        method: str = "cpdi2",
        degree: int = 1,
        quadrature_degree: int | None = None,
        outside: str = "error",
        domain_update: str = "stretch",
        partition: str = "given",
        on_distortion: str = "error",
    ) -> None:
        validate_spaces(body, V)
        validate_options(body, V, method, degree, quadrature_degree, outside, domain_update)
        validate_distortion(body, method, degree, quadrature_degree, on_distortion)
        if partition not in ("given", "background"):
            raise MPMError(f"Unknown partition={partition!r}; choose 'given' or 'background'.")
        self._options: dict[str, Any] = {
            "method": method,
            "degree": degree,
            "quadrature_degree": quadrature_degree,
            "outside": outside,
            "domain_update": domain_update,
            "on_distortion": on_distortion,
        }
        self._carriers: list[Carrier] = []
        self.rebases = 0
        self.cuts: Cuts = np.zeros((0, 2), dtype=np.int64)
        self._background = BackgroundBasis(V)
        if partition == "background":
            ranks = ranks_of_background(V, self._background, cell_centres(body))
            self._carriers.append(Redistribution(body, ranks))
            body = self._carriers[-1].mesh
        family = "Lagrange" if method == "cpdi2" else "Discontinuous Lagrange"
        super().__init__(body, family, degree, quadrature_degree, outside == "delete")
        self.V = V
        self.method = method
        self.increment = fem.Function(V, name="increment")
        self.load = fem.Constant(body, 0.0)
        self.outside = outside
        self.on_distortion = on_distortion
        self._domain_update = domain_update
        self._grid = None
        if method == "gimp":
            require_boxes(body, self._nodes[self.domain_nodes], self.global_index)
            self._grid = BoxGrid(V.mesh)
        self._converged = np.zeros_like(self._nodes)
        self._require_volume()
        self.locate()

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
        for carrier in self._carriers:
            thing = carrier.carry(thing)
        return thing

    def ranks_of_background(self) -> NDArray[np.int64]:
        """Return the rank on which each particle would best be now, shape ``(n,)`` (collective).

        That which owns the background where the particle is; where a rank would get more than
        5 % above an even share, that of the compact part that the particle is in.
        """
        return ranks_of_background(self.V, self._background, self.centroid)

    def move(self, ranks: NDArray[np.int64]) -> None:
        """Move particles to other ranks, undeformed (collective).

        ``mesh``, ``W``, ``displacement`` and ``load`` are new ones then. What else there is to
        be moved is the business of :meth:`QuasiStaticProblem.repartition`.

        Args:
            ranks: New rank of each particle this rank owns, shape ``(n,)``.
        """
        self._take(Redistribution(self.mesh, ranks), self.cuts, self.origin is not None)

    def rebase(self, cuts: Cuts, positions: NDArray[np.float64] | None = None) -> Rebase:
        """Cut quadrilaterals of the mesh in two, or move its nodes (collective).

        As in :meth:`move`, the rest is the business of :meth:`QuasiStaticProblem.split` and
        :meth:`QuasiStaticProblem.rebase`.

        Args:
            cuts: Which are cut, the same on all ranks.
            positions: Where the domains' corners are to be, shape ``(n, k, gdim)``, if elsewhere.
        """
        move = Rebase(self.mesh, cuts, positions)
        moved = positions is not None or self.origin is not None
        self._take(move, np.concatenate([self.cuts, cuts]), moved)
        self.rebases += positions is not None
        return move

    def _take(self, move: Carrier, cuts: Cuts, moved: bool) -> None:
        """Live on another mesh (collective)."""
        kept = {name: self.__dict__[name] for name in ("V", "increment", "rebases", "_options")}
        carriers = [carrier.then(move) for carrier in self._carriers]
        self.__dict__.clear()
        Particles.__init__(self, move.mesh, kept["V"], **kept["_options"])
        self.__dict__ |= kept
        # Each mesh holds communicators of MPI, of which there are about 2000.
        self._carriers = [*carriers[:1], *carriers[1:][1 - REMEMBERED :], move]
        self.cuts = cuts
        if moved or len(cuts):
            self.expect_reference(moved)

    @property
    def origin_index(self) -> NDArray[np.int64]:
        """Input index of the domain that each particle is, or is half of, shape ``(n,)``."""
        first = self.num_global - len(self.cuts)
        index = self.global_index.copy()
        index[index >= first] = self.cuts[index[index >= first] - first, 0]
        return index

    def locate(self) -> None:
        """Find the background cells of all domain nodes, unless that is done (collective).

        Raises:
            ParticleOutsideError: A domain of the last converged step is not wholly inside the
                background.
        """
        self._rows

    def _state(self) -> DomainState:
        """Return where the domains are at the last converged step."""
        return DomainState(
            self._nodes,
            self._converged,
            self.domain_nodes,
            self.initial_centroid,
            self.mean(self._nodes[self.domain_nodes] + self._of_domains(self._converged)),
            np.eye(self._gdim) + self._average(self.converged_gradient()),
        )

    def _found_rows(self) -> tuple[Rows, NDArray[np.int64]]:
        """Return the rows of T, and the local domains that are not wholly in the background."""
        if self.method == "cpdi2":
            rows = cpdi2(self.node_positions, self._background)
        elif self.method == "gimp":
            assert self._grid is not None
            stretch = self._domain_update == "stretch"
            rows = gimp(self._state(), self._background, self._grid, stretch)
        else:
            rows = {"cpdi": cpdi, "mpm": mpm}[self.method](self._state(), self._background)
        lost = (~rows.basis.found)[self.domain_nodes].any(axis=1)
        return rows, np.flatnonzero(lost & ~self.deleted)

    def _require_inside(self, rows: Rows, lost: NDArray[np.int64], what: str, advice: str) -> None:
        with agree(self.mesh.comm):
            if len(lost):
                corners = self.domains if rows.corners is None else rows.corners
                out = ~rows.basis.found[self.domain_nodes[lost[0]]]
                where = corners[lost[0]][out][0]
                where = np.where(np.abs(where) < 1e-12 * np.abs(where).max(), 0.0, where)
                raise ParticleOutsideError(
                    f"{what} outside the background mesh, e.g. at "
                    f"{tuple(float(f'{c:.6g}') for c in where)}; {advice}",
                    self.global_index[lost],
                )

    def converged_gradient(self) -> NDArray[np.float64]:
        """Return ``F - I`` at the history's points, last converged, ``(n, nq, gdim, gdim)``."""
        gradient = self.quadrature.displacement_gradient(self._of_domains(self._converged))
        return self._whole_gradient(gradient)

    @cached_property
    def _rows(self) -> Rows:
        """The rows of T at the last converged positions."""
        rows, lost = self._found_rows()
        self._require_inside(
            rows,
            lost,
            "The domains of {particles} are",
            "make the background larger or the load smaller",
        )
        return self._without_dead(rows)

    def _without_dead(self, rows: Rows) -> Rows:
        """Take the weight from nodes that belong to deleted domains only."""
        if self.deletion is not None:
            values = rows.basis.values
            values[self.deletion.dead[: len(values)]] = 0.0
            if rows.corners is not None:
                rows.corners[self.deleted] = self.domains[self.deleted]
        return rows

    def leaving(self) -> NDArray[np.int64]:
        """Return which of this rank's particles the last step took out (collective).

        Returns:
            Their local indices, with ``outside="delete"``; without it there are none.

        Raises:
            ParticleOutsideError: Some are outside and shall not be deleted, or all would be.
        """
        if self.deletion is None:
            self.locate()
            return np.zeros(0, dtype=np.int64)
        rows, lost = self._found_rows()
        left = self.num_local - int(self.deleted.sum()) - len(lost)
        if self.mesh.comm.allreduce(left) == 0:
            self._require_inside(
                rows,
                lost,
                "The domains of {particles}, the last that were not deleted, are",
                "make the background larger or the load smaller",
            )
        self.__dict__["_rows"] = self._without_dead(rows)
        return lost

    def delete(self, domains: NDArray[np.int64]) -> None:
        """Delete domains (collective), after :meth:`leaving`.

        Args:
            domains: Local indices of this rank's particles.
        """
        assert self.deletion is not None
        self.deletion.add(domains, self._of_domains(self._converged))
        self._without_dead(self._rows)

    @cached_property
    def T(self) -> PETSc.Mat:
        """The transfer: all dofs of W by all dofs of V, at the last converged positions."""
        return transfer_matrix(self._rows.basis, self.W, self.V)

    @cached_property
    def active_nodes(self) -> NDArray[np.int32]:
        """Nodes of V with weight that this rank owns, local numbers, sorted."""
        owned = self.W.dofmap.index_map.size_local
        return TouchedNodes(self.V, [self._rows.basis], [owned]).active

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
        weights = sum_by_particle(average, gradient, self._rows.basis, self.domain_nodes)
        return weights if self.deletion is None else without_deleted(weights, self.deleted)

    @property
    def domains(self) -> NDArray[np.float64]:
        """Corners of the particles' own domains, shape ``(n, k, gdim)``.

        For cpdi2 they are those of the displaced body mesh, for cpdi parallelograms, for gimp
        boxes; for mpm, whose particles are points, parallelograms of their volume.
        """
        if self.method == "cpdi2":
            positions = self._nodes[self.domain_nodes] + self._of_domains(self._converged)
            return np.asarray(positions)
        state = self._state()
        if self.method == "gimp":
            return boxes(state, self._domain_update == "stretch")
        return np.asarray(state.centroid[:, None] + state.arms())

    @property
    def converged_displacement(self) -> NDArray[np.float64]:
        """Displacement at the last converged step, on the local dofs of W."""
        return self._converged.ravel()

    @property
    def node_positions(self) -> NDArray[np.float64]:
        """Positions of this rank's nodes of W at the last converged step, shape ``(N, gdim)``."""
        return np.asarray(self._nodes + self._converged)

    def _domain_averages(
        self,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        corners = self._rows.corners
        return domain_weights(
            self.domains if corners is None else corners,
            self._shape_functions,
            self.mesh.basix_cell(),
            self._exact_degree,
        )

    @property
    def node_basis(self) -> PointBasis:
        """The background basis at the local nodes of W, at the last converged positions."""
        return self._rows.basis

    @property
    def background_basis(self) -> BackgroundBasis:
        """What evaluates the basis of V at points."""
        return self._background

    def quadrature_points(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions ``(n nq, gdim)`` and volumes ``(n nq,)`` of the history's points.

        They are those of the last converged step, without deleted particles.
        """
        there = ~self.deleted
        nodal = self._nodes[self.domain_nodes] + self._of_domains(self._converged)
        points = np.einsum("qk,nki->nqi", self.quadrature.shapes, nodal[there])
        jacobian = np.linalg.det(np.eye(self._gdim) + self.converged_gradient()[there])
        volumes = self.quadrature.weights[there] * jacobian
        return points.reshape(-1, self._gdim), volumes.ravel()

    @property
    def quadrature_degree(self) -> int:
        """Degree of the rule that carries the history."""
        return self._degree

    def options(self) -> dict[str, Any]:
        """Return method and degrees, for a checkpoint to know these particles by."""
        return {
            "method": self.method,
            "degree": self.W.ufl_element().degree,
            "quadrature_degree": self._degree,
            "domain_update": self._domain_update,
            "delete": self.deletion is not None,
        }

    def converged_state(self) -> dict[str, NDArray[Any]]:
        """Return the last converged step cell by cell, for a checkpoint: arrays ``(n, ...)``."""
        nodal = self._converged[self.domain_nodes]
        arrays: dict[str, NDArray[Any]] = {"displacement": nodal}
        if self.deletion is not None:
            arrays |= {"deleted": self.deletion.mask, "kept": self.deletion.kept(nodal)}
        if self.mass_share is not None:
            arrays |= {f"reference {k}": v for k, v in self.reference._asdict().items()}
            arrays["mass share"] = self.mass_shares()
        if self.origin is not None:
            arrays["mesh nodes"] = self._nodes[self.domain_nodes]
        return arrays

    def set_converged_state(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Make what :meth:`converged_state` once returned the last converged step (collective)."""
        d = self.displacement.x
        d.array.reshape(-1, self._gdim)[self.domain_nodes] = arrays["displacement"]
        d.scatter_forward()
        if self.deletion is not None:
            self.deletion.restore(np.zeros_like(self.deletion.mask), arrays["kept"])
            self.deletion.restore(arrays["deleted"], arrays["kept"])
        if self.mass_share is not None:
            self.refer(Reference(*(arrays[f"reference {name}"] for name in Reference._fields)))
            self.set_mass_shares(arrays["mass share"])
        self.commit()

    def commit(self) -> NDArray[np.float64]:
        """Make the present displacement the converged one; return what that was before."""
        before = self._converged
        present = self.displacement.x.array.reshape(-1, self._gdim)
        self.restore(np.array(present, dtype=np.float64))
        return before

    def restore(self, converged: NDArray[np.float64]) -> None:
        """Set the converged displacement, shape ``(N, gdim)`` at the local nodes of W."""
        self._converged = converged
        for name in ("_rows", "active_nodes", "T"):
            self.__dict__.pop(name, None)

    def roll_back(self) -> None:
        """Restore the converged displacement."""
        self.displacement.x.array[:] = self._converged.ravel()
        self.increment.x.array[:] = 0.0
