# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies and rigid obstacles that several tests of contact need."""

import numpy as np
import scenes
from posed import posed
from scenes import QUADRILATERAL, WORLD

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.materials import Hencky, LinearElastic

YOUNG, POISSON = 1e4, 0.3
CONFINED = YOUNG * (1 - POISSON) / (1 + POISSON) / (1 - 2 * POISSON)


def tilted(angle):
    """Return direction along and normal of a plane that is inclined."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([c, s]), np.array([-s, c])


def on_plane(friction, cell=QUADRILATERAL, angle=0.0, n=3, comm=WORLD, material=None, **options):
    """Return a block 1 x 0.5 that stands on a plane, its contact, and the force per mass."""
    t, normal = tilted(angle)
    body = scenes.box([0.0, 0.0], [1.0, 0.5], [2 * n, n], cell, comm)
    body.geometry.x[:, :2] = body.geometry.x[:, :2] @ np.array([t, normal])
    V = scenes.vectors(scenes.box([-1.1, -1.1], [1.7, 1.8], [9, 9], QUADRILATERAL, comm))
    methods = {key: options.pop(key) for key in ("method", "outside") if key in options}
    particles = mpm.Particles(body, V, **methods)
    law = options.pop("law", "penalty")
    ground = contact.Rigid(particles, contact.plane((0.0, 0.0), normal), friction, law=law)
    force = fem.Constant(body, np.zeros(2))
    problem = posed(
        mpm.QuasiStaticProblem,
        particles,
        material or LinearElastic(YOUNG, POISSON),
        body_force=force,
        terms=[ground],
        **options,
    )
    return problem, ground, force


def between_plates(cell, material, n=3, degree=1, law="penalty", **options):
    """Return a unit block between plates, the lower and the upper one."""
    dim = 2 if cell in scenes.PLANE else 3
    grid = QUADRILATERAL if dim == 2 else scenes.HEXAHEDRON
    lower = np.append(np.zeros(dim - 1), -0.3)
    V = scenes.vectors(scenes.box(lower, [1.5] * dim, [3] * dim, grid), degree)
    rule = 2 if "axisymmetric" in options else None
    particles = mpm.Particles(scenes.unit(n, cell), V, degree=degree, quadrature_degree=rule)
    up = np.eye(dim)[-1]
    axisymmetric = options.get("axisymmetric", False)
    below, above = (
        contact.Rigid(particles, contact.plane(at, n), law=law, axisymmetric=axisymmetric)
        for at, n in ((0.0 * up, up), (up, -up))
    )
    problem = posed(
        mpm.QuasiStaticProblem,
        particles,
        material,
        bcs=[scenes.fix(V, scenes.at(i, 0.0), component=i) for i in range(dim - 1)],
        terms=[below, above],
        **options,
    )
    return problem, below, above


def turning(force, angle, load, most):
    """Return a path: weight that grows, then turns by an angle at most."""
    t, normal = tilted(angle)

    def path(s):
        weight, turn = min(4.0 * s, 1.0) / s, most * max(s - 0.25, 0.0) / 0.75
        path.angle = np.degrees(turn)
        force.value[:] = -load * weight * (np.cos(turn) * normal + np.sin(turn) * t)

    return path


def lines(h, fine, end):
    """Return places from 0 to end, h apart up to ``fine`` and farther apart beyond."""
    places = [h * i for i in range(round(fine / h) + 1)]
    while places[-1] < end:
        places.append(places[-1] + min(1.25 * (places[-1] - places[-2]), 0.4))
    return np.array(places)


def graded(x, y, parts):
    """Return a mesh of quadrilaterals between lines, each interval in equal parts."""
    domain = scenes.box(
        [0.0, 0.0], [1.0, 1.0], [(len(x) - 1) * parts, (len(y) - 1) * parts], QUADRILATERAL
    )
    for i, places in enumerate((x, y)):
        at = domain.geometry.x[:, i] * (len(places) - 1)
        domain.geometry.x[:, i] = np.interp(at, np.arange(len(places)), places)
    return domain


def hertz(n, penalty, steps, depth=0.0108, law="penalty"):
    """Return a disc pressed on an elastic block, its contact, half width and largest pressure."""
    radius, a = 6.0, 0.2
    h = a / n
    x = lines(h, 0.3, 3.0)
    y = -lines(h, 0.3, 3.0)[::-1]
    over = np.append(y, 0.4 * h)
    wide = np.append(x, 2 * x[-1] - x[-2])
    V = scenes.vectors(graded(wide, over, 1))
    particles = mpm.Particles(graded(x, y, 2), V)
    top = scenes.facet_tags(particles.mesh, scenes.at(1, 0.0))
    disc = contact.disc((0.0, radius), radius)
    die = contact.Rigid(particles, disc, facets=(top, 1), penalty=penalty, law=law)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, LinearElastic(1e3, POISSON)),
        bcs=[scenes.fix(V, scenes.at(0, 0.0), component=0), scenes.fix(V, scenes.at(1, y[0]))],
        terms=[die],
    )
    problem.solve(steps, update=lambda t: die.move((0.0, -depth * t)))
    force = -2.0 * problem.reaction(die)[1]
    stiff = 1e3 / (1 - POISSON**2)
    half = np.sqrt(4 * force * radius / np.pi / stiff)
    return problem, die, half, 2 * force / np.pi / half


def error_of_facets(die, half, most):
    """Return the L2 error of mean pressures over facets against Hertz's, relative."""
    x, p, w = (scenes.gather(v) for v in (die.points[:, 0], die.pressure, die.area))
    exact = most * np.sqrt(np.maximum(1 - (x / half) ** 2, 0.0))
    order = np.argsort(x)  # each facet has two points
    mean = [(v * w)[order].reshape(-1, 2).sum(axis=1) for v in (p, exact)]
    return np.sqrt(np.sum((mean[0] - mean[1]) ** 2) / np.sum(mean[1] ** 2))


def dragged(
    cell=QUADRILATERAL,
    comm=WORLD,
    method="cpdi2",
    material=None,
    degree=1,
    friction=0.4,
    n=8,
    law="penalty",
    **options,
):
    """Return a block with a disc on it, the contact, and a path: down, then along."""
    V = scenes.vectors(scenes.box([-0.3, -0.2], [2.3, 1.2], [13, 7], QUADRILATERAL, comm), degree)
    base = fem.locate_dofs_geometrical(V, lambda x: x[1] < 0.01)
    body = scenes.box([0.0, 0.0], [2.0, 1.0], [2 * n, n], cell, comm)
    names = ("on_distortion", "outside", "quadrature_degree")
    own = {key: options.pop(key) for key in names if key in options}
    particles = mpm.Particles(body, V, method=method, degree=degree, **own)
    die = contact.Rigid(particles, contact.disc((0.7, 1.6), 0.6), friction, law=law)
    problem = posed(
        mpm.QuasiStaticProblem,
        particles,
        material or Hencky(1e3, POISSON),
        bcs=[fem.dirichletbc(np.zeros(2), base, V)],
        terms=[die],
        **options,
    )

    def path(t):
        die.move((0.5 * max(t - 0.3, 0.0), -0.1 * min(t, 0.3) / 0.3), -0.5 * max(t - 0.5, 0.0))

    return problem, die, path


def told(die):
    """Return what a contact tells, in an order that does not depend on ranks."""
    x, p, t = (scenes.gather(v) for v in (die.points, die.pressure, die.traction))
    w, g, s = (scenes.gather(v) for v in (die.area, die.gap, die.sticks))
    order = np.lexsort(np.round(x, 6).T)
    return {
        "points": x[order],
        "pressure": p[order],
        "traction": t[order],
        "area": w[order],
        "gap": g[order],
        "sticks": s[order].astype(float),
        "reaction": die.reaction,
        "moment": die.moment((0.7, 1.0)),
        "offset": die.offset,
        "angle": die.angle,
    }


def close(one, other, bound=1e-9):
    """Compare what contacts tell."""
    for key in one:
        size = np.abs(one[key]).max(initial=1e-300)
        assert np.abs(one[key] - other[key]).max(initial=0.0) <= bound * size, key


def wall(particles, point, normal, **options):
    """Return contact with a smooth plane that hardly gives way."""
    return contact.Rigid(particles, contact.plane(point, normal), **{"penalty": 1e3, **options})
