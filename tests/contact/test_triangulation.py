# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Surfaces by segments and triangles: distances against brute force and against other shapes."""

import numpy as np
import pytest
import scenes
from compare import outcome, same_run
from scenes import HEXAHEDRON, QUADRILATERAL, WORLD

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.materials import Hencky, LinearElastic

LOWER, UPPER = np.array([-1.0, -0.5, -0.4]), np.array([1.0, 0.5, 0.8])


def cube(n=1):
    """Return points and triangles of a box, n by n squares on each side, all turned inwards."""
    points, triangles = [], []
    s = np.linspace(0.0, 1.0, n + 1)
    for axis in range(3):
        for side in (0.0, 1.0):
            u, v = (g.ravel() for g in np.meshgrid(s, s, indexing="ij"))
            x = np.zeros(((n + 1) ** 2, 3))
            x[:, axis], x[:, (axis + 1) % 3], x[:, (axis + 2) % 3] = side, u, v
            number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1) + sum(map(len, points))
            a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
            for t in ((a, b, c), (a, c, d)):
                t = np.stack(t, axis=-1).reshape(-1, 3)
                triangles.append(t if side == 0.0 else t[:, ::-1])
            points.append(x)
    return LOWER + np.concatenate(points) * (UPPER - LOWER), np.concatenate(triangles)


def ball(times=3):
    """Return points and triangles of a unit sphere: those of an octahedron, divided."""
    x = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array(
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    )
    for _ in range(times):
        corners = x[faces]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2.0
        a, b, c = (corners[:, k] for k in range(3))
        d, e, f = (middles[:, k] for k in range(3))
        x = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, d, f), (d, b, e), (f, e, c), (d, e, f))]
        )
        x = x.reshape(-1, 3)
        x, faces = x / np.linalg.norm(x, axis=1)[:, None], np.arange(len(x)).reshape(-1, 3)
    return x, faces


def waves(n=9):
    """Return places and heights of hills."""
    x, y = np.linspace(-1.0, 1.0, n), np.linspace(-1.2, 0.9, n + 2)
    return x, y, 0.3 * np.sin(3.0 * x)[:, None] * np.cos(2.0 * y)


def ring(n=40, radius=0.7):
    """Return a polygon of points on a circle, closed."""
    angle = 2.0 * np.pi * np.arange(n + 1) / n
    return np.column_stack([0.1 + radius * np.cos(angle), 0.2 + radius * np.sin(angle)])


#: A line with a hill, a ditch and two flat pieces.
PROFILE = [(-2.0, 0.0), (-1.0, 0.0), (-0.4, 0.5), (0.2, 0.1), (0.8, 0.6), (1.5, 0.6), (2.5, 0.6)]


def shapes():
    return {
        "cube": contact.triangulated(*cube(3)),
        "rounded cube": contact.triangulated(*cube(3), radius=0.1),
        "ball": contact.triangulated(*ball()),
        "hills": contact.terrain(*waves()),
        "rounded hills": contact.terrain(*waves(), radius=0.05),
        "ring": contact.polyline(ring()),
        "profile": contact.polyline(PROFILE, outside=(0, 1)),
        "rounded profile": contact.polyline(PROFILE[::-1], outside=(0, 1), radius=0.08),
    }


def nearest(points, corners):
    """Return distances to the nearest of triangles or segments, by all of them."""
    found = np.full(len(points), np.inf)
    for facet in corners:
        for k in range(len(facet) if len(facet) == 3 else 1):
            a, e = facet[k], facet[(k + 1) % len(facet)] - facet[k]
            s = np.clip((points - a) @ e / (e @ e), 0.0, 1.0)
            found = np.minimum(found, np.linalg.norm(points - a - s[:, None] * e, axis=1))
        if len(facet) == 3:
            E = (facet[1:] - facet[0]).T
            s = np.linalg.lstsq(E, (points - facet[0]).T, rcond=None)[0]
            inner = (s >= 0.0).all(axis=0) & (s.sum(axis=0) <= 1.0)
            off = np.linalg.norm(points - facet[0] - (E @ s).T, axis=1)
            found = np.where(inner, np.minimum(found, off), found)
    return found


@pytest.mark.parametrize("name", list(shapes()))
def test_gradient_and_curvature_are_the_derivatives_of_the_distance(name):
    shape = shapes()[name]
    y = np.random.default_rng(3).uniform(-1.5, 1.5, (400, shape.dim))
    phi, n = shape.distance(y)
    H = shape.curvature(y)
    step = 1e-30
    for i, e in enumerate(np.eye(shape.dim)):
        ahead = shape.distance(y + 1j * step * e)
        assert np.abs(ahead[0].imag / step - n[:, i]).max() < 1e-12
        bent = ahead[1].imag / step
        assert np.all(np.abs(bent - H[:, :, i]).max(axis=1) < 1e-12 * (1 + np.abs(H).max((1, 2))))
    assert np.abs(np.linalg.norm(n, axis=1) - 1.0).max() < 1e-12
    foot, _ = shape.distance(y - phi[:, None] * n)
    assert np.abs(foot[phi > 0.0]).max() < 1e-12


@pytest.mark.parametrize("name", ["cube", "ball", "hills", "ring", "profile"])
def test_the_distance_is_that_of_the_nearest_facet_of_all(name):
    shape = shapes()[name]
    y = np.random.default_rng(4).uniform(-3.0, 3.0, (300, shape.dim))
    found = np.abs(shape.distance(y)[0])
    assert np.abs(found - nearest(y, shape.points[shape.facets])).max() < 1e-13
    # at corners and in the middle of edges, too
    x = shape.points[shape.facets]
    for at in (x[:, 0], (x[:, 0] + x[:, 1]) / 2):
        phi, n = shape.distance(at)
        assert np.abs(phi).max() < 1e-14
        assert np.abs(np.linalg.norm(n, axis=1) - 1.0).max() < 1e-13


@pytest.mark.parametrize("radius", [0.0, 0.1])
def test_triangles_of_a_box_are_a_box(radius):
    one = contact.triangulated(*cube(4), radius=radius)
    other = contact.box(LOWER, UPPER, radius)
    y = np.random.default_rng(1).uniform(-1.5, 1.5, (800, 3))
    (phi, n), (exact, m) = one.distance(y), other.distance(y)
    near = exact > -0.1
    assert np.abs(phi - exact)[near].max() < 1e-13
    assert np.abs(n - m)[near].max() < 1e-12
    assert np.abs(one.curvature(y) - other.curvature(y))[near].max() < 1e-9
    assert np.abs(one.bounds - other.bounds).max() < 1e-14
    assert np.abs(one.pivot - other.pivot).max() < 1e-14


@pytest.mark.parametrize("radius", [0.0, 0.05])
def test_a_polygon_and_a_closed_line_have_the_distance_of_segments(radius):
    corners = np.array([(0, 0), (2, 0), (2, 2), (1, 2), (1, 1), (0, 1), (0, 0)], dtype=float)
    inwards = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1), (1, -1), (1, -1), (1, 1)])
    a = corners + radius * inwards
    y = np.random.default_rng(1).uniform(-0.5, 2.5, (800, 2))
    x, way, arm = y[:, None], a[1:] - a[:-1], y[:, None] - a[:-1]
    along = np.clip((arm * way).sum(axis=2) / (way**2).sum(axis=1), 0.0, 1.0)
    far = np.linalg.norm(arm - along[:, :, None] * way, axis=2).min(axis=1)
    across = (a[:-1, 1] > x[:, :, 1]) != (a[1:, 1] > x[:, :, 1])  # edges here are upright or level
    inside = (across & (x[:, :, 0] < a[:-1, 0])).sum(axis=1) % 2 == 1
    exact = np.where(inside, -far, far) - radius
    shapes = [contact.polyline(one, radius=radius) for one in (corners, corners[::-1])]
    shapes += [contact.polygon(one, radius) for one in (corners[:-1], corners[-2::-1])]
    for shape in shapes:
        phi, n = shape.distance(y)
        assert np.abs(phi - exact).max() < 1e-12
        on = np.abs(shape.distance(y - phi[:, None] * n)[0])[np.abs(phi) < 0.2]
        assert np.median(on) < 1e-12
    assert np.abs(shapes[-1].pivot - a[:-1].mean(axis=0)).max() < 1e-14


def test_triangles_of_a_ball_come_near_to_a_sphere_with_their_number():
    y = np.random.default_rng(1).uniform(-1.5, 1.5, (500, 3))
    y = y[np.linalg.norm(y, axis=1) > 0.5]
    exact = contact.sphere((0.0, 0.0, 0.0), 1.0).distance(y)[0]
    errors = [
        np.abs(contact.triangulated(*ball(k)).distance(y)[0] - exact).max() for k in (2, 3, 4)
    ]
    assert errors[0] > 3.0 * errors[1] > 9.0 * errors[2]
    assert errors[2] < 4e-3


def test_beyond_its_border_an_open_surface_is_no_obstacle():
    line = contact.polyline([(0.0, 0.0), (1.0, 0.0)], outside=(0, 1))
    phi, _ = line.distance(np.array([[0.5, -0.2], [0.5, 0.2], [1.1, -0.2], [-0.2, 0.0]]))
    assert np.allclose(phi, [-0.2, 0.2, np.hypot(0.1, 0.2), 0.2], atol=1e-14)
    flat = contact.terrain([0.0, 1.0], [0.0, 1.0], np.zeros((2, 2)))
    phi, n = flat.distance(
        np.array([[0.5, 0.4, -0.2], [0.4, 0.4, 0.2], [1.1, 0.5, -0.2], [0, 0, 0.0]])
    )
    assert np.allclose(phi, [-0.2, 0.2, np.hypot(0.1, 0.2), 0.0], atol=1e-14)
    assert np.allclose(n[[0, 1, 3]], [0.0, 0.0, 1.0], atol=1e-14)


def told(*, points=None, triangles=None, **options):
    x, t = cube()
    return contact.triangulated(
        x if points is None else points, t if triangles is None else triangles, **options
    )


FAN = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)]


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: told(triangles=cube()[1][1:]), "is open: 3 edges"),
        (lambda: told(outside=(0, 0, 1)), "is closed, and has its outside"),
        (lambda: told(triangles=cube()[1][:2], outside=(0, 1, 0)), "does not tell"),
        (lambda: told(triangles=np.vstack([cube()[1][1:], cube()[1][:1, ::-1]])), "turned against"),
        (lambda: contact.triangulated(FAN, [(0, 1, 2), (1, 0, 3), (0, 1, 4)]), "belongs to 3 tri"),
        (lambda: told(triangles=[(0, 1, 99)]), "numbers of points from 0 to 23"),
        (lambda: told(triangles=[(0, 1)]), r"triangles of the shape \(m, 3\)"),
        (lambda: told(points=[(0, 0)]), r"finite points of the shape \(n, 3\)"),
        (lambda: told(points=np.full((9, 3), np.nan)), "finite points"),
        (lambda: told(points=np.zeros((24, 3))), "at one place"),
        (lambda: told(radius=0.7), "too small for the radius 0.7"),
        (lambda: told(radius=-1.0), "radius must be"),
        (lambda: contact.triangulated(FAN, [(0, 1, 2), (0, 2, 1)]), "encloses nothing"),
        (lambda: contact.polyline([(0, 0)], outside=(0, 1)), "two points or more"),
        (lambda: contact.polyline([(0, 0), (1, 0)]), "is open: 2 ends"),
        (lambda: contact.polyline([(0, 0), (1, 0)], outside=(1, 0)), "does not tell"),
        (lambda: contact.polyline(3.0), r"points of the shape \(n, 2\)"),
        (lambda: contact.terrain([0, 1], [1, 0], np.zeros((2, 2))), "places that grow"),
        (lambda: contact.terrain([0, 1], [0, 1], np.zeros((2, 3))), r"\(2, 3\)"),
    ],
)
def test_what_is_no_surface_is_refused(make, sentence):
    with pytest.raises(mpm.MPMError, match=sentence):
        make()


# -- Files ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["stl", "ply", "vtp", "vtk", "obj"])
def test_a_surface_of_a_file(kind, mpi_tmp_path):
    pyvista = pytest.importorskip("pyvista")
    path = mpi_tmp_path / f"box.{kind}"
    if WORLD.rank == 0:
        x, t = cube(2)
        faces = np.column_stack([np.full(len(t), 3), t])
        pyvista.PolyData(1000.0 * x, faces).save(path)
    shape = contact.read_surface(path, scale=1e-3, radius=0.1, pivot=(0, 0, 0))
    y = np.random.default_rng(1).uniform(-1.5, 1.5, (200, 3))
    phi, exact = shape.distance(y)[0], contact.box(LOWER, UPPER, 0.1).distance(y)[0]
    near = exact > -0.1
    assert np.abs(phi - exact)[near].max() < 1e-6  # (some kinds have single precision)
    assert shape.pivot.tolist() == [0.0, 0.0, 0.0]


def test_the_boundary_of_a_volume_in_a_file(mpi_tmp_path):
    pyvista = pytest.importorskip("pyvista")
    path = mpi_tmp_path / "grid.vtu"
    if WORLD.rank == 0:
        grid = pyvista.ImageData(dimensions=(3, 4, 2), spacing=(1.0, 0.5, 2.0))
        grid.cast_to_unstructured_grid().save(path)
    shape = contact.read_surface(path)
    y = np.random.default_rng(1).uniform(-1.0, 3.0, (200, 3))
    exact = contact.box((0, 0, 0), (2.0, 1.5, 2.0)).distance(y)[0]
    assert np.abs(shape.distance(y)[0] - exact).max() < 1e-13


def test_files_that_hold_no_surface_are_refused(mpi_tmp_path):
    pyvista = pytest.importorskip("pyvista")
    with pytest.raises(mpm.MPMError, match="needs the path of a file, not 5"):
        contact.read_surface(5)
    with pytest.raises(mpm.MPMError, match="There is no file"):
        contact.read_surface(mpi_tmp_path / "nothing.stl")
    if WORLD.rank == 0:
        (mpi_tmp_path / "words.xyz3").write_text("no surface at all")
        pyvista.PolyData(np.eye(3)).save(mpi_tmp_path / "points.vtp")
        x, t = cube()
        faces = np.column_stack([np.full(len(t) - 1, 3), t[1:]])
        pyvista.PolyData(x, faces).save(mpi_tmp_path / "open.stl")
    WORLD.Barrier()
    with pytest.raises(mpm.MPMError, match=r"Reading .*words.xyz3 failed"):
        contact.read_surface(mpi_tmp_path / "words.xyz3")
    with pytest.raises(mpm.MPMError, match=r"no triangles in .*points.vtp"):
        contact.read_surface(mpi_tmp_path / "points.vtp")
    with pytest.raises(mpm.MPMError, match=r"The surface of .*open.stl is open: 3 edges"):
        contact.read_surface(mpi_tmp_path / "open.stl")


# -- Runs ----------------------------------------------------------------------------------


def dragged(shape, comm=WORLD, friction=0.4):
    """Return a block over which a shape is dragged, and the contact."""
    V = scenes.vectors(scenes.box([-0.3, -0.2], [2.3, 1.2], [13, 7], QUADRILATERAL, comm))
    base = fem.locate_dofs_geometrical(V, lambda x: x[1] < 0.01)
    body = scenes.box([0.0, 0.0], [2.0, 1.0], [16, 8], QUADRILATERAL, comm)
    particles = mpm.Particles(body, V)
    die = contact.Rigid(particles, shape, friction)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.3)),
        bcs=[fem.dirichletbc(np.zeros(2), base, V)],
        terms=[die],
    )

    def path(t):
        die.move((0.5 * max(t - 0.3, 0.0), -0.1 * min(t, 0.3) / 0.3), -0.5 * max(t - 0.5, 0.0))

    problem.solve(5, update=path)
    return problem, die


@pytest.mark.parametrize("closed", [False, True])
def test_a_polygon_presses_as_the_box_that_it_is(closed):
    corners = [(0.4, 1.0), (1.0, 1.0), (1.0, 1.6), (0.4, 1.6)]
    square = contact.polyline([*corners, corners[0]], radius=0.1)
    problem, die = dragged(square if closed else contact.polygon(corners, 0.1))
    other, same = dragged(contact.box(corners[0], corners[2], 0.1))
    assert np.abs(die.reaction - same.reaction).max() < 1e-9 * np.abs(same.reaction).max()
    same_run(outcome(problem), outcome(other), 1e-9)
    # gaps of points that were too far away to be looked for in each iteration, too
    assert np.abs(die.gap - same.gap).max(initial=0.0) < 1e-9
    again = die.distance(die.points)
    assert np.abs(die.gap - again).max(initial=0.0) < 1e-9


def test_a_disc_of_segments_presses_as_a_disc():
    angle = 2.0 * np.pi * np.arange(201) / 200
    points = np.column_stack([0.7 + 0.6 * np.cos(angle), 1.6 + 0.6 * np.sin(angle)])
    _, die = dragged(contact.polyline(points))
    _, same = dragged(contact.disc((0.7, 1.6), 0.6))
    assert die.reaction == pytest.approx(same.reaction, rel=3e-3)


@pytest.mark.mpi
def test_terrain_is_the_same_on_any_number_of_ranks():
    runs = []
    for comm in (WORLD, scenes.MPI.COMM_SELF):
        problem, ground, _ = on_slope(3, comm)
        for _ in problem.steps(time=0.05, dt=0.01):
            pass
        runs.append((outcome(problem), ground.reaction))
    same_run(runs[0][0], runs[1][0], 1e-9)
    assert np.abs(runs[0][1] - runs[1][1]).max() < 1e-8 * np.abs(runs[1][1]).max()


def on_slope(n, comm=WORLD, triangles=True, friction=0.3, angle=25.0):
    """Return a block that slides down in space, along x, its contact, and the slope's normal."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    along, normal = np.array([c, 0.0, s]), np.array([-s, 0.0, c])
    body = scenes.box([0.0, -0.2, 0.0], [0.4, 0.2, 0.2], [n, n, 2], HEXAHEDRON, comm)
    body.geometry.x[:] = body.geometry.x @ np.array([along, [0.0, 1.0, 0.0], normal])
    V = scenes.vectors(
        scenes.box([-0.4, -0.41, -0.3], [0.8, 0.39, 0.6], [6, 4, 5], HEXAHEDRON, comm)
    )
    particles = mpm.Particles(body, V)
    x = np.linspace(-1.03, 1.17, 12)
    y = np.linspace(-0.63, 0.71, 7)
    z = np.broadcast_to(x[:, None] * s / c, (12, 7))
    shape = contact.terrain(x, y, z) if triangles else contact.plane((0, 0, 0), normal)
    ground = contact.Rigid(particles, shape, friction)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, LinearElastic(1e5, 0.3), density=1.0, body_force=(0.0, 0.0, -10.0)),
        scheme="euler",
        terms=[ground],
    )
    return problem, ground, normal


@pytest.mark.slow
def test_a_block_slides_over_triangles_as_over_their_plane():
    speeds = []
    for triangles in (True, False):
        problem, ground, normal = on_slope(3, triangles=triangles)
        for _ in problem.steps(time=0.1, dt=0.01):
            pass
        speeds.append(problem.momentum)
        reaction = ground.reaction
        pressed = reaction @ normal
        assert np.linalg.norm(reaction - pressed * normal) == pytest.approx(0.3 * pressed, rel=1e-9)
    assert np.abs(speeds[0] - speeds[1]).max() < 1e-8 * np.abs(speeds[1]).max()


def test_parts_are_solids_holes_or_refused():
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    cube = np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])

    def two(first, size, place, turned):
        """Return a cube of 4 and another one."""
        other = cube[:, ::-1] if turned else cube
        first = cube[:, ::-1] if first else cube
        points = np.vstack([4.0 * corners, size * corners + place])
        return contact.triangulated(points, np.vstack([first, other + 8]))

    for first in (False, True):
        hollow = two(first, 2.0, 1.0, not first)
        phi, _ = hollow.distance(np.array([[0.5, 2.0, 2.0], [1.5, 2.0, 2.0], [-1.0, 2.0, 2.0]]))
        np.testing.assert_allclose(phi, [-0.5, 0.5, 1.0])
        both = two(first, 2.0, 5.0, first)
        phi, _ = both.distance(np.array([[0.5, 2.0, 2.0], [5.5, 6.0, 6.0]]))
        np.testing.assert_allclose(phi, [-0.5, -0.5])
        with pytest.raises(mpm.MPMError, match="has 1 closed parts that are turned inside out"):
            two(first, 2.0, 5.0, not first)
