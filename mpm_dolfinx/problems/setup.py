# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a user has given for a problem, kept unchanged: all that its system is made from.

A problem is built from its setup and the present meshes of its bodies, at first and again whenever
these are other ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import mesh

from ..boundary.supports import Support
from ..constitutive.averaging import F_BARS
from ..errors import MPMError
from ..parallel.given import require_same, require_truth
from ..particles.particles import Particles
from ..reals import is_one_of
from ..solvers.linear import LINEAR_SOLVERS
from ..system.term import Term
from .arguments import carried, holds
from .summary import counted

__all__ = ["MIXED", "BodySetup", "Numerics", "Setup"]

#: What may be an unknown beside displacements.
MIXED = ("pressure", "stabilised pressure")
#: Least values of PETSc's tolerances and numbers of iterations, and what they are below.
TOLERANCES = {
    "rtol": (0.0, 1.0),
    "atol": (0.0, np.inf),
    "stol": (0.0, np.inf),
    "max_it": (1.0, np.inf),
}


@dataclass(frozen=True)
class Numerics:
    """How a problem is solved; see :class:`ParticleProblem` for each.

    Raises:
        MPMError: Something that there is not.
    """

    petsc_options_prefix: str
    petsc_options: dict[str, Any]
    form_compiler_options: dict[str, Any] | None
    jit_options: dict[str, Any] | None
    shift: float
    line_search: bool
    dependent_dofs: str
    predictor: bool
    stabilisation: str | None
    linear_solver: str
    entity_maps: Any = None

    @classmethod
    def agreed(
        cls, comm: MPI.Comm, *, petsc_options: dict[str, Any] | None, **options: Any
    ) -> Numerics:
        """Return them from a user's keywords, which are the same on all ranks (collective).

        Args:
            comm: The ranks.
            petsc_options: As below, or ``None`` for none.
            **options: All others, by the names of the attributes.

        Raises:
            MPMError: They differ between ranks, or there is no such thing.
        """
        require_same(comm, petsc_options=petsc_options, **options)
        given = {} if petsc_options is None else petsc_options
        return cls(petsc_options=given, **options)

    def __post_init__(self) -> None:
        """Say so where something is unknown."""
        for name in ("line_search", "predictor"):
            require_truth(name, getattr(self, name))
        if not isinstance(self.petsc_options_prefix, str):
            raise MPMError(
                f"petsc_options_prefix must be a string, not {self.petsc_options_prefix!r}."
            )
        for name in ("petsc_options", "form_compiler_options", "jit_options"):
            given = getattr(self, name)
            if given is None or (
                isinstance(given, dict) and all(isinstance(k, str) for k in given)
            ):
                continue
            raise MPMError(f"{name} must be a dictionary of options by their names, not {given!r}.")
        for name, value in self.petsc_options.items():
            _require_tolerance(name, value)
        if not is_one_of(self.dependent_dofs, ("shift", "remove")):
            raise MPMError(
                f"Unknown dependent_dofs={self.dependent_dofs!r}; choose 'shift' or 'remove'."
            )
        if not is_one_of(self.linear_solver, LINEAR_SOLVERS):
            raise MPMError(
                f"Unknown linear_solver={self.linear_solver!r}; choose one of "
                f"{', '.join(map(repr, LINEAR_SOLVERS))}."
            )
        if not isinstance(self.shift, float | int | np.floating) or not 0.0 <= self.shift < 1.0:
            raise MPMError(f"shift must be at least 0 and below 1, not {self.shift!r}.")
        # a number of NumPy's would make arrays of PETSc's vectors
        object.__setattr__(self, "shift", float(self.shift))

    def in_words(self) -> dict[str, str]:
        """Return how the problem is solved, for a reader."""
        words = {
            "shift": f"{self.shift:g}",
            "line search": "on" if self.line_search else "off",
            "predictor": "on" if self.predictor else "off",
            "stabilisation": str(self.stabilisation),
        }
        if self.dependent_dofs == "remove":
            words["dependent dofs"] = "removed"
        kept = {name: value for name, value in self.petsc_options.items() if value is not None}
        if kept:
            words["PETSc"] = " ".join(f"{name}={value}" for name, value in kept.items())
        return words

    @property
    def of_forms(self) -> dict[str, Any]:
        """Options with which forms are compiled."""
        options = {
            "form_compiler_options": self.form_compiler_options,
            "jit_options": self.jit_options,
        }
        return options if self.entity_maps is None else {**options, "entity_maps": self.entity_maps}


def _require_tolerance(name: str, value: Any) -> None:
    """Raise an error where PETSc would take a tolerance, or a number of iterations, for another.

    It takes some negative values for "as it was", and reads none where nothing iterates.
    """
    solver, _, what = name.rpartition("snes_" if "snes_" in name else "ksp_")
    bounds = TOLERANCES.get(what)
    if not name.startswith(("snes_", "ksp_")) or solver or bounds is None or value is None:
        return
    least, below = bounds
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not least <= number < below:
        most = f" and below {below:g}" if np.isfinite(below) else ""
        raise MPMError(
            f"{name} of petsc_options= must be a number of at least {least:g}{most}, not {value!r}."
        )


@dataclass(frozen=True)
class BodySetup:
    """What a body is made of, and what acts on it; see :class:`QuasiStaticProblem` for each.

    Attributes:
        more: What else is given for the body, by name.
    """

    particles: Particles
    material: Any
    density: Any
    body_force: Any
    tractions: Sequence[Any]
    pressures: Sequence[Any]
    cell_tags: Any
    facet_tags: Any
    supports: tuple[Support, ...]
    more: Mapping[str, Any] = MappingProxyType({})

    def __post_init__(self) -> None:
        """Say so where something is no tags."""
        for name in ("cell_tags", "facet_tags"):
            tags = getattr(self, name)
            if tags is not None and not isinstance(tags, mesh.MeshTags):
                raise MPMError(f"{name} must be dolfinx MeshTags, not {type(tags).__name__}.")

    def in_words(self) -> str:
        """Return the laws, and what loads and holds the body."""
        laws = self.material
        if isinstance(laws, Mapping):
            words = "; ".join(f"tag {tag}: {law!r}" for tag, law in laws.items())
        else:
            words = repr(laws)
        acts = ["body force"] if self.body_force is not None else []
        for count, noun in (
            (len(self.tractions), "traction"),
            (len(self.pressures), "pressure"),
            (len(self.supports), "support"),
        ):
            if count:
                acts.append(counted(count, noun))
        return f"{words}; {', '.join(acts) or 'no loads'}"

    def carried(self) -> BodySetup:
        """Return the same on the present mesh of the particles (collective)."""
        return replace(
            self,
            material=carried(self.particles, self.material),
            cell_tags=self.particles.carry(self.cell_tags),
            facet_tags=self.particles.carry(self.facet_tags),
        )

    def require_movable(self, consequence: str = "the particles cannot move") -> None:
        """Raise an error unless the body can be taken to another mesh.

        Args:
            consequence: What else cannot be.

        Raises:
            MPMError: Something lives on its present mesh.
        """
        for name in ("density", "body_force", "tractions", "pressures"):
            if holds(getattr(self, name), ufl.core.expr.Expr):
                raise MPMError(
                    f"{name} is written on the present body mesh, so {consequence}; give a "
                    "function that makes it from a mesh, e.g. "
                    "lambda mesh: ufl.SpatialCoordinate(mesh)[1]."
                )
        for name, value in self.more.items():
            if holds(value, ufl.core.expr.Expr):
                raise MPMError(
                    f"{name} is written on the present body mesh, so {consequence}; give numbers."
                )
        if self.supports:
            raise MPMError(f"supports= lie on the present body mesh, so {consequence}.")
        laws = self.material.values() if isinstance(self.material, Mapping) else [self.material]
        for law in laws:
            if any(isinstance(value, np.ndarray) for value in law.parameters.values()):
                raise MPMError(
                    "A material has arrays of parameters, one value for each particle of a rank, "
                    f"so {consequence}; use DG0 Functions."
                )

    def require_movable_nodes(self, consequence: str) -> None:
        """Raise an error unless the nodes of the body's mesh can be moved; see above."""
        self.require_movable(consequence)
        for name in ("density", "body_force", "tractions", "pressures"):
            if holds(getattr(self, name), Callable):
                raise MPMError(
                    f"{name} is a function of the mesh, whose nodes move, so {consequence}."
                )


@dataclass(frozen=True)
class Setup:
    """The bodies of a problem with materials, and what holds for all of them.

    Attributes:
        bodies: One setup for each body.
        axisymmetric: Whether ``x[0]`` is the radius of a body of revolution.
        f_bar: Average of the volume ratio that materials see.
        terms: What else acts on the bodies.
        mixed: What else is an unknown: ``None``, or one of ``MIXED``.

    Raises:
        MPMError: An average that there is not, or a term that takes the bodies for others.
    """

    bodies: tuple[BodySetup, ...]
    axisymmetric: bool
    f_bar: str
    terms: tuple[Term, ...] = ()
    mixed: str | None = None

    def __post_init__(self) -> None:
        """Say so where something is unknown."""
        require_truth("axisymmetric", self.axisymmetric)
        if not is_one_of(self.f_bar, F_BARS):
            raise MPMError(
                f"Unknown f_bar={self.f_bar!r}; choose one of {', '.join(map(repr, F_BARS))}."
            )
        if self.mixed is not None:
            self._require_mixed()
        for term in self.terms:
            if term.axisymmetric not in (None, self.axisymmetric):
                raise MPMError(
                    f"A {type(term).__name__} was made with axisymmetric={term.axisymmetric}, but "
                    f"the problem has axisymmetric={self.axisymmetric}; give both the same."
                )

    def _require_mixed(self) -> None:
        """Raise an error unless a pressure can be an unknown of all bodies."""
        if not is_one_of(self.mixed, MIXED):
            known = ", ".join(map(repr, MIXED))
            raise MPMError(f"Unknown mixed={self.mixed!r}; choose {known} or None.")
        if self.f_bar != "none":
            raise MPMError(f"mixed={self.mixed!r} takes the place of f_bar; leave f_bar='none'.")
        for body in (given.particles for given in self.bodies):
            degrees = [space.ufl_element().degree for space in (body.V, body.W)]
            if self.mixed == "stabilised pressure":
                if degrees != [1, 1]:
                    raise MPMError(
                        "mixed='stabilised pressure' is for a background and particles of degree "
                        f"1, not {degrees[0]} and {degrees[1]}; use mixed='pressure' there."
                    )
                if body.V.mesh.topology.cell_name() not in ("quadrilateral", "hexahedron"):
                    raise MPMError(
                        "mixed='stabilised pressure' needs a background of quadrilaterals or "
                        "hexahedra: on triangles or tetrahedra it would oscillate, or nearly so; "
                        "use degree 2 with mixed='pressure' there."
                    )
            elif min(degrees) < 2:
                raise MPMError(
                    "mixed='pressure' needs a background and particles of degree 2 or 3 "
                    f"(degree=2), not {degrees[0]} and {degrees[1]}: with displacements of degree "
                    "1 the pressure would oscillate; use mixed='stabilised pressure' or "
                    "f_bar='patch' there."
                )

    def carried(self) -> Setup:
        """Return the same on the present meshes of the particles (collective)."""
        return replace(self, bodies=tuple(body.carried() for body in self.bodies))

    def require_movable(self, consequence: str = "the particles cannot move") -> None:
        """Raise an error unless all bodies can be taken to other meshes.

        Args:
            consequence: What else cannot be.

        Raises:
            MPMError: Something lives on a present mesh.
        """
        for body in self.bodies:
            body.require_movable(consequence)
        for term in self.terms:
            term.require_movable(consequence)

    def require_divisible(self) -> None:
        """Raise an error unless domains may be split.

        Raises:
            MPMError: They may not.
        """
        self.require_movable("domains cannot be split")
        for term in self.terms:
            term.require_remeshable("domains cannot be split")
        if self.f_bar != "none":
            raise MPMError(
                f"Domains cannot be split with f_bar={self.f_bar!r}, whose averages they would "
                "change; it keeps most domains from folding by itself."
            )
        if self.axisymmetric:
            raise MPMError(
                "Domains of a body of revolution cannot be split, since the halves have other "
                "radii; use quadrature_degree=2 with f_bar='domain'."
            )
