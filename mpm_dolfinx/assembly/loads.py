# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The virtual work of loads on a body, in UFL."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import ufl
from dolfinx import fem, mesh
from ufl.algorithms.analysis import extract_coefficients

from ..constitutive.strain import Strain
from ..errors import MPMError, agree
from ..meshes.tags import require_on_boundary
from ..meshes.values import Value, as_ufl
from ..particles.particles import Particles

__all__ = ["VirtualWork", "changeable", "facet_measure"]


def facet_measure(
    particles: Particles,
    facet_tags: mesh.MeshTags | None,
    loads: Sequence[tuple[Value, int]],
    what: str,
) -> ufl.Measure:
    """Return the measure on a body's tagged facets, for pairs of a value and a tag.

    Raises:
        MPMError: Tags that are none.
    """
    require_on_boundary(particles.mesh, facet_tags, [tag for _, tag in loads], what)
    return ufl.Measure(
        "ds",
        domain=particles.mesh,
        subdomain_data=facet_tags,
        metadata=particles.dx_exact.metadata(),
    )


class VirtualWork:
    """The forms of a body.

    Args:
        strain: What the body is strained in.
    """

    def __init__(self, strain: Strain) -> None:
        self._strain = strain
        self._body = strain.particles
        self._dim = self._body.mesh.geometry.dim
        self._v = ufl.TestFunction(self._body.W)

    def mass(self, density: Any, test: Any) -> ufl.Form:
        """Return the integral of the density times a test function."""
        form: ufl.Form = density * self._strain.turn * test * self._body.dx_exact
        return form

    def _at_load(self, terms: Sequence[ufl.Form]) -> ufl.Form:
        """Return the sum of terms times the load factor."""
        return ufl.Form([i for term in terms for i in (self._body.load * term).integrals()])

    def body_force(self, density: Any, force: Any) -> ufl.Form:
        """Return the virtual work of the body force."""
        b = as_ufl(force, self._body.mesh, "body_force", (self._dim,))
        work: ufl.Form = density * self._strain.turn * ufl.inner(b, self._v) * self._body.dx_exact
        return self._at_load([work])

    def seepage(self, pressure: Any) -> ufl.Form:
        """Return the virtual work of the gradient of a pore pressure, in the undeformed body.

        Raises:
            MPMError: It is no pressure, or one that jumps between cells.
        """
        p = as_ufl(pressure, self._body.mesh, "pore_pressure")
        with agree(self._body.mesh.comm):
            if any(f.ufl_element() not in ufl.H1 for f in extract_coefficients(p)):
                raise MPMError(
                    "pore_pressure acts by its gradient, which a Function that jumps between cells "
                    "does not have; give one of a continuous space, such as ('Lagrange', 1)."
                )
        force = -ufl.grad(p) * self._body.undeformed.mass_ratio
        work: ufl.Form = self._strain.turn * ufl.inner(force, self._v) * self._body.dx_exact
        return self._at_load([work])

    def tractions(self, loads: Sequence[tuple[Any, int]], tags: Any) -> ufl.Form:
        """Return the virtual work of dead tractions."""
        ds = facet_measure(self._body, tags, loads, "tractions")
        terms = [
            self._strain.turn
            * self._body.undeformed.area_ratio
            * ufl.inner(as_ufl(t, self._body.mesh, "a traction", (self._dim,)), self._v)
            * ds(tag)
            for t, tag in loads
        ]
        return self._at_load(terms)

    def pressures(self, loads: Sequence[tuple[Any, int]], tags: Any) -> ufl.Form:
        """Return minus the virtual work of pressures on the deformed facets."""
        ds = facet_measure(self._body, tags, loads, "pressures")
        d = self._body.displacement
        F = ufl.Identity(self._dim) + ufl.grad(d)
        area = ufl.det(F) * ufl.inv(F).T * ufl.FacetNormal(self._body.mesh)
        area *= self._strain.present_turn
        terms = [
            as_ufl(p, self._body.mesh, "a pressure") * ufl.inner(area, self._v) * ds(tag)
            for p, tag in loads
        ]
        return self._at_load(terms)


def changeable(load: ufl.Form, particles: Particles) -> list[fem.Constant | fem.Function]:
    """Return the Constants and Functions of a load that a user may change, none of the body's."""
    own = (particles.load, particles.displacement)
    return [f for f in (*load.constants(), *load.coefficients()) if all(f is not o for o in own)]
