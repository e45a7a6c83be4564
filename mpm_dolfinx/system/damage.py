# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Damage of a body whose law is one of fracture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem, mesh

from ..constitutive.assignment import in_cells, per_cell
from ..constitutive.groups import background_cells
from ..constitutive.points import MaterialPoints
from ..constitutive.step_stress import StepStress
from ..errors import MPMError, agree, warn
from ..materials.fracture import Fracture
from ..meshes.quadrature import exact_degree
from ..parallel.boundary import collective
from ..parallel.compilation import compiled_form
from ..parallel.totals import over_ranks
from ..particles.field import ParticleField
from ..particles.free import chosen_nodes
from ..particles.particles import Particles
from .field_equation import FieldEquation
from .term import PointMaterial

__all__ = ["Damage"]

#: Damage from which on a crack runs through a domain.
CRACKED = 0.9


class Damage(FieldEquation):
    """Phase field of the cracks in a body, between its values before and 1 (collective).

    A problem makes one of each body whose law is a :class:`mpm_dolfinx.materials.Fracture`:
    ``problem.damage``.

    Args:
        particles: The body.
        materials: Its law, or one for each tag of ``cell_tags``; what is no ``Fracture`` does not
            crack.
        cell_tags: Tags of its cells.

    Attributes:
        field: Damage, a :class:`mpm_dolfinx.ParticleField`: 0 where the body is whole, 1 in a
            crack.

    Raises:
        MPMError: Laws that do not go together.
    """

    def __init__(
        self, particles: Particles, materials: Any, cell_tags: mesh.MeshTags | None
    ) -> None:
        body, comm = particles.mesh, particles.mesh.comm
        Q = fem.functionspace(body, ("Lagrange", 1))
        d = ParticleField(particles, Q, at="nodes", kind="body", name="damage")
        cells = fem.functionspace(body, ("Discontinuous Lagrange", 0))
        self._toughness, self._length = (fem.Function(cells) for _ in range(2))
        with agree(comm):
            laws = in_cells(particles, materials, cell_tags)
        self._laws = [(law, where) for law, where in laws if isinstance(law, Fracture)]
        model = self._model()
        self._follow(particles)
        self._drive = particles.quadrature_function("driving_energy")
        shape = d if model == "AT1" else d**2
        slope = ufl.dot(ufl.grad(d), ufl.grad(d))
        weight = 8.0 / 3.0 if model == "AT1" else 2.0
        # (one point in a quadrilateral would not see damage that alternates from node to node)
        degree = exact_degree(body.topology.cell_name(), 1)
        exact = ufl.Measure("dx", domain=body, metadata={"quadrature_degree": degree})
        density = shape / self._length + self._length * slope
        surface = self._toughness / weight * density * exact
        self._surface = compiled_form(surface)
        energy = (1.0 - d) ** 2 * self._drive * particles.dx + surface
        self._share = 3.0 / 8.0 if model == "AT1" else 0.5
        self._points: MaterialPoints | None = None
        self._said = False
        super().__init__(
            d,
            ufl.derivative(energy, d, ufl.TestFunction(d.W)),
            lower="previous",
            upper=self._uppermost(particles, d.W),
        )

    def _model(self) -> str:
        """Return the model of fracture of all laws."""
        models = {law.model for law, _ in self._laws}
        if len(models) > 1:
            raise MPMError("The laws of one body have different models of fracture; give one.")
        return models.pop()

    def _follow(self, body: Particles) -> None:
        """Take toughness and length of each cell as they are now (collective)."""
        dofs = self._toughness.function_space.dofmap.list[: body.num_local, 0]
        with agree(body.mesh.comm):
            for function, name in ((self._toughness, "toughness"), (self._length, "length")):
                function.x.array[:] = 1.0  # which means nothing where there is no damage
                for law, where in self._laws:
                    value: Any = law.parameters[name]
                    if isinstance(value, fem.Function | np.ndarray):
                        value = per_cell(body, name, value)[where]
                    function.x.array[dofs[where]] = getattr(value, "value", value)
        for function in (self._toughness, self._length):
            function.x.scatter_forward()

    def _uppermost(self, body: Particles, W: fem.FunctionSpace) -> fem.Function:
        """Return the largest damage: none at the nodes of cells that do not crack (collective)."""
        whole = np.ones(body.num_local, dtype=bool)
        for _, where in self._laws:
            whole[where] = False
        upper = fem.Function(W)
        upper.x.array[:] = ~chosen_nodes(W, W.dofmap.list[: body.num_local][whole].ravel())
        return upper

    # -- What it does in a step ------------------------------------------------------------------

    @override
    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        super().take_part(number, bodies, materials)
        own = materials[self._body_number]
        points = own.points if isinstance(own, StepStress) else own
        assert isinstance(points, MaterialPoints)
        self._points = points
        self._tell()

    @property
    def _known(self) -> MaterialPoints:
        assert self._points is not None
        return self._points

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        self._follow(self.bodies[0])
        return super().begin()

    @override
    def alternate(self) -> int:
        energy = self._known.trial.variable("driving_energy")
        self._drive.x.array[: energy.size] = energy.ravel()
        solves = super().alternate()
        self._tell()
        return solves

    def _tell(self) -> None:
        """Let the law know the damage at its points."""
        points, damage = self._known, np.clip(self.field.at_points(), 0.0, 1.0)
        points.go_from(points.last.supposing("damage", damage))

    @override
    def commit(self) -> Callable[[], None]:
        if not self._said:
            self._warn_of_coarse_cells()
        return super().commit()

    @override
    def roll_back(self) -> None:
        super().roll_back()
        self._tell()

    # -- Results ---------------------------------------------------------------------------------

    @collective()
    def surface_energy(self) -> float:
        """Return the energy that the cracks have taken up, with what the mesh adds (collective).

        A crack in domains of size h counts ``1 + 3 h / (8 l)`` times the toughness with the model
        AT1, ``1 + h / (2 l)`` times with AT2 (Bourdin, Francfort & Marigo 2008, section 8.1): see
        :meth:`excess`.
        """
        mine: Any = fem.assemble_scalar(self._surface)
        return float(over_ranks(self._comm, float(mine)))

    @collective()
    def excess(self) -> NDArray[np.float64]:
        """Return how much more energy a crack takes on the mesh than the toughness (collective).

        It is the band that is broken: as wide as the cells of the background, or of the body if
        they are larger, over the length.

        Returns:
            Share of the toughness in each owned domain, shape ``(n,)``.
        """
        return self._share * self._sizes() / self._lengths()

    def _lengths(self) -> NDArray[np.float64]:
        cells = self._length.function_space.dofmap.list[: self.bodies[0].num_local, 0]
        return np.asarray(self._length.x.array[cells])

    def _sizes(self) -> NDArray[np.float64]:
        """Return the size of the cells that displacements are resolved by (collective)."""
        body = self.bodies[0]
        power = 1.0 / body.mesh.geometry.dim
        own = np.asarray(body.initial_volume**power)
        if body.is_free or body.free_nodes is not None:
            return own
        return np.asarray(np.maximum(own, background_cells(body)[1] ** power))

    def _warn_of_coarse_cells(self) -> None:
        """Say so, once, where a crack runs through cells that are too large for its length."""
        damage = self.field.x.array[self.field.W.dofmap.list[: self.bodies[0].num_local]]
        if not over_ranks(self._comm, bool(np.any(damage > CRACKED)), MPI.LOR):
            return
        sizes, lengths = self._sizes(), self._lengths()
        coarse = (damage.max(axis=1) > CRACKED) & (sizes > 0.505 * lengths)
        ratio = float((sizes / lengths)[coarse].max(initial=0.0))
        ratio = over_ranks(self._comm, ratio, MPI.MAX)
        if ratio == 0.0:
            return
        self._said = True
        warn(
            self._comm,
            f"A crack runs through cells of {ratio:.2g} times the length over which it is smeared; "
            "they must be smaller than half of it. It takes "
            f"{1.0 + self._share * ratio:.2f} times the toughness there, and follows the mesh.",
        )
