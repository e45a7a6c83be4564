# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forces across sections, beside what acts beyond them and stresses that are added up."""

from itertools import product

import numpy as np
import pytest
from compare import raises
from marks import thinned
from ranks import fails
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD, box, gather, vectors

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic, Undrained

TIGHT = mpm.Solver(petsc_options={"snes_rtol": 1e-12})


def turn(angle):
    """Return the matrix of a rotation in the plane."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def at_end(problem, tags, traction, centre):
    """Return force and moment of a dead traction on tagged facets about points, by DOLFINx."""
    particles = problem.bodies[0]
    ds = ufl.Measure("ds", domain=particles.mesh, subdomain_data=tags)(2)
    gdim = len(traction)
    x = ufl.SpatialCoordinate(particles.mesh) + particles.displacement

    def total(form):
        return WORLD.allreduce(fem.assemble_scalar(fem.form(form)))

    one = fem.Constant(particles.mesh, 1.0)
    area = total(one * ds)
    middle = np.array([total(x[i] * ds) for i in range(gdim)]) / area
    force = area * np.asarray(traction)
    arm = middle - centre
    if gdim == 2:
        return force, arm[:, 0] * force[1] - arm[:, 1] * force[0]
    return force, np.cross(arm, force)


@pytest.mark.parametrize(
    ("angle", "degree", "cell"), thinned(3, product([0.0, 2.3], [1, 2], [QUADRILATERAL, TRIANGLE]))
)
def test_a_beam_bends_far_by_a_load_at_its_end(cell, degree, angle):
    # Sections know nothing of the mesh: there are 7 on 20 cells.
    beam = box([0, 0], [3.0, 0.2], [20, 2], cell)
    tags = mpm.facet_tags(beam, {1: mpm.region(x=0.0), 2: mpm.region(x=3.0)})
    R = turn(angle)
    beam.geometry.x[:, :2] = beam.geometry.x[:, :2] @ R.T + (50.0, -20.0)
    particles = mpm.Particles(beam, degree=degree)
    load = R @ (200.0, -300.0)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e5, 0.2), tractions=[(load, 2)], facet_tags=tags),
        supports=[mpm.boundary.fixed(particles, tags, 1)],
        solver=TIGHT,
    )
    problem.solve(4)
    axis = np.linspace((0.0, 0.1), (3.0, 0.1), 8) @ R.T + (50.0, -20.0)
    found = mpm.section_forces(particles, axis)
    force, moment = at_end(problem, tags, load, found.position)
    t = found.direction
    turned = np.degrees(np.arccos(t[0] @ t[-1]))
    assert turned > 30.0 and np.allclose(np.linalg.norm(t, axis=1), 1.0, rtol=1e-14)
    size = np.linalg.norm(force)
    assert np.allclose(found.axial, t @ force, atol=1e-7 * size)
    assert np.allclose(found.shear, t[:, 1] * force[0] - t[:, 0] * force[1], atol=1e-7 * size)
    assert np.allclose(found.moment, moment, atol=1e-7 * abs(moment).max())
    assert (found.moment < 0.0).all()  # its left side is in tension
    assert (np.diff(found.moment) * found.shear[1:] > 0.0).all()


@pytest.mark.parametrize("cell", [HEXAHEDRON, TETRAHEDRON])
def test_a_pile_in_space_is_bent_and_twisted(cell):
    pile = box([0, 0, 0], [0.3, 0.3, 2.0], [2, 2, 8], cell)
    tags = mpm.facet_tags(pile, {1: mpm.region(z=0.0), 2: mpm.region(x=0.3, z=(1.5, 2.0))})
    particles = mpm.Particles(pile)
    load = np.array([40.0, 90.0, -60.0])  # beside the axis
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e5, 0.2), tractions=[(load, 2)], facet_tags=tags),
        supports=[mpm.boundary.fixed(particles, tags, 1)],
        solver=TIGHT,
    )
    problem.solve(2)
    found = mpm.section_forces(particles, np.linspace((0.15, 0.15, 0.0), (0.15, 0.15, 1.5), 5))
    force, moment = at_end(problem, tags, load, found.position)
    t = found.direction
    assert np.allclose(found.axial, t @ force, rtol=1e-7)
    assert np.allclose(found.axial[:, None] * t + found.shear, force, atol=1e-7 * 90.0)
    assert np.allclose(np.einsum("ni,ni->n", found.shear, t), 0.0, atol=1e-12)
    assert np.allclose(found.moment, moment, atol=1e-7 * abs(moment).max())
    assert np.einsum("ni,ni->n", found.moment, t)[0] > 0.01 * abs(moment).max()  # torque


def test_a_ring_under_pressure():
    n, inner, outer, pressure = 48, 1.0, 1.1, 2.0
    angles = 2.0 * np.pi * np.arange(n) / n
    radii = np.array([inner, 0.5 * (inner + outer), outer])
    x = (radii[:, None, None] * np.column_stack([np.cos(angles), np.sin(angles)])).reshape(-1, 2)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(2), indexing="ij"))
    k = (i + 1) % n
    cells = np.column_stack([j * n + i, (j + 1) * n + i, j * n + k, (j + 1) * n + k])
    mine = cells if WORLD.rank == 0 else cells[:0]
    element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    body = mesh.create_mesh(WORLD, mine.astype(np.int64), element, x if WORLD.rank == 0 else x[:0])
    tags = mpm.facet_tags(body, {1: lambda x: np.hypot(x[0], x[1]) > 1.09})
    particles = mpm.Particles(body)
    held = fem.locate_dofs_geometrical(
        particles.W, lambda x: np.isclose(x[1], 0.0) & np.isclose(x[0], -1.0)
    )
    turned = fem.locate_dofs_geometrical(
        (particles.W.sub(1), particles.W.sub(1).collapse()[0]),
        lambda x: np.isclose(x[1], 0.0) & np.isclose(x[0], 1.0),
    )
    zero = fem.Function(particles.W.sub(1).collapse()[0])
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e6, 0.2), pressures=[(pressure, 1)], facet_tags=tags),
        bcs=[
            fem.dirichletbc(np.zeros(2), held, particles.W),
            fem.dirichletbc(zero, turned, particles.W.sub(1)),
        ],
        solver=TIGHT,
    )
    problem.solve()
    ring = 2.0 * np.pi * np.arange(n + 1) / n
    axis = 1.05 * np.column_stack([np.cos(ring), np.sin(ring)])
    axis[-1] = axis[0]
    found = mpm.section_forces(particles, axis)
    exact = pressure * outer * np.cos(np.pi / n)  # of a polygon, which is pressed together
    assert np.allclose(found.axial, -exact, rtol=1e-4)
    assert np.allclose(found.shear, 0.0, atol=1e-4 * pressure)
    assert np.allclose(found.moment, 0.0, atol=2e-3 * pressure)
    turned = mpm.section_forces(particles, np.append(axis[17:-1], axis[:18], axis=0))
    assert np.allclose(np.roll(turned.axial, 17), found.axial, rtol=1e-12)
    fails(lambda: mpm.section_forces(particles, axis[3:-5]), "back to its beginning")
    half = mpm.section_forces(particles, axis[:25], lambda x: x[1] > 0.0)
    assert np.allclose(half.axial[1:-1], found.axial[1:23], rtol=1e-12)
    assert np.allclose(half.axial, found.axial[:24], rtol=0.01)  # ends across the first chord


def glued(n=12, degree=2, background=True):
    """Return a wall in soil, of one mesh, that is pushed at its head; its tags and cells."""
    side = np.linspace(0.0, 2.0, 9)
    across = np.concatenate([side[:-1] - 2.05, [-0.05, 0.05], side[1:] + 0.05])
    up = np.linspace(0.0, 3.0, n + 1)
    body = mpm.grid(WORLD, [across, up], QUADRILATERAL)
    tags = mpm.cell_tags(
        body, {1: mpm.region(y=(0, 3)), 2: mpm.region(x=(-0.05, 0.05), y=(1.0, 3.0))}
    )
    facets = mpm.facet_tags(body, {1: mpm.region(y=0.0), 2: mpm.region(x=(-0.05, 0.05), y=3.0)})
    if background:
        V = vectors(box([-2.4, -0.3], [2.4, 3.6], [12, 10], QUADRILATERAL), degree)
        free = mpm.region(x=(-0.3, 0.3), y=(0.7, 3.0))
        particles = mpm.Particles(body, V, degree=degree, free=free)
    else:
        particles = mpm.Particles(body, degree=degree)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            {1: Hencky(1e4, 0.3), 2: Hencky(1e7, 0.2)},
            tractions=[((100.0, -50.0), 2)],
            cell_tags=tags,
            facet_tags=facets,
        ),
        supports=[mpm.boundary.fixed(particles, facets, 1)],
        solver=TIGHT,
    )
    problem.solve()
    return problem, tags


def test_a_wall_in_soil_and_the_stresses_of_its_cells():
    problem, tags = glued(n=60, background=False)
    particles = problem.bodies[0]
    axis = np.linspace((0.0, 1.0), (0.0, 3.0), 41)  # a section for each of its cells
    found = mpm.section_forces(particles, axis, (tags, 2))
    by_place = mpm.section_forces(particles, axis, mpm.region(x=(-0.05, 0.05), y=(1.0, 3.0)))
    assert np.array_equal(found.moment, by_place.moment)
    # stress times lever, added up over the points of each cell
    middle = particles.initial_centroid
    mine = (np.abs(middle[:, 0]) < 0.05) & (middle[:, 1] > 1.0)
    parts = particles.undeformed.point_volumes()[mine] / 0.05
    parts = parts * particles.point_stress[mine][:, :, 1, 1]
    lever = particles.initial_points[mine][:, :, 0]
    order = np.argsort(gather(middle[mine][:, 1]))
    axial, moment = (gather(p.sum(axis=1))[order] for p in (parts, -lever * parts))
    inner = slice(2, -2)
    assert np.allclose(found.axial[inner], axial[inner], atol=0.01 * abs(axial).max())
    assert np.allclose(found.moment[inner], -moment[inner], atol=0.01 * abs(moment).max())


def test_free_nodes_of_a_wall_bend_as_finite_elements_do():
    axis = np.linspace((0.0, 1.0), (0.0, 3.0), 9)
    moments = []
    for background in (True, False):
        problem, tags = glued(background=background)
        moments.append(mpm.section_forces(problem.bodies[0], axis, (tags, 2)).moment)
    assert np.allclose(moments[0], moments[1], atol=0.02 * abs(moments[1]).max())


def test_water_bears_too():
    # An undrained block under a pressure: skeleton and water together are in equilibrium with it.
    block = box([0, 0], [1.0, 4.0], [4, 16], QUADRILATERAL)
    tags = mpm.facet_tags(block, {1: mpm.region(y=0.0), 2: mpm.region(y=4.0)})
    particles = mpm.Particles(block, degree=2)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            Undrained(Hencky(1e3, 0.3), water_bulk=1e4),
            tractions=[((0.0, -20.0), 2)],
            facet_tags=tags,
        ),
        supports=[mpm.boundary.fixed(particles, tags, 1)],
        solver=TIGHT,
    )
    problem.solve()
    found = mpm.section_forces(particles, np.linspace((0.5, 0.5), (0.5, 3.5), 4))
    assert np.allclose(found.axial, -20.0, rtol=1e-8)


def test_a_body_that_is_rebased_has_the_same():
    V = vectors(box([-0.5, -1.0], [4.0, 1.0], [18, 8], QUADRILATERAL))
    beam = box([0, 0], [3.0, 0.5], [24, 4], TRIANGLE)
    tags = mpm.facet_tags(beam, {2: mpm.region(x=3.0)})
    particles = mpm.Particles(beam, V)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e5, 0.2), density=100.0, body_force=(0.0, -1.0)),
        bcs=[mpm.held(V, x=(-0.5, 0.0))],
    )
    problem.solve(2)
    assert tags is not None
    axis = np.linspace((0.0, 0.25), (3.0, 0.25), 7)
    before = mpm.section_forces(particles, axis)
    problem.rebase()
    after = mpm.section_forces(particles, axis)
    assert abs(before.moment).max() > 100.0
    for name in ("position", "direction", "axial", "shear", "moment"):
        assert np.allclose(getattr(after, name), getattr(before, name), rtol=1e-9, atol=1e-9)


def test_what_makes_no_sense_is_refused():
    body = box([0, 0], [1.0, 1.0], [4, 4], QUADRILATERAL)
    particles = mpm.Particles(body)
    line = [(0.5, 0.0), (0.5, 1.0)]
    fails(lambda: mpm.section_forces(particles, line), "have no material")
    mpm.QuasiStaticProblem(mpm.Body(particles, Hencky(1e3, 0.3)))
    for axis in ([(0.5, 0.0)], [0.5, 1.0], "middle", [(0.5, np.nan), (0.5, 1.0)], [(0, 0)] * 2):
        fails(lambda axis=axis: mpm.section_forces(particles, axis), "axis= must be two points")
    fails(lambda: mpm.section_forces(particles, line, 3), "where= is a function")
    tags = mpm.cell_tags(body, {1: mpm.region(x=(0.0, 0.5))})
    fails(lambda: mpm.section_forces(particles, line, (tags, "wall")), "is a whole number")
    fails(lambda: mpm.section_forces(particles, line, (tags, 2)), "No cell has the tag 2 of where=")
    other = mpm.cell_tags(box([0, 0], [1, 1], [2, 2], QUADRILATERAL), {1: lambda x: x[0] < 0.5})
    fails(
        lambda: mpm.section_forces(particles, line, (other, 1)),
        "those of cells of the present body",
    )
    fails(lambda: mpm.section_forces(particles, line, lambda x: x[0]), "one bool for each")
    nowhere = mpm.region(x=(3.0, 4.0))
    fails(lambda: mpm.section_forces(particles, line, nowhere), "is not between points 0 and 1")
    beyond = [(0.5, 0.5), (0.5, 1.0), (0.5, 2.0)]
    fails(lambda: mpm.section_forces(particles, beyond), "is not between points 1 and 2")
    # An end would bear a part of what acts there.
    for axis in ([(0.5, 0.5), (0.5, 1.1)], [(0.5, -0.1), (0.5, 0.4), (0.5, 0.5)]):
        fails(lambda axis=axis: mpm.section_forces(particles, axis), "does not reach from point 0")
    sides = mpm.facet_tags(body, {1: mpm.region(x=0.0)})
    fails(lambda: mpm.section_forces(particles, line, (sides, 1)), "those of cells")


def test_tags_of_a_mesh_that_was_split_are_refused_until_they_are_carried_over():
    V = vectors(box([-0.5, -0.5], [1.5, 1.5], [8, 8], QUADRILATERAL))
    body = box([0, 0], [1.0, 1.0], [8, 8], QUADRILATERAL)
    tags = mpm.cell_tags(body, {1: mpm.region(x=(0.0, 0.5))})
    particles = mpm.Particles(body, V, on_distortion="split")
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.3), density=1.0, body_force=(0.0, -10.0)),
        bcs=[mpm.held(V, y=(-np.inf, 0.0))],
    )
    problem.solve()
    line = [(0.25, 0.0), (0.25, 0.5), (0.25, 1.0)]
    before = mpm.section_forces(particles, line, (tags, 1))
    problem.split([4, 5])
    fails(lambda: mpm.section_forces(particles, line, (tags, 1)), "those of cells of the present")
    after = mpm.section_forces(particles, line, (particles.carry(tags), 1))
    assert np.allclose(after.axial, before.axial, rtol=0.01) and before.axial.max() < -0.5


def test_a_law_of_small_strains_is_in_equilibrium_where_the_body_was():
    beam = box([0, 0], [3.0, 0.2], [20, 2], QUADRILATERAL)
    tags = mpm.facet_tags(beam, {1: mpm.region(x=0.0), 2: mpm.region(x=3.0)})
    particles = mpm.Particles(beam)
    load = (200.0, -60.0)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, LinearElastic(1e5, 0.2), tractions=[(load, 2)], facet_tags=tags),
        supports=[mpm.boundary.fixed(particles, tags, 1)],
        solver=TIGHT,
    )
    problem.solve()
    found = mpm.section_forces(particles, np.linspace((0.0, 0.1), (3.0, 0.1), 8))
    assert np.allclose(found.position[:, 0], 3.0 / 7.0 * (np.arange(7) + 0.5), atol=5e-3)
    assert np.allclose(found.position[:, 1], 0.1, rtol=1e-12)
    assert np.allclose(found.direction, (1.0, 0.0), atol=1e-12)
    assert np.allclose(found.axial, 40.0, rtol=1e-9)
    assert np.allclose(found.shear, 12.0, rtol=1e-9)
    assert np.allclose(found.moment, -12.0 * (3.0 - found.position[:, 0]), rtol=1e-9)


def test_a_body_of_revolution_is_refused():
    particles = mpm.Particles(box([0, 0], [1.0, 1.0], [4, 4], QUADRILATERAL))
    mpm.QuasiStaticProblem(mpm.Body(particles, Hencky(1e3, 0.3)), axisymmetric=True)
    raises(
        lambda: mpm.section_forces(particles, [(0.5, 0.0), (0.5, 1.0)]),
        mpm.MPMError,
        "body of revolution",
    )
