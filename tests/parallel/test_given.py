# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Ranks that are given different things, or of which one alone fails: one error on all, no hang."""

import warnings
from functools import partial
from itertools import product

import numpy as np
import pytest
import scenes
from marks import thinned
from posed import posed
from ranks import LAST, differing, fails, in_step
from scenes import QUADRILATERAL, WORLD

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises


def made(law=None, n=2, **options):
    """Return a problem of a block that hangs from its left side."""
    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL))
    ours = {k: options.pop(k) for k in ("method", "quadrature_degree", "degree") if k in options}
    particles = mpm.Particles(scenes.unit(n, QUADRILATERAL), V, **({"quadrature_degree": 2} | ours))
    options.setdefault("bcs", [scenes.fix(V, scenes.at(0, 0.0))])
    options.setdefault("body_force", (0.0, -1.0))
    options.setdefault("f_bar", "domain")
    return posed(
        mpm.QuasiStaticProblem, particles, Hencky(1e3, 0.3) if law is None else law, **options
    )


def conditions(count):
    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL))
    bcs = [scenes.fix(V, scenes.at(0, 0.0)), scenes.fix(V, scenes.at(1, -1.0))]
    particles = mpm.Particles(scenes.unit(2, QUADRILATERAL), V, quadrature_degree=2)
    mpm.QuasiStaticProblem(mpm.Body(particles, Hencky(1e3, 0.3)), bcs=bcs[:count])


def stepping(usual, other, **options):
    problem = made()
    problem.solve(steps=differing(usual, other), **options)


def loaded():
    problem = made()
    problem.particles.load.value = differing(0.5, 0.25)
    problem.step()


def constant():
    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(2, QUADRILATERAL), V, quadrature_degree=2)
    force = fem.Constant(particles.mesh, (0.0, -1.0))
    bcs = [scenes.fix(V, scenes.at(0, 0.0))]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.3), body_force=force), bcs=bcs
    )
    problem.solve(steps=1)
    force.value[1] = differing(-1.0, -2.0)
    problem.step()


def residual():
    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL))
    p = mpm.Particles(scenes.unit(2, QUADRILATERAL), V, quadrature_degree=2)
    R = ufl.inner(ufl.grad(p.displacement), ufl.grad(ufl.TestFunction(p.W))) * p.dx
    if LAST:
        R += ufl.TestFunction(p.W)[0] * ufl.ds
    mpm.ParticleProblem(R, p)


def terms(kind):
    """Make a problem with a term that the last rank does not give."""
    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL))
    p = mpm.Particles(scenes.unit(2, QUADRILATERAL), V, quadrature_degree=2)
    given = {"terms": differing([mpm.Term([p])], [])}
    if kind is mpm.ParticleProblem:
        R = ufl.inner(ufl.grad(p.displacement), ufl.grad(ufl.TestFunction(p.W))) * p.dx
        kind(R, p, **given)
    else:
        kind(mpm.Body(p, Hencky(1e3, 0.3), 1.0), **given)


DIFFERENT = {
    "method": (lambda: made(method=differing("cpdi2", "cpdi"), quadrature_degree=None), "^method"),
    "points": (lambda: made(quadrature_degree=differing(2, 3)), "^quadrature_degree .* 2.* 3"),
    "modulus": (lambda: made(Hencky(differing(1e3, 2e3), 0.3)), "^young differs .* 1000.* 2000"),
    "law": (
        lambda: made(differing(Hencky(1e3, 0.3), VonMises(1e3, 0.3, rho_y=1.0))),
        "^material differs .* Hencky .* VonMises",
    ),
    "density": (lambda: made(density=differing(1.0, 2.0)), "^density differs .* 1.0.* 2.0"),
    "force": (lambda: made(body_force=differing((0.0, -1.0), None)), "^body_force differs .*None"),
    "F-bar": (lambda: made(f_bar=differing("domain", "none")), "^f_bar .*'domain'.*'none'"),
    "options": (lambda: made(petsc_options=differing({}, {"snes_rtol": 1e-9})), "petsc_options"),
    "conditions": (lambda: conditions(differing(1, 2)), "^The number of bcs differs .* 1 .* 2"),
    "steps": (lambda: stepping(1, 2), "^steps differs"),
    "path": (
        lambda: made().solve(steps=1, update=differing(None, lambda t: None)),
        "^update differs .*None on rank 0, a function on rank",
    ),
    "load": (loaded, "^load differs .*0.5.*0.25"),
    "constant": (constant, "constants.* differs .*-1.0.*-2.0"),
    "residual": (residual, "^R differs .*form"),
    **{
        kind.__name__: (partial(terms, kind), "^The number of terms differs .* 1 on rank 0, 0 on")
        for kind in (mpm.ParticleProblem, mpm.QuasiStaticProblem, mpm.DynamicProblem)
    },
}


@pytest.mark.mpi
@pytest.mark.parametrize("what", DIFFERENT)
def test_what_differs_between_ranks_is_named(what):
    build, sentence = DIFFERENT[what]
    fails(build, sentence)


class Failing(Hencky):
    """A law in which one method fails on the last rank."""

    def __init__(self, method):
        super().__init__(1e3, 0.3)
        self.method = method

    def fail(self, method):
        if LAST and method == self.method:
            raise ValueError("no table")

    def initial_state(self, n, dim):
        self.fail("initial_state")
        return super().initial_state(n, dim)

    def update(self, displacement_gradient, state, tangent=True):
        self.fail("update")
        return super().update(displacement_gradient, state, tangent)

    def cauchy_stress(self, displacement_gradient, state):
        self.fail("cauchy_stress")
        return super().cauchy_stress(displacement_gradient, state)


@pytest.mark.parametrize("method", ["initial_state", "update", "cauchy_stress"])
@pytest.mark.parametrize("f_bar", ["none", "patch"])
def test_law_that_fails_on_one_rank(method, f_bar, mpi_tmp_path):
    def run():
        problem = made(Failing(method), f_bar=f_bar)
        problem.solve(steps=1)
        problem.write(mpi_tmp_path / "block.pvd")

    fails(run, rf"{method} of Failing failed with ValueError: no table")


def test_an_error_asked_of_a_law_that_fails_on_one_rank():
    def run():
        problem = made(Failing("cauchy_stress"), f_bar="patch")
        problem.solve(steps=1)
        problem.error()

    fails(run, "cauchy_stress of Failing failed with ValueError: no table")


def test_support_whose_law_fails_on_one_rank():
    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL))
    p = mpm.Particles(scenes.unit(2, QUADRILATERAL), V, quadrature_degree=2)
    support = mpm.boundary.fixed(p, scenes.facet_tags(p.mesh, scenes.at(0, 0.0)), 1)
    law = Failing("update")
    fails(
        lambda: mpm.QuasiStaticProblem(mpm.Body(p, law), supports=[support]),
        "update of Failing failed with ValueError: no table",
    )


def force_of(x):
    if LAST:
        raise KeyError("gravity")
    return (0.0, -1.0)


def test_force_that_fails_on_one_rank():
    fails(lambda: made(body_force=force_of), "UFL coordinates, failed with KeyError: 'gravity'")


@pytest.mark.mpi
def test_force_that_differs_between_ranks():
    fails(
        lambda: made(body_force=lambda x: differing((0.0, -1.0), (0.0, -2.0))),
        "^body_force differs",
    )


@pytest.mark.parametrize("method", ["commit", "end_step"])
def test_problem_that_fails_between_steps_on_one_rank(method):
    class Wrong(mpm.ParticleProblem):
        def commit(self):
            if method == "commit" and LAST:
                raise ValueError("no table")

        def end_step(self):
            if method == "end_step" and LAST:
                raise ValueError("no table")

    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL))
    p = mpm.Particles(scenes.unit(2, QUADRILATERAL), V, quadrature_degree=2)
    v = ufl.TestFunction(p.W)
    R = ufl.inner(scenes.linear_stress(p.displacement, 1e3, 0.3), ufl.grad(v)) * p.dx
    R += p.load * v[1] * p.dx_exact
    problem = Wrong(R, p, bcs=[scenes.fix(V, scenes.at(0, 0.0))])
    fails(lambda: problem.solve(steps=1), rf"{method}\(\) failed with ValueError: no table")


def test_warnings_that_are_errors():
    # Rank 0 alone warns; that one point in domains as large as the cells is too few ...
    def crowded():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            made(quadrature_degree=None, f_bar="none")

    fails(crowded, "hourglass", UserWarning)

    # ... and that the last step takes the body out of the background.
    def leaving():
        V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 1.0], [4, 2], QUADRILATERAL))
        p = mpm.Particles(scenes.unit(2, QUADRILATERAL), V, quadrature_degree=2)
        bcs = [scenes.fix(V, scenes.at(0, 0.0))]
        problem = mpm.QuasiStaticProblem(
            mpm.Body(p, Hencky(1e3, 0.3), body_force=(0.0, -9.0)), bcs=bcs
        )
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            problem.solve(steps=1)

    fails(leaving, "The run is complete, but the domains of", UserWarning)


def test_interrupt_of_one_rank():
    problem = made()

    def path(t):
        if t > 0.5 and LAST:
            raise KeyboardInterrupt

    caught = None
    try:
        problem.solve(2, update=path)
    except KeyboardInterrupt as error:
        caught = error
    assert all(in_step(caught is not None))


class Leaving(Hencky):
    """A law that wants to end the program on one rank, at the second step."""

    kind = None

    def update(self, displacement_gradient, state, tangent=True):
        if LAST and self.kind is not None and np.abs(state["stress"]).any():
            raise self.kind
        return super().update(displacement_gradient, state, tangent)


@pytest.mark.parametrize(
    ("kind", "where", "f_bar"),
    thinned(
        5,
        product(
            [KeyboardInterrupt, SystemExit],
            ["path", "first body", "second body"],
            ["none", "domain", "patch"],
        ),
    ),
)
def test_one_rank_that_wants_to_end(kind, where, f_bar):
    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL))
    meshes = [scenes.box([0.0, y], [1.0, y + 0.5], [4, 2], QUADRILATERAL) for y in (0.0, 0.5)]
    bodies = [mpm.Particles(body, V, quadrature_degree=2) for body in meshes]
    laws = [Leaving(1e3, 0.3), Leaving(1e3, 0.3)]
    bcs = [scenes.fix(V, scenes.at(0, 0.0))]
    problem = posed(
        mpm.QuasiStaticProblem, bodies, laws, body_force=(0.0, -1.0), bcs=bcs, f_bar=f_bar
    )
    if where != "path":
        laws[("first body", "second body").index(where)].kind = kind

    def path(t):
        if t > 0.5 and LAST and where == "path":
            raise kind

    caught = None
    try:
        problem.solve(2, update=path)
    except BaseException as error:
        caught = error
    assert set(in_step(type(caught).__name__)) == {kind.__name__}
    steps = problem.history.steps
    assert [step.load for step in steps] == [0.5]
    assert all(float(body.load.value) == 0.5 for body in bodies)
    for law in laws:
        law.kind = None
    problem.solve(1, update=lambda t: None)
    assert problem.history.steps[-1].load == 1.0


@pytest.mark.parametrize("how", ["rows", "type", "none", "nan", "tangent", "state", "rank"])
@pytest.mark.parametrize("f_bar", ["none", "domain"])
def test_answer_of_a_law_that_cannot_be(how, f_bar):
    class Wrong(Hencky):
        first = True

        def update(self, displacement_gradient, state, tangent=True):
            P, A, new = super().update(displacement_gradient, state, tangent)
            if not LAST or not displacement_gradient.any():
                return mpm.materials.Update(P, A, new)
            if how == "rows":
                P = P[:1]
            elif how == "type":
                P = P.astype(np.float32)
            elif how == "none":
                P = None
            elif how == "nan":
                P[0, 0, 0] = np.nan
            elif how == "tangent":
                A[-1, 0, 0, 0, 0] = np.inf
            elif how == "state":
                new = {"stress": new["stress"][:-1]}
            elif how == "rank":
                new = {"stress": new["stress"], "more": P}
            return mpm.materials.Update(P, A, new)

    sentence, kind = {
        "rows": (r"stress P that is an array of shape \(1, 2, 2\).* must have the shape", None),
        "type": (r"stress P that is an array of .* float32; it must have .* float64", None),
        "none": (r"stress P that is None", None),
        "nan": (r"stress P that is not finite \(at particle \d+\)", mpm.ConvergenceError),
        "tangent": (r"tangent that is not finite \(at particle \d+\)", mpm.ConvergenceError),
        "state": (r"state 'stress' that is an array of shape .* must have the shape", None),
        "rank": (r"must return a state with the variables of initial_state: stress", None),
    }[how]
    problem = made(Wrong(1e3, 0.3), f_bar=f_bar)
    error = fails(lambda: problem.solve(steps=1), sentence, kind or mpm.MPMError)
    if kind is not None:
        own = problem.particles.global_index
        named = WORLD.bcast(own[[0, -1]].tolist(), root=WORLD.size - 1)
        assert error.particles == [named[0 if how == "nan" else 1]]
    assert not problem.history.steps and problem.particles.load.value == 0.0


class Scribbling(VonMises):
    """A law that writes into what it receives."""

    where = "state"

    def update(self, displacement_gradient, state, tangent=True):
        if self.where == "state":
            state["plastic_strain"] += 1e-3
        elif self.where == "gradient":
            displacement_gradient *= 2.0
        return super().update(displacement_gradient, state, tangent)


@pytest.mark.parametrize("where", ["state", "gradient"])
def test_law_that_writes_into_what_it_receives(where):
    law = Scribbling(1e3, 0.3, rho_y=1.0)
    law.where = where
    for f_bar in ("none", "domain"):
        build = partial(made, law, body_force=(0.0, -9.0), f_bar=f_bar)
        fails(
            lambda build=build: build().solve(steps=2),
            "read-only; a law must not write into what it receives",
        )


def test_law_with_arrays_of_its_own_that_it_uses_again():
    class Saving(VonMises):
        """A law that answers with the same arrays each time."""

        def update(self, displacement_gradient, state, tangent=True):
            P, A, new = super().update(displacement_gradient, dict(state), tangent)
            if not hasattr(self, "kept"):
                self.kept = [P.copy(), A.copy(), {k: v.copy() for k, v in new.items()}]
            np.copyto(self.kept[0], P)
            np.copyto(self.kept[1], A)
            for name, values in new.items():
                np.copyto(self.kept[2][name], values)
            return mpm.materials.Update(self.kept[0], self.kept[1], dict(self.kept[2]))

    tips = []
    for law in (Saving, VonMises):
        problem = made(law(1e3, 0.3, rho_y=1.0, hardening=500.0), f_bar="none")
        problem.solve(steps=3)
        tips.append(scenes.own(problem.particles.displacement).copy())
        assert scenes.largest(problem.particles.plastic_strain) > 1e-4
    np.testing.assert_allclose(tips[0], tips[1], rtol=0.0, atol=1e-12)
