# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Trusses and membranes in bodies, beside exact solutions and stock DOLFINx."""

import numpy as np
import pytest
from ranks import differing, fails
from scenes import HEXAHEDRON, QUADRILATERAL, WORLD, at, box, facet_tags, vectors
from stock import newton

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic
from mpm_dolfinx.structures.laws import Bar, Sheet
from mpm_dolfinx.structures.layout import Layout, layout_of
from mpm_dolfinx.structures.stretching import rule_of, stretched

YOUNG, POISSON = 1e3, 0.3
TIGHT = mpm.Solver(petsc_options={"snes_rtol": 1e-12})


def line(first, last, n):
    """Return the points of a straight line of n cells."""
    return np.linspace(first, last, n + 1)


def bar(n=4, truss=True, **options):
    """Return a bar of finite elements, 1 x 0.5, with a truss along its middle."""
    body = mpm.Particles(box([0, 0], [1, 0.5], [n, 1], QUADRILATERAL))
    return body, mpm.Truss(body, line((0, 0.25), (1, 0.25), n), **options)


def driven(body, law, terms, **options):
    """Return a problem in which all nodes of a body are where a function of a path puts them."""
    where = fem.Function(body.W)
    every = np.arange(body.W.dofmap.index_map.size_local + body.W.dofmap.index_map.num_ghosts)
    bc = fem.dirichletbc(where, every.astype(np.int32))
    problem = mpm.QuasiStaticProblem(mpm.Body(body, law), bcs=[bc], terms=terms, **options)
    x = body.W.tabulate_dof_coordinates()[:, : body.mesh.geometry.dim]

    def put(to):
        where.x.array[:] = (to(x) - x).ravel()

    return problem, put


# -- Exact solutions ----------------------------------------------------------------------------


def test_a_truss_is_the_energy_of_facets_in_stock_dolfinx():
    # A bar along facets inside a block, of which DOLFINx integrates the energy itself.
    stiffness, q = 2000.0, 1e-3
    domain = box([0, 0], [4, 2], [16, 8], QUADRILATERAL)
    ends = facet_tags(domain, at(0, 4.0))
    V = vectors(domain)
    u, v = fem.Function(V), ufl.TestFunction(V)
    along = mesh.locate_entities(
        domain, 1, lambda x: np.isclose(x[1], 1.0) & (x[0] > 0.99) & (x[0] < 3.01)
    )
    tags = mesh.meshtags(domain, 1, np.sort(along), np.full(len(along), 1, dtype=np.int32))
    dS = ufl.Measure("dS", domain, subdomain_data=tags)(1)
    ds = ufl.Measure("ds", domain, subdomain_data=ends)(1)
    strain = ufl.sym(ufl.grad(u))
    lam, G = YOUNG * POISSON / (1 + POISSON) / (1 - 2 * POISSON), YOUNG / 2 / (1 + POISSON)
    energy = (lam / 2 * ufl.tr(strain) ** 2 + G * ufl.inner(strain, strain)) * ufl.dx
    energy += stiffness / 2 * ufl.grad(u)("+")[0, 0] ** 2 * dS - q * u[0] * ds
    newton(ufl.derivative(energy, u, v), u, [mpm.held(V, 0, x=0.0), mpm.held(V, 1, y=0.0)])

    body = mpm.Particles(domain)
    truss = mpm.Truss(body, line((1, 1), (3, 1), 8), stiffness)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, LinearElastic(YOUNG, POISSON), tractions=[((q, 0), 1)], facet_tags=ends),
        bcs=[mpm.held(body.W, 0, x=0.0), mpm.held(body.W, 1, y=0.0)],
        terms=[truss],
        solver=TIGHT,
    )
    problem.solve()
    assert len(truss.force) == 8 and truss.force.min() > 0.0
    gap = np.abs(body.displacement.x.array - u.x.array).max()
    assert gap < 1e-5 * np.abs(u.x.array).max()  # the truss turns, and DOLFINx's bar does not


@pytest.mark.parametrize(("free", "most"), [(None, 1e-3), ("layer", 1e-3), ([], 1e-2)])
def test_the_force_of_a_bar_at_the_edge_of_a_block_is_the_exact_one(free, most):
    # Displacements sin(kx) f(y), cos(kx) g(y) of two of Papkovich's solutions, chosen so that the
    # shear stress at y = 0 is what a bar there has too much.
    k, kappa, G, stiffness = 0.5 * np.pi, 3 - 4 * POISSON, YOUNG / 2 / (1 + POISSON), 800.0
    B = -stiffness * k / (G * (kappa + 1))
    total, apart = -1.0 / k, kappa * B / k
    first = {k: (total + apart) / 2, -k: (total - apart) / 2}
    amplitude = 1e-5
    domain = box([0, 0], [2, 1], [16, 8], QUADRILATERAL)
    x, y = ufl.SpatialCoordinate(domain)

    def field(s):
        psi = ufl.cos(k * x) * ufl.exp(s * y)
        return ufl.grad(psi), psi

    u = sum((first[s] * field(s)[0] for s in (k, -k)), ufl.as_vector((0.0, 0.0)))
    slope, psi = field(-k)
    u = amplitude * (u + B * (y * slope - kappa * ufl.as_vector((0.0, psi))))
    strain = ufl.sym(ufl.grad(u))
    lam = YOUNG * POISSON / (1 + POISSON) / (1 - 2 * POISSON)
    stress = lam * ufl.tr(strain) * ufl.Identity(2) + 2 * G * strain
    top = facet_tags(domain, at(1, 1.0))
    options = {"degree": 2}
    if free is None:
        body = mpm.Particles(domain, **options)
    else:
        background = box([0, 0], [2, 1.125], [16, 9], QUADRILATERAL)
        free = mpm.region(y=(0.0, 0.125)) if free == "layer" else free
        body = mpm.Particles(domain, vectors(background, 2), free=free, **options)
    truss = mpm.Truss(body, line((0, 0), (2, 0), 32), stiffness)
    law = LinearElastic(YOUNG, POISSON)
    bcs = [mpm.held(body.V, 1, y=0.0), *(mpm.held(body.V, 0, x=end) for end in (0.0, 2.0))]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, law, tractions=[(stress[:, 1], 1)], facet_tags=top),
        bcs=bcs,
        terms=[truss],
    )
    problem.solve()
    middle = truss.nodes[truss.cells][:, :, 0].mean(axis=1)
    exact = amplitude * stiffness * k * np.cos(k * middle)
    assert np.abs(truss.force - exact).max() < most * exact.max()


def rings(kind, n=12, outer=3.0):
    """Return a ring around a hole of radius 1 of some kind, its lining, and how it is held."""
    if kind == "axisymmetric":
        domain = box([1, 0], [outer, 0.5], [n, 2], QUADRILATERAL)
        body = mpm.Particles(domain, degree=2)
        lining = mpm.Membrane(body, line((1, 0), (1, 0.5), 4), 500.0, axisymmetric=True)
        return body, lining, [mpm.held(body.W, 1, y=0.0), mpm.held(body.W, 1, y=0.5)], at(0, 1.0)
    if kind == "plane":
        domain = box([0, 0], [1, 1], [n, 2 * n], QUADRILATERAL)
    else:
        domain = box([0, 0, 0], [1, 1, 0.1], [n // 2, n, 1], HEXAHEDRON)
    share, turn = domain.geometry.x[:, 0].copy(), 0.5 * np.pi * domain.geometry.x[:, 1]
    r = outer**share
    domain.geometry.x[:, 0], domain.geometry.x[:, 1] = r * np.cos(turn), r * np.sin(turn)

    def inside(x):
        return np.hypot(x[0], x[1]) < 1.0 + 1e-9

    body = mpm.Particles(domain)
    fdim = domain.topology.dim - 1
    facets = mesh.locate_entities_boundary(domain, fdim, inside)
    surface = mesh.create_submesh(domain, fdim, facets)[0]
    lining = mpm.Membrane(body, surface, 500.0)
    bcs = [mpm.held(body.W, 0, x=0.0), mpm.held(body.W, 1, y=0.0)]
    if fdim == 2:
        bcs += [mpm.held(body.W, 2, z=0.0), mpm.held(body.W, 2, z=0.1)]
    return body, lining, bcs, inside


@pytest.mark.parametrize("kind", ["plane", "axisymmetric", "space"])
def test_a_lining_bonded_to_a_ring_bears_what_lame_says(kind):
    # u = A r + B / r; the pressure in the hole is borne by the ring and by N / R of the lining.
    pressure, outer = 1e-3, 3.0
    body, lining, bcs, inside = rings(kind, outer=outer)
    tags = facet_tags(body.mesh, inside)
    x = ufl.SpatialCoordinate(body.mesh)
    radial = [x[0] / ufl.sqrt(x[0] ** 2 + x[1] ** 2), x[1] / ufl.sqrt(x[0] ** 2 + x[1] ** 2), 0.0]
    push = [1.0, 0.0] if kind == "axisymmetric" else radial[: body.mesh.geometry.dim]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            body,
            LinearElastic(YOUNG, POISSON),
            tractions=[(pressure * ufl.as_vector(push), 1)],
            facet_tags=tags,
        ),
        bcs=bcs,
        terms=[lining],
        axisymmetric=kind == "axisymmetric",
    )
    problem.solve()
    c, stiffness = YOUNG / (1 + POISSON), 500.0
    soft = c / (1 - 2 * POISSON)
    A, B = np.linalg.solve(
        [[soft, -c / outer**2], [soft - stiffness, -c - stiffness]], [0.0, -pressure]
    )
    exact = stiffness * (A + B)
    found = lining.force
    around = found[:, 1] if kind == "axisymmetric" else found[:, 0]
    along = found[:, 0] if kind == "axisymmetric" else found[:, 1]
    assert 0.2 * pressure < exact < 0.8 * pressure
    assert np.abs(around / exact - 1.0).max() < 0.01
    assert np.abs(along).max() < 0.01 * exact


@pytest.mark.parametrize("n", [6, 12])
def test_a_nail_is_pulled_out_by_its_limit_times_its_length(n):
    limit, length, h = 5.0, 3.0, 0.5
    background = box([-0.5, -0.5], [5.5, 3.0], [12, 7], QUADRILATERAL)
    domain = box([0, 0], [5, 2], [20, 8], QUADRILATERAL)
    soil = mpm.Particles(domain, vectors(background), quadrature_degree=2)
    points = np.concatenate([[(-h, 1.1)], line((0, 1.1), (length, 1.1), n)])
    nail = mpm.Truss(
        soil,
        points,
        2e4,
        bond=mpm.Bond(1e5, limit, where=mpm.region(x=(0, length))),
        held=lambda x: x[0] < -0.1,
    )
    tags = facet_tags(domain, at(1, 0.0), at(0, 5.0))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(soil, LinearElastic(2e4, 0.3)),
        supports=[mpm.boundary.fixed(soil, tags, tag) for tag in (1, 2)],
        terms=[nail],
    )
    pulls = [
        -problem.reaction(nail)[0]
        for _ in problem.steps(12, update=lambda t: nail.move((-0.012 * t, 0.0)))
    ]
    assert pulls[0] < 0.9 * limit * length
    assert np.allclose(pulls[-4:], limit * length, rtol=1e-6)
    # what is left of the pull falls along the nail to nothing at its tip
    assert np.allclose(
        nail.force[1:], limit * (length - length / n * (np.arange(n) + 0.5)), atol=1e-4
    )
    assert max(problem.history.iterations) <= 5


class Watched(mpm.Truss):
    """A truss that notes whether it was smooth, and whether it was driven."""

    def smooth(self):
        found = super().smooth()
        self.seen.append((found, self.drives()))
        return found


def test_a_casing_is_pulled_out_by_its_limit_around_the_axis():
    """A tube of bars in a body of revolution: its bond acts on the whole circumference."""
    limit, length, radius = 5.0, 2.0, 1.2
    domain = box([0.5, 0], [2.5, 2], [8, 8], QUADRILATERAL)
    soil = mpm.Particles(domain)
    points = np.concatenate([[(radius, length + 0.5)], line((radius, length), (radius, 0.0), 8)])
    casing = Watched(
        soil,
        points,
        2e4,
        bond=mpm.Bond(1e5, limit, where=mpm.region(y=(0, length))),
        held=lambda x: x[1] > length + 0.1,
        axisymmetric=True,
    )
    casing.seen = []
    law, bcs = LinearElastic(2e4, 0.3), [mpm.held(soil.W, y=0.0), mpm.held(soil.W, x=2.5)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(soil, law), bcs=bcs, terms=[casing], axisymmetric=True
    )
    pulls, smooth = [], []
    for _ in problem.steps("auto", update=lambda t: casing.move((0.0, 0.02 * t**2))):
        pulls.append(problem.reaction(casing)[1])
        smooth.append(casing.seen[-1])
        casing.seen.clear()
    whole = limit * length * 2.0 * np.pi * radius
    assert np.isclose(pulls[-1], whole, rtol=1e-6)
    assert pulls[0] < 0.3 * whole
    assert smooth[0] == (True, True)  # elastic, and on a path of its own
    assert smooth[-1] == (False, True)  # along the bond it slips
    assert not casing.drives()


def test_a_stretched_sheet_on_a_block_in_space_adds_its_plane_stress():
    # A uniform stretch along x of a block of Hencky's law without Poisson's effect.
    domain = box([0, 0, 0], [1, 1, 0.5], [2, 2, 1], HEXAHEDRON)
    top = mesh.locate_entities_boundary(domain, 2, lambda x: np.isclose(x[2], 0.5))
    body = mpm.Particles(domain)
    sheet = mpm.Membrane(body, mesh.create_submesh(domain, 2, top)[0], 300.0, 0.25)
    rod = mpm.Truss(body, line((0, 0, 0), (0, 1, 0), 2), 70.0)
    problem, put = driven(body, Hencky(1.0, 0.0), [sheet, rod])
    problem.solve(update=lambda t: put(lambda x: x * [1 + 0.1 * t, 1 - 0.05 * t, 1.0]))
    D = 300.0 / (1 - 0.25**2)
    assert np.allclose(sheet.force, [D * (0.1 - 0.25 * 0.05), D * (-0.05 + 0.25 * 0.1)])
    assert np.allclose(rod.force, -70.0 * 0.05)


# -- The law ------------------------------------------------------------------------------------


def test_a_turned_truss_has_the_force_of_its_stretch_alone():
    body, truss = bar(stiffness=50.0)
    problem, put = driven(body, Hencky(1.0, 0.3), [truss])

    def path(t):
        c, s = np.cos(2.5 * t), np.sin(2.5 * t)  # to 143 degrees
        put(lambda x: (x * [1 + 0.2 * t, 1.0]) @ np.array([[c, s], [-s, c]]))

    problem.solve(10, update=path)
    assert np.allclose(truss.force, 10.0, rtol=1e-9)


def test_a_bar_yields_goes_slack_and_keeps_its_prestress():
    forces = {}
    kinds = {
        "yields": {"yield_force": 1.0},
        "cable": {"yield_force": 1.0, "compression": False},
        "anchor": {"prestress": 0.3},
        "jack": {"prestress": 0.3},
    }
    for name, options in kinds.items():
        body, truss = bar(stiffness=0.0 if name == "jack" else 100.0, **options)
        problem, put = driven(body, Hencky(1.0, 0.0), [truss])
        for end in (0.02, 0.005, 0.012):
            problem.solve(3, update=lambda t, e=end: put(lambda x: x * [1 + e * t, 1.0]))
            forces.setdefault(name, []).append(float(truss.force.mean()))
            assert np.ptp(truss.force) < 1e-12
    assert np.allclose(forces["yields"], [1.0, -0.5, 0.2])
    assert np.allclose(forces["cable"], [1.0, 0.0, 0.2])
    assert np.allclose(forces["anchor"], [2.3, 0.8, 1.5])
    assert np.allclose(forces["jack"], 0.3)


def test_a_sheet_without_compression_is_taut_along_one_axis_or_slack():
    cloth, plate = Sheet(10.0, 0.3, False), Sheet(10.0, 0.3, True)
    none = np.zeros(1)

    def forces(sheet, *stretches):
        return sheet.respond(np.array([stretches]), none).forces[0]

    assert np.allclose(forces(cloth, 1.1, 1.05), forces(plate, 1.1, 1.05))
    assert np.allclose(forces(cloth, 1.1, 0.98), forces(plate, 1.1, 0.98))  # it would be narrower
    assert np.allclose(forces(cloth, 1.1, 0.9), [1.0, 0.0])
    assert np.allclose(forces(cloth, 0.2, 1.1), [0.0, 1.0])
    assert np.allclose(forces(cloth, 0.9, 0.95), 0.0)


def test_a_nail_slips_alike_however_its_cells_are_drawn():
    points = np.concatenate([line((0, 0.5), (3, 0.5), 6), [(-1.0, 0.5)]])
    forces = []
    for turned in (6, 2):  # every so many cells
        body = mpm.Particles(box([0, 0], [3, 1], [6, 2], QUADRILATERAL))
        cells = [[i + 1, i] if i % turned == 1 else [i, i + 1] for i in range(6)]
        nail = mpm.Truss(
            body,
            mesh_of(points, [*cells, [7, 0]]),
            100.0,
            bond=mpm.Bond(50.0, 0.4, where=mpm.region(x=(0, 3))),
            held=mpm.region(x=-1.0),
        )
        problem = mpm.QuasiStaticProblem(
            mpm.Body(body, Hencky(1e3, 0.3)), bcs=[mpm.held(body.W, x=3.0)], terms=[nail]
        )
        problem.solve(3, update=lambda t, nail=nail: nail.move((-0.02 * t, 0.0)))
        middle = nail.nodes[nail.cells][:, :, 0].mean(axis=1)
        forces.append(nail.force[np.argsort(middle)])
    assert np.abs(nail.state.bond).max() == pytest.approx(0.4)
    assert np.allclose(forces[0], forces[1], rtol=1e-8)
    assert forces[0][0] == pytest.approx(forces[0].max()) and forces[0][-1] < forces[0][1]


TRI, QUAD, LINE = basix.CellType.triangle, basix.CellType.quadrilateral, basix.CellType.interval
CORNERS = np.array([[1.0, 1.0, 0.0], [2.0, 1.0, 0.1], [1.1, 2.0, 0.0], [2.1, 2.2, 0.3]])


@pytest.mark.parametrize(
    ("kind", "cells", "gdim", "law", "axisymmetric"),
    [
        (TRI, [[0, 1, 2], [1, 3, 2]], 3, Sheet(10.0, 0.3, True), False),
        (QUAD, [[0, 1, 2, 3]], 3, Sheet(10.0, 0.3, True), False),
        (TRI, [[0, 1, 2], [1, 3, 2]], 3, Sheet(10.0, 0.3, False), False),
        (LINE, [[0, 1], [1, 3]], 2, Sheet(10.0, 0.3, True), True),
        (LINE, [[0, 1], [1, 3]], 2, Sheet(10.0, 0.3, False), True),
        (LINE, [[0, 1], [1, 3]], 2, Sheet(10.0, 0.3, True), False),
        (LINE, [[0, 1], [1, 3]], 3, Bar(10.0, 0.5, False), False),
        (LINE, [[0, 1], [1, 3]], 2, Bar(10.0, np.inf, True), True),
    ],
)
def test_the_tangent_is_that_of_the_forces(kind, cells, gdim, law, axisymmetric):
    layout = Layout(CORNERS[:, :gdim], np.array(cells), kind)
    count = 1 if isinstance(law, Bar) else 2
    rule = rule_of(layout, layout.nodes, count, axisymmetric)
    anyhow = 0.3 * np.random.default_rng(1).standard_normal(layout.nodes.shape)
    none, present = np.zeros(rule.weights.shape), np.ones(len(cells))

    def forces(x):
        nodal, total = stretched(rule, law, x, none, present), np.zeros_like(x)
        np.add.at(total, layout.cells, nodal.forces)
        return total.ravel(), nodal.tangent

    dofs = (layout.cells[:, :, None] * gdim + np.arange(gdim)).reshape(len(cells), -1)
    for x in (layout.nodes + anyhow, 1.2 * layout.nodes):  # (by equal stretches, too)
        K, h = np.zeros((x.size, x.size)), 1e-6
        for own, part in zip(dofs, forces(x)[1], strict=True):
            K[np.ix_(own, own)] += part.reshape(len(own), len(own))
        steps = [h * row.reshape(x.shape) for row in np.eye(x.size)]
        slopes = np.array([(forces(x + s)[0] - forces(x - s)[0]) / (2 * h) for s in steps]).T
        assert np.allclose(K, slopes, atol=1e-8 * np.abs(K).max())
        assert np.allclose(K, K.T, atol=1e-13 * np.abs(K).max())
    assert np.abs(forces(layout.nodes)[0]).max() < 1e-14


def test_means_over_a_cell_are_weighed():
    layout = Layout(CORNERS, np.array([[0, 1, 2, 3]]), QUAD)
    rule = rule_of(layout, layout.nodes, 2, False)
    assert np.ptp(rule.weights) > 0.1 * rule.weights.max()
    values = np.arange(rule.weights.size, dtype=float)
    mean = np.average(values, weights=rule.weights[0])
    assert rule.means(values[None, :, None]) == pytest.approx(mean, rel=1e-14)


# -- With the rest ------------------------------------------------------------------------------


def pit(carried=True, **options):
    """Return a problem of soil under its weight."""
    domain = box([0, 0], [2, 1], [16, 8], QUADRILATERAL)
    if carried:
        background = box([0, 0], [2.25, 1.25], [9, 5], QUADRILATERAL)
        soil = mpm.Particles(domain, vectors(background), quadrature_degree=2)
    else:
        soil = mpm.Particles(domain)
    bcs = [mpm.held(soil.V, 0, x=0.0), mpm.held(soil.V, y=0.0)]
    body = mpm.Body(soil, Hencky(500.0, 0.3), density=1.0, body_force=(0.0, -20.0))
    return mpm.QuasiStaticProblem(body, bcs=bcs, solver=TIGHT, **options)


def test_in_a_stage_a_truss_begins_without_stress_and_goes_on_as_another():
    problem = pit(carried=False)
    soil = problem.particles
    problem.solve(2)
    points = line((0.1, 0.45), (1.9, 0.9), 12)
    truss = mpm.Truss(soil, points, 1e3)
    d = soil.displacement.x.array.copy()
    problem.stage("reinforced", terms=[truss])
    problem.solve()
    assert np.abs(soil.displacement.x.array - d).max() < 1e-12
    assert np.abs(truss.force).max() < 1e-9
    heavier = problem.body().replace(body_force=(0.0, -30.0))
    problem.stage("loaded", heavier)
    problem.solve(2)
    force, d = truss.force.copy(), soil.displacement.x.array.copy()
    assert np.abs(force).max() > 0.1
    for number, options in enumerate(({"stiffness": 1e3}, {"stiffness": 4e3}, {"stiffness": 1e3})):
        other = mpm.Truss(soil, points, **options)
        problem.stage(f"replaced {number}", terms=[other])
        problem.solve()
        assert np.abs(other.force - force).max() < 1e-9
        assert np.abs(soil.displacement.x.array - d).max() < 1e-12
    problem.stage("without", terms=[])
    problem.solve(2)
    assert np.abs(soil.displacement.x.array - d).max() > 1e-4


def test_a_prestress_comes_over_a_stage_and_is_locked_off():
    problem = pit(carried=False)
    soil = problem.particles
    problem.solve(2)
    points = [(1.0, 0.3), (1.8, 0.8)]
    jack = mpm.Truss(soil, points, 0.0, prestress=3.0)
    problem.stage("jacked", terms=[jack])
    problem.solve(2)
    assert np.allclose(jack.force, 3.0)
    d = soil.displacement.x.array.copy()
    anchor = mpm.Truss(soil, points, 2e3)
    problem.stage("locked off", terms=[anchor])
    problem.solve()
    assert np.allclose(anchor.force, 3.0, rtol=1e-9)
    assert np.abs(soil.displacement.x.array - d).max() < 1e-12


def built(name=None):
    """Return soil under its weight, with a nail that slips and yields and a cloth, in a stage."""
    problem = pit()
    problem.solve(2)
    soil = problem.particles
    nail = mpm.Truss(
        soil,
        np.concatenate([[(0.1, 0.5)], line((0.3, 0.5), (1.8, 0.8), 10)]),
        300.0,
        yield_force=0.5,
        bond=mpm.Bond(1e3, 1.0, where=mpm.region(x=(0.15, 2))),
    )
    nail.name = name
    cloth = mpm.Membrane(soil, line((0.2, 0.3), (1.9, 0.3), 9), 50.0, 0.2, compression=False)
    heavier = problem.body().replace(body_force=(0.0, -50.0))
    problem.stage("built", heavier, terms=[nail, cloth])
    return problem, nail, cloth


def test_a_run_goes_on_from_a_checkpoint_bit_for_bit(tmp_path):
    path = WORLD.bcast(tmp_path) / "state"
    problem, nail, cloth = built()
    for number, _ in enumerate(problem.steps(4)):
        if number == 1:
            problem.save(path)
    assert np.isclose(np.abs(nail.state.bond).max(), 1.0)
    assert np.isclose(np.abs(nail.state.forces).max(), 0.5)
    other, its_nail, its_cloth = built()
    other.restore(path)
    other.solve(4)
    d, its = problem.particles.displacement.x.array, other.particles.displacement.x.array
    # (sums of what three ranks send are taken as it comes)
    same = np.array_equal if WORLD.size < 3 else lambda a, b: np.allclose(a, b, rtol=0, atol=1e-10)
    assert same(its_nail.force, nail.force)
    assert same(its_cloth.force, cloth.force)
    assert same(its, d)


def test_held_nodes_stay_where_they_were_after_a_restart(tmp_path):
    path = WORLD.bcast(tmp_path) / "state"

    def made():
        body = mpm.Particles(box([0, 0], [1, 1], [2, 2], QUADRILATERAL))
        rope = mpm.Truss(body, [(0.5, 1.0), (0.5, 2.0)], 50.0, held=lambda x: x[1] > 1.5)
        problem = mpm.QuasiStaticProblem(
            mpm.Body(body, Hencky(1e3, 0.3)), bcs=[mpm.held(body.W, y=0.0)], terms=[rope]
        )
        return problem, rope

    problem, rope = made()
    problem.solve(2, update=lambda t: rope.move((0.0, 0.1 * t)))
    problem.save(path)
    problem.step()
    assert 3.0 < problem.reaction(rope)[1] < 5.0
    other, its = made()
    other.restore(path)
    other.step()
    assert np.array_equal(its.force, rope.force)
    rope.move((0.0, 0.2))
    assert np.array_equal(its.reaction, rope.reaction)  # of the last converged step


def test_structures_follow_particles_to_other_ranks():
    forces = []
    for share in (None, 1e-9):
        problem, nail, cloth = built()
        problem.solve(4, repartition=share)
        forces.append(np.concatenate([nail.force, cloth.force.ravel()]))
    assert np.allclose(forces[0], forces[1], rtol=1e-9, atol=1e-9)


def test_an_anchor_between_two_bodies_bears_what_hangs_on_it():
    high = mpm.Particles(box([0, 2], [1, 3], [2, 2], QUADRILATERAL))
    low = mpm.Particles(box([0, 0], [1, 1], [2, 2], QUADRILATERAL), degree=2)
    ropes = mesh_of([[0.0, 0.9], [0.0, 2.1], [1.0, 0.9], [1.0, 2.1]], [[0, 1], [2, 3]])
    cables = mpm.Truss([low, high], ropes, 400.0, degree=1, compression=False, prestress=1.0)
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(high, Hencky(1e3, 0.3)),
            mpm.Body(low, Hencky(1e3, 0.3), density=1.0, body_force=(0.0, -3.0)),
        ],
        bcs=[mpm.held(high.W, y=3.0), *(mpm.held(low.W, 0, x=side) for side in (0.0, 1.0))],
        terms=[cables],
    )
    problem.solve(3)
    assert np.allclose(cables.force, 1.5, rtol=1e-6)
    assert np.allclose(problem.reaction(problem.bcs[0]), [0.0, 3.0], atol=1e-6)


def mesh_of(points, cells):
    """Return a mesh of lines, which the first rank gives."""
    points, cells = np.array(points), np.array(cells, dtype=np.int64)
    if WORLD.rank > 0:
        points, cells = points[:0], cells[:0]
    element = basix.ufl.element("Lagrange", "interval", 1, shape=(2,))
    return mesh.create_mesh(WORLD, cells, element, points)


@pytest.mark.parametrize("scheme", ["midpoint", "conserving", "euler"])
def test_a_block_on_a_spring_swings_with_its_period(scheme):
    # A stiff block hangs on a bar that is held above it, and is let go where this has no force.
    body = mpm.Particles(box([0, 0], [1, 1], [2, 2], QUADRILATERAL))
    rods = mesh_of([[0.0, 1.0], [0.0, 3.0], [1.0, 1.0], [1.0, 3.0]], [[0, 1], [2, 3]])
    springs = mpm.Truss(body, rods, 40.0, held=lambda x: x[1] > 2.0)
    problem = mpm.DynamicProblem(
        mpm.Body(body, Hencky(1e6, 0.3), density=2.0, body_force=(0.0, -1.0)),
        scheme=scheme,
        bcs=[mpm.held(body.W, 0, x=0.0)],
        terms=[springs],
    )
    period, n = 2.0 * np.pi * np.sqrt(2.0 / (2 * 40.0 / 2.0)), 40
    lowest = [
        float(springs.positions[:, 1].min()) - 1.0
        for _ in problem.steps(time=0.5 * period, dt=0.5 * period / n)
    ]
    whole = 2.0 * 2.0 / 40.0  # twice the displacement at rest
    assert np.isclose(lowest[-1], -whole, rtol=0.2 if scheme == "euler" else 0.01)
    balance = [energy.balance for energy in problem.history.energies]
    assert np.abs(balance).max() < 1e-6


def test_the_factor_of_safety_of_soil_beside_what_is_elastic():
    soil = mpm.Particles(box([0, 0], [2, 1], [8, 4], QUADRILATERAL))
    wall = mpm.Particles(box([2, 0], [2.25, 1], [1, 4], QUADRILATERAL))
    truss = mpm.Truss(soil, line((0, 0.5), (2, 0.5), 8), 1e3)
    law = mpm.materials.MohrCoulomb(1e4, 0.3, cohesion=6.0, friction_angle=20.0)
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(soil, law, density=1.0, body_force=(0.0, -20.0)),
            mpm.Body(wall, LinearElastic(1e5, 0.3)),
        ],
        bcs=[mpm.held(soil.W, y=0.0), mpm.held(wall.W, y=0.0)],
        terms=[truss],
    )
    problem.solve(2)
    found = mpm.strength_reduction(problem, most=1.2, tolerance=0.1)
    assert found.factor >= 1.0 and len(found.factors) > 1


def factor_of_a_cut(nailed):
    """Return the factor of safety of a vertical cut of 2 m, with two rows of nails or without."""
    V = vectors(box([0, 0], [8, 4], [16, 8], QUADRILATERAL))
    soil = mpm.Particles(box([0, 0], [8, 3], [32, 12], QUADRILATERAL), V, quadrature_degree=2)
    law = mpm.materials.MohrCoulomb(30e3, 0.3, cohesion=8.0, friction_angle=25.0)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(soil, law, density=1.8, body_force=(0.0, -9.81), f_bar="patch"),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=8.0), mpm.held(V, y=0.0)],
    )
    problem.solve(3)
    problem.remove(lambda x: (x[0] < 3.0) & (x[1] > 1.0), name="dig")
    if nailed:
        bond = mpm.Bond(2e4, 30.0)
        rows = [line((3.0, y), (6.0, y - 0.4), 12) for y in (1.5, 2.5)]
        problem.stage("nail", terms=[mpm.Truss(soil, points, 4e4, bond=bond) for points in rows])
    problem.solve(3)
    return mpm.strength_reduction(problem, tolerance=0.02)


@pytest.mark.slow
def test_nails_hold_a_cut():
    bare, nailed = factor_of_a_cut(False), factor_of_a_cut(True)
    assert bare.reason == nailed.reason == "flow"
    assert 1.3 < bare.factor < 1.45 and nailed.factor > 1.75


def test_structures_are_written_and_drawn(tmp_path):
    path = WORLD.bcast(tmp_path)
    problem, nail, cloth = built("nail")
    problem.solve(1)
    problem.write(path / "pit.pvd")
    files = sorted(file.name for file in path.iterdir() if file.suffix == ".pvd")
    assert files == ["pit.pvd", "pit_nail.pvd", "pit_structure1.pvd"]
    pyvista = pytest.importorskip("pyvista")
    if WORLD.rank == 0:
        grid = pyvista.read(path / "pit_nail_000000.vtu")
        assert np.allclose(grid.cell_data["axial_force"], nail.force)
    places = nail.positions
    if WORLD.rank == 0:
        assert np.allclose(grid.points[:, :2], places)
    figure = mpm.plot.scene(problem, "axial_force")
    if WORLD.rank == 0:
        drawn = figure.axes[0].collections
        segments = [c for c in drawn if type(c).__name__ == "LineCollection"]
        assert [len(c.get_segments()) for c in segments] == [len(nail.cells), len(cloth.cells)]
        assert len(np.unique(segments[0].get_colors(), axis=0)) > 2


@pytest.mark.slow
def test_structures_in_space_are_drawn():
    pytest.importorskip("pyvista")
    domain = box([0, 0, 0], [1, 1, 0.5], [2, 2, 1], HEXAHEDRON)
    body = mpm.Particles(domain)
    rod = mpm.Truss(body, line((0.2, 0.2, 0), (0.8, 0.9, 0.4), 3), 70.0)
    top = mesh.locate_entities_boundary(domain, 2, lambda x: np.isclose(x[2], 0.5))
    sheet = mpm.Membrane(body, mesh.create_submesh(domain, 2, top)[0], 300.0, 0.25)
    problem, put = driven(body, Hencky(1.0, 0.0), [sheet, rod])
    problem.solve(update=lambda t: put(lambda x: x * [1 + 0.1 * t, 1 - 0.05 * t, 1.0]))
    for field in ("axial_force", "membrane_force", "displacement"):
        figure = mpm.plot.scene(problem, field)
        assert (figure is None) == (WORLD.rank > 0)


@pytest.mark.mpi
def test_places_that_differ_between_ranks_are_named():
    soil, places = pit().particles, [mpm.region(x=(0, 1.2)), mpm.region(x=(0.7, 2))]
    bond = mpm.Bond(1e3, where=differing(*places))
    fails(lambda: mpm.Truss(soil, POINTS, 1.0, held=differing(*places)), "^held=.* differs between")
    fails(lambda: mpm.Truss(soil, POINTS, 1.0, bond=bond), "^where= of a Bond differs between")


def test_what_makes_no_sense_is_refused():
    body, truss = bar(stiffness=1.0)
    points = line((0, 0.25), (1, 0.25), 2)
    V = vectors(box([-1, -1], [2, 2], [4, 4], QUADRILATERAL))
    alone = mpm.Particles(box([0, 0], [1, 1], [2, 2], QUADRILATERAL), V, method="mpm")
    cases = [
        (lambda: mpm.Truss(alone, points, 1.0), "method='cpdi2'"),
        (lambda: mpm.Truss([body, body], points, 1.0), "several that differ"),
        (lambda: mpm.Truss(body, [(0.0, 0.0)], 1.0), r"points of a polyline, shape \(n, 2\)"),
        (lambda: mpm.Truss(body, line((0, 0.25), (2, 0.25), 4), 1.0), "is in none of its bodies"),
        (lambda: mpm.Truss(body, [(0, 0), (0, 0)], 1.0), "has no size"),
        (lambda: mpm.Truss(body, body.mesh, 1.0), "is one of lines, not of quadrilateral"),
        (lambda: mpm.Truss(body, points, 0.0), "must be a positive number"),
        (lambda: mpm.Truss(body, points, 1.0, prestress="1"), "prestress of a Truss"),
        (lambda: mpm.Truss(body, points, 1.0, bond=3.0), "is an mpm.Bond"),
        (lambda: mpm.Truss(body, points, 1.0, degree=4), "from 1 to 3"),
        (lambda: mpm.Truss(body, points, 1.0, held=lambda x: x[0] > 9), "holds at no node"),
        (
            lambda: mpm.Truss(body, points, 1.0, held=lambda x: x[0] > 0.9, bond=mpm.Bond(1.0)),
            "leave them out by where=",
        ),
        (lambda: mpm.Truss(body, line((0, 0), (0, 0.5), 2), 1.0, axisymmetric=True), "on the axis"),
        (lambda: mpm.Bond(-1.0), "stiffness of a Bond"),
        (lambda: mpm.Membrane(body, points, 1.0, 1.0), "between -1 and 1"),
        (lambda: truss.move((1.0, 0.0)), "No node of this Truss is held"),
        (
            lambda: mpm.QuasiStaticProblem(
                mpm.Body(body, Hencky(1.0, 0.0)), terms=[truss], axisymmetric=True
            ),
            "axisymmetric",
        ),
    ]
    for call, sentence in cases:
        with pytest.raises(mpm.MPMError, match=sentence):
            call()


def test_a_tie_tells_its_reaction():
    low = mpm.Particles(box([0, 0], [1, 1], [2, 2], QUADRILATERAL))
    high = mpm.Particles(box([0, 1], [1, 2], [3, 2], QUADRILATERAL))
    tie = mpm.Tie(low, high, facet_tags(low.mesh, at(1, 1.0)), 1, 1e6)
    law = Hencky(1e4, 0.3)
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(low, law), mpm.Body(high, law, density=1.0, body_force=(0.0, -4.0))],
        bcs=[mpm.held(low.W, y=0.0)],
        terms=[tie],
    )
    problem.solve(2)
    assert np.allclose(problem.reaction(tie), [0.0, -4.0], atol=1e-6)
    assert np.allclose(problem.reaction(problem.bcs[0]), [0.0, 4.0], atol=1e-6)


# -- In place of others --------------------------------------------------------------------------


def stretched_pit(*terms):
    """Return a problem with terms that a heavier weight has stretched, and its body's points."""
    problem = pit(carried=False)
    problem.solve(2)
    made = [one(problem.particles) for one in terms]
    heavier = problem.body().replace(body_force=(0.0, -60.0))
    problem.stage("loaded", heavier, terms=made)
    problem.solve(4)
    return problem, made


POINTS = line((0.1, 0.45), (1.9, 0.9), 12)
#: Forces by stretches of 1500, which are known to round-off of one.
KNOWN = 1e-14 * 1500.0


def test_two_that_are_drawn_alike_go_on_each_as_its_own():
    laws = ({"stiffness": 500.0}, {"stiffness": 1500.0})

    def made(laws):
        return [lambda soil, one=one: mpm.Truss(soil, POINTS, **one) for one in laws]

    problem, before = stretched_pit(*made(laws))
    d, soil = problem.particles.displacement.x.array.copy(), problem.particles
    others = [one(soil) for one in made(laws)[::-1]]
    problem.stage("equal", terms=others)
    problem.solve()
    for one, other in zip(before, others[::-1], strict=True):
        assert np.abs(other.force - one.force).max() < KNOWN
    assert np.abs(soil.displacement.x.array - d).max() < 1e-12
    # of two others nobody knows which is which, unless they are called so
    changed = [mpm.Truss(soil, POINTS, stiffness) for stiffness in (600.0, 1600.0)]
    with pytest.raises(mpm.MPMError, match="not to be told in whose place"):
        problem.stage("unknown", terms=changed)
    assert problem.terms == others
    for name, one, other in zip("ab", others, changed, strict=True):
        one.name = other.name = name
    problem.stage("called", terms=changed)
    problem.solve()
    for one, other in zip(others, changed, strict=True):
        assert np.abs(other.force - one.force).max() < KNOWN


def test_a_bond_elsewhere_has_the_forces_of_its_own_nodes():
    """Bonds at as many nodes, in another place: what both have goes on, the rest begins at zero."""

    def nail(low, high):
        bond = mpm.Bond(1e3, 5.0, where=mpm.region(x=(low, high)))
        return lambda soil: mpm.Truss(soil, POINTS, 500.0, bond=bond)

    problem, (before,) = stretched_pit(nail(0.0, 1.2))
    other = nail(0.8, 2.0)(problem.particles)
    assert other.state.bond.shape == before.state.bond.shape
    problem.stage("elsewhere", terms=[other])
    both = before.layout.nodes[:, 0] > 0.79
    mine = before.layout.nodes[:, 0] < 1.21
    kept = before.state.bond[both & mine]
    assert np.abs(kept).min() > 1e-3
    assert np.array_equal(other.state.bond[both & mine], kept)
    assert not other.state.bond[~(both & mine)].any()


def test_a_sheet_goes_on_as_an_equal_one_alone():
    problem, (before,) = stretched_pit(lambda soil: mpm.Membrane(soil, POINTS, 1e3, 0.2))
    soil = problem.particles
    d = soil.displacement.x.array.copy()
    other = mpm.Membrane(soil, POINTS, 1e3, 0.2)
    problem.stage("equal", terms=[other])
    problem.solve()
    assert np.abs(other.force - before.force).max() < KNOWN
    assert np.abs(soil.displacement.x.array - d).max() < 1e-12
    for options in ({"stiffness": 4e3, "poisson": 0.2}, {"stiffness": 1e3}):
        with pytest.raises(mpm.MPMError, match="cannot go on as one that is drawn like it"):
            problem.stage("stiffer", terms=[mpm.Membrane(soil, POINTS, **options)])
    problem.stage("without", terms=[])
    problem.solve(2)
    problem.stage("stiffer", terms=[stiffer := mpm.Membrane(soil, POINTS, 4e3)])
    problem.solve()
    assert np.abs(stiffer.force).max() < 1e-9


@pytest.mark.parametrize("kind", [mpm.Truss, mpm.Membrane])
def test_no_force_where_the_bodies_were_taken_away(kind):
    points = line((0.1, 0.45), (1.9, 0.45), 12)
    problem, (one,) = stretched_pit(lambda soil: kind(soil, points, 500.0))
    assert np.abs(one.force.reshape(12, -1)[:, 0]).min() > 1e-3
    problem.remove(mpm.region(x=(1.0, 2.0), y=(0.35, 1.0)))
    problem.solve(2)
    there = points[1:, 0] < 0.99
    assert np.abs(one.force[there]).max() > 0.1
    assert not one.force[points[:-1, 0] > 1.01].any()
    for values in one.fields().values():
        assert not values[points[:-1, 0] > 1.01].any()


def test_nodes_and_cells_of_a_mesh_have_its_own_order_on_any_number_of_ranks():
    count = 31
    points = np.column_stack([np.linspace(0.0, 1.0, count), np.sin(np.arange(count))])
    first = np.arange(count - 1)
    ends = np.column_stack([first, first + 1])
    lines = mesh_of(points, ends[np.random.default_rng(3).permutation(count - 1)])
    drawn = layout_of(lines, WORLD, 2, "Truss", False)
    np.testing.assert_array_equal(drawn.nodes, points)
    np.testing.assert_array_equal(np.sort(drawn.cells, axis=1), ends)


@pytest.mark.parametrize(
    ("scheme", "limits", "limit"),
    [("midpoint", {}, 0.05), ("euler", {"compression": False}, 0.2)],
)
def test_in_motion_a_bar_is_in_balance_with_what_holds_it(scheme, limits, limit):
    """It has no mass; and pieces of it slip as a whole, beside what is slack."""
    block = mpm.Particles(box([0, 0], [1, 1], [4, 4], QUADRILATERAL))
    ends = np.array([[0.1, 0.15], [0.8, 0.85]])
    bond = mpm.Bond(1e3, limit)
    nail = mpm.Truss(block, np.linspace(*ends, 7), 300.0, bond=bond, **limits)
    own = mpm.Body(block, Hencky(1e3, 0.3), density=1.0, body_force=(3.0, -10.0))
    held = [mpm.held(block.W, y=0.0)]
    problem = mpm.DynamicProblem(own, bcs=held, terms=[nail], scheme=scheme)
    most = 0.0
    for _ in problem.steps(time=0.16, dt=0.02):
        length = np.linalg.norm(ends[1] - ends[0]) / 6
        inside = np.cumsum(nail.state.bond)[:-1] - 0.5 * nail.state.bond[0]
        np.testing.assert_allclose(nail.force, length * inside, atol=1e-6)
        most = max(most, np.abs(nail.state.bond).max())
    assert most == pytest.approx(limit) and np.abs(nail.state.slip).max() > 1e-4
    assert problem.history.cutbacks == 0
    assert max(step.iterations for step in problem.history.steps) < 10


def test_each_piece_of_a_bar_that_was_cut_slips_by_itself():
    """Nothing is pulled across the part that was removed, and no piece slips without bound."""
    V = vectors(box([-1, -1], [5, 2], [24, 12], QUADRILATERAL))
    domain = box([0, 0], [4, 1], [16, 4], QUADRILATERAL)
    block = mpm.Particles(domain, V, outside="delete", quadrature_degree=2)
    nail = mpm.Truss(block, line((0.3, 0.4), (3.7, 0.4), 17), 50.0, bond=mpm.Bond(50.0, 0.01))
    aside = fem.Constant(V.mesh, np.zeros(2))
    left, right = (
        fem.locate_dofs_geometrical(V, where)
        for where in (lambda x: x[0] < 0.01, lambda x: x[0] > 3.99)
    )
    problem = mpm.QuasiStaticProblem(
        mpm.Body(block, Hencky(20.0, 0.3)),
        bcs=[fem.dirichletbc(np.zeros(2), left, V), fem.dirichletbc(aside, right, V)],
        terms=[nail],
    )
    problem.solve(2, update=lambda t: aside.value.put(0, 0.05 * t))
    problem.remove(mpm.region(x=(1.7, 2.3)))
    problem.solve()
    problem.solve(4, update=lambda t: aside.value.put(0, 0.05 + 0.3 * t))
    assert problem.history.cutbacks == 0
    assert np.abs(nail.state.bond).max() == pytest.approx(0.01)
    gone = np.flatnonzero(nail.force == 0.0)
    sizes = np.full(18, 0.2)
    sizes[[0, -1]] = 0.1
    for piece in (slice(0, gone[0] + 1), slice(gone[-1] + 1, None)):
        assert abs(np.sum((sizes * nail.state.bond)[piece])) < 1e-8
