# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What particles can be made of, and the sentences for what they cannot."""

from __future__ import annotations

from typing import Any

from dolfinx import fem, mesh

from . import _compat
from .errors import MPMError
from .methods import BOX_CELLS, METHODS
from .quadrature import default_degree

__all__ = ["validate_distortion", "validate_options", "validate_spaces"]

DEGREES = (1, 2, 3)


def validate_spaces(body: Any, V: Any) -> None:
    """Raise an error unless a body and a background space go together."""
    if not isinstance(body, mesh.Mesh):
        raise MPMError(f"The body must be a dolfinx.mesh.Mesh, not {type(body).__name__}.")
    if not isinstance(V, fem.FunctionSpace):
        raise MPMError(
            f"V must be a dolfinx FunctionSpace on the background, not {type(V).__name__}."
        )
    background = V.mesh
    gdim = body.geometry.dim
    if V.mesh is body:
        raise MPMError("V lives on the body mesh; make it on the background mesh.")
    if gdim not in (2, 3) or body.topology.dim != gdim:
        raise MPMError(
            f"The body must fill its space in 2-D or 3-D; it has topological dimension "
            f"{body.topology.dim} in {gdim} dimensions."
        )
    if background.geometry.dim != gdim or background.topology.dim != gdim:
        raise MPMError(
            f"The body is {gdim}-dimensional, the background {background.geometry.dim}-"
            "dimensional; both must have the same dimension."
        )
    cells = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
    for what, domain in (("body", body), ("background", background)):
        if domain.topology.cell_name() not in cells:
            raise MPMError(
                f"The {what} has {domain.topology.cell_name()} cells; use one of "
                f"{', '.join(cells)}."
            )
    element = V.ufl_element()
    if (
        element.reference_value_shape != (gdim,)
        or element.family_name != "P"
        or (element.discontinuous)
    ):
        raise MPMError(
            f"V must be a continuous Lagrange space of vectors with {gdim} components, e.g. "
            f'fem.functionspace(background, ("Lagrange", 1, ({gdim},))).'
        )
    if V.dofmap.index_map_bs != gdim:
        raise MPMError("V must not be a subspace; pass the whole vector space.")
    if body.comm.size != background.comm.size:
        raise MPMError(
            "The body and the background live on different numbers of ranks; make both on the "
            "same communicator."
        )


def _validate_degrees(body: mesh.Mesh, background: int, domains: Any) -> None:
    """Raise an error unless the degrees of background and domains are a good pair.

    Domains of a lower degree than the background's lose its order; quadrilaterals and hexahedra
    with one point also have modes without strain at any density (docs/high-order.md).
    """
    if background not in DEGREES:
        raise MPMError(
            f"The background has degree {background}; use "
            f"{'1' if background < 1 else '3, the highest that is supported'}."
        )
    if not isinstance(domains, int) or domains not in DEGREES:
        raise MPMError(f"The domains' degree must be 1, 2 or 3, not {domains!r}.")
    if domains < background:
        hourglass = domains == 1 and body.basix_cell() in BOX_CELLS
        why = "leave modes without strain and lose its order" if hourglass else "lose its order"
        raise MPMError(
            f"Domains of degree {domains} on a background of degree {background} {why}; use "
            f"degree={background}, or a background of degree {domains}."
        )


def validate_options(
    body: mesh.Mesh,
    V: fem.FunctionSpace,
    method: str,
    degree: int,
    quadrature_degree: int | None,
    outside: str,
    domain_update: str,
) -> None:
    """Raise an error unless method, degrees and policies go together."""
    element = V.ufl_element()
    if method not in METHODS:
        raise MPMError(f"Unknown method {method!r}; choose one of {', '.join(map(repr, METHODS))}.")
    _validate_degrees(body, element.degree, degree)
    if method != "cpdi2" and (element.degree, degree, quadrature_degree or 1) != (1, 1, 1):
        raise MPMError(
            f"Method {method!r} has one quadrature point per domain of degree 1, on a background "
            "of degree 1; use 'cpdi2' for others."
        )
    if quadrature_degree is not None and (
        not isinstance(quadrature_degree, int) or quadrature_degree < 0
    ):
        raise MPMError(
            f"quadrature_degree must be a whole number from 0 on, not {quadrature_degree!r}."
        )
    if quadrature_degree is not None and degree > 1 and quadrature_degree < 2 * degree - 2:
        raise MPMError(
            f"A rule of degree {quadrature_degree} does not see all strains of a domain of degree "
            f"{degree}; use quadrature_degree={default_degree(body.basix_cell().name, degree)} "
            "or more."
        )
    if outside not in ("error", "stop", "delete"):
        raise MPMError(f"Unknown policy outside={outside!r}; choose 'error', 'stop' or 'delete'.")
    if domain_update not in ("stretch", "fixed"):
        raise MPMError(f"Unknown domain_update={domain_update!r}; choose 'stretch' or 'fixed'.")


def validate_distortion(
    body: mesh.Mesh, method: str, degree: int, quadrature_degree: int | None, policy: str
) -> None:
    """Raise an error unless the policy for distorted domains is one for these domains."""
    if policy not in ("error", "split"):
        raise MPMError(f"Unknown policy on_distortion={policy!r}; choose 'error' or 'split'.")
    plain = (body.basix_cell(), _compat.geometry_degree(body)) == (BOX_CELLS[0], 1)
    one_point = plain and (method, degree) == ("cpdi2", 1) and quadrature_degree in (None, 0, 1)
    if policy == "split" and not one_point:
        raise MPMError(
            "Only quadrilaterals with one quadrature point and method 'cpdi2' can be split "
            "(on_distortion='split'); others fold less with quadrature_degree=2 and f_bar='domain'."
        )
