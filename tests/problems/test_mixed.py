# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pressure as an unknown of built-in materials, against UFL, differences and exact solutions."""

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from compare import EXACT, error_of_blocks, outcome, raises, same_run
from marks import slow, thinned
from posed import posed
from routes import ROUTES, on_route
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD
from stock import held, mixed_space, newton, same_values

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import (
    DruckerPrager,
    Hencky,
    LinearElastic,
    Material,
    ModifiedCamClay,
    MohrCoulomb,
    SmallStrainVonMises,
    Tresca,
    VonMises,
)

STIFF = Hencky(30.0, 0.49999)
YIELDING = VonMises(30.0, 0.4999, yield_stress=1.0, hardening=3.0)
LAWS = [STIFF, YIELDING, LinearElastic(30.0, 0.4999)]
LAWS.append(SmallStrainVonMises(30.0, 0.4999, yield_stress=1.0, hardening=3.0))


class Foreign(Material):
    """A law that is not written in strain space."""

    symmetric = True

    def initial_state(self, n, dim):
        return {"stress": np.zeros((n, 4))}

    def update(self, displacement_gradient, state, tangent=True):
        raise NotImplementedError

    def cauchy_stress(self, displacement_gradient, state):
        raise NotImplementedError


def beam(
    material=STIFF,
    cell=QUADRILATERAL,
    comm=WORLD,
    load=0.1,
    degree=2,
    diagonal="left_right",
    grid=None,
    **options,
):
    """Return a beam that bends under its weight through cells of the background."""
    if cell in (TETRAHEDRON, HEXAHEDRON):
        grid = cell if degree > 1 else HEXAHEDRON
        background = scenes.box([0.0] * 3, [1.5, 1.0, 1.0], (3, 2, 2), grid, comm)
        shape = scenes.box([0.0, 0.2, 0.3], [1.0, 0.6, 0.7], (3, 2, 2), cell, comm)
    else:
        grid = grid or (cell if degree > 1 else QUADRILATERAL)
        background = scenes.box([0.0, 0.0], [2.5, 2.0], (5, 4), grid, comm)
        shape = scenes.box([0.0, 0.61], [2.0, 1.11], (8, 2), cell, comm, diagonal)
    particles = mpm.Particles(shape, scenes.vectors(background, degree), degree=degree)
    force = (0.0,) * (shape.geometry.dim - 1) + (-load,)
    bcs = [scenes.fix(particles.V, scenes.at(0, 0.0))]
    options = {"mixed": "pressure", "bcs": bcs, "body_force": force} | options
    return posed(mpm.QuasiStaticProblem, particles, material, **options)


def test_the_same_as_in_ufl():
    """Hencky's energy with a pressure, written out, and as a material."""
    problem = beam()
    problem.solve(steps=2)
    background = scenes.box([0.0, 0.0], [2.5, 2.0], (5, 4), QUADRILATERAL)
    shape = scenes.box([0.0, 0.61], [2.0, 1.11], (8, 2), QUADRILATERAL)
    particles = mpm.Particles(shape, scenes.vectors(background, 2), degree=2)
    p = mpm.ParticleField(particles, fem.functionspace(background, ("Lagrange", 1)), name="p")
    d, v, q = particles.displacement, ufl.TestFunction(particles.W), ufl.TestFunction(p.W)
    F = ufl.Identity(2) + ufl.grad(d)
    J = ufl.det(F)
    half = ufl.tr(F * F.T) / 2.0 / J - 1.0  # cosh of twice the stretch, less 1
    near = 2.0 * half - half**2 / 3.0 + 4.0 / 45.0 * half**3 - half**4 / 35.0
    far = ufl.ln(1.0 + half + ufl.sqrt(ufl.max_value(half * (half + 2.0), 1e-12))) ** 2
    squares = ufl.conditional(ufl.lt(half, 1e-3), near, far)
    shear, bulk = STIFF.shear, STIFF.bulk
    psi = shear * (squares / 2.0 + ufl.ln(J) ** 2 / 6.0) + p * ufl.ln(J) - p**2 / (2.0 * bulk)
    psi *= particles.dx
    load = particles.load * 0.1 * v[1] * particles.dx_exact
    R = [ufl.derivative(psi, d, v) + load, ufl.derivative(psi, p, q)]
    bcs = [scenes.fix(particles.V, scenes.at(0, 0.0))]
    other = mpm.ParticleProblem(R, particles, bcs=bcs, fields=[p], symmetric=True)
    other.solve(steps=2)
    one, two = problem.particles, particles
    for name in ("centroid", "deformation_gradient"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), rtol=0.0, atol=1e-9)
    (pressure,) = problem.pressure
    size = scenes.largest(p.x.array)
    assert scenes.largest(pressure.x.array - p.x.array) <= 1e-8 * size
    mean = np.trace(one.point_stress, axis1=2, axis2=3) / 3.0
    ratio = np.linalg.det(one.point_deformation_gradient)
    own = pressure.x.array[: mean.size].reshape(mean.shape)
    assert scenes.largest(mean * ratio - own) <= 1e-12 * size


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
def test_the_tangent_against_differences(law):
    problem = beam(law, load=0.1)
    problem.solve(steps=3)
    assert law.inelastic is bool(scenes.largest(problem.particles.plastic_strain) > 0.0)
    assert error_of_blocks(problem, step=1e-6, size=1e-4) <= 1e-6


@pytest.mark.parametrize("cell", [TRIANGLE, TETRAHEDRON, HEXAHEDRON], ids=scenes.name)
def test_other_cells(cell):
    problem = beam(cell=cell)
    problem.solve(steps=1)
    body = problem.particles
    logarithm = np.log(np.linalg.det(body.point_deformation_gradient))
    weighted = (body.undeformed.point_volumes() * logarithm).sum(axis=1)
    assert abs(scenes.total(body, weighted)) <= 1e-7
    assert error_of_blocks(problem) <= 1e-6


def test_a_pressure_jumps_between_bodies():
    """Two layers under a load: exact where each is a body, with a pressure of its own."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [1.0, 3.0], (2, 6), QUADRILATERAL), 2)
    shapes = [scenes.box([0.0, y], [1.0, y + 1.0], (4, 4), QUADRILATERAL) for y in (0.0, 1.0)]
    bodies = [mpm.Particles(shape, V, degree=2) for shape in shapes]
    problem = posed(
        mpm.QuasiStaticProblem,
        bodies,
        [LinearElastic(1e3, 0.49), LinearElastic(1e3, 0.25)],
        bcs=[
            scenes.fix(V, scenes.at(0, 0, 1), component=0),
            scenes.fix(V, scenes.at(1, 0), component=1),
        ],
        tractions=[[], [((0.0, -1.0), 1)]],
        facet_tags=[None, scenes.facet_tags(shapes[1], scenes.at(1, 2))],
        mixed="pressure",
    )
    problem.solve(steps=1)
    for body, poisson in zip(bodies, (0.49, 0.25), strict=True):
        mean = np.trace(body.stress, axis1=1, axis2=2) / 3.0
        assert scenes.largest(mean + (1.0 + poisson) / (3.0 * (1.0 - poisson))) < 1e-8


def test_both_routes():
    ends = []
    for route in ROUTES:
        with on_route(route):
            problem = beam(YIELDING, load=0.1)
            problem.solve(steps=2)
        ends.append(outcome(problem))
    same_run(*ends, 1e-9)


def driven(**options):
    """Return a beam whose end is moved by nodes of the background."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.5, 2.0], (5, 4), QUADRILATERAL), 2)
    body = mpm.Particles(scenes.box([0.0, 0.61], [2.0, 1.11], (8, 2), QUADRILATERAL), V, degree=2)
    bcs = [scenes.fix(V, scenes.at(0, 0.0), value=np.array([0.05, -0.02]))]
    return posed(mpm.QuasiStaticProblem, body, YIELDING, bcs=bcs, mixed="pressure", **options)


def two_lifts(**options):
    """Return two bodies, one of them stiffer, on the same background, and under their weight."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 3.0], (2, 3), QUADRILATERAL), 2)
    parts = [
        mpm.Particles(scenes.box([0.0, low], [1.5, low + 1.0], (3, 2), QUADRILATERAL), V, degree=2)
        for low in (0.0, 1.0)
    ]
    bcs = [scenes.fix(V, scenes.at(1, 0.0))]
    options |= {"bcs": bcs, "body_force": (0.0, -1.0), "density": 1.0, "mixed": "pressure"}
    return posed(mpm.QuasiStaticProblem, parts, [STIFF, YIELDING], **options)


@pytest.mark.parametrize(
    "make",
    [
        driven,
        two_lifts,
        lambda: beam(cell=TETRAHEDRON),
        lambda: shell(cells=2),
        lambda: turning("midpoint"),
    ],
    ids=["driven", "two lifts", "in space", "revolution", "motion"],
)
def test_the_tangent_by_both_routes(make, take):
    """What the compiled loops add up domain by domain are products of matrices, to round-off."""
    found = []
    for route in ROUTES:
        take(route)
        problem = make()
        reduced = problem.reduced
        ends = [np.zeros(len(field.bodies[0].increment.x.array)) for field in reduced.fields]
        for end, field in zip(ends, reduced.fields, strict=True):
            for bc in field.prescribed:
                bc.set(end)
        reduced.begin(ends, 1.0)
        reduced.impose()
        x = reduced.unknowns.restricted(reduced.unknowns.forces)
        x.array_w[:] = 1e-3 * np.sin(37.0 * np.arange(*x.getOwnershipRange()))
        force = x.duplicate()
        assert reduced.residual(x, force) is None
        reduced.scale(force)  # before there is a tangent
        K = reduced.tangent()
        scale, lift = reduced.scale(force), reduced.lift()
        found.append(
            (K * x, reduced.levels.diagonal(K), lift, reduced.resistance.stiffness(x), scale)
        )
    for one, other in zip(*found, strict=True):
        if isinstance(one, float):
            assert one == pytest.approx(other, rel=1e-10)
            continue
        size = max(scenes.largest(other.array_r), 1e-30)
        assert scenes.largest(one.array_r - other.array_r) <= 1e-11 * size
    assert len(found) == 2 and (make is not driven or scenes.largest(found[0][2].array_r) > 0.0)


def test_fields_are_split_by_their_names():
    """Blocks of displacement and pressure in an iterative solver of PETSc's."""
    lu = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    options = {
        "ksp_type": "gmres",
        "ksp_rtol": 1e-10,
        "pc_type": "fieldsplit",
        "pc_fieldsplit_type": "schur",
        "pc_fieldsplit_schur_fact_type": "full",
        "pc_fieldsplit_schur_precondition": "selfp",
        **{f"fieldsplit_displacement_{key}": value for key, value in lu.items()},
        **{f"fieldsplit_pressure_{key}": value for key, value in lu.items()},
    }
    one, two = beam(), beam(petsc_options=options)
    for problem in (one, two):
        problem.solve(steps=2)
    same_run(outcome(one), outcome(two), 1e-9)
    ksp = two.solver.getKSP()
    assert ksp.getPC().getType() == "fieldsplit" and 1 < ksp.getIterationNumber() < 60


def test_incompressible_to_the_last_digit():
    """The answer no longer depends on the bulk modulus, nor does the number of solves."""
    found = []
    for poisson in (0.4999999, 0.4999999999):
        problem = beam(Hencky(30.0, poisson))
        problem.solve(steps=2)
        found.append((problem.particles.centroid, problem.history.iterations))
    assert scenes.largest(found[0][0] - found[1][0]) <= 1e-5
    assert found[0][1] == found[1][1]


def shell(law=VonMises(3.0 * 3.8e3, 0.4997, yield_stress=0.5), cells=4, **options):
    """Return a problem of a thick cylinder, one slice of it, that is blown up."""
    inner, outer, height = 1.0, 2.0, 1.0 / cells
    background = scenes.box([0.0, 0.0], [4.0, height], (4 * cells, 1), QUADRILATERAL)
    shape = scenes.box([inner, 0.0], [outer, height], (cells, 1), QUADRILATERAL)
    particles = mpm.Particles(shape, scenes.vectors(background, 2), degree=2, quadrature_degree=4)
    tags = scenes.facet_tags(shape, scenes.at(0, inner))
    axial = fem.locate_dofs_geometrical(
        (particles.V.sub(1), particles.V.sub(1).collapse()[0]), lambda x: x[0] > -1.0
    )
    zero = fem.Function(particles.V.sub(1).collapse()[0])
    bcs = [fem.dirichletbc(zero, axial, particles.V.sub(1))]
    problem = posed(
        mpm.QuasiStaticProblem,
        particles,
        law,
        axisymmetric=True,
        pressures=[(1.0, 1)],
        facet_tags=tags,
        bcs=bcs,
        mixed="pressure",
        **options,
    )
    return problem


def test_a_cylinder_against_the_exact_solution():
    """Expansion of a rigid-plastic cylinder (Yu 2000, section 4.2): volume does not change."""
    problem = shell()
    point = mpm.DisplacementControl(problem.particles, 0.6, point=(1.0, 0.0), direction=(1.0, 0.0))
    problem.solve(steps=12, control=point)
    a = 1.6
    exact = -0.5 / np.sqrt(3.0) * np.log(a**2 / (4.0 + a**2 - 1.0))
    assert abs(float(problem.particles.load.value) / exact - 1.0) < 3e-3


def test_the_tangent_of_a_body_of_revolution():
    problem = shell(STIFF)
    point = mpm.DisplacementControl(problem.particles, 0.1, point=(1.0, 0.0), direction=(1.0, 0.0))
    problem.solve(steps=1, control=point)
    assert error_of_blocks(problem, size=1e-4) <= 1e-6


def test_results_do_not_depend_on_the_ranks():
    problem = beam(YIELDING, load=0.1)
    problem.solve(steps=2)
    together = outcome(problem)
    if WORLD.rank == 0:
        alone = beam(YIELDING, comm=MPI.COMM_SELF, load=0.1)
        alone.solve(steps=2)
        index = np.argsort(alone.particles.global_index)
        for name in ("centroid", "stress"):
            expected = getattr(alone.particles, name)[index]
            found = together[f"{name} 0"]
            assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()


def test_restart_and_moves_to_other_ranks(tmp_path):
    path = WORLD.bcast(tmp_path / "run.ckpt")
    problem = beam(YIELDING, load=0.1)
    for step in problem.steps(4):
        if step.load == 0.5:
            problem.save(path)
    whole = outcome(problem)
    other = beam(YIELDING, load=0.1)
    other.restore(path)
    before = scenes.largest(other.pressure[0].previous.x.array)
    assert before > 0.0
    other.solve(steps=4)
    same_run(outcome(other), whole, EXACT)
    moved = beam(YIELDING, load=0.1)
    moved.solve(steps=4, repartition=0.0)
    same_run(outcome(moved), whole, 1e-9)


def test_a_failed_step_leaves_the_pressure_as_it_was():
    problem = beam(petsc_options={"snes_max_it": 1})
    problem.particles.load.value = 1.0
    raises(problem.step, mpm.ConvergenceError, "Newton")
    assert not problem.pressure[0].x.array.any()


def test_what_does_not_go_together_is_refused():
    raises(lambda: beam(mixed="volume"), mpm.MPMError, "Unknown mixed='volume'")
    triangles = scenes.box([0.0, 0.0], [2.5, 2.0], (5, 4), TRIANGLE)
    shape = scenes.box([0.0, 0.61], [2.0, 1.11], (8, 2), QUADRILATERAL)
    body = mpm.Particles(shape, scenes.vectors(triangles, 1))
    raises(
        lambda: mpm.QuasiStaticProblem(mpm.Body(body, STIFF), mixed="stabilised pressure"),
        mpm.MPMError,
        "needs a background of quadrilaterals or hexahedra",
    )
    raises(lambda: beam(degree=1), mpm.MPMError, "needs a background and particles of degree 2")
    raises(lambda: beam(mixed="stabilised pressure"), mpm.MPMError, "degree 2; it is for degree 1")
    raises(
        lambda: simple(cell=TRIANGLE, grid=TRIANGLE),
        mpm.MPMError,
        "needs a background of quadrilaterals or hexahedra",
    )
    raises(lambda: beam(f_bar="domain"), mpm.MPMError, "takes the place of f_bar")
    raises(lambda: beam(Foreign()), mpm.MPMError, "a law in strain space .*, not Foreign")
    clay = ModifiedCamClay(0.1, 0.02, 1.0, 100.0, 5.0, 3.0)
    raises(lambda: beam(clay), mpm.MPMError, "ModifiedCamClay, which may soften under a given")


# -- Degree 1 ----------------------------------------------------------------------------


def simple(material=STIFF, **options):
    """Return the beam in degree 1, with a pressure that is kept from oscillating."""
    return beam(material, degree=1, mixed="stabilised pressure", **options)


def test_a_stabilised_pressure_comes_near_that_of_degree_2():
    def bent(n, degree, mixed):
        background = scenes.box([0.0, 0.0], [2.5, 2.0], (5 * n, 4 * n), QUADRILATERAL)
        shape = scenes.box([0.0, 0.61], [2.0, 1.11], (8 * n, 2 * n), QUADRILATERAL)
        V = scenes.vectors(background, degree)
        body = mpm.Particles(shape, V, degree=degree)
        bcs = [scenes.fix(V, scenes.at(0, 0.0))]
        problem = mpm.QuasiStaticProblem(
            mpm.Body(body, STIFF, body_force=(0, -0.2)), bcs=bcs, mixed=mixed
        )
        problem.solve(2)
        assert problem.history.iterations == [4, 4]
        pressure = np.abs(scenes.in_order(body, body.stress).trace(axis1=1, axis2=2)).mean() / 3.0
        return 0.61 - scenes.in_order(body, body.domains)[:, :, 1].min(), pressure

    exact = bent(3, 2, "pressure")
    for n, bounds in ((2, (0.03, 0.03)), (4, (0.01, 0.05))):
        found = bent(n, 1, "stabilised pressure")
        for value, other, bound in zip(found, exact, bounds, strict=True):
            assert value == pytest.approx(other, rel=bound)


def test_a_constant_pressure_is_not_smoothed():
    """A block under pressure from all sides is as it is without an unknown for it."""

    def block(mixed):
        V = scenes.vectors(scenes.box([0.0, 0.0], [1.5, 1.5], (3, 3), QUADRILATERAL))
        shape = scenes.bend(scenes.box([0.0, 0.0], [1.0, 1.0], (4, 4), QUADRILATERAL), 0.0)
        sides = scenes.facet_tags(shape, scenes.at(0, 1.0), scenes.at(1, 1.0))
        bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in range(2)]
        problem = mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(shape, V),
                Hencky(10.0, 0.3),
                pressures=[(2.0, 1), (2.0, 2)],
                facet_tags=sides,
            ),
            bcs=bcs,
            mixed=mixed,
            solver=mpm.Solver(petsc_options={"snes_rtol": 1e-11}),
        )
        problem.solve(2)
        return outcome(problem)

    same_run(block("stabilised pressure"), block(None), 1e-9)


@pytest.mark.parametrize("cell", [QUADRILATERAL, TRIANGLE, TETRAHEDRON], ids=scenes.name)
def test_routes_ranks_and_differences_of_a_stabilised_pressure(cell, take):
    law = VonMises(30.0, 0.499, yield_stress=0.5)
    results = []
    for options in ({}, {"comm": MPI.COMM_SELF}, {"route": "reference"}):
        take(options.pop("route", "loops"))
        problem = simple(law, cell=cell, load=0.05, **options)
        problem.solve(2)
        results.append(outcome(problem))
        if not results[1:]:
            assert error_of_blocks(problem) < 1e-6
    for other in results[1:]:
        same_run(other, results[0], 1e-9)


def test_a_stabilised_pressure_goes_on_from_a_file_and_on_other_meshes(mpi_tmp_path):
    law = Hencky(30.0, 0.4999)
    whole = simple(law)
    run = whole.steps(4)
    next(run)
    next(run)
    whole.save(mpi_tmp_path / "state")
    for _ in run:
        pass
    other = simple(law)
    other.restore(mpi_tmp_path / "state")
    other.solve(4)
    same_run(outcome(other), outcome(whole), EXACT)
    moved = simple(law)
    run = moved.steps(4)
    next(run)
    next(run)
    moved.rebase()
    moved.repartition(0.0)
    for load in (0.75, 1.0):
        moved.particles.load.value = load
        moved.step()
    same_run(outcome(moved), outcome(whole), 1e-8)


def test_a_split_carries_the_pressure():
    problem = simple()
    body, which = problem.particles, [3, 5, 10]
    body.load.value = 0.5
    problem.step()

    def state():
        (p,) = problem.pressure
        values = p.x.array[: body.num_local].copy()
        return [scenes.in_order(body, a) for a in (values, body.stress)]

    before, force = state(), problem.reaction(problem.bcs[0])
    problem.split(which)
    origin = scenes.in_order(body, body.origin_index)
    for now, values in zip(state(), before, strict=True):
        size = np.abs(values).max()
        assert size > 0.1
        np.testing.assert_allclose(now, values[origin], rtol=0.0, atol=1e-12 * size)
    np.testing.assert_allclose(problem.reaction(problem.bcs[0]), force, rtol=1e-12)
    body.load.value = 1.0
    problem.step()
    held = problem.reaction(problem.bcs[0])
    np.testing.assert_allclose(held, [0.0, 0.1 * 2.0 * 0.5], rtol=0.0, atol=1e-8)


def test_a_body_that_is_split_at_first_is_one_of_triangles():
    tight = {"petsc_options": {"snes_rtol": 1e-12}}
    cut, plain = simple(**tight), simple(cell=TRIANGLE, diagonal="right", **tight)
    cut.split(range(16))
    cut.particles.undeformed.mass_share.x.array[:] = (
        1.0  # masses of triangles, not of quadrilaterals
    )
    ends = []
    for problem in (cut, plain):
        problem.solve(2)
        body = problem.particles
        x = scenes.in_order(body, body.domains).reshape(-1, 2)
        ends.append(
            np.concatenate([x.min(axis=0), x.max(axis=0), problem.reaction(problem.bcs[0])])
        )
    assert ends[0][1] < 0.57
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-9)


# -- Soils -------------------------------------------------------------------------------

SOILS = {
    "tresca": Tresca(300.0, 0.3, 1.0),
    "mohr-coulomb": MohrCoulomb(300.0, 0.3, 1.0, 20.0, 5.0),
    "associated": MohrCoulomb(300.0, 0.3, 1.0, 20.0, 20.0),
    "softening": MohrCoulomb(300.0, 0.3, 1.0, 20.0).with_softening(10.0, cohesion=0.5),
    "drucker-prager": DruckerPrager(300.0, 0.3, 1.0, 20.0),
}


def pressed(law, width=1.0, comm=WORLD, push=0.03, **options):
    """Return a problem of a block between rollers that is pressed down over a part of its top."""
    background = scenes.box([0.0, 0.0], [2.0, 1.5], (4, 3), QUADRILATERAL, comm)
    shape = scenes.box([0.0, 0.0], [1.0, 1.0], (4, 4), QUADRILATERAL, comm)
    body = mpm.Particles(shape, scenes.vectors(background, 2), degree=2)
    tags = scenes.facet_tags(shape, lambda x: np.isclose(x[1], 1.0) & (x[0] < width + 1e-9))
    plate = mpm.boundary.roller(body, tags, 1, normal=(0.0, -1.0), value=push)
    sides = [scenes.fix(body.V, scenes.at(axis, 0), component=axis) for axis in (0, 1)]
    options = {"mixed": "pressure", "bcs": sides, "supports": [plate]} | options
    return posed(mpm.QuasiStaticProblem, body, law, **options)


@pytest.mark.parametrize("name", SOILS)
def test_soils_in_a_uniform_state(name):
    """A pressure of its own changes nothing there."""
    one, two = pressed(SOILS[name]), pressed(SOILS[name], mixed=None)
    for problem in (one, two):
        problem.solve(steps=3)
        assert problem.particles.plastic_strain.min() > 1e-3
    same_run(outcome(one), outcome(two), 1e-7)
    mean = np.trace(one.particles.point_stress, axis1=2, axis2=3) / 3.0
    ratio = np.linalg.det(one.particles.point_deformation_gradient)
    own = one.pressure[0].x.array[: mean.size].reshape(mean.shape)
    np.testing.assert_allclose(mean * ratio, own, rtol=1e-6)


@pytest.mark.skip_in_parallel  # a state by numbers of dofs, which may lie at a kink
@pytest.mark.parametrize("name", SOILS)
def test_soils_under_a_strip(name):
    """The tangent there against differences."""
    problem = pressed(SOILS[name], 0.5)
    problem.solve(steps=3)
    assert problem.particles.plastic_strain.max() > 1e-2
    assert problem.yield_function.max() <= (1e-9 if name != "softening" else np.inf)
    assert error_of_blocks(problem, step=1e-8, size=1e-6) <= 1e-5


def test_both_routes_of_soils(take):
    ends = []
    for route in ROUTES:
        take(route)
        problem = pressed(SOILS["mohr-coulomb"], 0.5, push=0.01)
        problem.solve(steps=2)
        assert problem.particles.plastic_strain.max() > 1e-3
        ends.append(outcome(problem))
    same_run(*ends, 1e-8)


def test_two_laws_in_a_body_and_a_file(mpi_tmp_path):
    """Soil on a stiff layer whose mean stress comes apart; restart bit for bit, and other ranks."""

    def made(comm=WORLD):
        laws = {1: SOILS["mohr-coulomb"], 2: Hencky(3e3, 0.4999)}
        problem = pressed(SOILS["mohr-coulomb"], 0.5, comm)
        tags = scenes.cell_tags(problem.particles.mesh, lambda x: np.where(x[:, 1] > 0.5, 1, 2))
        return pressed_again(problem, laws, tags)

    problem = made()
    for step in problem.steps(4):
        if step.load == 0.5:
            problem.save(mpi_tmp_path / "run")
    whole = outcome(problem)
    other = made()
    other.restore(mpi_tmp_path / "run")
    other.solve(steps=4)
    same_run(outcome(other), whole, EXACT)
    if WORLD.rank == 0:
        alone = made(MPI.COMM_SELF)
        alone.solve(steps=4)
        index = np.argsort(alone.particles.global_index)
        for name in ("centroid", "stress"):
            expected = getattr(alone.particles, name)[index]
            size = np.abs(expected).max()
            assert np.abs(whole[f"{name} 0"] - expected).max() <= 1e-8 * size


def pressed_again(problem, laws, tags):
    """Return the problem of the same body with other laws."""
    return posed(
        mpm.QuasiStaticProblem,
        problem.particles,
        laws,
        cell_tags=tags,
        bcs=problem.bcs,
        supports=problem.setup.supports,
        mixed="pressure",
    )


@pytest.mark.parametrize("name", ["mohr-coulomb", *slow("drucker-prager")])
def test_soil_in_a_stage(name, mpi_tmp_path):
    """A stage that changes nothing holds nothing back, from a file and after a failure too."""
    ends = []
    for way in ("plain", "on", "file", "failure"):
        problem = pressed(SOILS[name], 0.5, push=0.01, density=1.0, body_force=(0.0, -1.0))
        if way != "file":
            problem.solve(steps=2)
            assert scenes.largest(problem.particles.plastic_strain) > 1e-3
        if way == "on":
            problem.save(mpi_tmp_path / "soil")
        elif way == "file":
            problem.restore(mpi_tmp_path / "soil")
        elif way == "failure":
            forces = problem.reduced.terms.nodal_forces()
            problem.particles.load.value = 1e4
            with pytest.raises(mpm.MPMError):
                problem.step()
            problem.particles.load.value = 1.0
            for now, then in zip(problem.reduced.terms.nodal_forces(), forces, strict=True):
                np.testing.assert_array_equal(now, then)
        if way == "plain":
            problem.step()
        else:
            problem.stage("nothing")
            next(problem.steps(2))
        ends.append(outcome(problem))
    same_run(ends[1], ends[0], 1e-9)
    same_run(ends[2], ends[1], EXACT)
    same_run(ends[3], ends[1], EXACT)


def test_soil_in_motion():
    """By backward Euler, whose stress is that at the step's end."""
    problem = turning("euler", SOILS["drucker-prager"].with_parameters(young=30.0, cohesion=0.05))
    problem.solve(time=0.06, dt=0.03)
    assert problem.particles.plastic_strain.max() > 0.0
    assert error_of_blocks(problem, step=1e-8, size=1e-6) <= 1e-5


# -- Stages ------------------------------------------------------------------------------


def ground(V, low, high, law, **options):
    """Return what carries its weight between rollers, as a problem or as a lift."""
    shape = scenes.box([0.0, low], [2.0, high], (4, round(2 * (high - low))), QUADRILATERAL)
    return mpm.Particles(shape, V, degree=2), law, {"density": 2.0, "body_force": (0.0, -10.0)}


def test_a_lift_and_another_material():
    """Two lifts, of which the lower one is replaced: stress stays, and the end is exact."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 3.0], (2, 3), QUADRILATERAL), 2)
    law = Hencky(1e7, 0.49)
    bcs = [
        scenes.fix(V, scenes.at(0, 0, 2), component=0),
        scenes.fix(V, scenes.at(1, 0), component=1),
    ]
    body, law, loads = ground(V, 0.0, 1.0, law)
    problem = posed(mpm.QuasiStaticProblem, body, law, bcs=bcs, mixed="pressure", **loads)
    problem.solve(2)
    lift, _, loads = ground(V, 1.0, 2.0, law)
    problem.add(mpm.Body(lift, law, **loads))
    assert len(problem.pressure) == 2
    for step in problem.steps(2):
        weight = 2.0 * 20.0 * (1.0 + step.load)
        assert problem.reaction(bcs[1])[1] == pytest.approx(weight, rel=1e-8)
    # sigma_zz = -20 (2 - z), and the pressure is (1 + nu) / (3 (1 - nu)) of it
    share = 1.49 / 3.0 / 0.51
    for part in (body, lift):
        z = part.centroid[:, 1]
        mean = np.trace(part.stress, axis1=1, axis2=2) / 3.0
        np.testing.assert_allclose(mean, -20.0 * share * (2.0 - z), atol=1e-3)
    before, moved = [b.stress for b in (body, lift)], scenes.in_order(body, body.centroid)
    stiffer = Hencky(2e7, 0.4999)
    problem.stage("another below", problem.body(body).replace(material=stiffer))
    for part, stress in zip((body, lift), before, strict=True):
        np.testing.assert_allclose(part.stress, stress, rtol=1e-7, atol=1e-7)
    problem.solve(1)
    np.testing.assert_allclose(scenes.in_order(body, body.centroid), moved, atol=1e-9)
    heavier = [given.replace(body_force=(0.0, -12.0)) for given in problem.setup.given]
    problem.stage("more weight", heavier)
    problem.solve(1)
    change = scenes.in_order(body, body.centroid)[:, 1] - moved[:, 1]
    E, nu = 2e7, 0.4999
    confined = E * (1 - nu) / (1 + nu) / (1 - 2 * nu)
    z = moved[:, 1]
    np.testing.assert_allclose(change, -4.0 * (2.0 * z - z**2 / 2.0) / confined, atol=1e-11)


def test_an_initial_stress():
    """A geostatic stress of any K0 is carried without a motion."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 3.0], (2, 3), QUADRILATERAL), 2)
    bcs = [
        scenes.fix(V, scenes.at(0, 0, 2), component=0),
        scenes.fix(V, scenes.at(1, 0), component=1),
    ]
    for law in (Hencky(1e3, 0.4999), SmallStrainVonMises(1e3, 0.4999, yield_stress=50.0)):
        body, law, loads = ground(V, 0.0, 2.0, law)
        stress = mpm.geostatic(2.0, 2.0, 0.8, (0.0, -10.0))
        problem = posed(
            mpm.QuasiStaticProblem,
            body,
            law,
            bcs=bcs,
            mixed="pressure",
            initial_stress=stress,
            **loads,
        )
        problem.solve(1)
        assert scenes.largest(body.displacement.x.array) < 1e-12
        mean = np.trace(body.stress, axis1=1, axis2=2) / 3.0
        np.testing.assert_allclose(mean, -20.0 * 2.6 / 3.0 * (2.0 - body.centroid[:, 1]))


def test_a_stage_is_taken_back_where_it_cannot_be():
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 3.0], (2, 3), QUADRILATERAL), 2)
    body, law, loads = ground(V, 0.0, 1.0, Hencky(1e4, 0.49))
    bcs = [
        scenes.fix(V, scenes.at(0, 0, 2), component=0),
        scenes.fix(V, scenes.at(1, 0), component=1),
    ]
    problem = posed(mpm.QuasiStaticProblem, body, law, bcs=bcs, mixed="pressure", **loads)
    problem.solve(1)
    pressure = problem.pressure[0].previous.x.array.copy()
    raises(
        lambda: problem.stage(bodies=problem.body().replace(material=Foreign())),
        mpm.MPMError,
        "not Foreign",
    )
    flat = scenes.box([0.0, 1.0], [2.0, 2.0], (4, 2), QUADRILATERAL)
    lift = mpm.Particles(flat, scenes.vectors(V.mesh), degree=1)
    raises(lambda: problem.add(mpm.Body(lift, law)), mpm.MPMError, "of degree 2 or 3")
    assert np.array_equal(problem.pressure[0].previous.x.array, pressure)
    problem.stage(bodies=problem.body().replace(body_force=(0.0, -11.0)))
    problem.solve(1)
    assert problem.reaction(bcs[1])[1] == pytest.approx(44.0, rel=1e-8)


# -- In motion ---------------------------------------------------------------------------


def test_a_small_motion_as_in_stock_finite_elements():
    """Steps of linear elasticity with Taylor & Hood's pair, particles being the cells."""
    law, density, dt, size = LinearElastic(10.0, 0.4999), 2.0, 0.1, 1e-9
    background = scenes.box([0.0, -0.5], [1.5, 1.5], (3, 4), QUADRILATERAL)
    body = mpm.Particles(
        scenes.unit(2, QUADRILATERAL), scenes.vectors(background, 2), degree=2, quadrature_degree=4
    )

    def start(x):
        return size * np.array([0.0 * x[0], x[0] * (0.3 + x[1])])

    problem = mpm.DynamicProblem(
        mpm.Body(body, law, density=density, body_force=(0.0, -size), velocity=start),
        bcs=[scenes.fix(body.V, scenes.at(0, 0.0))],
        mixed="pressure",
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}, stabilisation=None),
    )
    for _ in range(3):
        problem.step(dt)

    domain = scenes.unit(2, QUADRILATERAL)
    W = mixed_space(domain, 2, 1)
    z, (v, q) = fem.Function(W), ufl.TestFunctions(W)
    w, p = ufl.split(z)
    d_n, v_n = fem.Function(W.sub(0).collapse()[0]), fem.Function(W.sub(0).collapse()[0])
    v_n.interpolate(start)
    strain = ufl.sym(ufl.grad(d_n + w / 2.0))
    deviator = strain - ufl.tr(strain) / 3.0 * ufl.Identity(2)
    F = density * ufl.inner(2.0 / dt * (w / dt - v_n), v) + density * size * v[1]
    F += 2.0 * law.shear * ufl.inner(deviator, ufl.grad(v)) + p * ufl.div(v)
    F += q * (ufl.div(d_n + w) - p / law.bulk)
    for _ in range(3):
        z.x.array[:] = 0.0
        newton(F * ufl.dx, z, [held(W, 0, scenes.at(0, 0.0))])
        increment = z.sub(0).collapse().x.array
        d_n.x.array[:] += increment
        v_n.x.array[:] = 2.0 * increment / dt - v_n.x.array
    same_values(body.displacement, d_n, 1e-7)
    same_values(problem.velocity, v_n, 1e-7)


def turning(scheme, law=STIFF, mixed="pressure", **options):
    """Return a problem of a block that turns, and shakes, through cells of the background."""
    background = scenes.box([-2.0] * 2, [2.0] * 2, (8, 8), QUADRILATERAL)
    shape = scenes.box([-0.8, -0.3], [0.8, 0.3], (6, 3), QUADRILATERAL)
    body = mpm.Particles(shape, scenes.vectors(background, 2), degree=2)
    return posed(
        mpm.DynamicProblem,
        body,
        law,
        1.0,
        velocity=lambda x: np.array([-2.0 * x[1], 2.0 * x[0] + 0.5 * x[0] ** 2]),
        scheme=scheme,
        mixed=mixed,
        **options,
    )


@pytest.mark.parametrize("scheme", [*slow("midpoint"), "conserving"])
def test_a_body_that_turns(scheme):
    """The volume stays, so does energy, and angular momentum by the conserving scheme."""
    problem = turning(scheme)
    begin = problem.angular_momentum
    history = problem.solve(time=0.4, dt=0.02)
    assert history.cutbacks == 0 and np.mean(history.iterations) <= 3.0
    lost = problem.angular_momentum / begin - 1.0
    assert scenes.largest(lost) < (1e-10 if scheme == "conserving" else 1e-4)
    total = [e.kinetic + e.strain for e in history.energies]
    assert abs(total[-1] / total[0] - 1.0) < 3e-3
    balance = np.ptp([e.balance for e in history.energies])
    assert balance < 1e-11 * total[0]
    body = problem.particles
    volume = scenes.total(body, body.undeformed.point_volumes().sum())
    assert abs(volume / 0.96 - 1.0) < 1e-6


@pytest.mark.parametrize(
    ("name", "scheme"),
    thinned(7, [(name, scheme) for name in SOILS for scheme in ("midpoint", "conserving")]),
)
def test_soil_that_turns_and_yields(name, scheme):
    """It gives next to nothing back, and moves as without a pressure, where nothing locks."""
    ends = []
    for mixed in ("pressure", None):
        problem = turning(scheme, SOILS[name], mixed)
        begin = problem.angular_momentum
        energies = problem.solve(time=0.16, dt=0.02).energies
        assert problem.history.cutbacks <= 2 and np.mean(problem.history.iterations) < 12.0
        total = energies[0].kinetic + energies[0].strain
        assert np.ptp([e.balance for e in energies]) < 1e-12 * total
        dissipated = np.array([e.dissipated for e in energies])
        assert np.diff(dissipated).min() > -1e-4 * total and dissipated[-1] > 0.015 * total
        lost = scenes.largest(problem.angular_momentum / begin - 1.0)
        assert lost < (1e-12 if scheme == "conserving" else 1e-3)
        ends.append(energies[-1].kinetic)
    assert abs(ends[0] / ends[1] - 1.0) < 2.5e-3


@pytest.mark.parametrize("scheme", ["midpoint", "conserving"])
def test_the_tangent_of_soil_in_motion(scheme):
    problem = turning(scheme, SOILS["mohr-coulomb"], rayleigh=(0.5, 1e-3))
    problem.solve(time=0.06, dt=0.03)
    assert scenes.largest(problem.particles.plastic_strain) > 1e-3
    assert error_of_blocks(problem, step=1e-6, size=1e-4) <= 1e-6


@pytest.mark.parametrize(
    ("law", "scheme"),
    thinned(2, product(LAWS, ["midpoint", "conserving", "euler"])),
    ids=lambda it: it if isinstance(it, str) else type(it).__name__,
)
def test_the_tangent_in_motion(scheme, law):
    problem = turning(scheme, law, rayleigh=(0.5, 1e-3))
    problem.solve(time=0.06, dt=0.03)
    assert error_of_blocks(problem, step=1e-6, size=1e-4) <= 1e-6


@pytest.mark.parametrize(
    ("scheme", "law"),
    [("midpoint", YIELDING), ("conserving", SOILS["mohr-coulomb"])],
    ids=["metal", "soil"],
)
def test_a_motion_from_a_file_and_on_other_ranks(mpi_tmp_path, scheme, law):
    ends = []
    for how in ("straight", "restored", "moved"):
        problem = turning(scheme, law)
        if how == "restored":
            problem.restore(mpi_tmp_path / "motion")
        for _ in problem.steps(time=0.1, dt=0.025, repartition=0.0 if how == "moved" else None):
            if how == "straight" and len(problem.history.steps) == 2:
                problem.save(mpi_tmp_path / "motion")
        ends.append(outcome(problem))
    same_run(ends[1], ends[0], EXACT)
    same_run(ends[2], ends[0], 1e-9)


@pytest.mark.parametrize("mixed", [None, "pressure", "stabilised pressure"])
def test_the_work_on_a_step_tells_stability_where_no_saddle_is_solved_for(mixed):
    """A pressure makes the potential largest: work below zero is no fold there."""
    degree = 2 if mixed == "pressure" else 1
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL), degree)
    body = mpm.Particles(scenes.unit(4, QUADRILATERAL), V, degree=degree)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, MohrCoulomb(1e3, 0.3, 5.0, 30.0)), bcs=[mpm.held(V, y=0.0)], mixed=mixed
    )
    assert problem.reduced.work_tells() == (mixed is None)
