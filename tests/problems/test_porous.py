# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Consolidation of materials with water, against exact solutions, UFL and differences."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from compare import EXACT, error_of_blocks, outcome, raises, same_run
from marks import slow, thinned
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, WORLD

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic, SmallStrainVonMises, VonMises
from mpm_dolfinx.plot.fields import values_of

SOIL = LinearElastic(1e3, 0.25)


def confined(law):
    """Return the modulus of a soil that cannot go aside."""
    return law.bulk + 4.0 / 3.0 * law.shear


def roots(poisson, count=100):
    """Return the roots of tan a = a (1 - nu) / (1/2 - nu), one in each half of a period."""
    slope = (1.0 - poisson) / (0.5 - poisson)
    lower = np.arange(count) * np.pi + 1e-3
    upper = np.arange(count) * np.pi + np.pi / 2
    for _ in range(60):
        middle = 0.5 * (lower + upper)
        above = np.tan(middle) > slope * middle
        lower, upper = np.where(above, lower, middle), np.where(above, middle, upper)
    return lower


def terzaghi(z, time):
    """Return pressure over the load, z from the drained top over the height (Terzaghi 1943)."""
    M = (2.0 * np.arange(500) + 1.0) * np.pi / 2.0
    return (2.0 / M * np.sin(np.outer(z, M)) * np.exp(-M * M * time)).sum(axis=1)


def column(law=SOIL, permeability=None, load=1.0, n=4, offset=0.37, comm=WORLD, **options):
    """Return a column under a load on its top, which is drained; it lies off the grid."""
    h = 1.0 / n
    dim = options.pop("dim", 2)
    cell = HEXAHEDRON if dim == 3 else QUADRILATERAL
    wide = [2 * h] * (dim - 1)
    background = scenes.box(
        [*[0.0] * (dim - 1), -2 * h], [*wide, 1 + 3 * h], (*[2] * (dim - 1), n + 5), cell, comm
    )
    low = offset * h
    fine = 1 if dim == 3 else 2
    shape = scenes.box(
        [*[0.0] * (dim - 1), low],
        [*wide, 1 + low],
        (*[2 * fine] * (dim - 1), fine * n),
        cell,
        comm,
    )
    body = mpm.Particles(shape, scenes.vectors(background, 2), degree=2, quadrature_degree=4)
    up = dim - 1
    tags = scenes.facet_tags(shape, scenes.at(up, 1 + low), scenes.at(up, low))
    down = (*[0.0] * up, -1.0)
    sides = [
        scenes.fix(body.V, scenes.at(i, place), component=i)
        for i in range(up)
        for place in (0.0, 2 * h)
    ]
    options = {
        "bcs": sides,
        "supports": [mpm.boundary.roller(body, tags, 2, down)],
        "tractions": [(tuple(load * x for x in down), 1)],
        "facet_tags": tags,
        "drained": [(0.0, 1)],
    } | options
    permeability = 1.0 / confined(law) if permeability is None else permeability
    problem = posed(mpm.PorousProblem, body, law, permeability, **options)
    (p,) = problem.pore_pressure
    height = p.W.tabulate_dof_coordinates()[:, up] - low
    return problem, p, height


def worst(p, exact):
    return scenes.largest(p.x.array - exact) / scenes.largest(exact)


@pytest.mark.parametrize(
    "options",
    [{}, {"axisymmetric": True}, *slow({"law": Hencky(1e3, 0.25)}, {"dim": 3, "n": 3})],
)
def test_a_column(options):
    """Terzaghi's column in the plane, around an axis and in space, and small ones of Hencky's."""
    problem, p, y = column(**options)
    problem.solve(time=0.1, dt=0.025)
    assert worst(p, terzaghi(1.0 - y, 0.1)) < 0.06
    if "law" not in options:
        assert problem.history.iterations == [1, 1, 1, 1]


@pytest.mark.parametrize("offset", [1e-9, 0.37])
def test_water_that_cannot_leave_carries_the_load(offset):
    """Without a drained boundary to round-off, and with one but for what leaves in the step."""
    problem, p, _ = column(n=8, offset=offset, drained=())
    problem.step(1e-8)
    assert worst(p, np.ones(len(p.x.array))) < 1e-11
    lost = []
    for dt in (1e-8, 1e-9):
        problem, p, y = column(n=8, offset=offset)
        problem.step(dt)
        lost.append(scenes.largest(p.x.array[y < 0.7] - 1.0))
    assert lost[0] < 2e-6 and lost[0] == pytest.approx(10.0 * lost[1], rel=1e-2)


def test_short_steps_beside_a_drained_top():
    """From ``h^2 / (6 c_v)`` on the pressure stays below the load (Vermeer & Verruijt 1981)."""
    most = []
    for share in (0.01, 1.0 / 6.0, 0.25):
        problem, p, _ = column(n=4, offset=0.8)
        largest = []
        for _ in range(3):
            problem.step(share / 16.0)
            largest.append(scenes.largest(p.x.array))
        most.append(max(largest) - 1.0)
    assert most[0] < 0.15 and most[1] < 2e-3 and most[2] < 1e-6


def test_the_same_as_in_ufl():
    """Steps with storage and gravity on the water, written out."""
    settings = {"storage": 2e-4, "fluid_density": 0.3, "body_force": (0.0, -1.0), "density": 0.5}
    settings |= {"offset": 0.0, "supports": ()}
    ends = []
    for _ in range(2):
        problem, p, _ = column(**settings)
        base = scenes.at(1, 0.0)
        V = problem.particles.V
        dofs = fem.locate_dofs_geometrical((V.sub(1), V.sub(1).collapse()[0]), base)[0]
        problem.stage(bcs=[*problem.bcs, fem.dirichletbc(0.0, dofs, V.sub(1))])
        ends.append((problem, p))
    (problem, p), (other, _) = ends  # the second for its bodies and conditions alone
    problem.solve(time=0.06, dt=0.02)
    body, k, dt = other.particles, 1.0 / confined(SOIL), 0.02
    V_p = fem.functionspace(body.V.mesh, ("Lagrange", 1))
    field = mpm.ParticleField(body, V_p, at="nodes", name="pore_pressure")
    d, v, q = body.displacement, ufl.TestFunction(body.W), ufl.TestFunction(field.W)
    before, n, size = fem.Function(body.W), ufl.FacetNormal(body.mesh), 0.125
    tags = scenes.facet_tags(body.mesh, scenes.at(1, 1.0))
    ds = ufl.Measure("ds", domain=body.mesh, subdomain_data=tags, metadata=body.dx_exact.metadata())
    strain = ufl.sym(ufl.grad(d))
    stress = 2.0 * SOIL.shear * strain
    stress += (SOIL.bulk - 2.0 / 3.0 * SOIL.shear) * ufl.tr(strain) * ufl.Identity(2)
    R_u = ufl.inner(stress - field * ufl.Identity(2), ufl.grad(v)) * body.dx + v[1] * ds(1)
    R_u += 0.5 * v[1] * body.dx_exact
    flux = -k * (ufl.grad(field) - 0.3 * ufl.as_vector((0.0, -1.0)))
    stored = q * ufl.div(d - before) + 2e-4 * q * (field - field.previous)
    R_p = (-stored + dt * ufl.dot(flux, ufl.grad(q))) * body.dx
    R_p += dt * (-q * ufl.dot(flux, n) + k * field * ufl.dot(ufl.grad(q), n)) * ds(1)
    R_p -= dt * 5.0 / size * k * field * q * ds(1)
    twin = mpm.ParticleProblem(
        [R_u, R_p],
        body,
        bcs=other.bcs,
        fields=[field],
        symmetric=True,
        solver=mpm.Solver(predictor=False),
    )
    body.load.value = 1.0
    for _ in range(3):
        twin.step()
        before.x.array[:] = d.x.array
    assert worst(field, p.x.array) < 1e-8
    gap = scenes.own(problem.particles.displacement) - scenes.own(d)
    assert scenes.largest(gap) < 1e-8 * scenes.largest(scenes.own(d))


@pytest.mark.slow
def test_a_large_settlement():
    """A column of which a third is lost: finite strain, and a permeability that makes it linear.

    With ``k / lambda dP/dlambda`` constant the stretch lambda obeys the equation of heat (Gibson,
    England & Hussey 1967).
    """
    modulus, load, time = 10.0, 6.0, 0.3
    end = 0.669272727954  # modulus ln(end) / end = -load
    assert modulus * np.log(end) / end == pytest.approx(-load)
    M = (2.0 * np.arange(500) + 1.0) * np.pi / 2.0
    exact = (1.0 - end) * (1.0 - (2.0 / M**2 * np.exp(-M * M * time)).sum())
    errors = []
    for n, steps in ((4, 8), (8, 32)):
        problem, p, y = column(
            Hencky(modulus, 0.0), lambda J: J**3 / modulus / (1.0 - ufl.ln(J)), load, n
        )
        history = problem.solve(time=time, dt=time / steps)
        assert history.cutbacks == 0
        body = problem.particles
        d = body.displacement.x.array.reshape(-1, 2)[:, 1]
        top = np.isclose(body.W.tabulate_dof_coordinates()[:, 1], 1.0 + 0.37 / n)
        settled = WORLD.allreduce(float(-d[top].min(initial=0.0)), MPI.MAX)
        stretch = end + (1.0 - end) * terzaghi(1.0 - y, time)
        errors.append([settled / exact - 1.0, worst(p, load + modulus * np.log(stretch) / stretch)])
    assert np.abs(errors[1]).max() < 0.01
    assert np.log2(np.abs(errors[0][0] / errors[1][0])) > 1.8


def slab(n, poisson=0.2, shear=1e3, **options):
    """Return a quarter of Mandel's slab between rigid plates, off the grid, and its load path."""
    h, low = 1.0 / n, 0.37 / n
    background = scenes.box([-2 * h] * 2, [1 + 3 * h] * 2, (n + 5, n + 5), QUADRILATERAL)
    shape = scenes.box([low] * 2, [1 + low] * 2, (2 * n, 2 * n), QUADRILATERAL)
    body = mpm.Particles(shape, scenes.vectors(background, 2), degree=2, quadrature_degree=4)
    law = LinearElastic(2.0 * shear * (1.0 + poisson), poisson)
    sides = [(0, low), (1, low), (1, 1 + low), (0, 1 + low)]
    tags = scenes.facet_tags(shape, *(scenes.at(*side) for side in sides))
    top = fem.Constant(shape, 0.0)
    plate = mpm.boundary.roller(body, tags, 3, (0.0, 1.0), top)
    held = [mpm.boundary.roller(body, tags, i + 1, -np.eye(2)[i]) for i in (0, 1)]
    problem = posed(
        mpm.PorousProblem,
        body,
        law,
        1.0 / confined(law),
        supports=[*held, plate],
        facet_tags=tags,
        drained=[(0.0, 4)],
        **options,
    )
    a = roots(poisson)
    weights = np.sin(a) / (a - np.sin(a) * np.cos(a))

    def pressure(x, time):  # Cheng & Detournay 1988, over the force for half a plate
        shapes = np.cos(np.outer(x - low, a)) - np.cos(a)
        return shapes @ (weights * np.exp(-a * a * time))

    def path(time):
        rest = (weights * np.cos(a) * np.exp(-a * a * time)).sum()
        top.value = -((1.0 - poisson) / 2.0 - rest / 2.0) / shear

    return problem, plate, pressure, path


def squeeze(n, *schedule):
    """Return errors of pressure at the middle and everywhere, of the force, and the peak.

    Pressures are relative to that of the beginning.
    """
    problem, plate, pressure, path = slab(n)
    (p,) = problem.pore_pressure
    X = p.W.tabulate_dof_coordinates()[:, 0]
    middle = np.isclose(X, 0.37 / n)
    found = []
    for end, dt in schedule:
        for step in problem.steps(time=end, dt=dt, update=path):
            exact = pressure(X, step.time)
            centre = WORLD.allreduce(float(p.x.array[middle].max(initial=0.0)), MPI.MAX)
            (true,) = pressure(np.array([0.37 / n]), step.time)
            everywhere = scenes.largest(p.x.array - exact) / 0.5
            force = problem.reaction(plate)[1]
            found.append((step.time, (centre - true) / 0.5, everywhere, force + 1.0, centre))
    time, centre, everywhere, force, value = np.array(found).T
    return [
        np.abs(centre).max(),
        everywhere[time > 0.02].max(),
        np.abs(force).max(),
        value.max() / 0.5,
        time[value.argmax()],
    ]


def test_the_pressure_between_plates_rises_first():
    """Mandel (1953): it rises to 1.107 times what it is at first, before it falls."""
    centre, everywhere, force, peak, time = squeeze(4, (0.12, 0.02), (0.4, 0.04))
    assert centre < 0.02 and everywhere < 0.08 and force < 0.02
    assert peak == pytest.approx(1.107, rel=0.015) and 0.04 < time < 0.12


@pytest.mark.slow
def test_the_pressure_between_plates_on_a_finer_grid():
    """The first steps are short, as what backward Euler makes of them stays beside the drain."""
    first = (0.005, 0.00025), (0.02, 0.0005)
    centre, everywhere, force, peak, time = squeeze(8, *first, (0.1, 0.0025), (0.5, 0.01))
    assert centre < 5e-3 and everywhere < 0.01 and force < 0.005
    assert peak == pytest.approx(1.1069, rel=1e-3) and time == pytest.approx(0.0725, abs=0.01)


@pytest.mark.parametrize("law", [SOIL, SmallStrainVonMises(1e3, 0.25, yield_stress=50.0)])
def test_water_at_rest(law):
    """Ground under water stays as it is: weight, buoyancy and hydrostatic pressure are balanced."""
    problem, p, y = column(
        law,
        load=0.0,
        density=2.0,
        fluid_density=1.0,
        body_force=(0.0, -10.0),
        initial_stress=lambda x: _tensor(x, -10.0 * (1.0 + 0.37 / 4 - x[1])),
        pore_pressure=lambda x: 10.0 * (1.0 + 0.37 / 4 - x[1]),
    )
    problem.solve(time=0.2, dt=0.1)
    assert worst(p, 10.0 * (1.0 - y)) < 1e-9
    d = scenes.own(problem.particles.displacement).reshape(-1, 2)
    sunk = 2.0 * 10.0 / (1e3 * confined(law) / 0.125)  # into the penalty of its support
    assert scenes.largest(d[:, 1] + sunk) < 1e-9 and scenes.largest(d[:, 0]) < 1e-12


def _tensor(x, vertical):
    stress = np.zeros((3, 3, x.shape[1]))
    stress[1, 1], stress[0, 0], stress[2, 2] = vertical, 0.5 * vertical, 0.5 * vertical
    return stress


def test_flat_domains_on_a_drained_top():
    """Nitsche's penalty outweighs what is large in flat domains: pressure stays within the load."""
    background = scenes.box([0.0, 0.0], [10.0, 1.25], (1, 25), QUADRILATERAL)
    shape = scenes.box([0.0, 0.0], [10.0, 1.0], (1, 20), QUADRILATERAL)
    body = mpm.Particles(shape, scenes.vectors(background, 2), degree=2, quadrature_degree=4)
    walls = [scenes.fix(body.V, scenes.at(0, x), component=0) for x in (0.0, 10.0)]
    problem = mpm.PorousProblem(
        mpm.Body(
            body,
            SOIL,
            tractions=[((0.0, -1.0), 1)],
            facet_tags=scenes.facet_tags(shape, scenes.at(1, 1.0), scenes.at(1, 0.0)),
            pore_fluid=mpm.PoreFluid(1.0 / confined(SOIL), drained=[(0.0, 1)]),
        ),
        bcs=[*walls, scenes.fix(body.V, scenes.at(1, 0.0), component=1)],
    )
    (p,) = problem.pore_pressure
    largest = [scenes.largest(p.x.array) for _ in problem.steps(time=5e-3, dt=5e-4)]
    assert max(largest) < 1.01
    z = 1.0 - p.W.tabulate_dof_coordinates()[:, 1]
    assert worst(p, terzaghi(z, 5e-3)) < 0.15


def test_a_field_split_whose_block_has_no_factor():
    """The splits are told again where a factor of theirs failed, and smaller steps are tried.

    No pivot is large enough: what is singular but for round-off has a factor on some processors.
    """
    comm = MPI.COMM_SELF
    background = scenes.box([0.0, 0.0], [0.5, 1.25], (2, 5), QUADRILATERAL, comm)
    shape = scenes.box([0.0, 0.0], [0.5, 1.0], (1, 1), QUADRILATERAL, comm)
    body = mpm.Particles(shape, scenes.vectors(background, 2), degree=2)
    problem = mpm.PorousProblem(
        mpm.Body(
            body,
            SOIL,
            tractions=[((0.0, -1.0), 1)],
            facet_tags=scenes.facet_tags(shape, scenes.at(1, 1.0), scenes.at(1, 0.0)),
            pore_fluid=mpm.PoreFluid(1.0, drained=[(0.0, 1)]),
        ),
        bcs=[scenes.fix(body.V, scenes.at(1, 0.0), component=1)]
        + [scenes.fix(body.V, scenes.at(0, x), component=0) for x in (0.0, 0.5)],
        solver=mpm.Solver(
            petsc_options={
                "ksp_type": "gmres",
                "pc_type": "fieldsplit",
                "pc_fieldsplit_type": "schur",
                "fieldsplit_displacement_pc_type": "lu",
                "fieldsplit_displacement_pc_factor_mat_solver_type": "petsc",
                "fieldsplit_displacement_pc_factor_zeropivot": 1e9,
                "fieldsplit_pore_pressure_pc_type": "none",
            }
        ),
    )
    raises(lambda: problem.step(0.1), mpm.ConvergenceError, "factorisation of the tangent failed")
    assert problem.history.statistics["factorisations"] > 2


def test_water_flows_in():
    """Between rigid walls what flows in is stored: pressure rises by time over storage."""
    problem, p, _ = column(
        load=0.0, storage=0.5, permeability=10.0, tractions=(), drained=(), inflow=[(0.2, 1)]
    )
    body = problem.particles
    every = np.arange(body.V.dofmap.index_map.size_local + body.V.dofmap.index_map.num_ghosts)
    walls = fem.dirichletbc(np.zeros(2), every.astype(np.int32), body.V)
    problem.stage(bcs=[walls])
    problem.solve(time=1.0, dt=0.25)
    water, volume = (
        WORLD.allreduce(fem.assemble_scalar(fem.form(f * body.dx)))
        for f in (p, fem.Constant(body.mesh, 1.0))
    )
    assert water / volume == pytest.approx(0.2 / 0.5, rel=1e-9)


LAWS = [Hencky(10.0, 0.2), VonMises(10.0, 0.2, yield_stress=0.5, hardening=1.0)]
LAWS.append(SmallStrainVonMises(10.0, 0.2, yield_stress=0.5, hardening=1.0))


@pytest.mark.parametrize(
    ("law", "axisymmetric"), thinned(5, [(law, turned) for turned in (True, False) for law in LAWS])
)
def test_the_tangent_against_differences(law, axisymmetric):
    problem, _, _ = column(
        law,
        permeability=lambda J: 0.1 * J**2,
        load=1.3,
        storage=0.01,
        density=0.5,
        fluid_density=0.2,
        body_force=(0.0, -1.0),
        axisymmetric=axisymmetric,
    )
    problem.solve(time=0.1, dt=0.05)
    assert law.inelastic is bool(scenes.largest(problem.particles.plastic_strain) > 0.0)
    assert error_of_blocks(problem, step=1e-7, size=1e-4) <= 1e-6


def test_a_dry_lift_on_wet_ground():
    """What is put on the ground is carried by the water first."""
    problem, p, y = column(load=0.0, n=4, offset=0.0)
    problem.solve(time=1e-6, dt=1e-6)
    V = problem.particles.V
    lift = mpm.Particles(scenes.box([0.0, 1.0], [0.5, 1.25], (4, 1), QUADRILATERAL), V, degree=2)
    problem.add(mpm.Body(lift, SOIL, density=4.0, body_force=(0.0, -1.0)))
    assert len(problem.pore_pressure) == 1 and problem.pore_pressure[0] is p
    problem.solve(time=2e-6, dt=1e-6)
    assert scenes.largest(p.x.array[y < 0.6] - 1.0) < 1e-4
    problem.solve(time=5.0, dt=1.0)
    assert scenes.largest(p.x.array) < 0.02
    held = problem.reaction(problem.setup.supports[0])
    assert held[1] == pytest.approx(0.5, rel=1e-6)


def test_results_do_not_depend_on_the_ranks():
    problem, p, y = column(LAWS[1], load=1.5)
    problem.solve(time=0.1, dt=0.05)
    together = outcome(problem)
    values = scenes.gather(np.column_stack([y, p.x.array]))
    if WORLD.rank == 0:
        alone, its, height = column(LAWS[1], load=1.5, comm=MPI.COMM_SELF)
        alone.solve(time=0.1, dt=0.05)
        index = np.argsort(alone.particles.global_index)
        for name in ("centroid", "stress"):
            expected = getattr(alone.particles, name)[index]
            found = together[f"{name} 0"]
            assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()
        for h, value in values:
            near = its.x.array[np.isclose(height, h)]
            assert np.abs(near - value).min() <= 1e-8


def test_restart_and_a_step_that_fails(mpi_tmp_path):
    problem, p, _ = column(LAWS[1], load=1.5)
    for step in problem.steps(time=0.1, dt=0.025):
        if step.time == 0.05:
            problem.save(mpi_tmp_path / "half")
    end, pressure = outcome(problem), p.x.array.copy()
    other, its, _ = column(LAWS[1], load=1.5)
    other.restore(mpi_tmp_path / "half")
    before = its.x.array.copy()
    other.particles.V.mesh.comm.Barrier()
    assert scenes.largest(before) > 0.0
    other.solve(time=0.1, dt=0.025)
    same_run(outcome(other), end, EXACT)
    assert scenes.largest(its.x.array - pressure) <= EXACT
    for change in ({"permeability": 0.5}, {"storage": 1e-3}, {"fluid_density": 1.0}):
        another, _, _ = column(LAWS[1], load=1.5, **change)
        raises(lambda a=another: a.restore(mpi_tmp_path / "half"), mpm.MPMError, "material is not")
    tired, its, _ = column(LAWS[1], load=1.5, petsc_options={"snes_max_it": 1})
    raises(lambda: tired.solve(time=1.0, dt=1.0), mpm.ConvergenceError, "Newton")
    assert not its.x.array.any() and not its.previous.x.array.any()


def test_what_does_not_go_together_is_refused():
    raises(lambda: column(mixed="pressure"), mpm.MPMError, "has no mixed=")
    raises(
        lambda: column(permeability=-1.0),
        mpm.MPMError,
        "permeability of a PoreFluid must be positive",
    )
    raises(lambda: column(storage=-1.0), mpm.MPMError, "storage of a PoreFluid must be")
    raises(lambda: column(fluid_density=-1.0), mpm.MPMError, "density of a PoreFluid must be")
    raises(lambda: column(drained=[(0.0, 7)]), mpm.MPMError, "has the tag 7 of drained")
    raises(lambda: column(drained=3), mpm.MPMError, "drained must be a list")
    refused = "pressure of a PoreFluid must be a finite number"
    raises(lambda: column(pore_pressure="high"), mpm.MPMError, refused)
    raises(lambda: column(pore_pressure=True), mpm.MPMError, refused)
    zero = fem.Function(fem.functionspace(scenes.unit(2, QUADRILATERAL), ("Lagrange", 1)))
    raises(lambda: column(pore_pressure=zero), mpm.MPMError, "PoreFluid lives on another mesh")
    raises(lambda: column(permeability=lambda J: J.none), mpm.MPMError, "that gives permeability")
    raises(lambda: column(permeability=[1.0, 2.0]), mpm.MPMError, "permeability has the shape")
    raises(lambda: column(drained=(0.0, 1)), mpm.MPMError, "drained must be a list of pairs")
    raises(lambda: column(inflow=[(0.0, 1, 2)]), mpm.MPMError, "inflow must be a list of pairs")
    if WORLD.size > 1:
        short = 0.1 if WORLD.rank == 0 else -0.1
        raises(lambda: column()[0].step(short), mpm.MPMError, "dt differs between the ranks")
    problem, _, _ = column(permeability=lambda J: -J)
    raises(lambda: problem.step(0.1), mpm.MPMError, "permeability must not be negative, not -1")
    assert column(permeability=lambda J: 0.0 * J)[0].step(0.1).time == 0.1
    raises(lambda: mpm.strength_reduction(problem), mpm.MPMError, "not an mpm.PorousProblem")
    problem, _, _ = column()
    body = problem.particles
    for space in (("Lagrange", 2), ("Lagrange", 1, (2,))):
        V_p = fem.functionspace(body.V.mesh, space)
        raises(lambda V_p=V_p: column(pressure_space=V_p), mpm.MPMError, "must be a scalar space")
    raises(lambda: mpm.PoreFluid(None), mpm.MPMError, "permeability of a PoreFluid must be")
    raises(lambda: mpm.PorousProblem(mpm.Body(body, SOIL)), mpm.MPMError, "needs a body with a")
    flat = scenes.unit(2, QUADRILATERAL)
    low = mpm.Particles(flat, scenes.vectors(scenes.unit(2, QUADRILATERAL)))
    raises(
        lambda: mpm.PorousProblem(mpm.Body(low, SOIL, pore_fluid=mpm.PoreFluid(1.0))),
        mpm.MPMError,
        "of degree 2 or 3",
    )
    raises(lambda: problem.remove([0]), mpm.MPMError, "Deletion of particles does not go with")
    problem, _, _ = column()
    raises(lambda: problem.solve(time=0.0, dt=0.1), mpm.MPMError, "give a later time")


def soaked(comm=WORLD, **options):
    """Return a block that settles and is sheared while water goes in and out; one of four kinds."""
    background = scenes.box([0.0, 0.0], [3.0, 2.0], [6, 4], QUADRILATERAL, comm)
    shape = scenes.bend(scenes.box([0.0, 0.0], [1.0, 1.0], [3, 3], QUADRILATERAL, comm), 0.03)
    V = scenes.vectors(background, 2)
    body = mpm.Particles(shape, V, degree=2)
    defaults = {
        "permeability": lambda J: 0.02 * J**3,
        "storage": 0.01,
        "fluid_density": 0.5,
        "body_force": (0.2, -1.0),
        "bcs": [scenes.fix(V, scenes.at(1, 0.0))],
        "facet_tags": scenes.facet_tags(shape, scenes.at(0, 1.0), scenes.at(1, 1.0)),
        "drained": [(0.1, 1)],
        "inflow": [(0.05, 2)],
        "tractions": [((1.0, -0.5), 2)],
        "petsc_options": {"snes_rtol": 1e-11},
    } | options
    if options.get("axisymmetric"):
        defaults["bcs"].append(scenes.fix(V, scenes.at(0, 0.0), component=0))
    return posed(mpm.PorousProblem, body, defaults.pop("material", Hencky(10.0, 0.3)), **defaults)


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"material": LinearElastic(30.0, 0.3)}, marks=pytest.mark.slow),
        pytest.param({"axisymmetric": True}, marks=pytest.mark.slow),
    ],
    ids=["finite", "small", "around an axis"],
)
def test_a_rebased_body_goes_on_as_one_that_is_not(options):
    results = []
    for changes in (False, True):
        problem = soaked(**options)
        problem.solve(time=0.2, dt=0.1)
        if changes:
            problem.rebase()
            assert scenes.largest(problem.particles.displacement.x.array) == 0.0
        problem.solve(time=0.3, dt=0.1)
        if changes:
            problem.repartition(0.0)
            problem.rebase()
        problem.solve(time=0.4, dt=0.1)
        (p,) = problem.pore_pressure
        body = problem.particles
        vectors = fem.functionspace(body.mesh, ("Lagrange", 1, (2,)))
        start, moved = fem.Function(vectors), fem.Function(vectors)
        start.interpolate(lambda x: x[:2])
        moved.interpolate(body.displacement)
        own = slice(body.num_local)
        where = (start.x.array + moved.x.array).reshape(-1, 2)[vectors.dofmap.list[own]]
        values = {
            "pressure": scenes.in_order(body, p.x.array[p.W.dofmap.list[own]]),
            "places": scenes.in_order(body, where),
        }
        results.append(outcome(problem) | values)
        assert problem.history.iterations == results[0].setdefault("", problem.history.iterations)
    assert np.abs(results[0]["deformation_gradient 0"] - np.eye(3)).max() > 0.05
    del results[0][""]
    same_run(results[1], results[0], 1e-9)


@pytest.mark.parametrize("name", ["permeability", "storage", "drained", "inflow"])
def test_what_lies_on_the_mesh_of_before_is_refused(name):
    body = soaked().particles
    x = ufl.SpatialCoordinate(body.mesh)[0]
    tags = scenes.facet_tags(body.mesh, scenes.at(0, 1.0), scenes.at(1, 1.0))
    value = 0.1 * (1.0 + x)
    given = {"permeability": 0.02} | {
        name: [(value, 1)] if name in ("drained", "inflow") else value
    }
    held = [scenes.fix(body.V, scenes.at(1, 0.0))]
    again = mpm.Particles(body.mesh, body.V, degree=2)
    law = Hencky(10.0, 0.3)
    problem = posed(mpm.PorousProblem, again, law, facet_tags=tags, bcs=held, **given)
    before = scenes.state(problem)
    for change in (problem.rebase, lambda: problem.repartition(0.0)):
        raises(change, mpm.MPMError, f"{name} is written on the present body mesh")
    scenes.assert_same_state(before, scenes.state(problem))


def test_fields_of_a_body_with_water(mpi_tmp_path):
    """Total stress bears the load at any time; pictures and files have it, and pore pressure."""
    problem, p, _ = column()
    problem.solve(time=0.02, dt=0.005)
    body = problem.particles
    fields = body.fields()
    assert "pressure" not in fields
    nodes = p.x.array[p.W.dofmap.list[: body.num_local]]
    water = fields["pore_pressure"]
    assert (water >= nodes.min(axis=1) - 1e-12).all() and (water <= nodes.max(axis=1) + 1e-12).all()
    assert scenes.largest(fields["total_stress"][:, 1, 1] + 1.0) < 0.01
    mean = np.trace(fields["total_stress"], axis1=1, axis2=2) / 3.0
    np.testing.assert_allclose(-mean, fields["mean_effective_stress"] + water, atol=1e-12)
    (shown,) = values_of(problem, [body], "pore_pressure")
    assert np.array_equal(shown, water)
    raises(lambda: values_of(problem, [body], "pressure"), mpm.MPMError, "no field 'pressure'")
    problem.write(mpi_tmp_path / "soil.pvd")
    text = (mpi_tmp_path / "soil_000000.vtu").read_bytes()
    assert all(f'Name="{name}"'.encode() in text for name in ("pore_pressure", "total_stress"))


def test_a_body_without_water_has_no_pore_pressure():
    """It is grey in pictures of that; its stress is total, and its pressure the mean of it."""
    background = scenes.box([0.0, 0.0], [1.0, 1.5], (2, 3), QUADRILATERAL)
    V = scenes.vectors(background, 2)
    made = ([0.0, 0.0], [1.0, 1.0], (4, 4)), ([0.0, 1.0], [1.0, 1.5], (4, 2))
    bodies = [
        mpm.Particles(scenes.box(*size, QUADRILATERAL), V, degree=2, quadrature_degree=4)
        for size in made
    ]
    problem = posed(
        mpm.PorousProblem, bodies, SOIL, [1.0, None], bcs=[scenes.fix(V, scenes.at(1, 0.0))]
    )
    soil, footing = values_of(problem, bodies, "pore_pressure")
    assert not np.isnan(soil).any() and np.isnan(footing).all()
    assert {"pressure"} == bodies[1].fields().keys() - bodies[0].fields().keys()
