# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Equations of fields that steps solve in turn with the displacements."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import ufl
from dolfinx import fem, la, mesh
from dolfinx.fem.petsc import LinearProblem

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
YOUNG, TOUGHNESS, LENGTH = 100.0, 1.0, 0.5
QUADRILATERAL = mesh.CellType.quadrilateral


def surface(model: str, d: Any) -> Any:
    """The surface energy of a damage field, per volume."""
    if model == "AT2":
        return TOUGHNESS / (2 * LENGTH) * (d**2 + LENGTH**2 * ufl.dot(ufl.grad(d), ufl.grad(d)))
    return 3 * TOUGHNESS / 8 * (d / LENGTH + LENGTH * ufl.dot(ufl.grad(d), ufl.grad(d)))


class Pulled:
    """A square that is pulled, with damage; without a Poisson effect, so that it is uniform."""

    def __init__(self, model: str, carried: bool, cells: int = 6) -> None:
        body = mesh.create_rectangle(comm, [[0, 0], [1, 1]], [cells, cells], QUADRILATERAL)
        V = None
        if carried:
            grid = mesh.create_rectangle(comm, [[0, 0], [1.7, 1.7]], [5, 5], QUADRILATERAL)
            V = fem.functionspace(grid, ("Lagrange", 1, (2,)))
        self.particles = mpm.Particles(body, V, quadrature_degree=3)
        Q = fem.functionspace(body, ("Lagrange", 1))
        self.damage = d = mpm.ParticleField(
            self.particles, Q, at="nodes", kind="body", name="damage"
        )
        u = self.particles.displacement
        strain = ufl.sym(ufl.grad(u))
        energy = (1 - d) ** 2 * YOUNG / 2 * ufl.inner(strain, strain) + surface(model, d)
        energy *= self.particles.dx
        self.equation = mpm.FieldEquation(
            d, ufl.derivative(energy, d, ufl.TestFunction(d.W)), lower="previous", upper=1.0
        )
        space = self.particles.V
        self.grips = [mpm.held(space, 1, y=0.0), mpm.held(space, 0, x=0.0)]
        self.stretch = fem.Constant(body, 0.0)
        top = mpm.facet_tags(body, {1: mpm.region(y=1.0)})
        ds = ufl.Measure("ds", body, subdomain_data=top)
        stiff = 1e6 * YOUNG
        pull = stiff * (u[1] - self.stretch) * ufl.TestFunction(self.particles.W)[1] * ds(1)
        residual = ufl.derivative(energy, u, ufl.TestFunction(self.particles.W)) + pull
        self.problem = mpm.ParticleProblem(
            residual, self.particles, bcs=self.grips, symmetric=True, terms=[self.equation]
        )

    def to(self, stretch: float) -> None:
        self.stretch.value = stretch
        self.problem.step()


def uniform(model: str, stretch: float) -> float:
    """Damage of a uniform bar, in closed form (Pham et al. 2011)."""
    energy = YOUNG * stretch**2
    if model == "AT2":
        return energy / (energy + TOUGHNESS / LENGTH)
    return max(0.0, 1 - 3 * TOUGHNESS / (8 * LENGTH * energy)) if energy else 0.0


@pytest.mark.parametrize("carried", [False, True])
@pytest.mark.parametrize("model", ["AT1", "AT2"])
def test_damage_of_a_uniform_bar_is_the_closed_form_and_never_heals(
    model: str, carried: bool
) -> None:
    bar = Pulled(model, carried)
    least = 0.0
    for stretch in (0.05, 0.1, 0.15, 0.1, 0.2):
        before = bar.damage.x.array.copy()
        bar.to(stretch)
        least = max(least, stretch)
        expected = uniform(model, least)
        np.testing.assert_allclose(bar.damage.x.array, expected, atol=2e-5)
        assert (bar.damage.x.array >= before).all()
        np.testing.assert_array_equal(bar.damage.previous.x.array, bar.damage.x.array)
    assert [step.alternations > 0 for step in bar.problem.history.steps] == [True] * 5
    assert bar.problem.history.statistics["field_solves"] > 0


def test_a_step_ends_where_all_equations_hold() -> None:
    """One more alternation changes nothing, where there is none to be done."""
    bar = Pulled("AT2", carried=True)
    bar.to(0.14)
    before = bar.damage.x.array.copy()
    assert bar.problem.history.steps[-1].residuals[-1] <= 1e-6
    bar.problem.step()
    np.testing.assert_allclose(bar.damage.x.array, before, atol=1e-4)


def test_a_checkpoint_goes_on_as_if_nothing_had_been(tmp_path: Any) -> None:
    path = comm.bcast(str(tmp_path / "state.npz"))
    whole = Pulled("AT1", carried=True)
    for stretch in (0.1, 0.15):
        whole.to(stretch)
    whole.problem.save(path)
    whole.to(0.12)
    whole.to(0.2)
    other = Pulled("AT1", carried=True)
    other.problem.restore(path)
    assert other.damage.x.array.max() > 0.5
    other.to(0.12)
    other.to(0.2)
    np.testing.assert_array_equal(other.damage.x.array, whole.damage.x.array)
    np.testing.assert_array_equal(
        other.particles.displacement.x.array, whole.particles.displacement.x.array
    )


def test_a_step_that_fails_leaves_the_field_as_it_was() -> None:
    bar = Pulled("AT1", carried=False)
    bar.to(0.15)
    before = bar.damage.x.array.copy()
    bar.stretch.value = np.nan
    with pytest.raises(mpm.MPMError):
        bar.problem.step()
    np.testing.assert_array_equal(bar.damage.x.array, before)
    np.testing.assert_array_equal(bar.damage.previous.x.array, before)


def test_without_bounds_it_is_the_equation_of_dolfinx() -> None:
    """An averaging equation over a body at rest, by stock DOLFINx."""
    body = mesh.create_rectangle(comm, [[0, 0], [2, 1]], [9, 5], mesh.CellType.triangle)
    particles = mpm.Particles(body)
    Q = fem.functionspace(body, ("Lagrange", 1))
    p = mpm.ParticleField(particles, Q, at="nodes", kind="body", name="average")
    x, q = ufl.SpatialCoordinate(body), ufl.TestFunction(p.W)
    source = ufl.cos(3 * x[0]) + x[1]
    dx = particles.dx_exact
    residual = ((p - source) * q + 0.04 * ufl.dot(ufl.grad(p), ufl.grad(q))) * dx
    u, v = particles.displacement, ufl.TestFunction(particles.W)
    elastic = ufl.inner(ufl.grad(u), ufl.grad(v)) * dx - p * v[1] * dx
    problem = mpm.ParticleProblem(
        elastic,
        particles,
        bcs=[mpm.held(particles.W, y=0.0)],
        symmetric=True,
        terms=[mpm.FieldEquation(p, residual)],
    )
    step = problem.step()
    assert step.alternations >= 1
    trial, test = ufl.TrialFunction(Q), ufl.TestFunction(Q)
    stock = LinearProblem(
        (trial * test + 0.04 * ufl.dot(ufl.grad(trial), ufl.grad(test))) * ufl.dx,
        source * test * dx,
        petsc_options_prefix="stock_",
        petsc_options={"ksp_rtol": 1e-13, "pc_type": "jacobi", "ksp_type": "cg"},
    ).solve()
    np.testing.assert_allclose(p.x.array, stock.x.array, atol=1e-9)


def test_bounds_hold_where_the_equation_does_not() -> None:
    """An obstacle problem: a membrane that is pressed on a plane touches it, exactly."""
    body = mesh.create_rectangle(comm, [[0, 0], [1, 1]], [12, 12], QUADRILATERAL)
    particles = mpm.Particles(body)
    Q = fem.functionspace(body, ("Lagrange", 1))
    p = mpm.ParticleField(particles, Q, at="nodes", kind="body", name="height")
    q, x = ufl.TestFunction(p.W), ufl.SpatialCoordinate(body)
    load = ufl.conditional(ufl.lt(abs(x[0] - 0.5), 0.3), -60.0, 60.0)
    dx = ufl.dx(body)
    residual = (0.02 * ufl.dot(ufl.grad(p), ufl.grad(q)) + 10 * p * q - load * q) * dx
    equation = mpm.FieldEquation(p, residual, lower=-0.5, upper=0.3)
    equation.alternate()
    values = p.x.array
    assert comm.allreduce(values.min(), MPI.MIN) == -0.5
    assert comm.allreduce(values.max(), MPI.MAX) == 0.3
    force = fem.assemble_vector(fem.form(residual))
    force.scatter_reverse(la.InsertMode.add)
    own = p.W.dofmap.index_map.size_local
    values, force = values[:own], force.array[:own]
    assert force[values == -0.5].min(initial=0.0) >= -1e-12
    assert force[values == 0.3].max(initial=0.0) <= 1e-12
    assert np.abs(force[(values > -0.5) & (values < 0.3)]).max(initial=0.0) < 1e-10
    assert equation.alternate() == 0


def test_an_equation_that_is_not_linear_is_solved_to_round_off() -> None:
    body = mesh.create_rectangle(comm, [[0, 0], [1, 1]], [3, 3], QUADRILATERAL)
    particles = mpm.Particles(body)
    p = mpm.ParticleField(
        particles, fem.functionspace(body, ("Lagrange", 1)), at="nodes", kind="body", name="root"
    )
    residual = (p**3 + p - 10.0) * ufl.TestFunction(p.W) * ufl.dx(body)
    equation = mpm.FieldEquation(p, residual)
    assert equation.alternate() > 3
    np.testing.assert_allclose(p.x.array, 2.0, rtol=1e-9)
    assert equation.alternate() == 0


def test_an_upper_bound_below_what_never_heals_gives_way() -> None:
    body = mesh.create_rectangle(comm, [[0, 0], [1, 1]], [3, 3], QUADRILATERAL)
    particles = mpm.Particles(body)
    p = mpm.ParticleField(
        particles, fem.functionspace(body, ("Lagrange", 1)), at="nodes", kind="body", name="height"
    )
    upper = fem.Function(p.W)
    upper.x.array[:] = 1.0
    residual = (p - 0.7) * ufl.TestFunction(p.W) * ufl.dx(body)
    equation = mpm.FieldEquation(p, residual, lower="previous", upper=upper)
    equation.alternate()
    equation.commit()
    np.testing.assert_allclose(p.x.array, 0.7, rtol=1e-9)
    reached = p.x.array.copy()
    upper.x.array[:] = 0.4
    equation.alternate()
    np.testing.assert_array_equal(p.x.array, reached)


def test_what_cannot_be_alternated_is_refused() -> None:
    body = mesh.create_rectangle(comm, [[0, 0], [1, 1]], [4, 4], QUADRILATERAL)
    grid = mesh.create_rectangle(comm, [[0, 0], [1, 1]], [2, 2], QUADRILATERAL)
    particles = mpm.Particles(body, fem.functionspace(grid, ("Lagrange", 1, (2,))))
    total = mpm.ParticleField(
        particles, fem.functionspace(grid, ("Lagrange", 1)), at="nodes", name="total"
    )
    residual = total * ufl.TestFunction(total.W) * particles.dx
    with pytest.raises(mpm.MPMError, match="kind='body'"):
        mpm.FieldEquation(total, residual)
    with pytest.raises(mpm.MPMError, match="not of 3"):
        mpm.FieldEquation(3, residual)  # type: ignore[arg-type]
    own = mpm.ParticleField(
        particles, fem.functionspace(body, ("Lagrange", 1)), "nodes", "body", "own"
    )
    residual = own * ufl.TestFunction(own.W) * particles.dx
    for wrong in ("last", np.nan, np.inf, True):
        with pytest.raises(mpm.MPMError, match="must be a finite number"):
            mpm.FieldEquation(own, residual, lower=wrong)
    with pytest.raises(mpm.MPMError, match="nothing between its bounds"):
        mpm.FieldEquation(own, residual, lower=1.0, upper=0.5)
    growing = -residual + ufl.TestFunction(own.W) * particles.dx
    with pytest.raises(mpm.ConvergenceError, match="own"):
        mpm.FieldEquation(own, growing).alternate()
