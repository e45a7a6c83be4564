# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time series for ParaView, read again by pyvista."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest
import scenes
from scenes import PLANE, QUADRILATERAL, TRIANGLE, WORLD, box, vectors

import mpm_dolfinx as mpm
from mpm_dolfinx.io.series import Entry, Output, TimeSeries


@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_curved_domains_in_output(cell, degree, mpi_tmp_path):
    pyvista = pytest.importorskip("pyvista")
    V = vectors(box([-1.0, -1.0], [3.0, 3.0], [4, 4], QUADRILATERAL), degree)
    particles = mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [2, 2], cell), V, degree=degree)
    scenes.move(particles, lambda X: np.column_stack([0.3 * X[:, 1] ** 2, 0.2 * X[:, 0] ** 2]))
    area = scenes.total(particles, particles.volume)
    grid = mpm.plot.grid(particles)
    path = mpi_tmp_path / "curved.pvd"
    from mpm_dolfinx.io.series import TimeSeries

    TimeSeries(path, particles).write(0.0)
    WORLD.Barrier()
    if WORLD.rank == 0:
        reader = pyvista.get_reader(str(path))
        for found in (grid, reader.read()[0]):
            assert set(found.celltypes) == {{TRIANGLE: 69, QUADRILATERAL: 70}[cell]}
            flat = found.extract_surface(nonlinear_subdivision=4).triangulate()
            assert np.isclose(flat.area, area, rtol=2e-3)
    WORLD.Barrier()


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


def entries(path):
    """Return times and files of the states in a series."""
    root = ET.parse(path).getroot()
    return [(float(e.get("timestep")), e.get("file")) for e in root.iter("DataSet")]


def test_time_increases_over_stages(mpi_tmp_path):
    path = mpi_tmp_path / "block.pvd"
    problem = scenes.block()
    problem.write(path)
    times = [problem.history.time]

    def go_on(steps):
        for step in steps:
            problem.write(path)
            times.append(problem.history.time)
            assert step.time == problem.history.time

    go_on(problem.steps(2))
    problem.particles.load.value = 1.1
    go_on([problem.step()])
    go_on(problem.steps(4, update=lambda t: None))
    for _, step in zip(range(1), problem.steps(2, update=lambda t: None), strict=False):
        go_on([step])  # a stage that is left in the middle
    go_on([problem.step(), problem.step()][1:])
    go_on(problem.steps(2, update=lambda t: None))
    expected = [0.0, 0.5, 1.0, 2.0, 2.25, 2.5, 2.75, 3.0, 3.5, 6.0, 6.5, 7.0]
    assert times == expected
    assert np.all(np.diff([step.time for step in problem.history.steps]) > 0.0)
    WORLD.Barrier()
    if WORLD.rank == 0:
        assert [time for time, _ in entries(path)] == expected
        assert read(path)[0] == expected
        # One file a step, on any number of ranks, beside the index.
        names = {file for _, file in entries(path)}
        assert len(names) == len(expected)
        assert {p.name for p in mpi_tmp_path.iterdir()} == names | {"block.pvd"}
    WORLD.Barrier()


def test_time_under_displacement_control():
    problem = scenes.block()
    particles = problem.particles
    control = mpm.DisplacementControl(particles, -0.002, point=(1.0, 1.0), direction=(0.0, 1.0))
    problem.solve(2, control=control)
    other = mpm.DisplacementControl(particles, -0.001, point=(1.0, 1.0), direction=(0.0, 1.0))
    problem.solve(2, control=other)
    assert [step.time for step in problem.history.steps] == [0.5, 1.0, 1.5, 2.0]


def test_times_of_the_users_own(mpi_tmp_path):
    path = mpi_tmp_path / "block.pvd"
    problem = scenes.block()
    for step in problem.steps(2):
        problem.write(path, time=3600 * step.load)
    problem.write(path, time=3600)  # the same state again: it replaces the last one
    with pytest.raises(mpm.MPMError, match=r"time 3600, so none can follow with 1;"):
        problem.write(path)
    for wrong in (np.nan, "1", None.__class__):
        with pytest.raises(mpm.MPMError, match=r"time must be a finite number"):
            problem.write(path, time=wrong)
    WORLD.Barrier()
    if WORLD.rank == 0:
        assert [time for time, _ in entries(path)] == [1800.0, 3600.0]
    WORLD.Barrier()


@pytest.mark.parametrize("save_first", [False, True])
def test_series_with_times_of_its_own_goes_on_after_a_checkpoint(save_first, mpi_tmp_path):
    path, file = mpi_tmp_path / "column.pvd", mpi_tmp_path / "run.ckpt"
    problem = scenes.slump(TRIANGLE, 10e3, h=2.0)
    for number, step in enumerate(problem.steps(4)):
        if number == 1 and save_first:
            problem.save(file)
        problem.write(path, time=10.0 + 100.0 * step.load)
        if number == 1 and not save_first:
            problem.save(file)
    again = scenes.slump(TRIANGLE, 10e3, h=2.0)
    again.restore(file)
    assert again.history.time == 0.5
    for step in again.steps(4):
        again.write(path, time=10.0 + 100.0 * step.load)
        break
    assert again.history.time == 0.75
    again.step()
    assert again.history.time == 2.0
    WORLD.Barrier()
    if WORLD.rank == 0:
        assert [time for time, _ in entries(path)] == [35.0, 60.0, 85.0]
    WORLD.Barrier()


def test_domains_that_are_deleted_stay_apart(mpi_tmp_path):
    # A deleted domain stays where it was; its neighbours, who share nodes with it, move on.
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL)
    particles = mpm.Particles(body, V, outside="delete")
    scenes.move(particles, lambda X: 0.1 * X)
    particles.placement.delete(np.flatnonzero(particles.global_index == 0))
    scenes.move(particles, lambda X: 0.5 * X)
    path = mpi_tmp_path / "lost.pvd"
    TimeSeries(path, particles).write(1.0)
    deleted = scenes.gather(particles.deleted)
    WORLD.Barrier()
    if WORLD.rank == 0:
        _, (grid,) = read(path)
        sizes = np.abs(grid.compute_cell_sizes().cell_data["Area"])
        np.testing.assert_allclose(sizes, np.where(deleted, 0.55**2, 0.75**2), rtol=1e-12)
        assert np.array_equal(grid.cell_data["deleted"], deleted)
    WORLD.Barrier()


@pytest.mark.parametrize(
    ("state", "time", "step", "kept"),
    [
        # a state is known by its step, also before the first one, whatever time it was given
        (Entry(2.0, "a.vtu", 0), 0.5, 0, 1),
        (Entry(0.5, "a.vtu", 1), 0.5, 0, 0),
        (Entry(2.0, "a.vtu", 1), 0.5, 1, 1),
        # one of an older file by its time
        (Entry(0.5, "a.vtu", -1), 0.5, 3, 1),
        (Entry(0.6, "a.vtu", -1), 0.5, 3, 0),
    ],
)
def test_which_states_written_after_a_save_are_those_of_it(state, time, step, kept):
    output = Output()
    output.go_back({"a.pvd": [state]}, {"a.pvd": 0}, time, step)
    assert output.written() == {"a.pvd": kept}
