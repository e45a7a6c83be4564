# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Arguments of problems, made uniform, and whether a problem can move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem, mesh
from ufl.corealg.traversal import traverse_unique_terminals
from ufl.domain import extract_unique_domain
from ufl.measure import integral_type_to_measure_name

from .. import _compat
from ..boundary.supports import Support
from ..errors import MPMError
from ..materials.base import Material
from ..meshes.tags import is_tag
from ..particles.field import CarriedField, ParticleField
from ..particles.particles import LoadFactor, Particles
from ..system.term import Term

__all__ = [
    "as_bodies",
    "as_conditions",
    "as_fields",
    "as_pairs",
    "as_supports",
    "as_terms",
    "by_space",
    "carried",
    "holds",
    "one_for_each",
    "require_background_fields",
    "require_entity_maps",
    "require_no_conditions_on_bodies",
    "require_own_fields",
    "residuals_of",
]

#: Where integrals of these types are.
PLACES = {"cell": "of the mesh", "exterior_facet": "on the boundary", "interior_facet": "inside"}


def as_bodies(particles: Particles | Sequence[Particles]) -> list[Particles]:
    """Return the bodies of a problem as a list.

    Raises:
        MPMError: Something else than particles, or particles that share no space or ranks.
    """
    bodies = [particles] if isinstance(particles, Particles) else particles
    if (
        not isinstance(bodies, list | tuple)
        or not bodies
        or not all(isinstance(body, Particles) for body in bodies)
    ):
        raise MPMError(
            f"particles must be mpm.Particles or a list of them, not {type(particles).__name__}."
        )
    if len({id(body) for body in bodies}) < len(bodies):
        raise MPMError("The same particles are given twice.")
    first = bodies[0].V.mesh
    same = (MPI.IDENT, MPI.CONGRUENT)
    if any(
        body.V.mesh.geometry.dim != first.geometry.dim
        or MPI.Comm.Compare(body.V.mesh.comm, first.comm) not in same
        for body in bodies
    ):
        raise MPMError(
            "All particles of one problem must be in a space of the same dimension and on the same "
            "ranks."
        )
    return list(bodies)


def as_pairs(name: str, loads: Any) -> Sequence[Any]:
    """Return loads on facets as they are given.

    Args:
        name: What they are called in a message.
        loads: What is given; ``None``: none.

    Raises:
        MPMError: No list of pairs, such as a ``zip`` that is empty after it was looked at once.
    """
    if loads is None:
        return ()
    for pair in loads if isinstance(loads, list | tuple) else [loads]:
        if loads is pair or not isinstance(pair, list | tuple) or len(pair) != 2:
            raise MPMError(
                f"{name} must be a list of pairs of a value and a tag, such as [(1.0, 1)], not "
                f"{loads!r}."
            )
    return tuple(loads)


def as_fields(fields: Any, bodies: Sequence[Particles]) -> list[ParticleField]:
    """Return unknowns besides displacements as a list.

    Raises:
        MPMError: Something else, fields of other bodies, or names that are not their own.
    """
    known = isinstance(fields, list | tuple) and all(isinstance(f, ParticleField) for f in fields)
    if not known:
        raise MPMError("fields must be a list of mpm.ParticleField.")
    if len({id(field) for field in fields}) < len(fields):
        raise MPMError("The same field is given twice.")
    for body in bodies:
        names = [field.name for field in fields if field.particles is body]
        if len(set(names)) < len(names):
            raise MPMError(f"Fields are known by their names, which must differ, not {names}.")
    for field in fields:
        if all(field.particles is not body for body in bodies):
            raise MPMError(f"The field '{field.name}' is of particles that this problem has not.")
        if any(field.background is body.V for body in bodies):
            raise MPMError(
                f"The field '{field.name}' is on the V of a displacement; give it a space of its "
                "own, on the same mesh if you like."
            )
        for other in fields:
            alike = (field.kind == "increment") == (other.kind == "increment")
            if other.background is field.background and not alike:
                raise MPMError("Fields on one background space must be of the same kind.")
    return list(fields)


def residuals_of(
    R: Any, bodies: Sequence[Particles], fields: Sequence[ParticleField]
) -> tuple[list[Any], list[ufl.Form]]:
    """Return the residuals of bodies and those of fields.

    Raises:
        MPMError: More or less of them than bodies and fields, or not forms.
    """
    if not fields:
        return one_for_each(R, bodies, "residual R"), []
    given = list(R) if isinstance(R, list | tuple) else [R]
    count = len(bodies)
    if len(given) != count + len(fields):
        raise MPMError(
            f"There are {count} bodies and {len(fields)} fields; give R as a list with one "
            "residual for each body, then one for each field."
        )
    for field, form in zip(fields, given[count:], strict=True):
        if not isinstance(form, ufl.Form):
            raise MPMError(f"The residual of the field '{field.name}' must be a UFL form.")
    for number, body in enumerate(bodies):
        if given[number] is None and all(field.particles is not body for field in fields):
            raise MPMError(f"Body {number} has neither a residual nor fields.")
    return given[:count], given[count:]


def require_own_fields(
    form: Any,
    number: int,
    bodies: Sequence[Particles],
    what: str,
    fields: Sequence[ParticleField] = (),
    mapped: bool = False,
) -> None:
    """Raise an error where a form of a body holds what its tangent or its steps do not see.

    Args:
        form: A UFL form, or anything else, which is left to others.
        number: Number of its body.
        bodies: The bodies of the problem.
        what: What it is called in a sentence.
        fields: The unknowns of the problem besides displacements.
        mapped: Whether there are maps to other meshes; Functions on them are left to DOLFINx.

    Raises:
        MPMError: A field that is no unknown, a displacement or load factor of another body, or
            something of another mesh.
    """
    if not isinstance(form, ufl.Form):
        return
    body = bodies[number]
    name = what if len(bodies) == 1 else f"{what} of body {number}"
    for other, displacement in enumerate(b.displacement for b in bodies):
        if other != number and any(c is displacement for c in form.coefficients()):
            raise MPMError(
                f"The {name} holds the displacement of body {other}, whose change it would feel a "
                "step late; a residual knows its own body alone, and bodies of one problem act on "
                "each other by the background that they share, or by terms=."
            )
    for function in form.coefficients():
        known = any(function is field for field in fields)
        if isinstance(function, ParticleField) and not known:
            raise MPMError(
                f"The {name} holds the field '{function.name}', which is no unknown of the "
                "problem; give it in fields=, or use its .previous."
            )
    _require_own_load(form, body, name)
    _require_mesh(form, body.mesh, name, "particles.mesh", mapped)


def require_background_fields(form: Any, bodies: Sequence[Particles]) -> None:
    """Raise an error where a form on the background holds what its tangent does not see.

    Args:
        form: A UFL form, or anything else, which is left to others.
        bodies: The bodies of the problem; it is in the increment of the first one.

    Raises:
        MPMError: An increment or load factor of another body, or something of another mesh.
    """
    if not isinstance(form, ufl.Form):
        return
    for other, body in enumerate(bodies[1:], start=1):
        if any(c is body.increment for c in form.coefficients()):
            raise MPMError(
                f"The background form holds the increment of body {other}, which is that of all; "
                "write it in that of the first body."
            )
    _require_own_load(form, bodies[0], "background form")
    _require_mesh(form, bodies[0].V.mesh, "background form", "the background")


def _require_own_load(form: ufl.Form, body: Particles, name: str) -> None:
    if any(isinstance(c, LoadFactor) and c is not body.load for c in form.constants()):
        raise MPMError(
            f"The {name} holds the load factor of other particles, which is not followed here; "
            "write it with particles.load of its own body"
            + (", the first one." if name == "background form" else ".")
        )


def _require_mesh(
    form: ufl.Form, domain: mesh.Mesh, name: str, where: str, mapped: bool = False
) -> None:
    """Raise an error where a form holds Functions or geometry of another mesh."""
    own = domain.ufl_domain()
    for integral in form.integrals():
        if integral.ufl_domain() != own:
            raise MPMError(f"The {name} integrates over another mesh than {where}.")
        for terminal in traverse_unique_terminals(integral.integrand()):
            kinds = (ufl.Coefficient, ufl.classes.GeometricQuantity)
            if isinstance(terminal, kinds) and extract_unique_domain(terminal) != own:
                called = type(terminal).__name__
                if isinstance(terminal, fem.Function):
                    if mapped:
                        continue
                    called = f"'{terminal.name}'"
                raise MPMError(
                    f"The {name} holds {called} of another mesh, but must be written on {where}; "
                    "interpolate it there."
                )
        _require_tags(integral, domain, name, where)


def _require_tags(integral: ufl.Integral, domain: mesh.Mesh, name: str, where: str) -> None:
    """Raise an error where the tags of an integral are none of its mesh, or name nothing there.

    DOLFINx would integrate over nothing, or over entities of another mesh, which may end the
    process (collective).
    """
    kind, wanted, data = (
        integral.integral_type(),
        integral.subdomain_id(),
        integral.subdomain_data(),
    )
    if kind not in PLACES:
        return
    measure, dim = integral_type_to_measure_name[kind], domain.topology.dim - (kind != "cell")
    if isinstance(data, mesh.MeshTags):
        if not _compat.are_tags_of(data, domain):
            raise MPMError(
                f"The {name} integrates over {measure} with tags of another mesh; make them on "
                f"{where}."
            )
        if data.dim != dim:
            raise MPMError(
                f"The {name} integrates over {measure} with tags of dimension {data.dim}, but "
                f"needs tags of dimension {dim}."
            )
        found = data.values
        if kind == "exterior_facet":
            domain.topology.create_connectivity(dim, dim + 1)
            outer = mesh.exterior_facet_indices(domain.topology)
            found = found[np.isin(data.indices, outer)]
        mine = {int(tag) for tag in np.unique(found)}
    elif isinstance(data, list | tuple):
        mine = {int(tag) for tag, entities in data if len(entities)}
    else:
        mine = set()
    known = set().union(*domain.comm.allgather(mine))
    for tag in wanted if isinstance(wanted, tuple) else (wanted,):
        if is_tag(tag) and tag not in known:
            there = f"there are {sorted(known)}" if known else "its measure has none"
            raise MPMError(
                f"The {name} integrates over {measure}({tag}), but nothing {PLACES[kind]} has the "
                f"tag {tag}; {there}."
            )


def one_for_each(forms: Any, bodies: Sequence[Particles], what: str) -> list[Any]:
    """Return forms, of which each body has one, as a list.

    Raises:
        MPMError: More or less of them than bodies.
    """
    given = list(forms) if isinstance(forms, list | tuple) else [forms]
    if len(given) != len(bodies):
        raise MPMError(f"There are {len(bodies)} bodies; give one {what} for each, as a list.")
    return given


def by_space[Moved: (Particles, CarriedField)](bodies: Sequence[Moved]) -> list[list[Moved]]:
    """Return the bodies on each background space, in the order in which the spaces come first."""
    groups: list[list[Moved]] = []
    for body in bodies:
        known = [group for group in groups if group[0].V is body.V]
        if known:
            known[0].append(body)
        else:
            groups.append([body])
    return groups


def as_terms(terms: Any, bodies: Sequence[Particles]) -> list[Term]:
    """Return the terms that act on bodies, as a list.

    Raises:
        MPMError: Something else than terms, or terms on other bodies.
    """
    if not isinstance(terms, list | tuple) or not all(isinstance(t, Term) for t in terms):
        raise MPMError("terms must be a list of mpm.Term, such as mpm.Tie.")
    if len({id(term) for term in terms}) < len(terms):
        raise MPMError("A term stands twice in terms, and would act twice; give it once.")
    for term in terms:
        if any(all(own is not body for body in bodies) for own in term.bodies):
            raise MPMError(
                f"A {type(term).__name__} acts on other particles than those of this problem."
            )
    return list(terms)


def require_entity_maps(entity_maps: Any) -> None:
    """Raise an error unless entity_maps= is what ``dolfinx.fem.form`` takes."""
    listed = isinstance(entity_maps, list | tuple)
    if entity_maps is not None and not (
        listed and all(isinstance(one, mesh.EntityMap) for one in entity_maps)
    ):
        raise MPMError(
            "entity_maps must be a list of dolfinx.mesh.EntityMap, such as the second that "
            "create_submesh returns."
        )


def as_conditions(bcs: Any, spaces: Sequence[fem.FunctionSpace]) -> list[fem.DirichletBC]:
    """Return Dirichlet conditions on some background spaces as a list.

    Raises:
        MPMError: Something else than conditions, or conditions on another space.
    """
    if not isinstance(bcs, list | tuple) or not all(isinstance(bc, fem.DirichletBC) for bc in bcs):
        raise MPMError("bcs must be a list of dolfinx.fem.DirichletBC.")
    if not all(any(_compat.is_condition_on(bc, V) for V in spaces) for bc in bcs):
        raise MPMError(
            "A Dirichlet condition is not on the background space V of the particles "
            "or on a component of it (V.sub(i)); one on W can hold free nodes alone."
        )
    return list(bcs)


def require_no_conditions_on_bodies(
    bcs: Sequence[fem.DirichletBC], bodies: Sequence[Particles], consequence: str
) -> None:
    """Raise an error where conditions hold free nodes of bodies that are to have other meshes.

    Args:
        bcs: Dirichlet conditions.
        bodies: The bodies.
        consequence: Says what cannot be.
    """
    free = [body.W for body in bodies if body.free_nodes is not None]
    if any(_compat.is_condition_on(bc, W) for bc in bcs for W in free):
        raise MPMError(f"Dirichlet conditions on W lie on the present body mesh, so {consequence}.")


def require_joined(bodies: Sequence[Particles], terms: Sequence[Term]) -> None:
    """Raise an error where bodies on one background would pass through each other.

    They stick by nodes that it carries, of which ``free="auto"`` leaves none.

    Args:
        bodies: The bodies.
        terms: What acts on them, of which contacts and ties couple two.
    """
    for body in bodies:
        if body.free_nodes is None or not body.free_nodes.automatic:
            continue
        for other in bodies:
            if other is body or other.V is not body.V:
                continue
            if not any(body in term.bodies and other in term.bodies for term in terms):
                raise MPMError(
                    "Bodies on one background stick by nodes that it carries, and free='auto' "
                    "leaves none: they would pass through each other; give each its own V, such as "
                    "a second function space on the same mesh, and couple them by a contact.Pair, "
                    "or make the particles with free=[]."
                )


def functions_of(assignment: Any) -> list[fem.Function]:
    """Return the Functions among the parameters of materials."""
    if isinstance(assignment, Mapping):
        return [function for material in assignment.values() for function in functions_of(material)]
    if not isinstance(assignment, Material):
        return []
    return [v for v in assignment.parameters.values() if isinstance(v, fem.Function)]


def carried(particles: Particles, assignment: Any) -> Any:
    """Return materials with their DG0 parameters on the mesh to which the particles have moved."""
    if isinstance(assignment, Mapping):
        return {tag: carried(particles, material) for tag, material in assignment.items()}
    if not isinstance(assignment, Material):
        return assignment
    functions = {
        name: particles.carry(value)
        for name, value in assignment.parameters.items()
        if isinstance(value, fem.Function)
    }
    return assignment.with_parameters(**functions) if functions else assignment


def holds(value: Any, kind: Any) -> bool:
    """Return whether a value, or one in lists and tuples, is of a kind."""
    if isinstance(value, list | tuple):
        return any(holds(entry, kind) for entry in value)
    return isinstance(value, kind)


def as_supports(supports: Any, bodies: Sequence[Particles]) -> list[Support]:
    """Return supports as a list.

    Raises:
        MPMError: Something else, or supports on other bodies.
    """
    if not isinstance(supports, list | tuple) or not all(isinstance(s, Support) for s in supports):
        raise MPMError("supports must be a list of supports made by mpm.boundary.")
    if any(all(s.particles is not body for body in bodies) for s in supports):
        raise MPMError("A support was made with other particles than those of this problem.")
    if len({id(support) for support in supports}) < len(supports):
        raise MPMError("A support stands twice in supports, and would hold twice; give it once.")
    return list(supports)
