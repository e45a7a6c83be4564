# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Two bodies in contact that several tests need."""

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, TRIANGLE, WORLD, anywhere

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.materials import Hencky, LinearElastic
from mpm_dolfinx.meshes.redistribution import Redistribution

YOUNG, POISSON = 1e3, 0.3


def turned(domain, angle, origin=(0.0, 0.0)):
    """Turn and shift a mesh."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    domain.geometry.x[:, :2] = domain.geometry.x[:, :2] @ np.array([[c, s], [-s, c]]) + origin
    return domain


def spaces(lower, upper, n, count=2, comm=WORLD, degree=1):
    """Return spaces on one mesh, each of them a field of its own."""
    kind = QUADRILATERAL if len(n) == 2 else HEXAHEDRON
    domain = scenes.box(lower, upper, n, kind, comm)
    return [scenes.vectors(domain, degree) for _ in range(count)]


def patch(passes, tilt=30.0, cells=(QUADRILATERAL, QUADRILATERAL), n=(9, 5), law="penalty"):
    """Return two blocks, one on the other, under a uniform pressure; the largest stress error."""
    origin = (0.53, 0.31)
    Va, Vb = spaces([-1.0, -1.0], [4.0, 4.0], [20, 20])
    upper = scenes.box([0.0, 0.53], [1.0, 1.0], [n[0], n[0] // 2], cells[0])
    lower = scenes.box([0.0, 0.0], [1.0, 0.53], [n[1], n[1] // 2], cells[1])
    tags = [
        scenes.facet_tags(upper, scenes.at(1, 0.53), scenes.at(0, 0.0), scenes.at(1, 1.0)),
        scenes.facet_tags(lower, scenes.at(1, 0.53), scenes.at(0, 0.0), scenes.at(1, 0.0)),
    ]
    a, b = (
        mpm.Particles(turned(body, tilt, origin), V, quadrature_degree=2)
        for body, V in ((upper, Va), (lower, Vb))
    )
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    touch = contact.Pair(a, b, facets=[(one, 1) for one in tags], passes=passes, law=law)
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(
                a, LinearElastic(YOUNG, POISSON), tractions=[((s, -c), 3)], facet_tags=tags[0]
            ),
            mpm.Body(b, LinearElastic(YOUNG, POISSON)),
        ],
        supports=[
            mpm.boundary.roller(a, tags[0], 2, (c, s)),
            mpm.boundary.roller(b, tags[1], 2, (c, s)),
            mpm.boundary.roller(b, tags[1], 3, (-s, c)),
        ],
        terms=[touch],
    )
    problem.solve(1)
    Q = np.array([[c, -s], [s, c]])
    exact = Q @ np.diag([0.0, -1.0]) @ Q.T
    error = max(scenes.largest(p.stress[:, :2, :2] - exact) for p in (a, b))
    return problem, touch, error, Q


def hertz(passes, order, n=8, ratio=1.3, moduli=(YOUNG, YOUNG), **options):
    """Return two cylinders that are pressed together, and the radius of one."""
    radius, end, h = 8.0, 2.5, 0.2 / n

    def lines(size, middle=0.0):
        half = [size * i for i in range(round(0.3 / size) + 1)]
        while half[-1] < end:
            half.append(half[-1] + min(1.15 ** (size / h) * (half[-1] - half[-2]), 0.4))
        half = np.array(half)
        outer = half > 0.3
        half[outer] = 0.3 + (half[outer] - 0.3) * (end - 0.3) / (half[-1] - 0.3)
        return middle + np.concatenate([-half[:0:-1], half])

    def between(x, y):
        domain = scenes.box([0.0, 0.0], [1.0, 1.0], [len(x) - 1, len(y) - 1], QUADRILATERAL)
        for i, places in enumerate((x, y)):
            at = domain.geometry.x[:, i] * (len(places) - 1)
            domain.geometry.x[:, i] = np.interp(at, np.arange(len(places)), places)
        return domain

    def round_block(size, sign):
        body = between(lines(size), lines(size)[len(lines(size)) // 2 :])
        x, y = body.geometry.x[:, 0].copy(), body.geometry.x[:, 1].copy()
        body.geometry.x[:, 1] = y + (radius - np.sqrt(radius**2 - x**2)) * (1.0 - y / end)
        body.geometry.x[:] = body.geometry.x * [sign, sign, 1.0]
        return body

    bodies, tags = [], []
    for size, sign, off in ((h / 2, 1.0, 0.37), (ratio * h / 2, -1.0, 0.67)):
        wide = lines(h, off * h)
        wide[[0, -1]] += -0.2, 0.2
        V = scenes.vectors(between(wide, wide))
        particles = mpm.Particles(round_block(size, sign), V, quadrature_degree=2)

        def low(x, sign=sign):
            arc = radius - np.sqrt(np.maximum(radius**2 - x[0] ** 2, 0.0))
            return sign * x[1] < arc + 1e-9

        bodies.append(particles)
        tags.append(scenes.facet_tags(particles.mesh, low, scenes.at(1, sign * end)))
    a, b = (bodies[i] for i in order)
    touch = contact.Pair(a, b, facets=[(tags[i], 1) for i in order], passes=passes, **options)
    motion = fem.Constant(bodies[0].mesh, (0.0, -0.0135))
    supports = [
        mpm.boundary.fixed(bodies[0], tags[0], 2, value=motion),
        mpm.boundary.fixed(bodies[1], tags[1], 2),
    ]
    laws = [LinearElastic(E, POISSON) for E in moduli]
    problem = posed(
        mpm.QuasiStaticProblem, bodies, laws, facet_tags=tags, supports=supports, terms=[touch]
    )
    problem.solve(8)
    return problem, touch, radius


def two(
    cells=(QUADRILATERAL, TRIANGLE),
    friction=0.3,
    comm=WORLD,
    degree=1,
    material=None,
    rule=None,
    f_bar="none",
    method="cpdi2",
    tags_of=None,
    **options,
):
    """Return a small block that is pressed on a large one and dragged along it."""
    Va, Vb = spaces([-0.4, -0.2], [2.4, 1.8], [14, 10], comm=comm, degree=degree)
    a = mpm.Particles(
        scenes.box([0.2, 1.0], [0.83, 1.5], [5, 4], cells[0], comm),
        Va,
        degree=degree,
        quadrature_degree=rule,
        method=method,
    )
    b = mpm.Particles(
        scenes.box([0.0, 0.0], [2.0, 1.0], [16, 8], cells[1], comm),
        Vb,
        degree=degree,
        quadrature_degree=rule,
        method=method,
    )
    if tags_of is not None:
        options["facets"] = [(one, 1) for one in tags_of(a.mesh, b.mesh)]
    touch = contact.Pair(a, b, friction, **options)
    top = fem.locate_dofs_geometrical(Va, lambda x: x[1] > 1.39)
    base = fem.locate_dofs_geometrical(Vb, lambda x: x[1] < 0.01)
    motion = fem.Constant(Va.mesh, np.zeros(2))
    bcs = [fem.dirichletbc(motion, top, Va), fem.dirichletbc(np.zeros(2), base, Vb)]
    law = material or Hencky(YOUNG, POISSON)
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(p, law, f_bar=f_bar) for p in (a, b)], bcs=bcs, terms=[touch]
    )

    def path(t):
        motion.value[:] = [0.5 * max(t - 0.25, 0.0), -0.04 * min(4 * t, 1.0)]

    return problem, touch, path


def balance(problem, touch):
    """Return the sums of contact forces and of their moments on both bodies."""
    forces = touch.residuals()
    total, moment = np.zeros(2), 0.0
    for body, force in zip(touch.bodies, forces, strict=True):
        f = force.array_r.reshape(-1, 2)
        x = scenes.own(body.displacement).reshape(-1, 2)
        x = x + body.W.tabulate_dof_coordinates()[: len(x), :2]
        total += WORLD.allreduce(f.sum(axis=0))
        moment += WORLD.allreduce((x[:, 0] * f[:, 1] - x[:, 1] * f[:, 0]).sum())
    return total, moment


def fail_after(count, **options):
    """Drag a block along another for some steps of 8, let one fail, and compare all bit by bit.

    Args:
        count: How many steps.
        options: As for :func:`two`.
    """
    problem, touch, path = two(**options)
    steps = problem.steps(8, update=path)
    for _ in range(count):
        next(steps)
    before = [{k: c.values.copy() for k, c in touch.columns(i).items()} for i in (0, 1)]
    force, d = problem.reaction(touch), [b.displacement.x.array.copy() for b in problem.bodies]
    problem.bcs[0].g.value[:] = [0.0, -0.9]
    problem.solver.setTolerances(max_it=3)
    with pytest.raises(mpm.MPMError):
        problem.step()
    assert np.array_equal(force, problem.reaction(touch))
    for body, array in zip(problem.bodies, d, strict=True):
        assert np.array_equal(array, body.displacement.x.array)
    for number, columns in enumerate(before):
        for key, column in touch.columns(number).items():
            assert np.array_equal(columns[key], column.values), key


def go_on_other_meshes(what, **options):
    """Drag a block along another, with other meshes half-way; the force stays, and ends as without.

    Args:
        what: "move", "rebase" or "split".
        options: As for :func:`two`.

    Returns:
        The problem at its end.
    """
    options["cells"] = (QUADRILATERAL, QUADRILATERAL)
    problem, touch, path = two(**options)
    other, alone, same = two(**options)
    for number, _ in enumerate(problem.steps(8, update=path)):
        if number != 4:
            continue
        before = problem.reaction(touch)
        if what == "move":
            ranks = [anywhere(body.mesh, number) for body in problem.bodies]

            def change(ranks=ranks):
                for body, to in zip(problem.bodies, ranks, strict=True):
                    body.live_on(Redistribution(body.mesh, to))

            problem.state.renew(change, lambda state: state)
        elif what == "rebase":
            problem.rebase()
        else:
            problem.split(np.arange(0, 128, 2), body=1)
        after = problem.reaction(touch)
        assert np.abs(after - before).max() < 1e-8 * np.abs(before).max()
    other.solve(8, update=same)
    end = other.reaction(alone)
    bound = 5e-2 if what == "split" else 1e-6
    assert np.abs(problem.reaction(touch) - end).max() < bound * np.abs(end).max()
    return problem
