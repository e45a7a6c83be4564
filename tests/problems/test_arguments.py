# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bad input: one clear sentence of ours, the same on every rank."""

import copy

import numpy as np
import pytest
import scenes
from bad_input import (
    background,
    body,
    held,
    held_background,
    particles,
    problem,
    tags_of_facets,
    tie,
    values,
)
from compare import raises
from posed import posed
from scenes import TRIANGLE, WORLD

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky


def ufl_problem(write, **options):
    """Return a function that makes a problem of ``write(particles, d, v)``."""

    def build():
        p = particles()
        R = write(p, p.displacement, ufl.TestFunction(p.W))
        more = {k: f(p) for k, f in options.items()}
        return posed(mpm.ParticleProblem, R, p, **more)

    return build


def work(p, d, v):
    return ufl.inner(ufl.grad(d), ufl.grad(v)) * p.dx


def pulled(measure):
    """Return a residual with a force on what a function of the particles measures."""
    return lambda p, d, v: work(p, d, v) + v[0] * measure(p)


def tags_of_the_background(p):
    return scenes.facet_tags(p.V.mesh, scenes.at(0, -1.0))


def on_boundary(tags):
    """Return a function that makes the measure ds of a body, with tags."""
    return lambda p: ufl.Measure("ds", domain=p.mesh, subdomain_data=tags(p))


def foreign_condition(p):
    return [scenes.fix(scenes.vectors(background()), scenes.at(0, -1.0))]


def condition_on_the_body(p):
    return [scenes.fix(p.W, scenes.at(0, 0.0))]


def tags_of_cells(p):
    return scenes.cell_tags(p.mesh, lambda x: np.where(x[:, 0] < 0.5, 1, 2))


def parameter(degree, shape=(), own=True):
    """Return a function that makes a law whose parameter is a Function."""

    def law(p):
        domain = p.mesh if own else body()
        kind = "DG" if degree == 0 else "Lagrange"
        young = fem.Function(fem.functionspace(domain, (kind, degree, shape)))
        young.x.array[:] = 1e3
        return Hencky(young, 0.3)

    return law


def foreign_support():
    p = particles()
    support = mpm.boundary.fixed(p, tags_of_facets(p), 1)
    return mpm.QuasiStaticProblem(mpm.Body(particles(), Hencky(1e3, 0.3)), supports=[support])


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
        r"residual R integrates over another mesh than particles\.mesh",
    ),
    "R tested in another space of the body": (
        ufl_problem(
            lambda p, d, v: (
                ufl.div(d) * ufl.TestFunction(fem.functionspace(p.mesh, ("Lagrange", 1))) * p.dx
            )
        ),
        r"test.* the residual R must be from",
    ),
    "R on tags of the background": (
        ufl_problem(pulled(lambda p: on_boundary(tags_of_the_background)(p)(1))),
        r"residual R integrates over ds with tags of another mesh; make them on particles\.mesh",
    ),
    "R on all of ds with tags of the background": (
        ufl_problem(pulled(on_boundary(tags_of_the_background))),
        r"residual R integrates over ds with tags of another mesh",
    ),
    "R on tags of cells": (
        ufl_problem(pulled(lambda p: on_boundary(tags_of_cells)(p)(1))),
        r"over ds with tags of dimension 2, but needs tags of dimension 1",
    ),
    "R on a tag that no facet has": (
        ufl_problem(pulled(lambda p: on_boundary(tags_of_facets)(p)(9))),
        r"over ds\(9\), but nothing on the boundary has the tag 9; there are \[1\]",
    ),
    "R on two tags of which no facet has one": (
        ufl_problem(pulled(lambda p: on_boundary(tags_of_facets)(p)((1, 9)))),
        r"nothing on the boundary has the tag 9; there are \[1\]",
    ),
    "R on a tag without tags": (
        ufl_problem(pulled(lambda p: ufl.ds(3))),
        r"nothing on the boundary has the tag 3; its measure has none",
    ),
    "R on a tag of facets inside": (
        ufl_problem(
            pulled(
                lambda p: on_boundary(lambda p: scenes.facet_tags(p.mesh, scenes.at(0, 0.5)))(p)(1)
            )
        ),
        r"nothing on the boundary has the tag 1",
    ),
    "background form on tags of the body": (
        ufl_problem(
            work,
            background=lambda p: (
                ufl.inner(p.increment, ufl.TestFunction(p.V))
                * ufl.Measure("ds", domain=p.V.mesh, subdomain_data=tags_of_facets(p))(1)
            ),
        ),
        r"background form integrates over ds with tags of another mesh",
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
    "line search in words": (problem(line_search="yes"), r"line_search must be True or False"),
    "no predictor": (problem(predictor=None), r"predictor must be True or False, not None"),
    "options in a list": (problem(petsc_options=["a"]), r"petsc_options must be a dictionary"),
    "options by numbers": (problem(petsc_options={1: 2}), r"petsc_options must be a dictionary"),
    "prefix": (problem(petsc_options_prefix=3), r"petsc_options_prefix must be a string, not 3"),
    "compiler options": (problem(form_compiler_options=3), r"form_compiler_options must be a dict"),
    "jit options": (problem(jit_options="a"), r"jit_options must be a dictionary of options"),
    "mixed in an array": (problem(mixed=np.ones(2)), r"Unknown mixed=array"),
    "no shift": (problem(shift=None), r"shift must be .* not None"),
    "no steps": (run(steps=0), r"steps must be a whole number .*not 0"),
    "steps backwards": (run(steps=-3), r"steps must be a whole number .*not -3"),
    "half steps": (run(steps=2.5), r"steps must be a whole number .*not 2\.5"),
    "steps in words": (run(steps="ten"), r"steps must be a whole number .*not 'ten'"),
    "reaction": (
        lambda: (p := scenes.block()).reaction(scenes.fix(p.particles.V, scenes.at(0, 0.0))),
        r"one of the Dirichlet conditions of this problem",
    ),
    "stress of a UFL problem": (lambda: ufl_problem(work)().particles.stress, r"no material"),
    "plastic strain of a UFL problem": (
        lambda: ufl_problem(work)().particles.plastic_strain,
        r"no material",
    ),
    "PC of no kind": (
        problem(petsc_options={"pc_type": "foo"}),
        r"PETSc refuses an option of the problem: .*requested PC type foo; correct petsc_options=",
    ),
    "KSP of no kind": (problem(petsc_options={"ksp_type": "foo"}), r"requested KSP type foo"),
    "SNES of no kind": (problem(petsc_options={"snes_type": "foo"}), r"requested SNES type foo"),
    "solver of no kind": (
        problem(petsc_options={"pc_factor_mat_solver_type": "foo"}),
        r"Could not locate solver type foo for factorization type CHOLESKY",
    ),
    "tolerance in words": (
        problem(petsc_options={"snes_rtol": "small"}),
        r"snes_rtol of petsc_options= must be a number of at least 0 and below 1, not 'small'",
    ),
    "negative tolerance": (problem(petsc_options={"snes_rtol": -1}), r"below 1, not -1"),
    "negative size": (problem(petsc_options={"snes_atol": -1.0}), r"at least 0, not -1\.0"),
    "no iterations": (problem(petsc_options={"snes_max_it": 0}), r"at least 1, not 0"),
    "tolerance that nobody reads": (problem(petsc_options={"ksp_rtol": "x"}), r"ksp_rtol.* 'x'"),
    "path that is a number": (lambda: scenes.block().write(3), r"path must be the name of a file"),
    "checkpoint without name": (lambda: scenes.block().save(None), r"path must be .* not None"),
    "checkpoint of a number": (lambda: scenes.block().restore(1.0), r"path must be .* not 1\.0"),
    "stage of no name": (lambda: scenes.block().stage([]), r"name of a stage must be a string"),
    "half sudden": (lambda: scenes.block().stage(sudden=0), r"sudden of stage\(\) .* not 0"),
    "body of many": (
        lambda: scenes.block().remove([0], body=np.ones(2)),
        r"There is no body array",
    ),
    "steps that are true": (run(steps=True), r"steps must be a whole number .*not True"),
    "a bar of nothing": (
        run(progress=None),
        r"progress of solve\(\) must be True or False, not None",
    ),
    "half symmetric": (
        ufl_problem(work, symmetric=lambda p: "yes"),
        r"symmetric of ParticleProblem\(\) must be True or False, not 'yes'",
    ),
    "half a run": (
        lambda: scenes.block().restore("run.ckpt", resume=1),
        r"resume of restore\(\) must be True or False, not 1",
    ),
    "a time that is true": (
        lambda: scenes.block().write("run.pvd", time=True),
        r"time must be a finite number, not True",
    ),
    "a huge whole number of permeability": (
        lambda: mpm.PoreFluid(-(10**30)),
        r"permeability of a PoreFluid must be positive",
    ),
    "a storage that is true, among others": (
        problem(body_force=(True, -1.0)),
        r"body_force must be 2 finite numbers",
    ),
    "indices that are true": (
        lambda: scenes.block().split([True]),
        r"global indices, whole numbers, not \[True\]",
    ),
    "removed by truths": (
        lambda: scenes.block().remove([True, False]),
        r"whole numbers, or a function of coordinates, not \[True, False\]",
    ),
    "half a truth": (
        lambda: scenes.block().repartition(True),
        r"threshold must be a share from 0 to 1, not True",
    ),
    # kinds
    "condition on nothing": (
        lambda: mpm.held(None, x=0.0),
        r"V of held\(\) must be fem\.FunctionSpace, not None",
    ),
    "condition on particles": (lambda: mpm.held(particles(), x=0.0), r"V of held\(\) must be fem"),
    "component that is true": (
        lambda: mpm.held(particles().V, True, x=-1.0),
        r"There is no component True",
    ),
    "plane that is true": (lambda: mpm.held(particles().V, x=True), r"x= must be a number"),
    "value that is true": (
        lambda: mpm.held(particles().V, x=-1.0, value=True),
        r"value= must be 2 finite numbers",
    ),
    "tags of nothing": (
        lambda: mpm.facet_tags(None, {1: mpm.region(x=0.0)}),
        r"domain of facet_tags\(\) must be mesh\.Mesh, not None",
    ),
    "facets inside in words": (
        lambda: mpm.facet_tags(body(), {1: mpm.region(x=0.0)}, interior="no"),
        r"interior of facet_tags\(\) must be True or False, not 'no'",
    ),
    "field of a kind that is an array": (
        lambda: mpm.ParticleField(p := particles(), scenes.vectors(p.V.mesh), kind=np.ones(2)),
        r"kind of ParticleField\(\) must be str, not array\(\[1\., 1\.\]\)",
    ),
    # bodies
    "particles twice by a copy": (lambda: copy.copy(particles()), r"Particles cannot be copied"),
    "particles twice by a deep one": (
        lambda: copy.deepcopy(particles()),
        r"Particles cannot be copied",
    ),
    "a problem twice": (lambda: copy.copy(scenes.block()), r"A problem cannot be copied"),
    "a rule of too many points": (
        lambda: particles(quadrature_degree=99),
        r"quadrature_degree must be a whole number from 0 to 30, not 99",
    ),
    "a rule that is true": (lambda: particles(quadrature_degree=True), r"from 0 to 30, not True"),
    "a degree that is true": (lambda: particles(degree=True), r"degree must be 1, 2 or 3, not T"),
    "a tie of negative degree": (
        tie(quadrature_degree=-2),
        r"of a Tie must be .* not -2",
    ),
    "a tie of half a degree": (tie(quadrature_degree=1.5), r"of a Tie must be .* not 1\.5"),
    "a tie around a word": (tie(axisymmetric="r"), r"axisymmetric of Tie\(\) .* not 'r'"),
    "ordering of no kind": (
        lambda: scenes.block(
            petsc_options={
                "pc_type": "lu",
                "pc_factor_mat_solver_type": "petsc" if WORLD.size == 1 else "foo",
                "pc_factor_mat_ordering_type": "foo",
            }
        ).solve(steps=1),
        r"PETSc refuses an option of the problem: .*foo.*; correct petsc_options=",
    ),
    # materials
    "negative modulus put in place": (
        lambda: Hencky(1e3, 0.3).with_parameters(young=-1),
        r"young is -1 but must be finite, greater than 0",
    ),
    "modulus in words put in place": (
        lambda: Hencky(1e3, 0.3).with_parameters(young="stiff"),
        r"young must be a finite number",
    ),
    "misspelt parameter": (
        lambda: Hencky(1e3, 0.3).with_parameters(yuong=1.0),
        r"A Hencky has no parameter 'yuong'; there are poisson, young",
    ),
    "modulus that is true": (lambda: Hencky(True, 0.3), r"young must be a finite number"),
    "material of no particles": (
        lambda: mpm.QuasiStaticProblem(mpm.Body(body(), Hencky(1.0, 0.0))),
        r"mpm\.Particles, not of a Mesh",
    ),
    "material in words": (problem("steel"), r"material must be .* not str"),
    "materials in a list": (problem([Hencky(1.0, 0.0)]), r"material must be .* not list"),
    "materials without tags": (problem({1: Hencky(1.0, 0.0)}), r"needs cell_tags="),
    "materials with tags of facets": (
        problem({1: Hencky(1.0, 0.0)}, cell_tags=tags_of_facets),
        r"tags of a material must be those of cells",
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
    "density nan": (
        problem(density=np.nan, body_force=(0.0, -1.0)),
        r"density must be a finite number",
    ),
    "density in words": (
        problem(density="heavy", body_force=(0.0, -1.0)),
        r"density must be a finite number",
    ),
    "density of two numbers": (
        problem(density=(1.0, 2.0), body_force=(0.0, -1.0)),
        r"density has the shape \(2,\), but must have \(\)",
    ),
    "F-bar that does not exist": (problem(f_bar="cell"), r"Unknown f_bar=.cell."),
    "density in UFL that is negative somewhere": (
        problem(density=lambda p: ufl.SpatialCoordinate(p.mesh)[0] - 0.5),
        r"density must not be negative, not -0\.\d+ \(at particles ",
    ),
    "Constant density that is negative": (
        problem(density=lambda p: fem.Constant(p.mesh, -2.0)),
        r"density must not be negative, not -2 \(at particles 0, 1,",
    ),
    "density in UFL that is no number": (
        problem(density=lambda p: ufl.sqrt(ufl.SpatialCoordinate(p.mesh)[0] - 2.0)),
        r"density must not be negative, not nan",
    ),
    "negative density without a force": (problem(density=-1.0), r"density must not be"),
    "force of three numbers": (problem(body_force=(0.0, 0.0, -1.0)), r"body_force has the shape"),
    "force of a number": (problem(body_force=-9.81), r"body_force has the shape"),
    "infinite force": (problem(body_force=(0.0, -np.inf)), r"body_force must be 2 finite numbers"),
    "force in words": (problem(body_force="down"), r"2 finite numbers, .* not 'down'"),
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
    "traction without tags": (
        problem(tractions=[((1.0, 0.0), 1)]),
        r"A tag of tractions needs facet_tags=",
    ),
    "traction with tags of cells": (
        problem(tractions=[((1.0, 0.0), 1)], facet_tags=tags_of_cells),
        r"must be those of facets of the present body mesh",
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
        r"a traction must be 2 finite numbers",
    ),
    # supports
    "supports in words": (problem(supports=["floor"]), r"supports must be a list of supports"),
    "one support, no list": (
        problem(supports=lambda p: mpm.boundary.fixed(p, tags_of_facets(p), 1)),
        r"supports must be a list",
    ),
    "support twice": (
        problem(supports=lambda p: [mpm.boundary.fixed(p, tags_of_facets(p), 1)] * 2),
        r"stands twice in supports",
    ),
    "support of another body": (foreign_support, r"made with other particles"),
    "support of no body": (lambda: mpm.boundary.fixed("body", None, 1), r"mpm\.Particles, not str"),
    "roller of no body": (lambda: mpm.boundary.roller(1, None, 1, (0, 1)), r"Particles, not int"),
    "support without modulus": (support_without_modulus, r"needs modulus="),
    "negative modulus": (held("fixed", modulus=-1.0), r"modulus must be positive"),
    "modulus nan": (held("fixed", modulus=np.nan), r"modulus must be a finite number"),
    "no direction": (held("roller", normal=(0.0, 0.0)), r"normal must not be zero"),
    "direction of three numbers": (held("roller", normal=(0.0, 1.0, 0.0)), r"normal has the shape"),
    "direction nan": (held("roller", normal=(0.0, np.nan)), r"normal must be 2 finite numbers"),
    "displacement of two numbers": (
        held("roller", normal=(0.0, 1.0), value=(1.0, 2.0)),
        r"value has the shape",
    ),
    "displacement of one number": (held("fixed", value=1.0), r"value has the shape"),
    "no penalty": (held("fixed", penalty=0.0), r"penalty must be a positive number, not 0\.0"),
    "penalty that is true": (held("fixed", penalty=True), r"penalty must be a positive.*True"),
    "penalty in words": (held("fixed", penalty="stiff"), r"penalty must be a positive number"),
    "support on no facet": (held("fixed", tag=9), r"has the tag 9 of supports; there are \[1\]"),
    "support without tags": (
        held("fixed", facet_tags=None),
        r"A tag of supports needs facet_tags=",
    ),
    "support on cells": (
        held("fixed", facet_tags=tags_of_cells),
        r"must be those of facets of the present body mesh",
    ),
    "complex force": (problem(body_force=(0.0, 1j)), r"body_force must be 2 finite numbers"),
    "force of UFL of several shapes": (
        problem(body_force=lambda p: (0.0, fem.Constant(p.mesh, np.ones(2)))),
        r"body_force must be 2 finite numbers",
    ),
    "tractions in a zip": (
        problem(tractions=zip([(1.0, 0.0)], [1], strict=True), facet_tags=tags_of_facets),
        r"tractions must be a list of pairs.*not <zip object>",
    ),
    "pressures of a generator": (
        problem(pressures=(load for load in [(1.0, 1)]), facet_tags=tags_of_facets),
        r"pressures must be a list of pairs.*not <generator",
    ),
    "tags in words": (problem(cell_tags="sand"), r"cell_tags must be dolfinx MeshTags, not str"),
    "an axis in words": (problem(axisymmetric="no"), r"axisymmetric of .* must be True or False"),
    "averages in an array": (problem(f_bar=np.zeros(2)), r"Unknown f_bar=array"),
    "background in words": (problem(background="soft"), r"background must be UFL forms, not str"),
    "traction is no pair": (
        problem(tractions=[(1.0, 0.0, 1)], facet_tags=tags_of_facets),
        r"traction",
    ),
}


@pytest.mark.parametrize("case", PROBLEMS)
def test_problems(case):
    build, sentence = PROBLEMS[case]
    raises(build, mpm.MPMError, sentence)


@pytest.mark.parametrize("what", ["body", "background"])
def test_mesh_of_single_precision(what):
    single = mesh.create_unit_square(WORLD, 2, 2, dtype=np.float32)
    double = mesh.create_unit_square(WORLD, 2, 2)
    given = {"body": double, "background": double} | {what: single}

    def build():
        element = basix.ufl.element(
            "Lagrange", "triangle", 1, shape=(2,), dtype=given["background"].geometry.x.dtype
        )
        mpm.Particles(given["body"], fem.functionspace(given["background"], element))

    raises(build, mpm.MPMError, "float32.*float64")


def test_law_that_does_not_say_whether_it_is_symmetric():
    class Silent(mpm.materials.StrainMaterial):
        def integrate(self, strain, variables):
            raise AssertionError("a law that is not known is not called")

    sentence = r"Silent does not say whether its tangent is symmetric; write symmetric = True"
    raises(problem(Silent()), mpm.MPMError, sentence)


def test_checkpoint_without_a_name():
    raises(lambda: scenes.block().save(""), mpm.MPMError, "name")


@pytest.mark.mpi
def test_body_on_ranks_in_another_order():
    turned = WORLD.Split(0, WORLD.size - WORLD.rank)
    V = scenes.vectors(background())
    raises(
        lambda: mpm.Particles(scenes.unit(2, TRIANGLE, turned), V),
        mpm.MPMError,
        "communicator",
    )
    turned.Free()


def test_older_of_two_problems():
    p = particles()
    older = mpm.QuasiStaticProblem(mpm.Body(p, Hencky(1e3, 0.3)))
    newer = mpm.QuasiStaticProblem(mpm.Body(p, Hencky(1e3, 0.3)))
    for call in (older.solve, older.step, older.rebase, lambda: older.write("a.pvd")):
        raises(call, mpm.MPMError, "^Another problem was made of these particles since")
    newer.solve(steps=1)
    raises(older.step, mpm.MPMError, "^Another problem was made of these particles since")


def test_cell_of_a_notebook_that_runs_again():
    def cell(p):
        bcs = [scenes.fix(p.V, scenes.at(0, 0.0))]
        again = mpm.QuasiStaticProblem(
            mpm.Body(p, Hencky(1e3, 0.3), body_force=(0.0, -9.0)), bcs=bcs
        )
        again.solve(steps=2)
        return again

    # The same particles: the second problem goes on from the displacement of the first one's end.
    V = scenes.vectors(held_background())
    p = mpm.Particles(body(), V)
    first = cell(p)
    assert len(first.history.steps) == 2
    raises(lambda: cell(p), mpm.MPMError, "^The whole load is applied already")
    # New particles, the names bound again: the same answer.
    before = scenes.own(p.displacement).copy()
    p = mpm.Particles(body(), V)
    first = cell(p)
    assert np.array_equal(scenes.own(p.displacement), before)


@pytest.mark.parametrize("kind", ["Constant", "Function", "UFL"])
def test_density_that_becomes_negative(kind):
    V = scenes.vectors(held_background())
    p = mpm.Particles(body(), V)
    held = fem.Constant(p.mesh, 2.0)
    given = held
    if kind == "Function":
        given = held = fem.Function(fem.functionspace(p.mesh, ("DG", 0)))
        held.x.array[:] = 2.0
    elif kind == "UFL":
        given = held * (1.0 + ufl.SpatialCoordinate(p.mesh)[0])

    def become(value):
        if kind == "Function":
            held.x.array[:] = value
        else:
            held.value = value

    bcs = [scenes.fix(V, scenes.at(0, 0.0))]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(p, Hencky(1e3, 0.3), density=given, body_force=(0.0, -1.0)), bcs=bcs
    )
    problem.solve(steps=1)
    weight = problem.reaction(bcs[0])[1]
    np.testing.assert_allclose(weight, 3.0 if kind == "UFL" else 2.0, rtol=1e-9)
    become(-1.0)
    raises(problem.step, mpm.MPMError, "^density must not be negative, not -")
    assert problem.reaction(bcs[0])[1] == weight
    become(1.0)
    problem.step()
    np.testing.assert_allclose(problem.reaction(bcs[0])[1], weight / 2.0, rtol=1e-9)


def test_a_path_or_a_stage_of_another_kind():
    made = held("fixed")()
    raises(lambda: made.solve(2, update=5), mpm.MPMError, r"update= is a function of t, not 5")
    raises(lambda: made.stage(sudden="no"), mpm.MPMError, r"sudden of .* must be True or False")
    raises(lambda: made.stage(name=5), mpm.MPMError, r"name of a stage must be a string")
    assert not made.history.stages
