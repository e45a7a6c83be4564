# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quasi-static equilibrium of particles with a material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem, mesh

from .constitutive import ConstitutiveHistory
from .errors import MPMError
from .materials import Material
from .particles import Particles
from .problem import ParticleProblem

__all__ = ["QuasiStaticProblem"]


class QuasiStaticProblem(ParticleProblem):
    """Equilibrium of a body with a material, under body force, tractions and supports.

    ``int P : grad v dX - load (int density b . v dX + int t . v dS) = 0`` on the undeformed
    body; the first Piola stress P and its tangent dP/dF are Functions on a quadrature element,
    injected into the UFL forms.

    Args:
        particles: The body.
        material: A material, or ``{cell tag: material}`` with ``cell_tags``.
        density: Mass per undeformed volume: a number, Constant, Function or UFL expression.
        body_force: Force per mass at full load: a tuple, Constant, Function or UFL expression
            on the body mesh.
        bcs: Dirichlet conditions on V, totals at full load.
        tractions: Pairs of a dead load per undeformed area at full load (tuple or UFL) and a
            tag of ``facet_tags``.
        cell_tags: Tags of the body's cells.
        facet_tags: Tags of the body's facets.
        background: Form on the background, as in :class:`ParticleProblem`.
        petsc_options_prefix: Prefix of the PETSc options.
        petsc_options: PETSc options, without prefix.
        shift: As in :class:`ParticleProblem`.
        line_search: As in :class:`ParticleProblem`.
        **options: ``form_compiler_options`` and ``jit_options``.

    Raises:
        MPMError: Materials, loads or conditions that do not go together.
    """

    def __init__(
        self,
        particles: Particles,
        material: Material | Mapping[int, Material],
        density: Any = 1.0,
        body_force: Any = None,
        bcs: Sequence[fem.DirichletBC] = (),
        tractions: Sequence[tuple[Any, int]] = (),
        cell_tags: mesh.MeshTags | None = None,
        facet_tags: mesh.MeshTags | None = None,
        background: ufl.Form | None = None,
        petsc_options_prefix: str = "mpm_",
        petsc_options: dict[str, Any] | None = None,
        *,
        shift: float = 1e-13,
        line_search: bool = True,
        **options: Any,
    ) -> None:
        if not isinstance(particles, Particles):
            raise MPMError(f"particles must be mpm.Particles, not {type(particles).__name__}.")
        history = ConstitutiveHistory(particles, material, cell_tags)
        dim = particles.mesh.geometry.dim
        self._first_piola = particles.quadrature_function("first_piola", (dim, dim))
        self._tangent = particles.quadrature_function("tangent", (dim,) * 4)
        self._constitutive = history
        v, du = ufl.TestFunction(particles.W), ufl.TrialFunction(particles.W)
        i, j, k, m = ufl.indices(4)
        R = ufl.inner(self._first_piola, ufl.grad(v)) * particles.dx
        J = self._tangent[i, j, k, m] * ufl.grad(du)[k, m] * ufl.grad(v)[i, j] * particles.dx
        if body_force is not None:
            force = _expression(body_force, particles, "body_force", (dim,))
            mass = _expression(density, particles, "density", ())
            R -= particles.load * mass * ufl.inner(force, v) * particles.dx_exact
        if tractions:
            ds = _facet_measure(particles, facet_tags, [tag for _, tag in tractions])
            for value, tag in tractions:
                traction = _expression(value, particles, "a traction", (dim,))
                R -= particles.load * ufl.inner(traction, v) * ds(tag)
        super().__init__(
            R,
            particles,
            J=J,
            bcs=bcs,
            background=background,
            petsc_options_prefix=petsc_options_prefix,
            petsc_options=petsc_options,
            symmetric=history.symmetric,
            shift=shift,
            line_search=line_search,
            **options,
        )
        particles._constitutive = history

    def evaluate(self) -> MPMError | None:
        """Update the stress and its tangent for the present displacement."""
        try:
            self._constitutive.update()
        except MPMError as error:
            return error
        _fill(self._first_piola, self._constitutive.first_piola)
        _fill(self._tangent, self._constitutive.tangent)
        return None

    def commit(self) -> None:
        """Make the last update the history."""
        self._constitutive.commit()

    def roll_back(self) -> None:
        """Return to the stress of the last converged step."""
        self._constitutive.roll_back()
        _fill(self._first_piola, self._constitutive.first_piola)

    @property
    def yield_function(self) -> NDArray[np.float64]:
        """Largest yield function of each particle's points, shape ``(n,)``; -1 where elastic."""
        return np.asarray(self._constitutive.yield_function().max(axis=1, initial=-np.inf))


def _fill(function: fem.Function, values: NDArray[np.float64]) -> None:
    function.x.array[: values.size] = values.ravel()


def _expression(value: Any, particles: Particles, name: str, shape: tuple[int, ...]) -> Any:
    """Return a value as a UFL expression on the body mesh."""
    if not isinstance(value, ufl.core.expr.Expr):
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise MPMError(f"{name} must be numbers or a UFL expression, not {value!r}.") from None
        if not np.all(np.isfinite(array)):
            raise MPMError(f"{name} must be finite, not {value!r}.")
        if name == "density" and array.ndim == 0 and array < 0.0:
            raise MPMError(f"density must not be negative, not {value!r}.")
        value = fem.Constant(particles.mesh, array)
    if value.ufl_shape != shape:
        raise MPMError(f"{name} has the shape {value.ufl_shape}, but must have {shape}.")
    for domain in ufl.domain.extract_domains(value):
        if domain != particles.mesh.ufl_domain():
            raise MPMError(f"{name} lives on another mesh; write it on the body mesh.")
    return value


def _facet_measure(
    particles: Particles, facet_tags: mesh.MeshTags | None, tags: Sequence[int]
) -> ufl.Measure:
    body = particles.mesh
    if facet_tags is None or facet_tags.dim != body.topology.dim - 1:
        raise MPMError("tractions need facet_tags=, tags of the body's facets.")
    known = set().union(*body.comm.allgather({int(t) for t in np.unique(facet_tags.values)}))
    for tag in tags:
        if tag not in known:
            raise MPMError(f"No facet has the tag {tag!r} of a traction; tags are {sorted(known)}.")
    return ufl.Measure(
        "ds", domain=body, subdomain_data=facet_tags, metadata=particles.dx_exact.metadata()
    )
