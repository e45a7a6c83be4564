# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Sketches: each condition, load and material of a problem is in the picture, where it is."""

import numpy as np
import pytest
from ranks import fails
from scenes import HEXAHEDRON, QUADRILATERAL, TRIANGLE, WORLD, box, vectors

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm

pytest.importorskip("matplotlib")


def ground(**options):
    """Ground of two layers, 6 by 3, in cells of 0.5 of a background 8 by 4."""
    V = vectors(box([0.0, 0.0], [8.0, 4.0], [16, 8], QUADRILATERAL), 1)
    body = box([0.0, 0.0], [6.0, 3.0], [24, 12], TRIANGLE)
    particles = mpm.Particles(body, V)
    layers = mpm.cell_tags(body, {4: mpm.region(y=(0, 1)), 7: mpm.region(y=(1, 3))})
    tags = mpm.facet_tags(
        body, {1: mpm.region(x=(0, 2), y=3.0), 2: mpm.region(x=6.0), 3: mpm.region(x=(4, 6), y=3)}
    )
    laws = {
        4: mpm.materials.Hencky(1e6, 0.3),
        7: mpm.materials.VonMises(1e6, 0.3, yield_stress=1e4),
    }
    terms = options.pop("terms", lambda particles: ())(particles)
    supports = options.pop("supports", lambda particles, tags: ())(particles, tags)
    options = {"tractions": [((0.0, -1e3), 1)], "pressures": [(500.0, 2)], **options}
    given = mpm.Body(particles, laws, cell_tags=layers, facet_tags=tags, **options)
    bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, y=0.0)]
    return mpm.QuasiStaticProblem(given, bcs, terms=terms, supports=supports)


def words(figure):
    return [text.get_text() for text in figure.axes[0].get_legend().get_texts()]


def kinds(figure, colour):
    """Markers of one colour and where they are."""
    lines = [line for line in figure.axes[0].lines if line.get_color() == colour]
    return [
        (line.get_marker(), *(round(float(v[0]), 9) for v in line.get_data())) for line in lines
    ]


def test_what_holds_a_body_is_marked_at_the_nodes_that_carry_it():
    figure = mpm.plot.sketch(ground())
    if WORLD.rank > 0:
        assert figure is None
        return
    held = kinds(figure, "#222222")
    on_base = [x for marker, x, y in held if marker == "s" and y == 0.0]
    assert sorted(on_base) == [0.5 * k for k in range(13)]
    on_side = [y for marker, x, y in held if marker == 5 and x == 0.0]  # caret from the left
    assert sorted(on_side) == [0.5 * k for k in range(1, 7)]
    beyond = kinds(figure, "#a8a8a8")
    assert len(beyond) == 4 + 2 and all(x > 6.0 or y > 3.0 for _, x, y in beyond)


def test_loads_are_lines_on_their_facets_with_arrows_in_their_direction():
    collections = pytest.importorskip("matplotlib.collections")
    quiver = pytest.importorskip("matplotlib.quiver")
    figure = mpm.plot.sketch(ground())
    if WORLD.rank > 0:
        return
    ax = figure.axes[0]
    lines = [c for c in ax.collections if isinstance(c, collections.LineCollection)]
    lengths = [
        sum(np.linalg.norm(np.diff(part, axis=0)) for part in line.get_segments()) for line in lines
    ]
    assert np.allclose(sorted(lengths), [2.0, 3.0])
    traction, pressure = (q for q in ax.collections if isinstance(q, quiver.Quiver))
    assert np.allclose(traction.U, 0.0) and (traction.V < 0.0).all()
    assert (pressure.U < 0.0).all() and np.allclose(pressure.V, 0.0)  # against the outward normal
    assert words(figure)[:2] == ["Hencky, tag 4", "VonMises, tag 7"]
    assert {"held", "traction", "pressure"} < set(words(figure))


def test_water_obstacles_supports_and_gravity_are_in_the_legend(tmp_path):
    def wall(particles):
        return [mpm.contact.Rigid(particles, mpm.contact.disc((3.0, 3.8), 0.8))]

    def roller(particles, tags):
        return [mpm.boundary.roller(particles, tags, 3, normal=(0.0, 1.0))]

    problem = ground(
        terms=wall,
        supports=roller,
        density=2e3,
        body_force=(0.0, -9.81),
        pore_pressure=mpm.WaterTable(2.0, 9810.0),
        pressures=[],
    )
    path = WORLD.bcast(str(tmp_path / "sketch.png"))
    figure = mpm.plot.sketch(problem, path)
    if WORLD.rank == 0:
        found = {"obstacle", "support", "water table", "body force (0, -9.81)"}
        assert found < set(words(figure))
        (level,) = [line for line in figure.axes[0].lines if line.get_linestyle() == "--"]
        assert np.allclose(level.get_ydata(), 2.0)
        with open(path, "rb") as file:
            assert file.read(4) == b"\x89PNG"


def test_finite_elements_that_are_moved_and_a_residual_of_ones_own():
    quiver = pytest.importorskip("matplotlib.quiver")
    body = mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL))
    bcs = [mpm.held(body.W, y=0.0), mpm.held(body.W, 1, y=1.0, value=0.1)]
    d, v = body.displacement, ufl.TestFunction(body.W)
    R = ufl.inner(ufl.grad(d), ufl.grad(v)) * body.dx
    figure = mpm.plot.sketch(mpm.ParticleProblem(R, body, bcs=bcs))
    if WORLD.rank == 0:
        assert words(figure) == ["body 1", "held", "moved"]
        (arrows,) = (q for q in figure.axes[0].collections if isinstance(q, quiver.Quiver))
        assert len(arrows.U) == 5 and (arrows.V > 0.0).all()
        assert len(kinds(figure, "#222222")) == 10


def test_two_bodies_on_one_background_are_held_once():
    V = vectors(box([0.0, 0.0], [4.0, 2.0], [8, 4], QUADRILATERAL), 1)
    law = mpm.materials.Hencky(1e6, 0.3)
    both = [
        mpm.Particles(box([x, 0.0], [x + 1.0, 1.0], [4, 4], QUADRILATERAL), V) for x in (0.0, 2.0)
    ]
    problem = mpm.QuasiStaticProblem([mpm.Body(p, law) for p in both], [mpm.held(V, y=0.0)])
    figure = mpm.plot.sketch(problem)
    if WORLD.rank == 0:
        assert words(figure)[:2] == ["Hencky of body 1", "Hencky of body 2"]
        assert sorted(x for _, x, _ in kinds(figure, "#222222")) == [0.0, 0.5, 1.0, 2.0, 2.5, 3.0]
        assert sorted(x for _, x, _ in kinds(figure, "#a8a8a8")) == [1.5, 3.5, 4.0]


def test_free_nodes_are_held_with_the_background_and_removed_facets_bear_no_load():
    collections = pytest.importorskip("matplotlib.collections")
    V = vectors(box([0.0, 0.0], [4.0, 3.0], [8, 6], QUADRILATERAL), 1)
    body = box([0.0, 0.0], [2.0, 2.0], [8, 8], QUADRILATERAL)
    particles = mpm.Particles(body, V, free=mpm.region(x=(0, 1)), quadrature_degree=2)
    tags = mpm.facet_tags(body, {1: mpm.region(y=2.0)})
    given = mpm.Body(
        particles,
        mpm.materials.Hencky(1e6, 0.3),
        density=1.0,
        tractions=[((0.0, -1.0), 1)],
        facet_tags=tags,
    )
    problem = mpm.QuasiStaticProblem(given, [mpm.held(V, 0, x=0.0), mpm.held(V, y=0.0)])
    problem.solve(1)
    problem.remove(lambda x: (x[0] > 1.0) & (x[1] > 1.0))
    figure = mpm.plot.sketch(problem)
    if WORLD.rank == 0:
        held = kinds(figure, "#222222")
        assert sorted(y for _, x, y in held if x == 0.0) == [0.0, 0.5, 1.0, 1.5, 2.0]
        (line,) = (
            c for c in figure.axes[0].collections if isinstance(c, collections.LineCollection)
        )
        assert len(line.get_segments()) == 4


def test_in_space_conditions_are_points():
    pytest.importorskip("pyvista")
    V = vectors(box([0.0] * 3, [2.0] * 3, [4] * 3, HEXAHEDRON), 1)
    body = box([0.0] * 3, [1.0] * 3, [4] * 3, HEXAHEDRON)
    tags = mpm.facet_tags(body, {1: mpm.region(z=1.0)})
    q = fem.Constant(body, (0.0, 0.0, -1.0))
    given = mpm.Body(
        mpm.Particles(body, V),
        mpm.materials.Hencky(1e6, 0.3),
        tractions=[(q, 1)],
        facet_tags=tags,
    )
    figure = mpm.plot.sketch(mpm.QuasiStaticProblem(given, [mpm.held(V, z=0.0)]))
    if WORLD.rank == 0:
        assert words(figure)[:4] == ["Hencky", "held", "held, not reached", "traction"]
        assert words(figure)[4:] == [f"{axis} from 0 to 1" for axis in "xyz"]
        (corner,) = figure.axes[0].child_axes
        along = {text.get_text(): np.array(text.get_position()) for text in corner.texts}
        assert along["z"][1] > 0.0 and abs(along["z"][0]) < 1e-6  # upright, x to the right
        assert along["x"][0] > 0.0 and along["y"][0] > 0.0 and along["y"][1] > 0.0


def test_the_legend_tells_what_is_in_the_picture():
    figure = mpm.plot.sketch(ground(), box=[[1.0, 1.0], [5.0, 3.5]])
    if WORLD.rank == 0:
        assert words(figure)[2:] == ["traction"]


def test_what_is_no_problem_is_told():
    problem = ground()
    fails(lambda: mpm.plot.sketch("problem"), "Pictures are of a problem")
    fails(lambda: mpm.plot.sketch(problem.particles), "A sketch is of a problem")
    fails(lambda: mpm.plot.sketch(problem, box=[[0.0, 0.0]]), "box must be")
