# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stress of a whole step: its tangent against differences, its work against the energy."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import HEXAHEDRON, QUADRILATERAL, TRIANGLE, WORLD, box, vectors

from dolfinx import mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.constitutive.energies import potential_energy
from mpm_dolfinx.constitutive.moduli import undeformed_tangent
from mpm_dolfinx.constitutive.points import MaterialPoints
from mpm_dolfinx.constitutive.step_stress import StepStress
from mpm_dolfinx.constitutive.strain import strain_of
from mpm_dolfinx.errors import ConvergenceError
from mpm_dolfinx.materials import Hencky, LinearElastic, ModifiedCamClay, NeoHooke, VonMises

LAWS = {
    "Hencky": Hencky(10.0, 0.3),
    "neo-Hooke": NeoHooke(10.0, 0.3),
    "von Mises": VonMises(10.0, 0.3, rho_y=0.4),
    "linear": LinearElastic(10.0, 0.3),
}


def moving(x, amount, wave):
    """Return a smooth displacement of coordinates ``(n, dim)`` that turns and strains."""
    dim = x.shape[1]
    turn = np.eye(dim)
    c, s = np.cos(amount), np.sin(amount)
    turn[:2, :2] = [[c, -s], [s, c]]
    return x @ (turn - np.eye(dim)).T + 0.1 * amount * np.sin(wave * x[:, ::-1])


def body_of(cell, points=1):
    dim = 3 if cell == HEXAHEDRON else 2
    V = vectors(box([-1.0] * dim, [2.0] * dim, [3] * dim, cell))
    return mpm.Particles(
        box([0.0] * dim, [1.0] * dim, [2] * dim, cell), V, quadrature_degree=points
    )


def stepped(cell, law, conserving=True, viscosity=0.0, axisymmetric=False, f_bar="none"):
    """Return the stress over a step between two displacements, and how to set the second."""
    body = body_of(cell, 2 if f_bar == "domain" else 1)
    tags = None
    if isinstance(law, dict):  # one half of the cells each
        cells = np.arange(body.num_local, dtype=np.int32)
        values = np.where(2 * cells < len(cells), 1, 2).astype(np.int32)
        tags = mesh.meshtags(body.mesh, body.mesh.topology.dim, cells, values)
    points = MaterialPoints(strain_of(body, axisymmetric), law, tags, f_bar)
    stress = StepStress(points, conserving, viscosity, 0.5)
    stress.pace(0.25, 0.5)
    dim = body.mesh.geometry.dim
    x = body.W.tabulate_dof_coordinates()[:, :dim]
    bump = x[:, :1] if axisymmetric else 1.0  # the axis stays where it is

    def put(amount, wave, change=0.0):
        motion = bump * moving(x, amount, wave)
        body.displacement.x.array[:] = (motion + change).ravel()

    put(0.1, 2.0)
    stress.update()
    stress.commit()
    return body, points, stress, put


def law_of(name):
    """Return a law, or two that have one half of the cells each, by their names."""
    return (
        dict(enumerate((LAWS[one] for one in name.split(" and ")), 1))
        if " and " in name
        else LAWS[name]
    )


CASES = [
    (TRIANGLE, "Hencky", True, 0.0, False),
    (QUADRILATERAL, "Hencky", True, 0.2, True),
    (QUADRILATERAL, "neo-Hooke", True, 0.0, False),
    (HEXAHEDRON, "Hencky", True, 0.0, False),
    (QUADRILATERAL, "Hencky", False, 0.2, False),
    (TRIANGLE, "von Mises", True, 0.0, False),
    (TRIANGLE, "linear", True, 0.2, False),
    (QUADRILATERAL, "von Mises", True, 0.2, True),
    (HEXAHEDRON, "linear and von Mises", True, 0.2, False),
    (TRIANGLE, "Hencky and linear", True, 0.2, False),
]


@pytest.mark.parametrize(("cell", "law", "conserving", "viscosity", "axisymmetric"), CASES)
def test_the_tangent_is_the_derivative(cell, law, conserving, viscosity, axisymmetric):
    body, points, stress, put = stepped(cell, law_of(law), conserving, viscosity, axisymmetric)
    generator = np.random.default_rng(3)
    count = len(body.displacement.x.array) // body.mesh.geometry.dim
    direction = generator.normal(size=(count, body.mesh.geometry.dim))
    if axisymmetric:
        direction[:, 0] *= body.W.tabulate_dof_coordinates()[:, 0]
    size = 1e-6
    values, gradients = [], []
    for sign in (-1.0, 1.0):
        put(0.25, 2.5, sign * size * direction)
        stress.update()
        values.append(stress.first_piola.copy())
        gradients.append(points.strain.gradient().reshape(values[0].shape).copy())
    put(0.25, 2.5)
    stress.update()
    change = np.einsum("niJkL,nkL->niJ", stress.tangent, gradients[1] - gradients[0])
    found = values[1] - values[0]
    np.testing.assert_allclose(change, found, atol=2e-6 * np.abs(found).max(initial=1e-30))


@pytest.mark.parametrize(
    ("cell", "law", "axisymmetric", "viscosity"),
    [
        (TRIANGLE, "Hencky", False, 0.0),
        (QUADRILATERAL, "von Mises", True, 0.0),
        (QUADRILATERAL, "von Mises", True, 0.2),
        (HEXAHEDRON, "Hencky", False, 0.0),
        (HEXAHEDRON, "linear and von Mises", False, 0.2),
        (TRIANGLE, "Hencky and linear", False, 0.2),
    ],
)
def test_the_stress_is_that_of_the_formula(cell, law, axisymmetric, viscosity):
    """P* and P_v point by point, as the head of the module has them."""
    _, points, stress, put = stepped(cell, law_of(law), True, viscosity, axisymmetric)
    C, dim = undeformed_tangent(points.laws), points.dim
    ends = []
    for amount in (None, 0.4):
        if amount is not None:
            put(amount, 2.5)
            stress.update()
        F = np.eye(dim) + points.strain.gradient().reshape(-1, dim, dim)
        ends.append((F, points.first_piola.copy(), potential_energy(points, trial=True)))
    small = points.laws.has_small_strain
    for n, (F_n, P_n, W_n, F, P, W) in enumerate(zip(*ends[0], *ends[1], strict=True)):
        F_m, S = 0.5 * (F_n + F), 0.5 * (np.linalg.solve(F_n, P_n) + np.linalg.solve(F, P))
        dE = 0.5 * (F.T @ F - F_n.T @ F_n)
        c = (W - W_n - np.sum(S * dE)) / np.sum(dE * dE)
        whole = F_m @ (S + c * dE)
        if small[n]:
            F_m, dE, whole = np.eye(dim), 0.5 * (F - F_n + (F - F_n).T), 0.5 * (P_n + P)
        whole += F_m @ np.einsum("ijkl,kl->ij", C[n], viscosity / 0.25 * dE)
        size = np.abs(whole).max()
        np.testing.assert_allclose(0.5 * stress.first_piola[n], whole, atol=1e-9 * size)


@pytest.mark.parametrize("f_bar", ["none", "patch"])
def test_a_singular_gradient_is_an_error_of_the_step(f_bar):
    body, points, stress, _ = stepped(TRIANGLE, LAWS["von Mises"], f_bar=f_bar)
    x = body.W.tabulate_dof_coordinates()[:, :2]
    points.update = lambda: None  # the law would say so itself
    body.displacement.x.array[:] = (-x * [1.0, 0.0]).ravel()
    if body.num_local:
        with pytest.raises(ConvergenceError, match="singular"):
            stress.update()
    else:
        stress.update()


@pytest.mark.parametrize("cell", [TRIANGLE, QUADRILATERAL, HEXAHEDRON])
@pytest.mark.parametrize("law", ["Hencky", "neo-Hooke", "linear", "strong"])
def test_the_work_of_an_elastic_body_is_its_energy(cell, law):
    # (the strong one is of a law that yields, and does not)
    _, _, stress, put = stepped(cell, {**LAWS, "strong": VonMises(10.0, 0.3, rho_y=99.0)}[law])
    before = stress.strain_energy()
    put(0.6, 3.0)
    stress.update()
    symmetric = stress.first_piola.copy()
    stress.commit()
    assert stress.stress_work == pytest.approx(stress.strain_energy() - before, rel=1e-9)
    assert symmetric.shape == stress.first_piola.shape


@pytest.mark.parametrize("cell", [TRIANGLE, HEXAHEDRON])
def test_the_work_of_metal_is_its_energy_and_what_yielding_takes(cell):
    rho_y, hardening = 0.4, 2.0
    law = VonMises(10.0, 0.3, rho_y=rho_y, hardening=hardening)
    _, points, stress, put = stepped(cell, law)
    first, all_taken = WORLD.allreduce(stress.strain_energy()), 0.0
    for amount in (0.3, 0.6, 0.5, -0.1):
        kappa, energy = (
            points.last.plastic_strain().ravel(),
            WORLD.allreduce(stress.strain_energy()),
        )
        put(amount, 3.0)
        stress.update()
        stress.commit()
        change = points.last.plastic_strain().ravel() - kappa
        middle = rho_y + np.sqrt(2.0 / 3.0) * hardening * (kappa + 0.5 * change)
        taken = WORLD.allreduce(
            float(points.strain.weights.ravel() @ (np.sqrt(1.5) * middle * change))
        )
        found = WORLD.allreduce(stress.stress_work)
        energy = WORLD.allreduce(stress.strain_energy()) - energy
        assert found == pytest.approx(energy + taken, rel=1e-9)
        all_taken += taken
    assert all_taken > first


GROUPED = [
    (QUADRILATERAL, "Hencky", "domain", False),
    (QUADRILATERAL, "Hencky", "domain", True),
    (TRIANGLE, "Hencky", "patch", False),
    (HEXAHEDRON, "Hencky", "domain", False),
    (QUADRILATERAL, "von Mises", "domain", False),
    (TRIANGLE, "linear", "patch", False),
]


@pytest.mark.parametrize(("cell", "law", "f_bar", "axisymmetric"), GROUPED)
def test_with_f_bar_the_tangent_is_the_derivative(cell, law, f_bar, axisymmetric):
    body, points, stress, put = stepped(
        cell, LAWS[law], f_bar=f_bar, axisymmetric=axisymmetric, viscosity=0.1
    )
    dim = body.mesh.geometry.dim
    x = body.W.tabulate_dof_coordinates()[:, :dim]
    direction = np.sin(7.0 * x @ np.arange(1.0, dim + 1.0)[:, None] + np.arange(dim))
    if axisymmetric:
        direction[:, 0] *= x[:, 0]
    nodes, volumes = body.domain_nodes, points.averaging.counted()
    shape = (*volumes.shape, points.dim, points.dim)

    def forces():
        return points.strain.nodal(stress.first_piola.reshape(shape), volumes)

    size, values, gradients = 1e-6, [], []
    for sign in (-1.0, 1.0):
        put(0.25, 2.5, sign * size * direction)
        stress.update()
        values.append(forces())
        gradients.append(points.strain.gradient().reshape(-1, points.dim, points.dim))
    put(0.25, 2.5)
    stress.update()
    pointwise = np.einsum("niJkL,nkL->niJ", stress.tangent, gradients[1] - gradients[0])
    change = points.strain.nodal(pointwise.reshape(shape), volumes)
    change += 2.0 * size * stress.grouped.linearise().times(direction[nodes])
    found = values[1] - values[0]
    scale = WORLD.allreduce(np.abs(found).max(initial=1e-30), MPI.MAX)
    np.testing.assert_allclose(change, found, atol=4e-6 * scale)


@pytest.mark.parametrize(("cell", "f_bar"), [(c, f) for c, law, f, a in GROUPED[:5] if not a])
def test_with_f_bar_the_work_of_an_elastic_body_is_its_energy(cell, f_bar):
    body, points, stress, put = stepped(cell, LAWS["Hencky"], f_bar=f_bar)
    dim = body.mesh.geometry.dim
    x = body.W.tabulate_dof_coordinates()[:, :dim]
    resisted = []
    for amount in (0.0, 0.12, 0.05):  # what is rough is resisted where it is far from its average
        before = WORLD.allreduce(stress.strain_energy())
        put(0.2 + amount, 2.0, amount * np.cos(2 * np.pi * x).prod(axis=1)[:, None])
        stress.update()
        stress.commit()
        change = WORLD.allreduce(stress.strain_energy()) - before
        assert WORLD.allreduce(stress.stress_work) == pytest.approx(change, rel=1e-9)
        resisted.append(WORLD.allreduce(float(points.averaging.energy().sum())))
    assert resisted[0] == 0.0 and resisted[1] > 1e-6


@pytest.mark.parametrize("f_bar", ["none", "domain"])
def test_what_falls_apart_gives_back_no_more_than_it_has(f_bar):
    # Sand under pressure is pulled apart in one step: its stress is gone at the end, and half of
    # that at the beginning would do work on all of the motion.
    sand = mpm.materials.MohrCoulomb(100.0, 0.3, cohesion=0.0, friction_angle=30.0)
    _, points, stress, put = stepped(QUADRILATERAL, sand, f_bar=f_bar)
    x = points.strain.particles.W.tabulate_dof_coordinates()[:, :2]
    put(0.0, 0.0, -0.05 * x)
    stress.update()
    stress.commit()
    first = WORLD.allreduce(stress.strain_energy())
    mean = 0.5 * points.first_piola
    gradient = points.strain.gradient().reshape(mean.shape)
    put(0.0, 0.0, 0.3 * x)
    stress.update()
    change = points.strain.gradient().reshape(mean.shape) - gradient
    weights = points.strain.weights.ravel()
    given = WORLD.allreduce(-float(weights @ np.einsum("niJ,niJ->n", mean, change)))
    stress.commit()
    assert WORLD.allreduce(stress.strain_energy()) < 1e-12 * first
    assert given > 2.0 * first
    assert -WORLD.allreduce(stress.stress_work) == pytest.approx(first, rel=1e-9)


@pytest.mark.parametrize("law", ["Hencky", "von Mises"])
def test_a_commit_is_taken_back_and_a_trial_forgotten(law):
    _, points, stress, put = stepped(TRIANGLE, LAWS[law])
    put(0.2, 2.0)
    stress.update()
    expected = stress.first_piola.copy()
    undo = stress.commit()
    undo()
    put(0.5, 4.0)
    stress.update()
    put(0.2, 2.0)
    stress.update()
    np.testing.assert_array_equal(stress.first_piola, expected)
    put(0.1, 2.0)
    stress.roll_back()
    np.testing.assert_array_equal(stress.first_piola, 2.0 * points.first_piola)


def test_no_rotation_is_resisted():
    body, points, stress, _ = stepped(TRIANGLE, LAWS["Hencky"], False, 0.5)
    x = body.W.tabulate_dof_coordinates()[:, :2] + moving(
        body.W.tabulate_dof_coordinates()[:, :2], 0.1, 2.0
    )
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    body.displacement.x.array[:] += (x @ turn.T - x).ravel()
    stress.update()
    difference = np.abs(stress.first_piola - points.first_piola).max(initial=0.0)
    assert difference < 1e-12


def test_energies_of_laws_have_their_stress_as_derivative():
    laws = [
        Hencky(10.0, 0.3),
        ModifiedCamClay(
            shear_modulus=500.0,
            swelling=0.02,
            compression=0.1,
            critical_ratio=1.2,
            preconsolidation=100.0,
            reference_pressure=20.0,
        ),
    ]
    stress = -30.0 * np.array([[1.0, 1.2, 0.9, 0.1]])
    change = np.array([[0.1, -0.05, 0.02, 0.3]])
    for law in laws:
        ends = [law.strain_energy({"stress": stress + s * 1e-4 * change})[0] for s in (-1, 1)]
        strains = [law.elastic_strain(stress + s * 1e-4 * change) for s in (-1, 1)]
        work = np.sum(stress * (strains[1] - strains[0]))
        assert ends[1] - ends[0] == pytest.approx(work, rel=1e-6)
