# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The virtual work of stress and loads on a body, in UFL."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import ufl
from dolfinx import fem

from .boundary import Support
from .constitutive import ConstitutiveHistory
from .expressions import as_expression, facet_measure
from .particles import Particles

__all__ = ["VirtualWork"]


class VirtualWork:
    """The forms of a body in plane strain or space, or of a body of revolution.

    Args:
        body: The body.
        axisymmetric: Whether ``x[0]`` is the radius of a body of revolution.
    """

    def __init__(self, body: Particles, axisymmetric: bool) -> None:
        self._body = body
        self._axisymmetric = axisymmetric
        self._dim = body.mesh.geometry.dim
        self._v = ufl.TestFunction(body.W)
        self._radius = ufl.SpatialCoordinate(body.mesh)[0]
        self._turn = 2.0 * np.pi * self._radius if axisymmetric else 1.0

    def _gradient(self, w: Any) -> Any:
        if not self._axisymmetric:
            return ufl.grad(w)
        g = ufl.grad(w)
        hoop = w[0] / self._radius
        return ufl.as_tensor([[g[0, 0], g[0, 1], 0], [g[1, 0], g[1, 1], 0], [0, 0, hoop]])

    def internal(self, P: fem.Function, A: fem.Function) -> tuple[ufl.Form, ufl.Form]:
        """Return the internal virtual work and its tangent."""
        i, j, k, m = ufl.indices(4)
        trial = self._gradient(ufl.TrialFunction(self._body.W))
        test = self._gradient(self._v)
        work = self._turn * ufl.inner(P, test) * self._body.dx
        tangent = self._turn * A[i, j, k, m] * trial[k, m] * test[i, j] * self._body.dx
        return work, tangent

    def mass(self, density: Any, test: Any) -> ufl.Form:
        """Return the integral of the density times a test function."""
        form: ufl.Form = density * self._turn * test * self._body.dx_exact
        return form

    def _at_load(self, terms: Sequence[ufl.Form]) -> ufl.Form:
        """Return the sum of terms times the load factor."""
        return ufl.Form([i for term in terms for i in (self._body.load * term).integrals()])

    def body_force(self, density: Any, force: Any) -> ufl.Form:
        """Return the virtual work of the body force."""
        b = as_expression(force, self._body, "body_force", (self._dim,))
        work: ufl.Form = density * self._turn * ufl.inner(b, self._v) * self._body.dx_exact
        return self._at_load([work])

    def tractions(self, loads: Sequence[tuple[Any, int]], tags: Any) -> ufl.Form:
        """Return the virtual work of dead tractions."""
        ds = facet_measure(self._body, tags, loads, "tractions")
        terms = [
            self._turn
            * self._body.area_ratio
            * ufl.inner(as_expression(t, self._body, "a traction", (self._dim,)), self._v)
            * ds(tag)
            for t, tag in loads
        ]
        return self._at_load(terms)

    def support(self, support: Support, history: ConstitutiveHistory) -> ufl.Form:
        """Return minus the virtual work of a support."""
        if not support.has_modulus:
            modulus = fem.Function(fem.functionspace(self._body.mesh, ("DG", 0)))
            cells = modulus.function_space.dofmap.list[: self._body.num_local, 0]
            modulus.x.array[cells] = history.initial_modulus()
            support.scale(modulus)
        support.revolve(self._turn)
        return support.residual

    def pressures(self, loads: Sequence[tuple[Any, int]], tags: Any) -> ufl.Form:
        """Return minus the virtual work of pressures on the deformed facets."""
        ds = facet_measure(self._body, tags, loads, "pressures")
        d = self._body.displacement
        F = ufl.Identity(self._dim) + ufl.grad(d)
        area = ufl.det(F) * ufl.inv(F).T * ufl.FacetNormal(self._body.mesh)
        if self._axisymmetric:
            area *= 2.0 * np.pi * (self._radius + d[0])
        terms = [
            as_expression(p, self._body, "a pressure", ()) * ufl.inner(area, self._v) * ds(tag)
            for p, tag in loads
        ]
        return self._at_load(terms)
