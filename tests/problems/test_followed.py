# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a problem follows when it is changed after it was made, and what it refuses."""

import numpy as np
import pytest
import scenes
from routes import ROUTES
from scenes import QUADRILATERAL, WORLD, at, box, fix, vectors

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises


def column(material, **options):
    """Return a column under its weight, and its mesh before it is used by `material(mesh)`."""
    V = vectors(box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    body = box([0.0, 0.0], [1.0, 1.5], [4, 6], QUADRILATERAL)
    particles = mpm.Particles(body, V, quadrature_degree=2, **options)
    return mpm.QuasiStaticProblem(
        mpm.Body(particles, material(body), body_force=(0.0, -20.0), f_bar="domain"),
        bcs=[fix(V, at(0, 0.0), component=0), fix(V, at(1, 0.0), component=1)],
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )


def piecewise(body, value):
    field = fem.Function(fem.functionspace(body, ("Discontinuous Lagrange", 0)), name="stiffness")
    field.x.array[:] = value
    return field


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("kind", ["Function", "Constant"])
def test_values_of_functions_and_constants_are_followed(kind):
    held = {}

    def material(body):
        make = piecewise if kind == "Function" else fem.Constant
        held["young"] = make(body, 500.0)
        return Hencky(held["young"], 0.3)

    problem = column(material)
    if kind == "Function":
        held["young"].x.array[:] = 1000.0
    else:
        held["young"].value = 1000.0
    problem.solve(2)
    other = column(lambda body: Hencky(1000.0, 0.3))
    other.solve(2)
    gap = problem.particles.displacement.x.array - other.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-12
    stiff = problem.particles.displacement.x.array.copy()
    if kind == "Function":
        held["young"].x.array[:] = 500.0
    else:
        held["young"].value = 500.0
    problem.step()
    assert scenes.largest(problem.particles.displacement.x.array - stiff) > 1e-3


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_a_path_lowers_a_strength():
    # The block of one material is sheared to 0.02: what it bears is its strength at the end.
    V = vectors(box([-0.5, 0.0], [1.5, 1.0], [4, 2], QUADRILATERAL))
    body = box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL)
    strength = piecewise(body, 30.0)
    moved = fem.Function(V)
    dofs = fem.locate_dofs_geometrical(V, lambda x: np.ones(x.shape[1], dtype=bool))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V, quadrature_degree=2), VonMises(1e4, 0.3, rho_y=strength)),
        bcs=[fem.dirichletbc(moved, dofs)],
    )

    def path(t):
        moved.interpolate(lambda x: np.stack([0.02 * t * x[1], 0.0 * x[0]]))
        strength.x.array[:] = 30.0 * (1.0 - 0.5 * t)

    problem.solve(4, update=path)
    stress = problem.particles.stress
    size = np.sqrt(
        (stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)) ** 2
    )
    np.testing.assert_allclose(np.linalg.norm(size, axis=(1, 2)), 15.0, rtol=1e-9)


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_a_value_that_is_not_allowed_stops_the_next_step():
    held = {}

    def material(body):
        held["young"] = piecewise(body, 500.0)
        return Hencky(held["young"], 0.3)

    problem = column(material)
    problem.solve(2)
    before = scenes.state(problem)
    if WORLD.rank == WORLD.size - 1:
        held["young"].x.array[0] = -1.0
    with pytest.raises(mpm.MPMError, match="young is -1 but must be finite, greater than 0"):
        problem.step()
    scenes.assert_same_state(before, scenes.state(problem))
    held["young"].x.array[:] = 500.0
    problem.step()


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_numbers_are_what_they_were():
    law = Hencky(500.0, 0.3)
    with pytest.raises(mpm.MPMError, match="young of a material cannot be set; give a DG0"):
        law.parameters["young"] = 1.0
    problem = column(lambda body: law)
    problem.solve(1)
    law.parameters = {**law.parameters, "young": 1.0}
    with pytest.raises(mpm.MPMError, match="Parameters of a Hencky were replaced after"):
        problem.step()


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_arrays_are_copied():
    values = {}

    def material(body):
        values["young"] = np.full(body.topology.index_map(2).size_local, 500.0)
        return Hencky(values["young"], 0.3)

    problem = column(material)
    values["young"][:] = 1.0
    problem.solve(2)
    other = column(lambda body: Hencky(500.0, 0.3))
    other.solve(2)
    gap = problem.particles.displacement.x.array - other.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-12


def test_a_function_on_a_mesh_that_was_left_is_refused():
    held = {}

    def material(body):
        held["young"] = piecewise(body, 500.0)
        return Hencky(held["young"], 0.3)

    V = vectors(box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    body = box([0.0, 0.0], [1.0, 1.5], [4, 6], QUADRILATERAL)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V), material(body), body_force=(0.0, -20.0)),
        bcs=[fix(V, at(0, 0.0), component=0), fix(V, at(1, 0.0), component=1)],
    )
    problem.solve(1)
    problem.split([3])
    problem.step()
    held["young"].x.array[:] = 400.0
    with pytest.raises(mpm.MPMError, match=r"'stiffness'.* mesh that the particles have left"):
        problem.step()


@pytest.mark.parametrize("which", ["body", "background"])
def test_coordinates_that_change_stop_the_next_step(which):
    problem = column(lambda body: Hencky(500.0, 0.3))
    problem.solve(1)
    before = scenes.state(problem)
    moved = problem.particles.mesh if which == "body" else problem.particles.V.mesh
    if WORLD.rank == WORLD.size - 1:
        moved.geometry.x[0, 0] += 1e-3
    with pytest.raises(mpm.MPMError, match=f"coordinates of the {which} mesh were changed"):
        problem.step()
    if WORLD.rank == WORLD.size - 1:
        moved.geometry.x[0, 0] -= 1e-3
    scenes.assert_same_state(before, scenes.state(problem))


def test_coordinates_are_looked_at_for_residuals_too():
    problem = scenes.block()
    problem.particles.V.mesh.geometry.x[:, 0] *= 1.01
    with pytest.raises(mpm.MPMError, match="coordinates of the background mesh were changed"):
        problem.solve(1)
