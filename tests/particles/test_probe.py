# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Results at points of a body, beside what was prescribed and what the particles have."""

import numpy as np
import pytest
import scenes

from dolfinx import mesh

import mpm_dolfinx as mpm

CELLS = {2: mesh.CellType.quadrilateral, 3: mesh.CellType.hexahedron}


def bar(dim=2, degree=1, cell=None):
    """A bar of length 2 that is drawn by 10 % along x, without anything across."""
    cell = cell or CELLS[dim]
    kind = CELLS[dim]
    V = scenes.vectors(
        scenes.box([0.0] * dim, [3.0] + [1.0] * (dim - 1), [6, 2, 2][:dim], kind), degree
    )
    body = scenes.box([0.0] * dim, [2.0] + [1.0] * (dim - 1), [8, 4, 4][:dim], cell)
    particles = mpm.Particles(body, V, degree=degree)
    ends = [mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=(2.0, 3.0), value=0.2)]
    sides = [mpm.held(V, i, x=(0.0, 3.0)) for i in range(1, dim)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, mpm.materials.Hencky(1e3, 0.0)), bcs=[*ends, *sides]
    )
    return particles, problem


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("degree", [1, 2])
def test_a_bar_that_is_drawn(dim, degree):
    particles, problem = bar(dim, degree)
    points = np.array([[0.3, 0.7, 0.2], [1.0, 0.5, 0.5], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])[:, :dim]
    for step in problem.steps(1):
        u = mpm.probe(particles, points)
        assert np.allclose(u[:, 0], 0.1 * step.load * points[:, 0], atol=1e-10)
        assert np.allclose(u[:, 1:], 0.0, atol=1e-12)
        assert np.allclose(mpm.probe(particles, points, "position"), points + u, atol=1e-14)
        stress = mpm.probe(particles, points, "stress")
        exact = 1e3 * np.log(1 + 0.1 * step.load) / (1 + 0.1 * step.load)  # Cauchy: tau / J
        assert stress.shape == (4, 3, 3) and np.allclose(stress[:, 0, 0], exact, rtol=1e-8)
        one = mpm.probe(particles, points[0])
        assert one.shape == (dim,) and np.allclose(one, u[0], rtol=1e-14, atol=1e-16)


@pytest.mark.parametrize("dim", [2, 3])
def test_points_of_uneven_cells(dim):
    particles, _ = bar(dim)
    x = particles.mesh.geometry.x
    x[:, 0] += 0.03 * np.sin(np.pi * x[:, 0]) * np.cos(3.0 * x[:, 1])
    turn = np.arange(9.0).reshape(3, 3)[:dim, :dim]
    particles.displacement.interpolate(lambda X: turn @ X[:dim])
    points = np.random.default_rng(0).uniform(0.05, 0.95, (40, dim))
    assert np.allclose(mpm.probe(particles, points), points @ turn.T, rtol=1e-11)


def test_a_field_is_that_of_the_particle_there():
    particles, problem = bar(cell=mesh.CellType.triangle)
    problem.solve(steps=1)
    own = mesh.compute_midpoints(particles.mesh, 2, np.arange(particles.num_local, dtype=np.int32))[
        :, :2
    ]
    every = np.concatenate(particles.mesh.comm.allgather(own))
    expected = np.concatenate(
        particles.mesh.comm.allgather(particles.volume / particles.initial_volume)
    )
    assert np.allclose(mpm.probe(particles, every, "volume_ratio"), expected, rtol=1e-14)


def test_the_pore_pressure_along_a_line():
    """It is that of the nodes, continuous, and nothing where water drains: no stairs of domains."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [1.0, 1.25], [2, 5], CELLS[2]), 2)
    column = scenes.box([0.0, 0.0], [1.0, 1.0], [2, 8], CELLS[2])
    particles = mpm.Particles(column, V, degree=2)
    tags = mpm.facet_tags(column, {1: mpm.region(y=1.0)})
    problem = mpm.PorousProblem(
        mpm.Body(
            particles,
            mpm.materials.Hencky(10.0, 0.0),
            tractions=[((0.0, -3.0), 1)],
            facet_tags=tags,
            pore_fluid=mpm.PoreFluid(0.1, drained=[(0.0, 1)]),
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=1.0), mpm.held(V, 1, y=0.0)],
    )
    problem.step(0.1)
    field = problem.pore_pressure[0]
    at = field.W.tabulate_dof_coordinates()
    own = np.flatnonzero(abs(at[: field.W.dofmap.index_map.size_local, 0] - 0.5) < 1e-9)
    comm = column.comm
    x = np.concatenate(comm.allgather(at[own, :2]))
    p = mpm.probe(particles, x, "pore_pressure")
    assert len(x) == 9 and p.shape == (9,) and p.min() >= -1e-3 < 2.5 < p.max()
    assert np.allclose(p, np.concatenate(comm.allgather(field.x.array[own])), rtol=1e-12)
    assert abs(p[np.argmax(x[:, 1])]) < 0.03 * p.max()  # where it drains, in the sense of Nitsche
    one = mpm.probe(particles, (0.5, 0.5), "pore_pressure")
    assert one.shape == () and np.allclose(one, p[np.argmin(abs(x[:, 1] - 0.5))])


@pytest.mark.parametrize("low", [True, False])
def test_the_edge_of_a_pit_is_ground_on_any_rank(low):
    """The stress there is that of the ground that is left; what was dug away has none."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 3.0], [8, 6], CELLS[2]))
    ground = scenes.box([0.0, 0.0], [4.0, 2.0], [16, 8], CELLS[2])
    particles = mpm.Particles(ground, V)
    load, weight = (0.0, -1.0), 20.0
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.Hencky(1e6, 0.0),
            density=weight,
            body_force=load,
            initial_stress=mpm.geostatic(2.0, weight, 0.0, load),
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=4.0), mpm.held(V, 1, y=0.0)],
    )
    problem.remove(mpm.region(y=(0.0, 1.0) if low else (1.0, 2.0)), name="pit")
    points = [(0.6, 1.0), (1.25, 1.0), (3.9, 1.0)]
    stress = mpm.probe(particles, points, "stress")[:, 1, 1]
    own = weight * (0.875 if low else 1.125)  # in the middle of the row that is left
    assert np.allclose(stress, -own, rtol=1e-6)
    dug = (1.3, 0.4 if low else 1.6)
    for field in ("stress", "displacement", "position"):
        assert np.isnan(mpm.probe(particles, dug, field)).all()
        assert np.isfinite(mpm.probe(particles, points, field)).all()


def test_what_cannot_be_asked():
    particles, problem = bar()
    problem.solve(steps=1)
    with pytest.raises(mpm.MPMError, match=r"point \(2.1, 0.5\) is not in the undeformed body"):
        mpm.probe(particles, [(1.0, 0.5), (2.1, 0.5)])
    with pytest.raises(mpm.MPMError, match=r"no field 'pressur'.*they have displacement, position"):
        mpm.probe(particles, (1.0, 0.5), "pressur")
    for points in [(1.0,), "here", [[[0.0, 0.0]]], (np.nan, 0.0)]:
        with pytest.raises(mpm.MPMError, match=r"shape \(m, 2\)"):
            mpm.probe(particles, points)
