# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Small bodies and problems, with something wrong where a test wants it so."""

import numpy as np
import scenes
from posed import posed
from scenes import QUADRILATERAL, TRIANGLE

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import _compat
from mpm_dolfinx.materials import Hencky


def background(cell=QUADRILATERAL):
    return scenes.box([-1.0, -1.0], [2.0, 2.0], [6, 6], cell)


def held_background():
    """A background with a side at x = 0."""
    return scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL)


def body():
    return scenes.unit(2, TRIANGLE)


def particles(**options):
    return mpm.Particles(body(), scenes.vectors(background()), **options)


def problem(material=None, **options):
    """Return a function that makes a problem with a material; options may depend on particles."""

    def build():
        p = particles()
        more = {k: f(p) if callable(f) else f for k, f in options.items()}
        law = material(p) if callable(material) else material
        law = Hencky(1e3, 0.3) if law is None else law
        return posed(mpm.QuasiStaticProblem, p, law, **more)

    return build


def tags_of_facets(p):
    return scenes.facet_tags(p.mesh, scenes.at(0, 0.0))


def values(n):
    return lambda p: Hencky(np.full(p.num_local + n, 1e3), 0.3)


def held(kind, **options):
    """Return a function that makes a problem with a support of the body's own boundary."""

    def build():
        p = particles()
        make = getattr(mpm.boundary, kind)
        more = {"facet_tags": tags_of_facets(p), "tag": 1}
        more |= {k: f(p) if callable(f) else f for k, f in options.items()}
        return mpm.QuasiStaticProblem(mpm.Body(p, Hencky(1e3, 0.3)), supports=[make(p, **more)])

    return build


def tie(**options):
    """Return a function that makes a tie of two bodies of which one lies on the other."""

    def build():
        a, b = (
            mpm.Particles(
                scenes.box(low, high, (2, 1), QUADRILATERAL), scenes.vectors(background())
            )
            for low, high in (([0.0, 0.0], [1.0, 0.5]), ([0.0, 0.5], [1.0, 1.0]))
        )
        tags = scenes.facet_tags(a.mesh, scenes.at(1, 0.5))
        return mpm.Tie(a, b, tags, 1, **{"stiffness": 1e5} | options)

    return build


def touching(domain, where):
    """Return the input indices of all cells with a vertex where a marker holds."""
    vertices = domain.geometry.x[_compat.geometry_dofmap(domain)]
    count = domain.topology.index_map(2).size_local
    mine = np.flatnonzero(where(vertices[:count]).any(axis=1))
    index = domain.topology.original_cell_index[mine]
    return sorted(int(i) for i in scenes.gather(index))


def with_one_value(p, all_others, first):
    """Return a DG0 Function that is ``first`` in particle 0 and ``all_others`` elsewhere."""
    function = fem.Function(fem.functionspace(p.mesh, ("DG", 0)))
    function.x.array[:] = all_others
    mine = np.flatnonzero(p.global_index == 0)
    function.x.array[function.function_space.dofmap.list[mine, 0]] = first
    return function
