# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives found by going backward, against those carried forward and differences of runs."""

from types import MappingProxyType

from mpi4py import MPI

import numpy as np
import pytest
from gradients.runs import EXACT, TOLERANCE, VON_MISES, Slump, Stacked, von_mises
from marks import all_but
from scenes import QUADRILATERAL, TRIANGLE, WORLD, box, in_order, vectors

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials


class Layered:
    """A block, stiffness and strength of which differ from cell to cell, pushed along its top."""

    def __init__(
        self,
        law="von Mises",
        cell=QUADRILATERAL,
        degree=1,
        f_bar="none",
        support=False,
        stabilisation="ghost",
        comm=WORLD,
        changes=None,
    ):
        V = vectors(box([0.0, -0.5], [2.0, 2.5], [6, 12], QUADRILATERAL, comm), degree)
        body = box([0.0, 0.0], [1.0, 2.0], [6, 12], cell, comm)
        self.particles = p = mpm.Particles(body, V, quadrature_degree=2 * degree, degree=degree)
        DG = fem.functionspace(body, ("DG", 0))

        def field(mean, phase):
            function = fem.Function(DG)
            function.interpolate(lambda x: mean * (1 + 0.1 * np.sin(7 * x[0] + 3 * x[1] + phase)))
            return function

        push = fem.Function(fem.functionspace(body, ("Lagrange", 1)))
        push.interpolate(lambda x: 300.0 + 50.0 * x[0])
        self.named = {"young": field(5e4, 0.0), "push": push, "weight": fem.Constant(body, 1e3)}
        if law != "Hencky":
            self.named["strength"] = field(1e3, 1.0)
        if law == "von Mises":
            self.named["hardening"] = fem.Constant(body, 2e3)
        for name, change in (changes or {}).items():
            self.values(name)[...] += change
        young, weight = self.named["young"], self.named["weight"]
        if law == "Hencky":
            made = materials.Hencky(young, 0.3)
        elif law == "von Mises":
            hardening = self.named["hardening"]
            made = materials.VonMises(
                young, 0.3, yield_stress=self.named["strength"], hardening=hardening
            )
        else:
            made = materials.MohrCoulomb(young, 0.3, self.named["strength"], 10.0, 2.0)
        tags = mpm.facet_tags(body, {1: mpm.region(y=2.0), 2: mpm.region(y=0.0)})
        self.bcs = [mpm.held(V, 0, x=0.0)] + ([] if support else [mpm.held(V, y=0.0)])
        given = mpm.Body(
            p,
            made,
            body_force=ufl.as_vector([0.0, -weight]),
            tractions=[(ufl.as_vector([push, 0.0]), 1)],
            facet_tags=tags,
            f_bar=f_bar,
        )
        self.problem = mpm.QuasiStaticProblem(
            given,
            self.bcs,
            supports=[mpm.boundary.fixed(p, tags, 2)] if support else [],
            solver=mpm.Solver(stabilisation=stabilisation, petsc_options=EXACT),
        )
        d, ds = p.displacement, ufl.Measure("ds", domain=body, subdomain_data=tags)
        self.form = 0.5 * ufl.inner(d, d) * ds(1)
        self.compiled = fem.form(self.form)

    def values(self, name):
        thing = self.named[name]
        return thing.x.array if isinstance(thing, fem.Function) else thing.value

    def value(self):
        comm = self.particles.mesh.comm
        return comm.allreduce(fem.assemble_scalar(self.compiled))


def ways(scene):
    """Return a direction for each parameter, the same on any number of ranks."""
    found = {}
    for name, thing in scene.named.items():
        found[name] = 0.7 * float(thing.value) if isinstance(thing, fem.Constant) else None
        if isinstance(thing, fem.Function):
            way = fem.Function(thing.function_space)
            way.interpolate(lambda x: 1.0 + 0.5 * np.cos(5 * x[0] - 4 * x[1]))
            way.x.array[:] *= thing.x.array
            found[name] = way.x.array.copy()
    return found


def along(scene, name, slope, way):
    """Return the derivative along a direction."""
    thing = scene.named[name]
    if isinstance(thing, fem.Constant):
        return float(slope * way)
    dofs = thing.function_space.dofmap
    own = dofs.index_map.size_local * dofs.index_map_bs
    return thing.function_space.mesh.comm.allreduce(float(slope[:own] @ way[:own]))


def check(steps=4, **options):
    """Compare with what is carried forward, and with differences of runs."""
    scene = Layered(**options)
    adjoint = mpm.Adjoint(scene.problem, list(scene.named.values()))
    scene.problem.solve(steps)
    end = scene.particles.displacement.x.array.copy()
    slopes = dict(zip(scene.named, adjoint.of(scene.form), strict=True))
    assert np.array_equal(end, scene.particles.displacement.x.array)
    directions = ways(scene)
    other = Layered(**options)
    pairs = [(other.named[name], way) for name, way in directions.items()]
    forward = mpm.Sensitivity(other.problem, pairs)
    other.problem.solve(steps)
    carried = dict(zip(scene.named, forward.of(other.value), strict=True))
    for name, way in directions.items():
        ends = []
        for sign in (2e-6, -2e-6):
            beside = Layered(**options, changes={name: sign * way})
            beside.problem.solve(steps)
            ends.append(beside.value())
        found = along(scene, name, slopes[name], way)
        difference = (ends[0] - ends[1]) / 4e-6
        whole = max(abs(difference), 0.1 * scene.value())
        assert abs(found - difference) < TOLERANCE * whole, (name, found, difference)
        whole = max(abs(difference), scene.value())  # of which round-off is 1e-10 of a difference
        assert abs(found - carried[name]) < 1e-8 * whole, (name, found, carried[name])


KINDS = {
    "elastic": {"law": "Hencky"},
    "plastic": {},
    "not symmetric": {"law": "Mohr-Coulomb"},
    "F-bar domain": {"f_bar": "domain"},
    "F-bar patch": {"f_bar": "patch", "law": "Mohr-Coulomb"},
    "support": {"support": True},
    "support F-bar": {"support": True, "f_bar": "patch", "law": "Hencky"},
    "triangles": {"cell": TRIANGLE},
    "degree 2": {"degree": 2},
    "no penalty": {"stabilisation": None},
}


@pytest.mark.parametrize("kind", all_but(["plastic"], KINDS))
def test_backward_is_forward_and_a_difference(kind):
    check(**KINDS[kind])


def test_functionals_at_several_steps_and_of_the_history():
    """A curve of settlements and the plastic strain at the end, by arrays and by forms."""
    scene = Layered()
    p, points = scene.particles, scene.problem.points[0]
    young = scene.named["young"]
    adjoint = mpm.Adjoint(scene.problem, [young])
    way = ways(scene)["young"]
    gradient = mpm.Sensitivity(scene.problem, [(young, way)])
    curve, strains = [], None
    for _ in scene.problem.steps(4):
        curve.append(float(gradient.of(scene.value)[0]))
    strains = gradient.of(lambda: points.last.variable("plastic_strain"))[..., 0]
    (slope,) = adjoint.of({1: scene.form, -1: scene.form})
    expected = curve[1] + curve[3]
    assert abs(along(scene, "young", slope, way) - expected) < 1e-8 * abs(expected)
    rng = np.random.default_rng(p.mesh.comm.rank)
    weights = rng.standard_normal(strains.shape)

    def look(number):
        return {"plastic_strain": weights} if number == 3 else None

    (slope,) = adjoint.of(look)
    expected = p.mesh.comm.allreduce(float((weights * strains).sum()))
    size = p.mesh.comm.allreduce(float(np.abs(weights * strains).sum()))
    assert abs(along(scene, "young", slope, way) - expected) < 1e-8 * size


class Wearing(materials.Hencky):
    """An elastic law that remembers: its stress falls with all strains that it has had."""

    internal_variables = MappingProxyType({"wear": ()})

    def integrate(self, trial_strain, variables, tangent):
        stress, D, strain, _ = super().integrate(trial_strain, {}, tangent)
        left = 1.0 / (1.0 + variables["wear"])
        worn = variables["wear"] + 20.0 * np.sqrt((trial_strain**2).sum(axis=1))
        D = None if D is None else D * left[:, None, None]
        return materials.Integration(stress * left[:, None], D, strain, {"wear": worn})


def both_ways(prepared):
    """Return a form's derivatives by Adjoint and by Sensitivity, of a scene prepared for each.

    Args:
        prepared: Returns a problem, parameters, a form and a call that runs the problem.
    """
    ends = []
    for follows in (mpm.Adjoint, mpm.Sensitivity):
        problem, parameters, form, run = prepared()
        compiled, comm = fem.form(form), problem.bodies[0].mesh.comm
        gradient = follows(problem, parameters)
        run()

        def value(compiled=compiled, comm=comm):
            return comm.allreduce(fem.assemble_scalar(compiled))

        ends.append(np.array(gradient.of(form if follows is mpm.Adjoint else value)))
    return ends


def check_slump(law, numbers, steps, tolerance):
    """Compare both ways for a slump of a law, by all its numbers."""

    def prepared():
        scene = Slump(law, numbers)
        d = scene.particles.displacement
        form = 0.5 * ufl.inner(d, d) * ufl.dx
        parameters = [scene.named[name] for name in numbers]
        return scene.problem, parameters, form, lambda: scene.problem.solve(steps)

    one, other = both_ways(prepared)
    assert np.abs(one / other - 1.0).max() < tolerance, (one, other)


SOFT = {"young": 5e4, "weight": 1e3}


def test_a_law_that_remembers_without_being_inelastic():
    check_slump(lambda young: Wearing(young, 0.3), SOFT, 3, 1e-8)


SOFTENING = {
    "Tresca": lambda young: materials.Tresca(young, 0.45, 500.0).with_softening(
        5.0, cohesion=400.0
    ),
    "von Mises": lambda young: materials.VonMises(young, 0.3, 700.0).with_softening(
        5.0, residual=0.8
    ),
}


@pytest.mark.parametrize("law", SOFTENING)
def test_a_strength_that_falls_with_the_history(law):
    """It is no number of the compiled return alone: by that, derivatives are off by 1e-3."""
    check_slump(SOFTENING[law], SOFT, 4, 1e-7)


def test_what_materials_keep_is_found_again_where_it_was_not_noted():
    """Of eight steps it is noted once."""
    check_slump(von_mises, VON_MISES, 10, 1e-8)


def test_bodies_that_stick_by_their_joints():
    def prepared():
        scene = Stacked(below=2e4, above=1e4, weight=300.0)
        problem, d = scene.problem, scene.problem.bodies[1].displacement

        def run():
            counts = [problem.history.statistics["joint_nodes"] for _ in problem.steps(6)]
            assert max(counts) > 0

        parameters = [scene.named[name] for name in ("below", "above")]
        return problem, parameters, 0.5 * ufl.inner(d, d) * ufl.dx, run

    one, other = both_ways(prepared)
    assert np.abs(one / other - 1.0).max() < 1e-7, (one, other)


def test_it_goes_on_after_a_look_and_is_the_same_on_any_number_of_ranks():
    found, ends = [], []
    for comm, looks in ((WORLD, True), (MPI.COMM_SELF, False)):
        scene = Layered(f_bar="patch", comm=comm)
        adjoint = mpm.Adjoint(scene.problem, [scene.named["young"], scene.named["weight"]])
        for number, _ in enumerate(scene.problem.steps(4)):
            if looks and number == 1:
                adjoint.of(scene.form)
        slopes, weight = adjoint.of(scene.form)
        cells = scene.named["young"].function_space.dofmap.list[: scene.particles.num_local, 0]
        found.append((in_order(scene.particles, slopes[cells]), weight))
        ends.append(in_order(scene.particles, scene.particles.stress))
    assert np.abs(ends[0] - ends[1]).max() < 1e-8 * np.abs(ends[1]).max()
    for one, other in zip(*found, strict=True):
        assert np.abs(one - other).max() < 1e-8 * np.abs(other).max()


def test_a_functional_with_parameters_in_itself():
    """Terms of a cost that have a Constant, or a Function along a direction, besides motion."""

    def prepared():
        scene = Layered(law="Hencky")
        weight, young, d = scene.named["weight"], scene.named["young"], scene.particles.displacement
        form = weight**2 * young * ufl.inner(d, d) * ufl.dx
        parameters = [weight, (young, ways(scene)["young"])]
        return scene.problem, parameters, form, lambda: scene.problem.solve(2)

    one, other = both_ways(prepared)
    assert np.abs(one / other - 1.0).max() < 1e-7, (one, other)


def test_wrong_functionals_and_parameters_are_told():
    scene = Layered()
    p, weight = scene.particles, scene.named["weight"]
    foreign = fem.Constant(p.mesh, 3.0)
    unused = fem.Function(fem.functionspace(p.mesh, ("DG", 1)))
    unused.x.array[:] = 1.0
    for follows, given in (
        (mpm.Adjoint, foreign),
        (mpm.Adjoint, unused),
        (mpm.Sensitivity, foreign),
        (mpm.Sensitivity, (unused, 1.0)),
    ):
        with pytest.raises(mpm.MPMError, match="does not depend on it"):
            follows(scene.problem, [given])
    prescribed = fem.Function(p.V)
    prescribed.x.array[:] = 1e-3
    dofs = fem.locate_dofs_geometrical(p.V, lambda x: np.isclose(x[1], -0.5))
    moved = mpm.QuasiStaticProblem(
        mpm.Body(p, materials.Hencky(1e3, 0.3)), [fem.dirichletbc(prescribed, dofs)]
    )
    with pytest.raises(mpm.MPMError, match="Dirichlet values"):
        mpm.Adjoint(moved, [prescribed])
    scene = Layered()
    p, weight = scene.particles, scene.named["weight"]
    adjoint = mpm.Adjoint(scene.problem, [weight])
    scene.problem.solve(2)
    d, slope = p.displacement, adjoint.of(scene.form)[0]
    wrong = {
        "without test functions": ufl.inner(d, ufl.TestFunction(p.W)) * ufl.dx,
        "has neither": fem.Constant(p.mesh, 1.0) * ufl.dx(domain=p.mesh),
        "A functional is": d[0],
        "from 0 to 1": {2: scene.form},
        "not finite": fem.Constant(p.mesh, np.nan) * d[0] * ufl.dx,
        "of the shape": lambda number: {"displacement": np.zeros(3)},
        "'plastic_strain' are": lambda number: {"plastic_strain": "three"},
    }
    for words, functional in wrong.items():
        with pytest.raises(mpm.MPMError, match=words):
            adjoint.of(functional)
    assert adjoint.of(scene.form)[0] == slope  # (all is as it was)


def test_a_value_that_changes_on_one_rank_is_told_on_all_ranks():
    scene = Layered()
    young = scene.named["young"]
    adjoint = mpm.Adjoint(scene.problem, [young])
    scene.problem.solve(1)
    young.x.array[:1] *= 1.1 if WORLD.rank == 0 else 1.0
    with pytest.raises(mpm.MPMError, match="has changed"):
        adjoint.of(scene.form)


def test_what_is_not_gone_through_is_refused():
    scene = Layered()
    with pytest.raises(mpm.MPMError, match="Name a parameter"):
        mpm.Adjoint(scene.problem, [])
    adjoint = mpm.Adjoint(scene.problem, [scene.named["young"]])
    with pytest.raises(mpm.MPMError, match="no step yet"):
        adjoint.of(scene.form)
    scene.problem.solve(1)
    with pytest.raises(mpm.MPMError, match="A functional is"):
        adjoint.of(3.0)
    with pytest.raises(mpm.MPMError, match="dictionary of arrays"):
        adjoint.of(lambda number: [1.0])
    with pytest.raises(mpm.MPMError, match="No material"):
        adjoint.of(lambda number: {"moisture": np.zeros(1)})
    with pytest.raises(mpm.MPMError, match="from its first step on"):
        mpm.Adjoint(scene.problem, [scene.named["young"]])
    scene.named["young"].x.array[:] *= 1.1
    with pytest.raises(mpm.MPMError, match="has changed"):
        adjoint.of(scene.form)
    body = box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL)
    V = vectors(box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    law = materials.Hencky(1e3, 0.3)
    moving = mpm.DynamicProblem(mpm.Body(mpm.Particles(body, V), law, density=1.0))
    with pytest.raises(mpm.MPMError, match="follows a QuasiStaticProblem"):
        mpm.Adjoint(moving, [(law, "young")])
    stressed = mpm.Body(mpm.Particles(body, V), law, initial_stress=-ufl.Identity(3))
    with pytest.raises(mpm.MPMError, match="initial stress"):
        mpm.Adjoint(mpm.QuasiStaticProblem(stressed), [(law, "young")])
