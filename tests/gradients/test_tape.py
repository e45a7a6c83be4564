# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs on pyadjoint's tape, by Taylor tests and against an Adjoint."""

import warnings

from mpi4py import MPI

import numpy as np
import pytest
from gradients.runs import EXACT
from ranks import fails
from scenes import QUADRILATERAL, WORLD, box, vectors

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm

pyadjoint = pytest.importorskip("pyadjoint")
dolfinx_adjoint = pytest.importorskip("dolfinx_adjoint")


@pytest.fixture(autouse=True)
def tape():
    """A tape for each test."""
    with pyadjoint.set_working_tape(pyadjoint.Tape()) as new:
        pyadjoint.continue_annotation()
        yield new
        pyadjoint.pause_annotation()


class Block:
    """A block that slumps: its stiffness in each cell and its weight are controls."""

    def __init__(self, law=mpm.materials.VonMises, unit=1.0):
        self.V = vectors(box([0.0, 0.0], [4.0, 5.0], [8, 10], QUADRILATERAL), 1)
        self.body = box([0.0, 0.0], [2.0, 4.0], [8, 16], QUADRILATERAL)
        self.young = dolfinx_adjoint.Function(fem.functionspace(self.body, ("DG", 0)))
        self.young.x.array[:] = 5e4 / unit
        self.weight = pyadjoint.AdjFloat(1e3 / unit)
        self.value = fem.Constant(self.body, 1e3 / unit)
        self.controls = [self.young, (self.weight, self.value)]
        self.options = {} if law is mpm.materials.Hencky else {"yield_stress": 2.5e3}
        self.law, self.runs = law, 0

    def made(self):
        self.runs += 1
        particles = mpm.Particles(self.body, self.V, quadrature_degree=2)
        material = mpm.Body(
            particles,
            self.law(self.young, 0.3, **self.options),
            body_force=ufl.as_vector([0.0, -self.value]),
        )
        bcs = [mpm.held(self.V, 0, x=0.0), mpm.held(self.V, 1, y=0.0)]
        solver = mpm.Solver(stabilisation="ghost", petsc_options=EXACT)
        return mpm.QuasiStaticProblem(material, bcs, solver=solver)

    def change(self, size):
        """A direction for the stiffness."""
        change = dolfinx_adjoint.Function(self.young.function_space)
        change.interpolate(lambda x: size * np.sin(5.0 * x[0] + 3.0 * x[1]))
        return change


def five(problem):
    return problem.solve(5)


def test_a_misfit_of_two_steps_and_its_regularisation_pass_a_taylor_test():
    block = Block()
    last, third = mpm.taped(block.made, block.controls, five, steps=[-1, 2])
    J = dolfinx_adjoint.assemble_scalar(
        (ufl.inner(last, last) + 3.0 * third[1] ** 2 + 1e-10 * (block.young - 6e4) ** 2) * ufl.dx
    )
    controls = [block.young, block.weight]
    reduced = pyadjoint.ReducedFunctional(
        J * block.weight, [pyadjoint.Control(one) for one in controls]
    )
    change = [block.change(20.0), pyadjoint.AdjFloat(0.3)]
    assert pyadjoint.taylor_test(reduced, controls, change) > 1.99
    assert np.allclose(block.young.x.array, 5e4, rtol=0) and block.value.value == 1e3


def test_it_is_what_an_adjoint_says_and_runs_once():
    block = Block()
    (d,) = mpm.taped(block.made, block.controls, five)
    reduced = pyadjoint.ReducedFunctional(
        dolfinx_adjoint.assemble_scalar(ufl.inner(d, d) * ufl.ds), pyadjoint.Control(block.young)
    )
    found = reduced.derivative().x.array
    assert block.runs == 1
    with pyadjoint.stop_annotating():
        problem = block.made()
        adjoint = mpm.Adjoint(problem, [block.young])
        five(problem)
        own = problem.particles.displacement
        (slope,) = adjoint.of(ufl.inner(own, own) * ufl.ds)
    mine = slice(0, block.young.function_space.dofmap.index_map.size_local)
    size = WORLD.allreduce(np.abs(slope[mine]).max(initial=0.0), MPI.MAX)
    assert np.abs(found - slope)[mine].max(initial=0.0) < 1e-9 * size


def test_the_tangent_linear_model_is_what_the_adjoint_says():
    block = Block()
    last, second = mpm.taped(block.made, block.controls, five, steps=[-1, 1])
    J = dolfinx_adjoint.assemble_scalar((ufl.inner(last, last) + second[1] ** 2) * ufl.dx)
    reduced = pyadjoint.ReducedFunctional(
        J, [pyadjoint.Control(block.young), pyadjoint.Control(block.weight)]
    )
    way = block.change(20.0)
    forward = float(reduced.tlm([way, pyadjoint.AdjFloat(0.3)]))
    slope, by_weight = reduced.derivative()
    own = slice(0, way.function_space.dofmap.index_map.size_local)
    backward = WORLD.allreduce(float(slope.x.array[own] @ way.x.array[own])) + 0.3 * by_weight
    assert abs(forward - backward) < 1e-8 * abs(backward)
    assert float(reduced.tlm([block.change(0.0), pyadjoint.AdjFloat(0.3)])) == pytest.approx(
        0.3 * float(by_weight), rel=1e-8
    )


@pytest.mark.skip_in_parallel
@pytest.mark.slow
def test_a_stiffness_is_found_by_minimize():
    """In units in which its values are near 1, as a minimiser's first step is of that size."""
    block = Block(mpm.materials.Hencky, unit=1e4)

    def two(problem):
        problem.solve(2)

    with pyadjoint.stop_annotating():
        right = 5.0 + block.change(0.5).x.array
        block.young.x.array[:] = right
        (measured,) = mpm.taped(block.made, block.controls, two)
        block.young.x.array[:] = 5.0
    (d,) = mpm.taped(block.made, block.controls, two)
    seen = fem.Function(d.function_space)
    seen.x.array[:] = measured.x.array
    misfit = dolfinx_adjoint.assemble_scalar(1e6 * ufl.inner(d - seen, d - seen) * ufl.dx)
    reduced = pyadjoint.ReducedFunctional(misfit, pyadjoint.Control(block.young))
    first = float(reduced(block.young))
    best = pyadjoint.minimize(reduced, tol=1e-3)
    assert float(reduced(best)) < 1e-2 * first
    assert np.linalg.norm(best.x.array - right) < 0.7 * np.linalg.norm(right - 5.0)


def test_other_steps_than_the_first_time_are_told():
    block = Block()
    (d,) = mpm.taped(block.made, block.controls, lambda problem: problem.solve("auto"))
    reduced = pyadjoint.ReducedFunctional(
        dolfinx_adjoint.assemble_scalar(ufl.inner(d, d) * ufl.dx), pyadjoint.Control(block.weight)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reduced(pyadjoint.AdjFloat(1e3))
        other = pyadjoint.AdjFloat(0.7e3)
        fails(lambda: reduced(other), "has made other steps than the first time", UserWarning)


def test_a_run_without_annotation_leaves_the_tape_alone(tape):
    block = Block()
    with pyadjoint.stop_annotating():
        mpm.taped(block.made, block.controls, five)
    assert not tape.get_blocks()


@pytest.mark.parametrize("control", ["Constant", "plain", "number", "pair"])
def test_wrong_controls_are_told(control):
    block = Block()
    given = {
        "Constant": block.value,
        "plain": fem.Function(block.young.function_space),
        "number": 3.0,
        "pair": (block.young, block.young),
    }[control]
    with pytest.raises(mpm.MPMError, match="A control is a Function of dolfinx_adjoint, or a pair"):
        mpm.taped(block.made, [given], five)


def test_steps_that_were_not_made_are_told():
    block = Block()
    with pytest.raises(mpm.MPMError, match="made 5 steps"):
        mpm.taped(block.made, block.controls, five, steps=[5])
