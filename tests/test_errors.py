# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bad input: one clear sentence of ours, the same on every rank."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, TRIANGLE, WORLD

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx import _compat
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises


def raises(build, error, sentence):
    """Check class and sentence of an error, and that all ranks raise the same."""
    try:
        build()
        caught = None
    except Exception as exception:
        caught = exception
    texts = WORLD.allgather(f"{type(caught).__name__}: {caught}")
    assert all(text == texts[0] for text in texts), texts
    assert type(caught) is error, texts[0]
    message = str(caught)
    assert "\n" not in message and "Traceback" not in message
    with pytest.raises(error, match=sentence):
        raise caught
    return caught


# -- Particles ---------------------------------------------------------------------------


def background(cell=QUADRILATERAL):
    return scenes.box([-1.0, -1.0], [2.0, 2.0], [6, 6], cell)


def held_background():
    """A background with a side at x = 0."""
    return scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL)


def body():
    return scenes.unit(2, TRIANGLE)


def particles(**options):
    return mpm.Particles(body(), scenes.vectors(background()), **options)


def on(space, what=body, **options):
    """Return a function that makes particles of a body on a space."""
    return lambda: mpm.Particles(what(), space(), **options)


def vectors(**options):
    """Return a function that makes particles with other options."""
    return on(lambda: scenes.vectors(background()), **options)


def same_mesh():
    domain = body()
    return mpm.Particles(domain, scenes.vectors(domain))


def surface():
    """A flat mesh of triangles in space."""
    cells = np.array([[0, 1, 2], [1, 2, 3]]) if WORLD.rank == 0 else np.zeros((0, 3), int)
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]])
    x = x if WORLD.rank == 0 else np.zeros((0, 3))
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(3,))
    return mesh.create_mesh(WORLD, cells=cells, e=element, x=x)


def prisms():
    return mesh.create_unit_cube(WORLD, 1, 1, 1, mesh.CellType.prism)


def taylor_hood():
    cell = "quadrilateral"
    pair = [basix.ufl.element("P", cell, 1, shape=(2,)), basix.ufl.element("P", cell, 1)]
    return fem.functionspace(background(), basix.ufl.mixed_element(pair))


def far_away():
    domain = body()
    domain.geometry.x[:] += [5.0, 0.0, 0.0]
    return domain


def space(*element):
    return lambda: fem.functionspace(background(), element)


PARTICLES = {
    "outside": (
        on(lambda: scenes.vectors(background()), far_away),
        mpm.ParticleOutsideError,
        r"particles 0, 1.*outside the background mesh.*\(5\.0, 0\.0\)|outside the background",
    ),
    "no mesh": (on(lambda: scenes.vectors(background()), lambda: 3), r"Mesh, not int"),
    "no space": (on(background), r"FunctionSpace.*not Mesh"),
    "scalar V": (on(space("Lagrange", 1)), r"continuous Lagrange space of vectors"),
    "DG V": (on(space("DG", 1, (2,))), r"continuous Lagrange space of vectors"),
    "N1curl V": (on(space("RTCE", 1)), r"continuous Lagrange space of vectors"),
    "mixed V": (on(taylor_hood), r"continuous Lagrange space of vectors"),
    "three components": (on(space("Lagrange", 1, (3,))), r"vectors with 2 components"),
    "subspace": (on(lambda: scenes.vectors(background()).sub(0)), r"vectors|subspace"),
    "V on the body": (same_mesh, r"V lives on the body mesh"),
    "V in space": (
        on(lambda: scenes.vectors(scenes.unit(1, scenes.HEXAHEDRON))),
        r"body is 2-dimensional, the background 3-dimensional",
    ),
    "line": (
        on(
            lambda: scenes.vectors(mesh.create_unit_interval(WORLD, 4)),
            lambda: mesh.create_unit_interval(WORLD, 4),
        ),
        r"must fill its space in 2-D or 3-D",
    ),
    "surface": (
        on(lambda: scenes.vectors(scenes.unit(2, scenes.HEXAHEDRON)), surface),
        r"topological dimension 2 in 3",
    ),
    "prisms as body": (
        on(lambda: scenes.vectors(scenes.unit(1, scenes.HEXAHEDRON)), prisms),
        r"body has prism cells",
    ),
    "prisms as background": (
        on(
            lambda: fem.functionspace(prisms(), ("Lagrange", 1, (3,))),
            lambda: scenes.unit(1, scenes.HEXAHEDRON),
        ),
        r"background has prism cells",
    ),
    "degree of V": (on(space("Lagrange", 2, (2,))), r"degree 1 .* degree 2 .*; use degree=2, or"),
    "high degree of V": (on(space("Lagrange", 4, (2,))), r"background has degree 4; use 3"),
    "degree of W": (vectors(degree=4), r"degree must be 1, 2 or 3, not 4"),
    "degree of no number": (vectors(degree="one"), r"1, 2 or 3, not 'one'"),
    "few points": (vectors(degree=2, quadrature_degree=1), r"degree 2; use quadrature_degree=2"),
    "method": (vectors(method="fem"), r"Unknown method 'fem'; choose one of 'cpdi2'"),
    "method of no name": (vectors(method=None), r"Unknown method None"),
    "negative rule": (vectors(quadrature_degree=-1), r"quadrature_degree.*not -1"),
    "broken rule": (vectors(quadrature_degree=1.5), r"quadrature_degree.*not 1\.5"),
    "policy": (vectors(outside="ignore"), r"outside='ignore'"),
    "another communicator": (
        lambda: mpm.Particles(
            scenes.unit(2, TRIANGLE, MPI.COMM_SELF), scenes.vectors(background())
        ),
        r"different numbers of ranks",
    ),
}


@pytest.mark.parametrize("case", PARTICLES)
def test_particles(case):
    if case == "another communicator" and WORLD.size == 1:
        PARTICLES[case][0]()  # there is no difference
        return
    build, *expected = PARTICLES[case]
    error, sentence = expected if len(expected) == 2 else (mpm.MPMError, expected[0])
    raises(build, error, sentence)


# -- Problems ----------------------------------------------------------------------------


def ufl_problem(write, **options):
    """Return a function that makes a problem of ``write(particles, d, v)``."""

    def build():
        p = particles()
        R = write(p, p.displacement, ufl.TestFunction(p.W))
        more = {k: f(p) for k, f in options.items()}
        return mpm.ParticleProblem(R, p, **more)

    return build


def work(p, d, v):
    return ufl.inner(ufl.grad(d), ufl.grad(v)) * p.dx


def problem(material=None, **options):
    """Return a function that makes a problem with a material; options may depend on particles."""

    def build():
        p = particles()
        more = {k: f(p) if callable(f) else f for k, f in options.items()}
        law = material(p) if callable(material) else material
        law = Hencky(1e3, 0.3) if law is None else law
        return mpm.QuasiStaticProblem(p, law, **more)

    return build


def foreign_condition(p):
    return [scenes.fix(scenes.vectors(background()), scenes.at(0, -1.0))]


def condition_on_the_body(p):
    return [scenes.fix(p.W, scenes.at(0, 0.0))]


def tags_of_cells(p):
    return scenes.cell_tags(p.mesh, lambda x: np.where(x[:, 0] < 0.5, 1, 2))


def tags_of_facets(p):
    return scenes.facet_tags(p.mesh, scenes.at(0, 0.0))


def parameter(degree, shape=(), own=True):
    """Return a function that makes a law whose parameter is a Function."""

    def law(p):
        domain = p.mesh if own else body()
        kind = "DG" if degree == 0 else "Lagrange"
        young = fem.Function(fem.functionspace(domain, (kind, degree, shape)))
        young.x.array[:] = 1e3
        return Hencky(young, 0.3)

    return law


def values(n):
    return lambda p: Hencky(np.full(p.num_local + n, 1e3), 0.3)


def held(kind, **options):
    """Return a function that makes a problem with a support of the body's own boundary."""

    def build():
        p = particles()
        make = getattr(mpm.boundary, kind)
        more = {"facet_tags": tags_of_facets(p), "tag": 1}
        more |= {k: f(p) if callable(f) else f for k, f in options.items()}
        return mpm.QuasiStaticProblem(p, Hencky(1e3, 0.3), supports=[make(p, **more)])

    return build


def foreign_support():
    p = particles()
    support = mpm.boundary.fixed(p, tags_of_facets(p), 1)
    return mpm.QuasiStaticProblem(particles(), Hencky(1e3, 0.3), supports=[support])


def support_without_modulus():
    p = particles()
    support = mpm.boundary.fixed(p, tags_of_facets(p), 1)
    d, v = p.displacement, ufl.TestFunction(p.W)
    return mpm.ParticleProblem(work(p, d, v) + support.residual, p)


def run(**options):
    return lambda: scenes.block().solve(**options)


PROBLEMS = {
    # UFL
    "R of no particles": (lambda: mpm.ParticleProblem(0, "body"), r"mpm\.Particles.* not str"),
    "R is no form": (ufl_problem(lambda p, d, v: 0), r"residual R must be a UFL form"),
    "R without test function": (
        ufl_problem(lambda p, d, v: ufl.inner(d, d) * p.dx),
        r"residual R must be a UFL form with one test function",
    ),
    "R with two arguments": (
        ufl_problem(lambda p, d, v: work(p, ufl.TrialFunction(p.W), v)),
        r"residual R must be a UFL form with one test function",
    ),
    "R tested in V": (
        ufl_problem(lambda p, d, v: ufl.inner(p.increment, ufl.TestFunction(p.V)) * ufl.dx),
        r"test.* the residual R must be from",
    ),
    "R tested in another space of the body": (
        ufl_problem(
            lambda p, d, v: (
                ufl.div(d) * ufl.TestFunction(fem.functionspace(p.mesh, ("Lagrange", 1))) * p.dx
            )
        ),
        r"test.* the residual R must be from",
    ),
    "R of nothing": (
        ufl_problem(lambda p, d, v: v[0] * p.dx),
        r"does not depend on particles\.displacement",
    ),
    "R of another function": (
        ufl_problem(lambda p, d, v: work(p, fem.Function(p.W), v)),
        r"does not depend on particles\.displacement",
    ),
    "J is a vector": (
        ufl_problem(work, J=lambda p: work(p, p.displacement, ufl.TestFunction(p.W))),
        r"J",
    ),
    "J of the background": (
        ufl_problem(
            work,
            J=lambda p: ufl.inner(ufl.TrialFunction(p.V), ufl.TestFunction(p.V)) * ufl.dx,
        ),
        r"J",
    ),
    "background form on the body": (
        ufl_problem(work, background=lambda p: work(p, p.displacement, ufl.TestFunction(p.W))),
        r"background form must be from the space|background form",
    ),
    "background form of nothing": (
        ufl_problem(
            work,
            background=lambda p: (
                ufl.inner(fem.Constant(p.V.mesh, np.ones(2)), ufl.TestFunction(p.V)) * ufl.dx
            ),
        ),
        r"does not depend on particles\.increment",
    ),
    # conditions and numbers
    "bc on another background": (problem(bcs=foreign_condition), r"not on the background space V"),
    "bc on the body": (problem(bcs=condition_on_the_body), r"not on the background space V"),
    "bc is none": (problem(bcs=["left"]), r"Dirichlet"),
    "bcs is one bc": (
        problem(bcs=lambda p: scenes.fix(p.V, scenes.at(0, -1.0))),
        r"Dirichlet|bcs",
    ),
    "shift of one": (problem(shift=1.0), r"shift must be .* not 1\.0"),
    "negative shift": (problem(shift=-1e-13), r"shift must be .* not -1e-13"),
    "shift nan": (problem(shift=np.nan), r"shift must be .* not nan"),
    "dependent dofs of a stabilised problem": (
        problem(dependent_dofs="remove", stabilisation="ghost"),
        r"dependent_dofs='remove' is for a background of degree 1 without stabilisation",
    ),
    "dependent dofs": (problem(dependent_dofs="keep"), r"dependent_dofs='keep'"),
    "no shift": (problem(shift=None), r"shift must be .* not None"),
    "no steps": (run(steps=0), r"number of steps.*not 0"),
    "steps backwards": (run(steps=-3), r"number of steps.*not -3"),
    "half steps": (run(steps=2.5), r"number of steps.*not 2\.5"),
    "steps in words": (run(steps="ten"), r"number of steps.*not 'ten'"),
    "reaction": (
        lambda: (p := scenes.block()).reaction(scenes.fix(p.particles.V, scenes.at(0, 0.0))),
        r"one of the Dirichlet conditions of this problem",
    ),
    "stress of a UFL problem": (lambda: ufl_problem(work)().particles.stress, r"no material"),
    "plastic strain of a UFL problem": (
        lambda: ufl_problem(work)().particles.plastic_strain,
        r"no material",
    ),
    # materials
    "material of no particles": (
        lambda: mpm.QuasiStaticProblem(body(), Hencky(1.0, 0.0)),
        r"mpm\.Particles.* not Mesh",
    ),
    "material in words": (problem("steel"), r"material must be .* not str"),
    "materials in a list": (problem([Hencky(1.0, 0.0)]), r"material must be .* not list"),
    "materials without tags": (problem({1: Hencky(1.0, 0.0)}), r"needs cell_tags="),
    "materials with tags of facets": (
        problem({1: Hencky(1.0, 0.0)}, cell_tags=tags_of_facets),
        r"needs cell_tags=",
    ),
    "a tag without material": (
        problem({1: Hencky(1.0, 0.0)}, cell_tags=tags_of_cells),
        r"cell tags? .*material",
    ),
    "no materials": (problem({}, cell_tags=tags_of_cells), r"material"),
    "parameter on another mesh": (problem(parameter(0, own=False)), r"young must be a scalar DG0"),
    "parameter at nodes": (problem(parameter(1)), r"young must be a scalar DG0"),
    "parameter of two numbers": (problem(parameter(0, (2,))), r"young must be a scalar DG0"),
    "too many values": (problem(values(1)), r"young has \d+ values for \d+ particles"),
    "too few values": (problem(values(-1)), r"young has \d+ values for \d+ particles"),
    # loads
    "negative density": (problem(density=-1.0, body_force=(0.0, -1.0)), r"density must not be"),
    "density nan": (problem(density=np.nan, body_force=(0.0, -1.0)), r"density must be finite"),
    "density in words": (problem(density="heavy", body_force=(0.0, -1.0)), r"density must be num"),
    "density of two numbers": (
        problem(density=(1.0, 2.0), body_force=(0.0, -1.0)),
        r"density has the shape \(2,\), but must have \(\)",
    ),
    "F-bar that does not exist": (problem(f_bar="cell"), r"Unknown f_bar=.cell."),
    "negative density without a force": (problem(density=-1.0), r"density must not be"),
    "force of three numbers": (problem(body_force=(0.0, 0.0, -1.0)), r"body_force has the shape"),
    "force of a number": (problem(body_force=-9.81), r"body_force has the shape"),
    "infinite force": (problem(body_force=(0.0, -np.inf)), r"body_force must be finite"),
    "force in words": (problem(body_force="down"), r"body_force must be numbers"),
    "force on another mesh": (
        problem(body_force=lambda p: fem.Constant(p.V.mesh, np.ones(2))),
        r"body_force lives on another mesh",
    ),
    "density on another mesh": (
        problem(
            density=lambda p: fem.Function(fem.functionspace(body(), ("DG", 0))),
            body_force=(0.0, -1.0),
        ),
        r"density lives on another mesh",
    ),
    "traction without tags": (problem(tractions=[((1.0, 0.0), 1)]), r"tractions need facet_tags="),
    "traction with tags of cells": (
        problem(tractions=[((1.0, 0.0), 1)], facet_tags=tags_of_cells),
        r"tractions need facet_tags=",
    ),
    "traction on no facet": (
        problem(tractions=[((1.0, 0.0), 9)], facet_tags=tags_of_facets),
        r"tag.*(\[1\].*\b9\b|\b9\b.*\[1\])",
    ),
    "traction of a number": (
        problem(tractions=[(1.0, 1)], facet_tags=tags_of_facets),
        r"a traction has the shape",
    ),
    "traction nan": (
        problem(tractions=[((np.nan, 0.0), 1)], facet_tags=tags_of_facets),
        r"a traction must be finite",
    ),
    # supports
    "supports in words": (problem(supports=["floor"]), r"supports must be a list of supports"),
    "one support, no list": (
        problem(supports=lambda p: mpm.boundary.fixed(p, tags_of_facets(p), 1)),
        r"supports must be a list",
    ),
    "support of another body": (foreign_support, r"made with other particles"),
    "support of no body": (lambda: mpm.boundary.fixed("body", None, 1), r"mpm\.Particles, not str"),
    "roller of no body": (lambda: mpm.boundary.roller(1, None, 1, (0, 1)), r"Particles, not int"),
    "support without modulus": (support_without_modulus, r"needs modulus="),
    "negative modulus": (held("fixed", modulus=-1.0), r"modulus must be positive"),
    "modulus nan": (held("fixed", modulus=np.nan), r"modulus must be finite"),
    "no direction": (held("roller", normal=(0.0, 0.0)), r"normal must not be zero"),
    "direction of three numbers": (held("roller", normal=(0.0, 1.0, 0.0)), r"normal has the shape"),
    "direction nan": (held("roller", normal=(0.0, np.nan)), r"normal must be finite"),
    "displacement of two numbers": (
        held("roller", normal=(0.0, 1.0), value=(1.0, 2.0)),
        r"value has the shape",
    ),
    "displacement of one number": (held("fixed", value=1.0), r"value has the shape"),
    "no penalty": (held("fixed", penalty=0.0), r"penalty must be a positive number, not 0\.0"),
    "penalty in words": (held("fixed", penalty="stiff"), r"penalty must be a positive number"),
    "support on no facet": (held("fixed", tag=9), r"no facet tag 9; there are \[1\]"),
    "support without tags": (held("fixed", facet_tags=None), r"Supports need facet_tags="),
    "support on cells": (held("fixed", facet_tags=tags_of_cells), r"Supports need facet_tags="),
    "point of a plane in words": (
        held("plane", point="origin", normal=(0.0, 1.0)),
        r"point must be numbers",
    ),
    "traction is no pair": (
        problem(tractions=[(1.0, 0.0, 1)], facet_tags=tags_of_facets),
        r"traction",
    ),
}


@pytest.mark.parametrize("case", PROBLEMS)
def test_problems(case):
    build, sentence = PROBLEMS[case]
    raises(build, mpm.MPMError, sentence)


def test_condition_that_is_not_a_number():
    V = scenes.block().particles.V
    bc = scenes.fix(V, scenes.at(0, 0.0), np.array([np.nan, 0.0]))
    failed = scenes.block(bcs=[])
    failed = mpm.QuasiStaticProblem(
        mpm.Particles(scenes.unit(2, TRIANGLE), V), Hencky(1e3, 0.3), bcs=[bc]
    )
    kept = scenes.state(failed)
    error = raises(lambda: failed.solve(steps=2), mpm.MPMError, r"Dirichlet.*finite")
    assert error.load == 0.0
    scenes.assert_same_state(kept, scenes.state(failed))


def test_load_that_is_not_a_number():
    failed = scenes.block()
    failed.particles.load.value = np.nan
    raises(failed.step, mpm.ConvergenceError, r"finite")
    assert float(failed.particles.load.value) == 0.0
    failed.solve(steps=1)


MATERIALS = {
    "young 0": (lambda: Hencky(0.0, 0.3), r"young is 0"),
    "young negative": (lambda: LinearElastic(-1.0, 0.3), r"young is -1"),
    "young nan": (lambda: Hencky(np.nan, 0.3), r"young is nan"),
    "young infinite": (lambda: Hencky(np.inf, 0.3), r"young is inf"),
    "young in words": (lambda: Hencky("soft", 0.3), r"young must be a number"),
    "poisson 0.5": (lambda: Hencky(1.0, 0.5), r"poisson is 0\.5"),
    "poisson 0.7": (lambda: LinearElastic(1.0, 0.7), r"poisson is 0\.7"),
    "poisson -1": (lambda: VonMises(1.0, -1.0, rho_y=1.0), r"poisson is -1"),
    "rho_y 0": (lambda: VonMises(1.0, 0.3, rho_y=0.0), r"rho_y is 0"),
    "yield_stress negative": (lambda: VonMises(1.0, 0.3, yield_stress=-2.0), r"yield_stress is"),
    "no strength": (lambda: VonMises(1.0, 0.3), r"exactly one of rho_y and yield_stress"),
    "two strengths": (
        lambda: VonMises(1.0, 0.3, rho_y=1.0, yield_stress=1.0),
        r"exactly one of rho_y and yield_stress",
    ),
    "softening": (lambda: VonMises(1.0, 0.3, rho_y=1.0, hardening=-1.0), r"hardening is -1"),
    "one bad value of many": (
        lambda: Hencky(np.array([1.0, -3.0]), 0.3).initial_state(2, 2),
        r"young is -3",
    ),
    "no number among many": (
        lambda: Hencky(1.0, np.array([0.3, np.nan])).initial_state(2, 2),
        r"poisson is nan",
    ),
    "a table of values": (lambda: Hencky(np.ones((2, 2)), 0.3), r"young .*not 2-D"),
}


@pytest.mark.parametrize("case", MATERIALS)
def test_materials(case):
    build, sentence = MATERIALS[case]
    raises(build, mpm.MPMError, sentence)


# -- Errors of one rank ------------------------------------------------------------------


def far_corner(scale):
    """Return a body of triangles, one corner of which is moved out by a factor."""
    domain = scenes.unit(4, TRIANGLE)
    x = domain.geometry.x
    x[(x[:, 0] > 0.9) & (x[:, 1] > 0.9), :2] *= scale
    return domain


def touching(domain, where):
    """Return the input indices of all cells with a vertex where a marker holds."""
    vertices = domain.geometry.x[_compat.geometry_dofmap(domain)]
    count = domain.topology.index_map(2).size_local
    mine = np.flatnonzero(where(vertices[:count]).any(axis=1))
    index = domain.topology.original_cell_index[mine]
    return sorted(int(i) for i in scenes.gather(index))


def test_one_particle_outside():
    domain = far_corner(3.0)
    expected = touching(domain, lambda x: x[..., 0] > 2.0)
    assert 1 <= len(expected) <= 2
    error = raises(
        lambda: mpm.Particles(domain, scenes.vectors(background())),
        mpm.ParticleOutsideError,
        r"outside the background mesh",
    )
    assert error.particles == expected
    for p in expected:
        assert str(p) in str(error)


def test_one_flat_domain():
    # A corner of the body is moved onto the diagonal of its cell.
    domain = mesh.create_rectangle(
        WORLD, [[0.0, 0.0], [1.0, 1.0]], [4, 4], TRIANGLE, diagonal=mesh.DiagonalType.left
    )
    x = domain.geometry.x
    x[(x[:, 0] > 0.9) & (x[:, 1] > 0.9), :2] = [0.875, 0.875]
    expected = touching(domain, lambda x: np.isclose(x[..., 0], 0.875))
    assert len(expected) == 1
    error = raises(
        lambda: mpm.Particles(domain, scenes.vectors(background())),
        mpm.DomainDistortionError,
        r"have no volume",
    )
    assert error.particles == expected


class Touchy(Hencky):
    """A law that fails at points whose Young's modulus is 7."""

    def update(self, displacement_gradient, state, tangent=True):
        weak = np.flatnonzero(self.parameters["young"] == 7.0)
        if len(weak) and np.abs(displacement_gradient).max() > 0.0:
            raise mpm.ConvergenceError("The law failed", weak)
        return super().update(displacement_gradient, state, tangent)


@pytest.mark.parametrize("quadrature_degree", [None, 3])
def test_law_that_fails_at_one_particle(quadrature_degree):
    V = scenes.vectors(held_background())
    domain = scenes.unit(4, QUADRILATERAL)
    young = fem.Function(fem.functionspace(domain, ("DG", 0)))
    X = scenes.mesh.compute_midpoints(domain, 2, np.arange(len(young.x.array), dtype=np.int32))
    bad = (X[:, 0] > 0.75) & (X[:, 1] < 0.25)
    young.x.array[young.function_space.dofmap.list[: len(X), 0]] = np.where(bad, 7.0, 1e3)
    p = mpm.Particles(domain, V, quadrature_degree=quadrature_degree)
    failed = mpm.QuasiStaticProblem(
        p,
        Touchy(young, 0.3),
        body_force=(0.0, -1.0),
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
    )
    expected = [int(i) for i in scenes.gather(p.global_index[bad[: p.num_local]])]
    assert len(expected) == 1
    error = raises(
        lambda: failed.solve(steps=2), mpm.ConvergenceError, r"The law failed \(.*particle \d+\)"
    )
    assert error.particles == expected and error.load == 0.0
    assert f"particle {expected[0]}" in str(error)


class Broken(Hencky):
    """A law whose program has an error, on one rank and from some strain on."""

    def update(self, displacement_gradient, state, tangent=True):
        if WORLD.rank == WORLD.size - 1 and np.abs(displacement_gradient).max(initial=0.0) > 1e-3:
            raise ValueError("no such thing")
        return super().update(displacement_gradient, state, tangent)


def test_a_law_with_an_error_of_python():
    problem = scenes.block(material=Broken(1e3, 0.3), force=(0.0, -2.0))
    cause = r"update of Broken failed with ValueError: no such thing"
    raises(lambda: problem.solve(steps=1), mpm.MPMError, cause)
    assert problem.particles.load.value == 0.0 and not problem.history.steps
    assert not np.any(problem.particles.displacement.x.array)


def test_a_problem_with_an_error_of_python():
    class Wrong(mpm.ParticleProblem):
        def evaluate(self):
            if self.particles.load.value > 0.5 and WORLD.rank == WORLD.size - 1:
                raise KeyError("history")

    p = mpm.Particles(body(), scenes.vectors(held_background()))
    d, v = p.displacement, ufl.TestFunction(p.W)
    R = ufl.inner(scenes.linear_stress(d, 1e3, 0.3), ufl.grad(v)) * p.dx
    R -= p.load * v[1] * p.dx_exact
    problem = Wrong(R, p, bcs=[scenes.fix(p.V, scenes.at(0, 0.0))])
    raises(lambda: problem.solve(steps=2), mpm.MPMError, r"evaluate\(\) failed with KeyError")
    assert problem.history.load == [0.5] and p.load.value == 0.5


@pytest.mark.parametrize("held", [None, 0, 1])
def test_a_body_that_nothing_holds(held):
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    bcs = [] if held is None else [scenes.fix(V, scenes.at(held, 0.0), component=held)]
    problem = mpm.QuasiStaticProblem(
        mpm.Particles(scenes.unit(4, TRIANGLE), V), Hencky(1e3, 0.3), bcs=bcs, body_force=(1.0, 1.0)
    )
    raises(lambda: problem.solve(steps=1), mpm.MPMError, r"nothing holds the bodies; support each")
    assert not problem.history.steps and not np.any(problem.particles.displacement.x.array)


def test_what_is_held_softly_is_held():
    # Slender, one cell thick: bending has an eigenvalue some 1e-11 times that of a single cell.
    V = scenes.vectors(scenes.box([0.0, 0.0], [600.0, 3.0], [600, 3], QUADRILATERAL))
    beam = scenes.box([0.0, 1.0], [600.0, 2.0], [600, 1], QUADRILATERAL)
    problem = mpm.QuasiStaticProblem(
        mpm.Particles(beam, V, quadrature_degree=2),
        LinearElastic(1e3, 0.0),
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
        body_force=(0.0, -1e-10),
    )
    problem.solve(steps=1)
    np.testing.assert_allclose(problem.reaction(problem.bcs[0]), [0.0, 6e-8], rtol=1e-6, atol=1e-12)


def test_a_snes_with_a_test_of_its_own():
    options = {"snes_type": "ksponly"}
    problem = scenes.block(petsc_options=options)
    raises(lambda: problem.solve(steps=1), mpm.MPMError, r"SNES 'ksponly' ended by a test of its")


def test_tags_of_another_mesh_or_of_no_boundary():
    p, other = particles(), scenes.unit(3, TRIANGLE)
    tags = scenes.facet_tags(other, scenes.at(0, 1.0))
    loads = [((1.0, 0.0), 1)]

    def made(facets):
        return lambda: mpm.QuasiStaticProblem(
            p, Hencky(1e3, 0.3), tractions=loads, facet_tags=facets
        )

    raises(made(tags), mpm.MPMError, r"of the body's mesh, not of another one")
    inner = scenes.mesh.locate_entities(p.mesh, 1, scenes.at(0, 0.5)).astype(np.int32)
    inside = scenes.mesh.meshtags(p.mesh, 1, np.sort(inner), np.full(len(inner), 1, np.int32))
    raises(made(inside), mpm.MPMError, r"facets on the boundary, among \[\]")


def test_outside_is_said_by_a_corner_that_is():
    V = scenes.vectors(scenes.box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL))
    domain = scenes.box([0.5, 0.0], [1.25, 0.5], [1, 1], QUADRILATERAL)
    raises(lambda: mpm.Particles(domain, V), mpm.ParticleOutsideError, r"at \(1\.25, 0\.[05]\)")


def with_one_value(p, all_others, first):
    """Return a DG0 Function that is ``first`` in particle 0 and ``all_others`` elsewhere."""
    function = fem.Function(fem.functionspace(p.mesh, ("DG", 0)))
    function.x.array[:] = all_others
    mine = np.flatnonzero(p.global_index == 0)
    function.x.array[function.function_space.dofmap.list[mine, 0]] = first
    return function


def test_one_parameter_out_of_range():
    # Only the rank that owns the particle sees that its modulus is negative.
    young = with_one_value(particles(), 1e3, -1.0)
    raises(lambda: Hencky(young, 0.3), mpm.MPMError, r"young is -1")


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("young", -1.0, "young is -1 but"),
        ("yield_stress", np.nan, "yield_stress is nan but"),
        ("hardening", -2.0, "hardening is -2 but"),
    ],
)
def test_one_value_out_of_range_in_arrays_of_the_ranks(name, value, match):
    p = particles()
    values = np.full(p.num_local, 1e3)
    values[p.global_index == 0] = value
    parameters = {"young": 1e3, "yield_stress": 1.0, name: values}
    raises(
        lambda: mpm.QuasiStaticProblem(p, VonMises(poisson=0.3, **parameters)), mpm.MPMError, match
    )


def test_one_array_of_another_length():
    p = particles()
    young = np.full(p.num_local + (WORLD.rank == WORLD.size - 1), 1e3)
    raises(lambda: mpm.QuasiStaticProblem(p, Hencky(young, 0.3)), mpm.MPMError, "young has")


def test_one_negative_density():
    p = particles()
    density = with_one_value(p, 1.0, -3.0)
    raises(
        lambda: mpm.QuasiStaticProblem(p, Hencky(1e3, 0.3), density=density),
        mpm.MPMError,
        "density must not be negative, not -3",
    )


@pytest.mark.parametrize("wrong", [np.nan, 99.0, "shape", "text"])
def test_one_box_that_is_wrong(wrong):
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 4.0], [8, 8], QUADRILATERAL))
    x = np.array([[0.5 + 0.25 * WORLD.rank, 0.5], [0.5 + 0.25 * WORLD.rank, 0.75]])
    if WORLD.rank == WORLD.size - 1:
        if isinstance(wrong, float):
            x[1, 0] = wrong
        else:
            x = x[:, :1] if wrong == "shape" else "text"
    kind, match = mpm.MPMError, "points must be finite and of shape"
    if wrong == 99.0:
        kind, match = mpm.ParticleOutsideError, f"particle {2 * WORLD.size - 1} "
    raises(lambda: mpm.Particles.from_points(x, 0.25, V), kind, match)


class Unsendable(Exception):
    """An error that cannot be made again from its arguments."""

    def __init__(self, table, place):
        super().__init__(f"There is no {table} in {place}.")


@pytest.mark.parametrize(
    "error", [mpm.MPMError("No table."), ValueError("No table."), Unsendable("table", "here")]
)
def test_path_that_fails_on_one_rank(error):
    problem = scenes.block()
    last = WORLD.rank == WORLD.size - 1

    def path(t):
        if t > 0.5 and last:
            raise error

    kind = RuntimeError if isinstance(error, Unsendable) and not last else type(error)
    with pytest.raises(kind, match=r"[Nn]o table") as caught:
        problem.solve(2, update=path)
    if not isinstance(error, Unsendable):
        assert len(set(WORLD.allgather(str(caught.value)))) == 1
    # The state is that of the last converged step.
    assert problem.history.load == [0.5] and problem.particles.load.value == 0.5
    problem.solve(2)
    assert problem.history.load[-1] == 1.0


def test_errors_are_runtime_errors_with_particles_and_load():
    kinds = (mpm.ParticleOutsideError, mpm.DomainDistortionError, mpm.ConvergenceError)
    for kind in kinds:
        error = kind("It failed.", np.array([3, 1], dtype=np.int64), 0.5)
        assert isinstance(error, mpm.MPMError) and isinstance(error, RuntimeError)
        assert error.particles == [1, 3] and error.load == 0.5
        assert [type(p) for p in error.particles] == [int, int]
    assert mpm.MPMError("No.").particles == [] and mpm.MPMError("No.").load is None
