# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles that live where the background is in which they lie."""

import gc
import weakref

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from scenes import ALL, PLANE, QUADRILATERAL, TRIANGLE, WORLD

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx import _compat
from mpm_dolfinx.materials import Hencky, VonMises
from mpm_dolfinx.partition import Redistribution, cell_centres
from mpm_dolfinx.rebase import Rebase

SELF = MPI.COMM_SELF


def anywhere(body, seed=1):
    """Return a rank for each cell, by its input index."""
    cells = body.topology.index_map(body.topology.dim)
    every = np.random.default_rng(seed).integers(0, WORLD.size, cells.size_global)
    return every[_compat.input_cell_index(body)]


def by_index(body, values):
    """Gather values of cells in the order of the input."""
    count = body.topology.index_map(body.topology.dim).size_local
    index = np.concatenate(WORLD.allgather(body.topology.original_cell_index[:count]))
    return np.concatenate(WORLD.allgather(values))[np.argsort(index)]


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
@pytest.mark.parametrize("ghosts", ["none", "shared_facet"])
def test_mesh_on_other_ranks(cell, ghosts):
    n = [3] * (2 if cell in PLANE else 3)
    mode = getattr(mesh.GhostMode, ghosts)
    body = scenes.box([0.0] * len(n), [1.0] * len(n), n, cell, ghost_mode=mode)
    ranks = anywhere(body)
    moved = Redistribution(body, ranks).mesh
    cells, before = (m.topology.index_map(body.topology.dim) for m in (moved, body))
    assert cells.size_global == before.size_global
    wanted = WORLD.allreduce(np.bincount(ranks, minlength=WORLD.size))
    assert cells.size_local == wanted[WORLD.rank]
    corners = [
        m.geometry.x[_compat.geometry_dofmap(m)[: c.size_local]]
        for m, c in ((body, before), (moved, cells))
    ]
    assert np.array_equal(by_index(body, corners[0]), by_index(moved, corners[1]))
    if WORLD.size > 1:
        some = WORLD.allreduce(cells.num_ghosts)
        assert (some > 0) == (ghosts == "shared_facet")
        # Facets between cells are as many as before: each rank sees both sides of its own.
        inside = ufl.avg(fem.Constant(moved, 1.0)) * ufl.dS
        if ghosts == "shared_facet":
            area = WORLD.allreduce(fem.assemble_scalar(fem.form(inside)))
            whole = scenes.box([0.0] * len(n), [1.0] * len(n), n, cell, SELF)
            inside = ufl.avg(fem.Constant(whole, 1.0)) * ufl.dS
            assert area == pytest.approx(fem.assemble_scalar(fem.form(inside)), rel=1e-12)


def pieces(body):
    """Return a copy of a mesh whose cells share no vertex."""
    nodes = _compat.geometry_dofmap(body)[: body.topology.index_map(body.topology.dim).size_local]
    corners = body.geometry.x[nodes][:, :, : body.geometry.dim]
    return _compat.disconnected_mesh(WORLD, corners, body.basix_cell())


def moved_once(body):
    return Redistribution(body, anywhere(body))


def moved_thrice(body):
    """All to one rank, then anywhere, then anywhere else."""
    carrier = Redistribution(body, np.zeros_like(anywhere(body)))
    for seed in (2, 3):
        between = carrier.mesh
        carrier = carrier.then(Redistribution(between, anywhere(between, seed)))
    return carrier


def moved_and_stretched(body):
    """To other ranks, then to other places, then to other ranks."""
    carrier = moved_once(body)
    between = carrier.mesh
    nodes = _compat.geometry_dofmap(between)[: len(anywhere(between))]
    x = between.geometry.x[nodes][:, :, : between.geometry.dim]
    carrier = carrier.then(Rebase(between, np.zeros((0, 2), dtype=np.int64), 2.0 * x))
    return carrier.then(Redistribution(carrier.mesh, anywhere(carrier.mesh, 2)))


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
@pytest.mark.parametrize("apart", [False, True], ids=["joined", "apart"])
@pytest.mark.parametrize("way", [moved_once, moved_thrice, moved_and_stretched])
def test_tags_and_functions_move(cell, apart, way):
    body = scenes.unit(3, cell)
    if apart:
        body = pieces(body)
    facets = scenes.facet_tags(body, scenes.at(0, 0.0), scenes.at(1, 1.0))
    cells = scenes.cell_tags(body, lambda x: 1 + (x[:, 0] > 0.4) + (x[:, 1] > 0.6))
    values = fem.Function(fem.functionspace(body, ("DG", 0)), name="stiffness")
    values.interpolate(lambda x: 1.0 + x[0] + 2.0 * x[1])
    move = way(body)
    scale = 2.0 if way is moved_and_stretched else 1.0
    moved = [move.carry(thing) for thing in (facets, cells, values)]
    for old, new in zip((facets, cells), moved, strict=False):
        for tag in (1, 2, 3):
            sizes = []
            for tags, domain, size in ((old, body, 1.0), (new, move.mesh, scale)):
                kind = "ds" if tags is facets or tags is moved[0] else "dx"
                measure = ufl.Measure(kind, domain=domain, subdomain_data=tags)
                x = ufl.SpatialCoordinate(domain) / size
                form = fem.form((1.0 + x[0] + 3.0 * x[1]) * measure(tag))
                area = size ** (body.topology.dim - (kind == "ds"))
                sizes.append(WORLD.allreduce(fem.assemble_scalar(form)) / area)
            assert sizes[1] == pytest.approx(sizes[0], rel=1e-12, abs=1e-14)
    one, two = (
        WORLD.allreduce(
            fem.assemble_scalar(fem.form(f**2 * ufl.SpatialCoordinate(m)[0] / size * ufl.dx))
        )
        / size**body.topology.dim
        for f, m, size in ((values, body, 1.0), (moved[2], move.mesh, scale))
    )
    assert two == pytest.approx(one, rel=1e-12) and moved[2].name == "stiffness"
    if move.mesh is not body:
        linear = fem.Function(fem.functionspace(body, ("Lagrange", 1)))
        with pytest.raises(mpm.MPMError, match="piecewise constant"):
            move.carry(linear)
    assert move.carry(moved[0]) is moved[0] and move.carry(3.0) == 3.0


@pytest.mark.mpi
def test_meshes_between_are_forgotten():
    # Each holds some communicators of MPI, of which there are about 2000. Eight are remembered.
    problem = flowing("given")
    particles = problem.particles
    last = early = problem.arguments["cell_tags"]
    young = fem.Function(fem.functionspace(particles.mesh, ("DG", 0)))
    young.interpolate(lambda x: 1.0 + x[1])
    meshes = []
    for seed in range(11):
        ranks = anywhere(particles.mesh, seed)
        problem.make_anew(lambda ranks=ranks: particles.move(ranks), lambda state: state)
        meshes.append(weakref.ref(particles.mesh))
        last = particles.carry(last)
        if seed == 4:
            early = last
    other = flowing("given")
    for one in (problem, other):
        one.solve(2)
    gc.collect()
    assert [known() is not None for known in meshes] == [False] * 2 + [True] * 9
    assert_same_result(result(problem), result(other))
    own = slice(particles.num_local)
    middle = mesh.compute_midpoints(
        particles.mesh, 2, np.arange(particles.num_local, dtype=np.int32)
    )
    for tags in (last, particles.carry(early)):
        np.testing.assert_array_equal(tags.values[own], 1 + (middle[:, 1] > 4.0))
    carried = particles.carry(young)
    assert carried.function_space.mesh is particles.mesh
    np.testing.assert_allclose(carried.x.array[own], 1.0 + middle[:, 1], rtol=1e-12)


def weight(domain):
    """Return a weight that varies over the body, on its mesh of the moment."""
    return ufl.as_vector((0.0, -12.0 + 0.1 * ufl.SpatialCoordinate(domain)[0]))


def flowing(partition, comm=WORLD, **options):
    """A column of two materials that slumps, under a pressure on its top."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [12.0, 9.0], [12, 9], QUADRILATERAL, comm))
    body = scenes.box([0.0, 0.0], [4.0, 8.0], [8, 16], TRIANGLE, comm)
    tags = scenes.cell_tags(body, lambda x: 1 + (x[:, 1] > 4.0))
    young = fem.Function(fem.functionspace(body, ("DG", 0)))
    young.interpolate(lambda x: 1e6 * (1.0 + 0.05 * x[1]))
    law = VonMises(young, 0.3, rho_y=20e3, hardening=2e4)
    return mpm.QuasiStaticProblem(
        mpm.Particles(body, V, partition=partition),
        {1: law, 2: Hencky(1e6, 0.3)},
        density=1000.0,
        body_force=lambda domain: ufl.as_vector(
            (0.0, -12.0 + 0.1 * ufl.SpatialCoordinate(domain)[0])
        ),
        bcs=[scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)],
        cell_tags=tags,
        facet_tags=scenes.facet_tags(body, scenes.at(1, 8.0)),
        pressures=[(5e3, 1)],
        **options,
    )


def result(problem):
    """Return the arrays of a problem's particles in the order of the input."""
    particles = problem.particles
    names = ("centroid", "volume", "stress", "plastic_strain")
    values = {name: scenes.in_order(particles, getattr(particles, name)) for name in names}
    values["reaction"] = np.array([problem.reaction(bc) for bc in problem.bcs])
    return values


def assert_same_result(one, two):
    for name, values in one.items():
        size = np.abs(two[name]).max()
        np.testing.assert_allclose(values, two[name], rtol=0.0, atol=1e-9 * size, err_msg=name)


def test_answer_does_not_depend_on_the_partition():
    results = []
    for partition, repartition in (("given", None), ("background", None), ("given", 0.0)):
        problem = flowing(partition)
        problem.solve(4, repartition=repartition)
        results.append((problem.history.iterations, result(problem)))
    assert problem.history.statistics["repartitions"] >= (WORLD.size > 1)
    for iterations, values in results[1:]:
        assert iterations == results[0][0]
        assert_same_result(values, results[0][1])


def test_particles_are_where_their_background_is():
    # The body fills the background.
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 4.0], [32, 32], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [4.0, 4.0], [64, 64], TRIANGLE)
    problem = mpm.QuasiStaticProblem(
        mpm.Particles(body, V, partition="background"),
        Hencky(1e3, 0.3),
        bcs=[scenes.fix(V, scenes.at(i, 0.0, 4.0), component=i) for i in (0, 1)],
        body_force=(0.0, -1.0),
    )
    particles = problem.particles
    assert np.all(particles.ranks_of_background() == WORLD.rank)
    problem.solve(1)
    statistics = problem.history.statistics
    assert statistics["off_rank_rows"] <= 0.03 * 2 * (WORLD.size - 1)
    assert statistics["particle_imbalance"] <= 1.06
    assert statistics["dof_imbalance"] <= 1.06
    assert not problem.repartition(0.0)


@pytest.mark.mpi
def test_particles_of_a_rank_are_together():
    # A column in a corner of the background, which flows until it is a flat heap.
    problem = scenes.slump(TRIANGLE, 40e3, h=0.5, width=30.0)
    problem.solve(steps=10)
    before = problem.history.statistics["off_rank_rows"]
    assert problem.repartition(0.1)
    for _ in range(2):  # each part stays with the rank that has it
        assert not problem.repartition(0.01)
    problem.particles.load.value = 0.99
    problem.step()
    assert problem.history.statistics["off_rank_rows"] < 0.7 * before
    assert problem.history.statistics["particle_imbalance"] <= 1.05


@pytest.mark.mpi
def test_idle_ranks_get_particles():
    # All in one corner, and all on one rank: nobody has more than its share afterwards.
    problem = scenes.block()
    particles = problem.particles
    particles.move(np.zeros(particles.num_local, dtype=np.int64))
    problem = mpm.QuasiStaticProblem(particles, Hencky(1e3, 0.3), bcs=problem.bcs)
    assert (particles.num_local == 0) == (WORLD.rank > 0)
    assert problem.repartition(0.1)
    assert particles.num_local <= np.ceil(1.05 * particles.num_global / WORLD.size)
    assert problem.particles is particles and not problem.repartition(0.1)


def test_clouds_of_boxes(mpi_tmp_path):
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 4.0], [8, 8], QUADRILATERAL))
    x = np.stack(np.meshgrid(*[0.125 + 0.25 * np.arange(8)] * 2), axis=-1).reshape(-1, 2)
    own = x[WORLD.rank :: WORLD.size]
    values = []
    for partition in ("given", "background"):
        particles = mpm.Particles.from_points(own, 0.25, V, method="gimp", partition=partition)
        bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)]
        problem = mpm.QuasiStaticProblem(
            particles, Hencky(1e3, 0.3), bcs=bcs, body_force=(0.0, -10.0)
        )
        for _ in problem.steps(3, repartition=0.0):
            problem.write(mpi_tmp_path / f"{partition}.pvd")
        values.append(result(problem))
    assert_same_result(*values)


def test_checkpoints_do_not_mind(mpi_tmp_path):
    path = mpi_tmp_path / "column.ckpt"
    problem = flowing("background")
    for step in problem.steps(4, repartition=0.0):
        if step.load == 0.5:
            problem.save(path)
    other = flowing("given")
    other.restore(path)
    other.solve(4, repartition=0.05)
    assert other.history.iterations == problem.history.iterations
    assert_same_result(result(other), result(problem))


def test_objects_stay_the_same():
    problem = flowing("given")
    particles, history = problem.particles, problem.history
    moved = False
    for _ in problem.steps(4):
        before = result(problem)
        seconds = history.statistics["assemble"]
        moved |= problem.repartition(0.0)
        assert problem.particles is particles and problem.history is history
        assert history.statistics["assemble"] == seconds
        after = result(problem)
        for name, values in before.items():
            size = np.abs(values).max()
            np.testing.assert_allclose(after[name], values, rtol=0.0, atol=1e-13 * size)
    assert moved == (WORLD.size > 1)
    assert problem.history.load == [0.25, 0.5, 0.75, 1.0]


def test_what_cannot_move():
    problem = scenes.block()
    with pytest.raises(mpm.MPMError, match="threshold must be a share"):
        problem.repartition(2.0)
    body, V = problem.particles.mesh, problem.particles.V
    x = ufl.SpatialCoordinate(body)
    law = Hencky(1e3, 0.3)
    for options, match in (
        ({"body_force": ufl.as_vector((x[0], 0.0))}, "body_force is written on the present"),
        ({"density": fem.Constant(body, 2.0)}, "density is written on the present"),
        ({"material": Hencky(np.full(problem.particles.num_local, 1e3), 0.3)}, "use DG0"),
    ):
        arguments = {"material": law, "bcs": problem.bcs, **options}
        other = mpm.QuasiStaticProblem(mpm.Particles(body, V), **arguments)
        with pytest.raises(mpm.MPMError, match=match):
            other.repartition()
    particles = mpm.Particles(body, V)
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    R = ufl.derivative(scenes.neo_hookean(d) * particles.dx, d, v)
    with pytest.raises(mpm.MPMError, match="residual is written on the present body mesh"):
        mpm.ParticleProblem(R, particles, bcs=problem.bcs).repartition()
    with pytest.raises(mpm.MPMError, match="partition='somewhere'"):
        mpm.Particles(body, V, partition="somewhere")
    assert len(cell_centres(body)) == particles.num_local
