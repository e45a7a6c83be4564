# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scenes, histories and movies: what is drawn is what is there, and nothing overlaps."""

import numpy as np
import pytest
import scenes
from marks import slow, thinned
from ranks import fails
from scenes import HEXAHEDRON, TRIANGLE, WORLD, at, block, box, fix, vectors

from dolfinx import fem

import mpm_dolfinx as mpm

pytest.importorskip("matplotlib")


def require_apart(figure):
    """Check that no two axes overlap, labels and titles included."""
    figure.draw_without_rendering()
    boxes = [ax.get_tightbbox() for ax in figure.axes]
    for i, one in enumerate(boxes):
        for other in boxes[:i]:
            wide = min(one.x1, other.x1) - max(one.x0, other.x0)
            high = min(one.y1, other.y1) - max(one.y0, other.y0)
            assert wide <= 0.0 or high <= 0.0


@pytest.fixture
def solved():
    problem = block(cell=TRIANGLE)
    problem.solve(steps=2)
    return problem


def test_domains_of_a_scene_are_those_of_the_particles(solved, tmp_path):
    particles = solved.particles
    path = WORLD.bcast(str(tmp_path / "scene.png"))
    figure = mpm.plot.scene(solved, "displacement_y", path)
    wanted = scenes.in_order(particles, particles.domains)
    values = scenes.in_order(particles, (particles.centroid - particles.initial_centroid)[:, 1])
    if WORLD.rank > 0:
        assert figure is None
        return
    bodies = figure.axes[0].collections[-1]
    drawn = np.array([p.vertices[:3] for p in bodies.get_paths()])
    np.testing.assert_allclose(
        np.sort(drawn.sum(axis=1), axis=0), np.sort(wanted.sum(axis=1), axis=0), atol=1e-12
    )
    bar = figure.axes[1]
    np.testing.assert_allclose(bar.get_ylim(), (values.min(), values.max()), rtol=1e-12)
    assert bar.get_ylabel() == "displacement y"
    require_apart(figure)
    with open(path, "rb") as file:
        assert file.read(4) == b"\x89PNG"


@pytest.mark.parametrize(
    "field", ["mises", "stress_xy", "pressure", "plastic_strain", "volume_ratio", None]
)
def test_fields_by_name(solved, field):
    figure = mpm.plot.scene(solved, field, background=False)
    if WORLD.rank == 0:
        assert len(figure.axes) == (1 if field is None else 2)


def test_values_of_the_users_own(solved):
    particles = solved.particles
    height = particles.centroid[:, 1]
    scalar = fem.Function(fem.functionspace(particles.mesh, ("Lagrange", 1)))
    scalar.interpolate(lambda x: x[0])
    limits = scenes.in_order(particles, particles.initial_centroid[:, 0])
    for field, low, high in ((height, None, None), (scalar, limits.min(), limits.max())):
        figure = mpm.plot.scene(particles, field, label="mine")
        if WORLD.rank == 0:
            assert figure.axes[1].get_ylabel() == "mine"
            if low is not None:
                np.testing.assert_allclose(figure.axes[1].get_ylim(), (low, high))


def test_what_is_not_there_is_refused_in_one_sentence(solved):
    with pytest.raises(mpm.MPMError, match=r"no field 'colour'; there are displacement, "):
        mpm.plot.scene(solved, "colour")
    with pytest.raises(mpm.MPMError, match="no term of contact"):
        mpm.plot.scene(solved, "contact_pressure")
    with pytest.raises(mpm.MPMError, match="must have the shape"):
        mpm.plot.scene(solved, np.zeros(solved.particles.num_local + 1))
    with pytest.raises(mpm.MPMError, match="a problem, of particles"):
        mpm.plot.scene("slope")
    with pytest.raises(mpm.MPMError, match=r"lower and the upper corner .* 2 coordinates"):
        mpm.plot.scene(solved, box=[(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
    with pytest.raises(mpm.MPMError, match="lower and the upper corner"):
        mpm.plot.movie(solved, [], "run.gif", box=[(1.0, 1.0), (0.0, 2.0)])
    with pytest.raises(mpm.MPMError, match=r"ends in \.gif or \.webp"):
        mpm.plot.movie(solved, [], "run.avi")
    with pytest.raises(mpm.MPMError, match="no step yet"):
        mpm.plot.history(block())


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"field": object()}, "values must be numbers, one for each particle"),
        ({"field": True}, "values must be numbers"),
        ({"ax": "left"}, "ax must be axes of matplotlib, .* not 'left'"),
        ({"warp": np.inf}, "warp must be a finite number, not inf"),
        ({"warp": 1j}, "warp must be a finite number, not 1j"),
        ({"limits": (0.0, 1.0, 2.0)}, "limits must be the first and the last value"),
        ({"limits": (np.nan, 1.0)}, "limits must be .* a number or None"),
        ({"background": None}, r"background of Look\(\) must be True or False, not None"),
        ({"colour": "red"}, "A picture has no colour=; it has label, cmap, "),
        ({"lines": "few"}, r"lines of Look\(\) must be True, False or None"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_how_a_scene_is_drawn_is_looked_at(solved, options, sentence):
    fails(lambda: mpm.plot.scene(solved, **options), sentence)


def test_pictures_of_nothing_and_in_ufl(solved):
    # NumPy would take a scalar of UFL for a sequence of sequences without end
    scalar = fem.Function(fem.functionspace(solved.particles.mesh, ("DG", 0)))
    refused = {
        "of a problem, of particles": lambda: mpm.plot.scene([]),
        "box must be": lambda: mpm.plot.scene(solved, box=scalar),
        "values must be numbers": lambda: mpm.plot.domains(solved.particles, scalar),
        "vmin must be": lambda: mpm.plot.domains(solved.particles, vmin="least"),
        "linewidth must be": lambda: mpm.plot.background(solved.particles.V, linewidth="thin"),
        "every must be a whole": lambda: mpm.plot.movie(solved, [], "run.gif", every=1.5),
        "fps must be a positive": lambda: mpm.plot.movie(solved, [], "run.gif", fps=np.inf),
        "dpi must be a positive": lambda: mpm.plot.movie(solved, [], "run.gif", dpi=-1.0),
        "limits must be": lambda: mpm.plot.movie(solved, [], "run.gif", limits=1.0),
    }
    for sentence, call in refused.items():
        fails(call, sentence)


def test_scene_in_space_is_rendered_without_a_word(tmp_path, recwarn, capfd):
    pytest.importorskip("pyvista")
    V = vectors(box([0.0] * 3, [2.0, 2.0, 1.5], [2, 2, 2], HEXAHEDRON))
    body = box([0.0] * 3, [1.0, 1.0, 1.0], [2, 2, 2], HEXAHEDRON)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V), mpm.materials.Hencky(1e3, 0.3), body_force=(0.0, 0.0, -10.0)
        ),
        bcs=[fix(V, at(i, 0.0), component=i) for i in range(3)],
    )
    problem.solve(1)
    figure = mpm.plot.scene(problem, "displacement_z", camera=(1.0, -1.0, 1.0))
    assert not [w for w in recwarn if "pyvista" in str(w.filename).lower()]
    if WORLD.rank == 0:
        assert "WARN" not in capfd.readouterr().err
        image = figure.axes[0].images[0].get_array()
        assert min(image.shape[:2]) > 300
        assert (np.ptp(image[..., :3].astype(int), axis=2) > 50).mean() > 0.02  # something coloured
        require_apart(figure)


@pytest.mark.parametrize("every, frames", thinned(2, [(1, 6), (2, 4)]))
def test_movie_has_a_frame_for_each_step(tmp_path, every, frames):
    image = pytest.importorskip("PIL.Image")
    problem = block()
    path = WORLD.bcast(str(tmp_path / "run.gif"))
    mpm.plot.movie(problem, problem.steps(5), path, every=every, dpi=40)
    assert len(problem.history.steps) == 5
    if WORLD.rank == 0:
        with image.open(path) as film:
            assert film.n_frames == frames
            first = np.asarray(film.convert("RGB")).astype(int)
            film.seek(frames - 1)
            last = np.asarray(film.convert("RGB")).astype(int)
        assert first.shape == last.shape and np.abs(first - last).max() > 50


def test_history_of_loads_and_of_a_curve(solved):
    figure = mpm.plot.history(solved)
    curve = mpm.plot.history(solved, curve={"sag, m": [0.0, 1.0], "force, N": [0.0, 3.0]})
    if WORLD.rank == 0:
        require_apart(figure)
        heights = [bar.get_height() for bar in figure.axes[1].patches]
        assert heights == solved.history.iterations
        assert curve.axes[0].get_ylabel() == "force, N"


def test_residuals_of_a_step_that_begins_without_forces_leave_the_others_to_be_seen():
    """A stiff tool that is pressed in has 1e20 of nothing at first: that is not the scale."""
    problem = block()
    problem.solve(steps=2)
    problem.history.steps[0].residuals[0] = 1e20
    figure = mpm.plot.history(problem)
    if WORLD.rank == 0:
        low, high = figure.axes[3].get_ylim()
        assert low < 1e-9 and high <= 1e3


def test_history_of_a_motion_shows_energies():
    V = vectors(box([0.0, 0.0], [2.0, 2.0], [4, 4], TRIANGLE))
    particles = mpm.Particles(box([0.5, 1.0], [1.0, 1.5], [2, 2], TRIANGLE), V)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, mpm.materials.Hencky(1e4, 0.3), density=1.0, body_force=(0.0, -1.0))
    )
    problem.solve(time=0.1, dt=0.05)
    figure = mpm.plot.history(problem)
    speed = mpm.plot.scene(problem, "velocity_y")
    if WORLD.rank == 0:
        labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
        assert labels[0] == "kinetic" and labels[-1] == "balance"
        np.testing.assert_allclose(speed.axes[1].get_ylim(), (-0.1, -0.1), atol=1e-2)


def pressed(shape, dim):
    """Return a cube that a shape touches."""
    kind = TRIANGLE if dim == 2 else HEXAHEDRON
    V = vectors(box([-0.2] * dim, [1.2] * dim, [4] * dim, kind))
    particles = mpm.Particles(scenes.unit(2, kind), V)
    die = mpm.contact.Rigid(particles, shape)
    law = mpm.materials.Hencky(1e3, 0.3)
    return mpm.QuasiStaticProblem(mpm.Body(particles, law), terms=[die]), die


def test_an_obstacle_is_drawn_where_it_is():
    problem, die = pressed(mpm.contact.disc((0.5, 1.3), 0.3), 2)
    die.move((0.1, 0.05), 0.7)
    figure = mpm.plot.scene(problem, None)
    if WORLD.rank > 0:
        return
    ax = figure.axes[0]
    lines = [
        path.vertices
        for artist in ax.collections
        for path in artist.get_paths()
        if artist.get_zorder() == 0.8 and len(path.vertices)
    ]
    x = np.concatenate(lines)
    x = x[x[:, 1] < ax.get_ylim()[1] - 1e-6]
    assert len(x) > 50
    radius = np.linalg.norm(x - [0.6, 1.35], axis=1)
    assert np.abs(radius - 0.3).max() < 1e-3
    assert ax.get_ylim()[1] > 1.3  # as far as it is near the body


@pytest.mark.parametrize("kind", [*slow("sphere"), "hills", "nowhere"])
def test_obstacles_in_space_are_rendered(kind):
    pytest.importorskip("pyvista")
    shape = {
        "sphere": mpm.contact.sphere((0.5, 0.5, 1.3), 0.3),
        "hills": mpm.contact.terrain([0.0, 1.0, 2.0], [-1.0, 2.0], -0.1 - 0.1 * np.eye(3)[:, :2]),
        "nowhere": mpm.contact.sphere((50.0, 50.0, 50.0), 0.3),
    }[kind]
    problem, _ = pressed(shape, 3)
    figure = mpm.plot.scene(problem, None)
    if WORLD.rank == 0:
        pixels = np.asarray(figure.axes[0].images[0].get_array())[..., :3].astype(float)
        brownish = (pixels[..., 0] - pixels[..., 2] > 10).mean()
        assert brownish < 1e-3 if kind == "nowhere" else brownish > 0.03


def coloured(pixels):
    """Return first and last row and column of what has the colours of a field."""
    places = np.argwhere(np.ptp(np.asarray(pixels)[..., :3].astype(int), axis=2) > 60)
    return places.min(axis=0), places.max(axis=0) + 1


@pytest.mark.parametrize("wide", [*slow(1.0), 100.0])
def test_bodies_in_space_fill_the_picture_whatever_is_around_them(wide):
    pytest.importorskip("pyvista")
    V = vectors(box([-wide] * 3, [1.0 + wide] * 3, [8] * 3, HEXAHEDRON))
    particles = mpm.Particles(scenes.unit(2, HEXAHEDRON), V)
    hills = mpm.contact.terrain([-wide, wide], [-wide, wide], np.full((2, 2), -0.05))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, mpm.materials.Hencky(1e3, 0.3)),
        terms=[mpm.contact.Rigid(particles, hills)],
    )
    height = particles.centroid[:, 2]
    figure = mpm.plot.scene(problem, height, cmap="autumn", camera="xz", lines=False)
    if WORLD.rank > 0:
        return
    pixels = figure.axes[0].images[0].get_array()
    first, last = coloured(pixels)
    # the cube of size 1, a floor 0.05 below it, and room of 0.2 beside and above
    share = (last - first) / np.array(pixels.shape[:2])
    assert (share > 0.6).all()
    # seen from the front without perspective it is as wide as it is high
    assert abs((last - first)[0] / (last - first)[1] - 1.0) < 0.01


def test_a_box_is_what_is_shown(solved):
    shown = np.array([[0.2, 0.1], [0.7, 0.4]])
    figure = mpm.plot.scene(solved, box=shown)
    if WORLD.rank == 0:
        ax = figure.axes[0]
        np.testing.assert_array_equal(np.transpose([ax.get_xlim(), ax.get_ylim()]), shown)
        require_apart(figure)


def test_a_box_in_space_is_what_is_shown():
    pytest.importorskip("pyvista")
    problem, _ = pressed(mpm.contact.sphere((50.0, 50.0, 50.0), 0.3), 3)
    values = problem.particles.centroid[:, 2]
    # of four boxes' width the cube has the second; of two boxes' height the upper
    shown = [(-1.0, -9.0, -1.0), (3.0, 9.0, 1.0)]
    figure = mpm.plot.scene(
        problem, values, cmap="autumn", camera="xz", background=False, box=shown, lines=False
    )
    if WORLD.rank == 0:
        pixels = np.asarray(figure.axes[0].images[0].get_array())
        high, wide = pixels.shape[:2]
        assert abs(wide / high - 2.0) < 0.01
        first, last = coloured(pixels)
        np.testing.assert_allclose(first, (0, wide / 4), atol=3)
        np.testing.assert_allclose(last, (high / 2, wide / 2), atol=3)
