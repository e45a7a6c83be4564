# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time series for ParaView, read again by pyvista."""

import numpy as np
import pytest
import scenes
from scenes import PLANE, TRIANGLE, WORLD

import mpm_dolfinx as mpm

pyvista = pytest.importorskip("pyvista")


def read(path):
    """Return times and the cells that are no ghosts of each state (on rank 0)."""
    reader = pyvista.get_reader(path)
    states = []
    for time in reader.time_values:
        reader.set_active_time_value(time)
        grid = reader.read()
        grid = grid.combine() if isinstance(grid, pyvista.MultiBlock) else grid
        if "vtkGhostType" in grid.cell_data:
            grid.RemoveGhostCells()  # (extract_cells crashes now and then with VTK 9.3)
        states.append(grid)
    return list(reader.time_values), states


def expected(particles):
    """Return present centroids of corners and the fields of all particles."""
    nodes = particles.W.dofmap.list[: particles.num_local]
    x = particles.W.tabulate_dof_coordinates()[:, :2]
    x = x + particles.displacement.x.array.reshape(-1, 2)
    fields = {
        "volume": particles.volume,
        "volume_ratio": particles.volume / particles.initial_volume,
    }
    if particles.has_material:
        fields["stress"] = particles.stress.reshape(-1, 9)
        fields["pressure"] = -np.trace(particles.stress, axis1=1, axis2=2) / 3
        fields["plastic_strain"] = particles.plastic_strain
    gathered = {name: scenes.gather(value) for name, value in fields.items()}
    return scenes.gather(x[nodes].mean(axis=1)), gathered


def compare(grid, middle, fields):
    """Compare a state that was read with the particles' arrays."""
    assert grid.n_cells == len(middle)
    sizes = np.abs(grid.compute_cell_sizes().cell_data["Area"])
    points = np.array([grid.get_cell(i).points.mean(axis=0)[:2] for i in range(grid.n_cells)])
    gap = np.abs(points[:, None] - middle[None]).max(axis=2)
    order = gap.argmin(axis=1)
    assert sorted(order) == list(range(len(middle))) and gap.min(axis=1).max() < 1e-12
    volume = fields["volume"]
    np.testing.assert_allclose(sizes.sum(), volume.sum(), rtol=1e-12)
    np.testing.assert_allclose(sizes, volume[order], rtol=1e-10)
    for name, values in fields.items():
        if name != "volume":
            data = np.asarray(grid.cell_data[name]).reshape(len(points), -1)
            expected = values[order].reshape(len(points), -1)
            np.testing.assert_allclose(data, expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_time_series(cell, mpi_tmp_path):
    problem = scenes.slump(cell, 15e3, h=1.0)
    particles = problem.particles
    undeformed = particles.mesh.geometry.x.copy()
    path = mpi_tmp_path / "new" / "column.pvd"
    states = []
    for step in problem.steps(6):
        if len(problem.history.steps) % 3 == 0:
            problem.write(path)
            states.append((step.load, *expected(particles)))
    assert np.array_equal(particles.mesh.geometry.x, undeformed)
    assert [load for load, _, _ in states] == [0.5, 1.0]
    assert states[1][2]["plastic_strain"].max() > 0.1
    WORLD.Barrier()
    if WORLD.rank == 0:
        times, grids = read(path)
        assert times == [0.5, 1.0]
        for grid, (_, middle, fields) in zip(grids, states, strict=True):
            compare(grid, middle, fields)
    WORLD.Barrier()


def test_state_of_a_ufl_problem_and_before_any_step(mpi_tmp_path):
    problem = scenes.block()
    particles = mpm.Particles(scenes.unit(3, TRIANGLE), problem.particles.V)
    d, v = particles.displacement, scenes.ufl.TestFunction(particles.W)
    R = scenes.ufl.inner(scenes.linear_stress(d, 1e3, 0.3), scenes.ufl.grad(v)) * particles.dx
    free = mpm.ParticleProblem(R - particles.load * v[1] * particles.dx, particles, bcs=problem.bcs)
    path = str(mpi_tmp_path / "block.pvd")
    free.write(path)
    before = expected(particles)
    free.solve(steps=1)
    free.write(path)
    after = expected(particles)
    WORLD.Barrier()
    if WORLD.rank == 0:
        times, grids = read(path)
        assert times == [0.0, 1.0]
        compare(grids[0], *before)
        compare(grids[1], *after)
        assert "stress" not in grids[1].cell_data
        assert np.ptp(grids[1].point_data["displacement"][:, 1]) > 0.0
    WORLD.Barrier()


def test_another_run_replaces_the_series(mpi_tmp_path):
    path = mpi_tmp_path / "block.pvd"
    for _ in range(2):
        problem = scenes.block()
        for _ in problem.steps(2):
            problem.write(path)
        del problem
    WORLD.Barrier()
    if WORLD.rank == 0:
        assert read(path)[0] == [0.5, 1.0]
    WORLD.Barrier()


def started(path, tmp, save_first=False):
    """Return a problem that wrote four states of eight steps and was saved at the second."""
    problem = scenes.slump(TRIANGLE, 10e3, h=2.0)
    for step in problem.steps(8):
        if save_first and step.load == 0.5:
            problem.save(tmp / "run.ckpt")
        if step.load in (0.25, 0.5, 0.75, 0.875):
            problem.write(path)
        if not save_first and step.load == 0.5:
            problem.save(tmp / "run.ckpt")
        if step.load == 0.875:
            return problem
    raise AssertionError


@pytest.mark.parametrize("save_first", [False, True])
@pytest.mark.parametrize("again", [False, True])
def test_series_goes_on_after_a_checkpoint(save_first, again, mpi_tmp_path):
    path = mpi_tmp_path / "column.pvd"
    problem = started(path, mpi_tmp_path, save_first)
    if not again:
        problem = scenes.slump(TRIANGLE, 10e3, h=2.0)
    problem.restore(mpi_tmp_path / "run.ckpt")
    # Saved and restored once more before anything is written.
    problem.save(mpi_tmp_path / "later.ckpt")
    problem.restore(mpi_tmp_path / "later.ckpt")
    for step in problem.steps(8):
        if step.load in (0.625, 1.0):
            problem.write(path)
    state = expected(problem.particles)
    WORLD.Barrier()
    if WORLD.rank == 0:
        times, grids = read(path)
        assert times == [0.25, 0.5, 0.625, 1.0]
        compare(grids[-1], *state)
        heights = [grid.bounds[3] for grid in grids]
        assert sorted(heights, reverse=True) == heights and len(set(heights)) == 4
    WORLD.Barrier()


def test_series_that_the_checkpoint_does_not_know(mpi_tmp_path):
    path = mpi_tmp_path / "column.pvd"
    problem = started(path, mpi_tmp_path)
    problem.restore(mpi_tmp_path / "run.ckpt")
    other = mpi_tmp_path / "other.pvd"
    problem.write(other)
    WORLD.Barrier()
    if WORLD.rank == 0:
        assert read(other)[0] == [0.5]
        assert read(path)[0] == [0.25, 0.5, 0.75, 0.875]
        path.unlink()
    WORLD.Barrier()
    # A file that is gone begins again, one that is damaged is no reason to go on.
    problem.restore(mpi_tmp_path / "run.ckpt")
    problem.write(path)
    WORLD.Barrier()
    if WORLD.rank == 0:
        assert read(path)[0] == [0.5]
        path.write_text("<VTKFile>")
    WORLD.Barrier()
    before = problem.particles.displacement.x.array.copy()
    problem.solve(8)
    after = problem.particles.displacement.x.array.copy()
    with pytest.raises(mpm.MPMError, match=r"column\.pvd' should be the time series so far"):
        problem.restore(mpi_tmp_path / "run.ckpt")
    assert np.array_equal(problem.particles.displacement.x.array, after)
    assert not np.array_equal(before, after)


@pytest.mark.parametrize("name", ["run", "run.vtk", "run.xdmf", "run.pvd.txt"])
def test_wrong_name(name, mpi_tmp_path):
    problem = scenes.block()
    with pytest.raises(mpm.MPMError, match=r"'\.pvd' file"):
        problem.write(mpi_tmp_path / name)
    assert not (mpi_tmp_path / name).exists()


@pytest.mark.skip_in_parallel
def test_directory_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises((mpm.MPMError, OSError), match="file"):
        scenes.block().write(tmp_path / "file" / "run.pvd")
