# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles: a body mesh whose displacement is carried by a background space."""

from __future__ import annotations

import sys
from typing import Any, NoReturn

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from ..background.basis import PointBasis
from ..background.ownership import ranks_of_background
from ..errors import MPMError, agree
from ..meshes.boxes import mesh_of_boxes
from ..meshes.quadrature import default_degree
from ..meshes.redistribution import Carrier, Redistribution
from ..meshes.remesh import Cuts
from ..meshes.trail import Trail
from ..parallel.boundary import collective
from ..parallel.given import require_same
from ..transfer.cpdi import CPDI2
from ..transfer.elements import FiniteElements
from ..transfer.methods import METHODS
from ..transfer.transfer import Transfer
from ..transfer.weights import Weights, domain_weights, sum_by_particle
from .deletion import Deletion
from .free import FreeNodes, chosen_nodes
from .geometry import Geometry
from .options import (
    validate_cells,
    validate_distortion,
    validate_free,
    validate_options,
    validate_spaces,
)
from .placement import Mover, Placement
from .reference import Reference
from .response import MaterialDomains
from .undeformed import Undeformed

__all__ = ["LoadFactor", "Particles", "require_at_nodes", "require_shared_nodes"]


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
      rectangles or boxes, whose half-lengths follow the diagonal of the right stretch; ``"ugimp"``:
      boxes that keep their size;
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
        method: ``"cpdi2"`` (default), ``"cpdi"``, ``"gimp"``, ``"ugimp"`` or ``"mpm"``; without V
            ``"fem"``.
        degree: Degree of the domains' shape functions.
        quadrature_degree: Degree of the rule that carries the history; ``None`` is one point
            per domain for degree 1, and for finite elements the least without hourglass modes.
        outside: What happens when a step takes a corner of a domain out of the background:
            ``"error"`` ends the run with an error, ``"stop"`` without one (both before that
            step), ``"delete"`` goes on without the domain and adds up what is lost. What has passed
            a boundary whose nodes are held, by less than a cell, stays there and has not left.
        on_distortion: What a problem with a material does about quadrilaterals that a step has
            made concave: ``"error"`` nothing, until one crosses itself; ``"split"`` cuts them into
            two triangles each.
        free: Which nodes are free at the beginning: a function of undeformed coordinates, shape
            ``(3, n)``, such as ``mpm.region(...)``; ``(cell_tags, tag)``, or with a list of tags:
            all nodes of these cells; or local nodes of W, ``[]`` for none yet. ``"auto"``: all are,
            each until the domains around it are distorted or about to leave the background.
            ``None``: no node is ever free.

    Attributes:
        mesh: The body mesh, undeformed: ``body``, or its copy after :meth:`repartition`.
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
        trail: The way from ``body`` to the present mesh.
        mover: What moves the nodes.
        placement: Where the body is at the last converged step, and T there.

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
        on_distortion: str = "error",
        free: Any = None,
    ) -> None:
        validate_spaces(body, V)
        if method is None:
            method = (FiniteElements if V is None else CPDI2).name
        require_same(body.comm, free=free is not None)
        own = V is None or free is not None
        validate_options(body, V, method, degree, quadrature_degree, outside, own)
        validate_distortion(body, method, degree, quadrature_degree, on_distortion)
        if free is not None:
            validate_free(V, method, on_distortion)
        validate_cells(body, "body")
        if own:
            cell = body.basix_cell().name
            quadrature_degree = quadrature_degree or default_degree(cell, degree, free=True)
        self.method, self.outside, self.on_distortion = method, outside, on_distortion
        self.trail = Trail()
        self._degrees = degree, quadrature_degree
        self._frees = None if free is None else _is_auto(free)
        geometry = self._geometry_on(body)
        if V is not None:
            validate_cells(V.mesh, "background")
        self.mover = Mover(geometry.W if V is None else V, method)
        self.V, self.increment = self.mover.V, self.mover.increment
        self._settle(geometry, outside == "delete")
        if free is not None:
            self.placement.choose_free(chosen_nodes(self.W, free))
        self.mover.method.require(body, self.initial_domains, self.global_index)
        self.geometry.require_volume(self.undeformed.rule)
        self.placement.locate()

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Raise an error: a copy would have the mesh, the load and the displacement in common."""
        raise MPMError("Particles cannot be copied; make others: mpm.Particles(body, V, ...).")

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

    # -- Meshes ---------------------------------------------------------------------------

    def _geometry_on(self, body: mesh.Mesh) -> Geometry:
        shared = METHODS[self.method].shares_nodes
        family = "Lagrange" if shared else "Discontinuous Lagrange"
        return Geometry(body, family, *self._degrees)

    def _settle(self, geometry: Geometry, deletable: bool, moved: bool = False) -> None:
        """Live on a body mesh, where nothing is displaced: at the start and after each move.

        Args:
            geometry: The mesh (collective).
            deletable: Whether domains may be deleted.
            moved: Whether the mesh's nodes are elsewhere than in the undeformed body.
        """
        undeformed = Undeformed(geometry, len(self.trail.cuts) > 0, moved)
        self._live_on(undeformed, Deletion(geometry.mesh, geometry.W) if deletable else None)
        self.load = LoadFactor(geometry.mesh, 0.0)
        self.proportional = fem.Constant(geometry.mesh, 1.0)
        free = None if self._frees is None else FreeNodes(self, self.locate, self._frees)
        self.placement = Placement(undeformed, self.mover, self.deletion, free)

    def live_on(
        self,
        move: Carrier,
        cuts: Cuts | None = None,
        positions: NDArray[np.float64] | None = None,
    ) -> None:
        """Live on another mesh of the same body, undeformed (collective).

        ``mesh``, ``W``, ``displacement`` and ``load`` are new ones then. What else there is to
        be moved is the business of the problem.

        Args:
            move: Takes what lives on the present mesh to the other one.
            cuts: Quadrilaterals that it cuts in two, the same on all ranks.
            positions: Where it moves the domains' nodes to, shape ``(n, k, gdim)``.
        """
        before: Reference | None = None
        if positions is not None:
            before = self.present_reference()
        elif cuts is None and self.undeformed.differs:
            before = self.undeformed.reference
        moved = positions is not None or self.undeformed.origin is not None
        self.trail.append(move, cuts, positions is not None)
        geometry = self._geometry_on(move.mesh)
        if self.is_free:
            self.mover = Mover(geometry.W, self.method)
            self.V, self.increment = self.mover.V, self.mover.increment
        self._settle(geometry, self.deletion is not None, moved)
        if before is not None:  # at once, for what is made of the undeformed body
            self.undeformed.refer(Reference(*(move.of_cells(values) for values in before)))

    def present_reference(self) -> Reference:
        """Return the undeformed body as a mesh shows it that has the last converged positions."""
        return self.undeformed.reference._replace(gradient=self.placement.gradient())

    @collective()
    def repartition(self) -> None:
        """Move particles to the ranks that own the background around them (collective).

        For a body of which no problem is made yet: ``mesh``, ``W``, ``displacement`` and ``load``
        are new ones then; :meth:`carry` takes tags over. Where a rank would get more than 5 % above
        an even share, particles are in even compact parts instead.

        Raises:
            MPMError: A problem was made of them, whose own ``repartition`` moves them, or they are
                finite elements.
        """
        if self.governed_by is not None or np.any(self.placement.displacement):
            raise MPMError("Particles of a problem are moved by problem.repartition().")
        if self.is_free:
            raise MPMError("Finite elements have no background whose ranks would be better.")
        free = self.free
        move = Redistribution(self.mesh, self.best_ranks())
        nodal = free[self.domain_nodes]
        self.live_on(move)
        if self.free_nodes is not None:
            its = np.unique(self.domain_nodes[move.of_cells(nodal)])
            self.placement.choose_free(chosen_nodes(self.W, its))

    def best_ranks(self) -> NDArray[np.int64]:
        """Return the rank on which each particle would best be now, shape ``(n,)`` (collective).

        That which owns the background where the particle is; where a rank would get more than
        5 % above an even share, that of the compact part that the particle is in. Finite elements
        stay where they are.
        """
        if self.is_free:
            return np.full(self.num_local, self.mesh.comm.rank, dtype=np.int64)
        return ranks_of_background(self.V, self.mover.basis, self.centroid)

    def carry(self, thing: Any) -> Any:
        """Return tags or a DG0 Function on ``mesh``, to which cells have moved (collective).

        Args:
            thing: ``MeshTags`` or a piecewise constant Function on the body mesh that was given,
                or on a ``mesh`` of before one of the last eight moves; anything else is returned
                as it is.

        Raises:
            MPMError: A Function that is not piecewise constant.
        """
        return self.trail.carry(thing)

    def boundary(self) -> NDArray[np.int32]:
        """Return this rank's own facets of ``mesh`` on the body's boundary (collective).

        Where quadrilaterals were cut in two, halves do not share their diagonal: DOLFINx takes it
        for a boundary, and this does not.
        """
        return self.trail.boundary(self.mesh)

    @property
    def origin_index(self) -> NDArray[np.int64]:
        """Input index of the domain that each particle is, or is half of, shape ``(n,)``."""
        return self.trail.origin_index(self.global_index, self.num_global)

    # -- Nodes ----------------------------------------------------------------------------

    @property
    def shares_nodes(self) -> bool:
        """Whether neighbours share their nodes, so that the body hangs together."""
        return self.mover.method.shares_nodes

    @property
    def is_free(self) -> bool:
        """Whether all nodes have unknowns of their own, without a background."""
        return self.mover.method.free

    @property
    def free_nodes(self) -> FreeNodes | None:
        """The free nodes as the system moves them; ``None`` without ``free=``."""
        return self.placement.free_nodes

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
        self._frees = self.free_nodes.automatic = _is_auto(where)
        self.placement.choose_free(chosen_nodes(self.W, where))

    # -- As the background moves it -------------------------------------------------------------

    def locate(self) -> None:
        """Find the background cells of all domain nodes, unless that is done (collective).

        Raises:
            ParticleOutsideError: A domain of the last converged step is not wholly inside the
                background.
        """
        self.placement.locate()

    @property
    def transfer(self) -> Transfer:
        """T and what follows from it, at the last converged positions (collective)."""
        return self.placement.transfer

    def forget_transfer(self) -> None:
        """Drop T, which is made anew when it is needed."""
        if "placement" in vars(self):  # (where a problem ends after its particles, they have none)
            self.placement.forget_transfer()

    @property
    def T(self) -> PETSc.Mat:
        """The transfer: all dofs of W by all dofs of V, at the last converged positions.

        Rows of free nodes are zero.
        """
        return self.transfer.T

    @property
    def node_basis(self) -> PointBasis:
        """The background basis at the local nodes of W, at the last converged positions."""
        return self.transfer.rows.basis

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
        corners, geometry = self.transfer.rows.corners, self.geometry
        _, average, gradient = domain_weights(
            self.placement.domains if corners is None else corners,
            geometry.shape_functions,
            self.mesh.basix_cell(),
            geometry.exact_degree,
        )
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
        return self.mover.method.domains(self.placement.moved(present, self.displacement_gradient))

    @property
    def converged_displacement(self) -> NDArray[np.float64]:
        """Displacement at the last converged step, on the local dofs of W."""
        return self.placement.displacement.ravel()

    @property
    def node_positions(self) -> NDArray[np.float64]:
        """Positions of this rank's nodes of W at the last converged step, shape ``(N, gdim)``."""
        return self.placement.nodes

    def node_gradients(self) -> PointBasis:
        """Return :attr:`node_basis` with gradients (collective)."""
        return self.placement.basis_with_gradients()

    def carried_by(self, motion: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a motion on the local dofs of W as one of nodes, shape ``(N, gdim)``."""
        return motion.reshape(-1, self.geometry.gdim)

    def commit(self) -> NDArray[np.float64]:
        """Make the present displacement the converged one; return what that was before."""
        present = np.array(self.displacement.x.array, dtype=np.float64)
        return self.placement.go(present.reshape(-1, self.geometry.gdim))

    def restore(self, converged: NDArray[np.float64]) -> None:
        """Set the converged displacement, shape ``(N, gdim)`` at the local nodes of W."""
        self.placement.go(converged)

    def roll_back(self) -> None:
        """Restore the converged displacement."""
        self.displacement.x.array[:] = self.converged_displacement
        self.increment.x.array[:] = 0.0
        if self.free_nodes is not None:
            self.free_nodes.roll_back()

    def remove(self, domains: NDArray[np.int64]) -> None:
        """Delete domains that the user takes away, whatever ``outside`` is (collective).

        The rest is the business of :meth:`QuasiStaticProblem.remove`.

        Args:
            domains: Local indices of this rank's particles.
        """
        self.allow_deletion(True)
        self.placement.delete(domains)

    def allow_deletion(self, allowed: bool) -> None:
        """Let domains be deleted, or no longer, where none of them is (collective)."""
        if not allowed:
            self.deletion = None
        elif self.deletion is None:
            self.deletion = Deletion(self.mesh, self.W)
        self.placement.deletion = self.deletion


def require_shared_nodes(what: str, body: Any) -> None:
    """Raise an error unless a body is one whose domains share their nodes.

    Args:
        what: What needs it.
        body: What is given for the body.
    """
    if not isinstance(body, Particles) or not body.shares_nodes:
        raise MPMError(
            f"{what} needs method='cpdi2' of mpm.Particles, whose domains share their nodes, or "
            "finite elements."
        )


def require_at_nodes(what: str, body: Particles) -> None:
    """Raise an error where a body's domains are not moved at their nodes.

    Args:
        what: What needs it.
        body: The body.
    """
    if not body.mover.method.at_nodes:
        raise MPMError(
            f"{what} needs method='cpdi2' or 'cpdi', whose domains move at their nodes, not "
            f"{body.method!r}."
        )


def _is_auto(free: Any) -> bool:
    """Return whether nodes are to be free as long as the domains around them are good."""
    return isinstance(free, str) and free == "auto"
