# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Dependencies of the integrals of a form, and the quadrature rule that each one needs."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

import ufl
from dolfinx import fem
from ufl.algorithms.estimate_degrees import estimate_total_polynomial_degree
from ufl.classes import Division, Grad, Indexed, SpatialCoordinate, Zero
from ufl.corealg.traversal import traverse_unique_terminals, unique_pre_traversal

from ..errors import MPMError
from ..meshes.quadrature import quadrature_rule
from .expansion import expanded

__all__ = [
    "couples_cells",
    "data_at_points",
    "depends_on",
    "follows",
    "parts_with",
    "split_by_rule",
]


def parts_with(
    space: fem.FunctionSpace,
    form: Any,
    rank: int,
    what: str,
    where: str,
    *unknowns: fem.Function,
    zero: bool = False,
) -> list[ufl.Form]:
    """Return the parts by rule of a form whose test (and trial) function are from a space.

    Args:
        space: The space.
        form: The form.
        rank: 1, or 2 with a trial function.
        what: What messages call the form.
        where: What messages call the space.
        *unknowns: As of :func:`split_by_rule`.
        zero: Whether the form may be zero, which has no parts.

    Raises:
        MPMError: Another form, or as :func:`split_by_rule`.
    """
    is_form = isinstance(form, ufl.Form)
    parts = split_by_rule(form, *unknowns) if is_form else []
    if is_form and not parts:
        if zero:
            return parts
        raise MPMError(f"{what} is zero.")
    arguments = form.arguments() if is_form else ()
    if len(arguments) != rank:
        kind = "one test function" if rank == 1 else "a test and a trial function"
        raise MPMError(f"{what} must be a UFL form with {kind} of {where}.")
    if any(argument.ufl_function_space() != space for argument in arguments):
        kind = "test function" if rank == 1 else "test and trial functions"
        raise MPMError(f"The {kind} of {what} must be from {where}.")
    return parts


def couples_cells(form: ufl.Form) -> bool:
    """Return whether a form's element tensors have dofs of more than one cell."""
    return any(i.integral_type() not in ("cell", "exterior_facet") for i in form.integrals())


def depends_on(form: ufl.Form, function: fem.Function) -> bool:
    """Return whether a form contains a function."""
    return any(c is function for c in form.coefficients())


def follows(form: ufl.Form, *unknowns: fem.Function) -> bool:
    """Return whether a form changes during a step.

    It does where it has the displacement or another unknown, or data injected at quadrature
    points.
    """
    return any(depends_on(form, f) for f in unknowns) or bool(data_at_points(form))


def data_at_points(form: ufl.Form) -> set[fem.Function]:
    """Return the Functions at quadrature points that a form holds."""
    return {c for c in form.coefficients() if c.ufl_element().has_custom_quadrature}


def _rule(integral: Any, integrand: Any) -> tuple[int, str]:
    """Return the degree and scheme that one integral, expanded, is meant to be integrated with."""
    metadata = integral.metadata()
    degree = metadata.get("quadrature_degree", -1)
    scheme = str(metadata.get("quadrature_rule", "default"))
    at_points = False
    for terminal in traverse_unique_terminals(integral.integrand()):
        if not isinstance(terminal, fem.Function | ufl.Argument):
            continue
        space: Any = terminal.ufl_function_space()  # type: ignore[no-untyped-call]
        element = space.ufl_element()
        if not element.has_custom_quadrature:
            continue
        at_points = True
        points = element.custom_quadrature()[0]
        if degree == -1:
            degree = element.degree
        cell = space.mesh.basix_cell()
        rule, _ = quadrature_rule(cell, degree)
        if points.shape != rule.shape or not np.allclose(points, rule):
            name = getattr(terminal, "name", "a test function")
            raise MPMError(
                f"The form integrates '{name}', known at {len(points)} quadrature "
                f"point(s) of a domain, with a rule of {len(rule)} point(s); integrate it with "
                "particles.dx."
            )
    if at_points:
        _require_no_gradient(integrand)
    if degree == -1:
        estimate = estimate_total_polynomial_degree(integrand)
        degree = max(estimate) if isinstance(estimate, tuple) else estimate
    return int(degree), scheme


def _require_no_gradient(integrand: Any) -> None:
    """Raise an error where an integral has a gradient of what is known at points alone."""
    for node in unique_pre_traversal(integrand):
        if not isinstance(node, Grad):
            continue
        inner = node.ufl_operands[0]
        if not isinstance(inner, ufl.Coefficient | ufl.Argument):
            continue
        element: Any = inner.ufl_element()  # type: ignore[no-untyped-call]
        if getattr(element, "has_custom_quadrature", False):
            raise MPMError(
                f"The form holds a gradient of {_name_of(inner)}, which is known at "
                "quadrature points alone; for gradients make a field with at='nodes'."
            )


def _require_radius_seen(integral: Any, degree: int, *unknowns: fem.Function) -> None:
    """Raise an error where the one point of a quadrilateral stands for strains around an axis.

    They are told by an unknown or an argument over ``x[0]``.
    """
    one_point = degree <= 1 and integral.ufl_domain().ufl_cell().cellname == "quadrilateral"
    if integral.integral_type() != "cell" or not one_point:
        return
    for node in unique_pre_traversal(integral.integrand()):
        if not isinstance(node, Division):
            continue
        moved, radius = node.ufl_operands
        if not isinstance(radius, Indexed) or int(radius.ufl_operands[1][0]) != 0:
            continue
        if isinstance(radius.ufl_operands[0], SpatialCoordinate) and any(
            isinstance(t, ufl.Argument) or any(t is u for u in unknowns)
            for t in traverse_unique_terminals(moved)
        ):
            raise MPMError(
                "The form divides a displacement by the radius x[0] at the one point of a "
                "quadrilateral, which is wrong at the axis however small domains are; make the "
                "particles with quadrature_degree=2, or give a QuasiStaticProblem or a "
                "DynamicProblem axisymmetric=True."
            )


def _name_of(terminal: Any) -> str:
    """Return the name of a Function, or what an argument is."""
    return (
        f"'{terminal.name}'" if isinstance(terminal, fem.Function) else "a test or trial function"
    )


def split_by_rule(form: ufl.Form, *unknowns: fem.Function) -> list[ufl.Form]:
    """Split a form so that each part has one rule, one kind of dependence and one set of tags.

    Integrals that are zero, as in ``0.0 * form``, are left out: FFCx makes nothing of them.

    FFCx (0.9 to 0.11) miscompiles a form that mixes a one-point rule with another rule, so
    each rule gets a form of its own; parts that are constant during a step are apart too.

    Args:
        form: Any UFL form on the body mesh.
        *unknowns: The displacement of the body, and its other unknowns.

    Returns:
        The parts, whose sum is ``form``.

    Raises:
        MPMError: Where data at quadrature points meet another rule, or one point of a
            quadrilateral a strain around an axis.
    """
    parts: dict[tuple[bool, str, int, str, int], list[Any]] = defaultdict(list)
    markers: list[Any] = []
    for integral in form.integrals():
        integrand = expanded(integral.integrand())
        if isinstance(integrand, Zero):
            continue
        degree, scheme = _rule(integral, integrand)
        _require_radius_seen(integral, degree, *unknowns)
        metadata = dict(integral.metadata())
        metadata.update(quadrature_degree=degree, quadrature_rule=scheme)
        one = integral.reconstruct(metadata=metadata)
        constant = not follows(ufl.Form([one]), *unknowns)
        tags = integral.subdomain_data()
        seen = [i for i, known in enumerate(markers) if known is tags]
        if not seen:
            markers.append(tags)
        place = seen[0] if seen else len(markers) - 1
        parts[constant, integral.integral_type(), degree, scheme, place].append(one)
    return [ufl.Form(parts[key]) for key in sorted(parts)]
