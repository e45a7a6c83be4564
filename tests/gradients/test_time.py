# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of motions, consolidation and several fields against differences of whole runs."""

from mpi4py import MPI

import numpy as np
import pytest
from gradients.runs import EXACT, check, looked, von_mises
from marks import all_but, thinned
from scenes import QUADRILATERAL, WORLD, box, in_order, neo_hookean, vectors

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials

MOTION = {"young": 5e4, "density": 100.0, "weight": 15.0, "speed": 0.3, "lifted": 0.01}
WATER = {"young": 1e4, "push": 200.0, "drain": 5.0, "flow": 1e-3, "storage": 1e-6}


class Thrown:
    """A block that is thrown along the ground while it sinks under its weight."""

    def __init__(
        self,
        law="hencky",
        degree=1,
        stabilisation="auto",
        f_bar="none",
        dashpot=False,
        strength=2e3,
        comm=WORLD,
        written=False,
        **options,
    ):
        values = {name: options.pop(name) for name in MOTION}
        V = vectors(box([0.0, -1.0], [3.0, 3.0], [9, 12], QUADRILATERAL, comm), degree)
        body = box([0.6, 0.0], [1.6, 2.0], [6, 12], QUADRILATERAL, comm)
        points = 2 * degree
        self.particles = p = mpm.Particles(body, V, quadrature_degree=points, degree=degree)
        self.named = {name: fem.Constant(body, value) for name, value in values.items()}
        self.named["lifted"] = fem.Constant(V.mesh, values["lifted"])
        young, density, weight, speed, lifted = self.named.values()
        self.bcs = [mpm.held(V, 1, y=0.0, value=lifted)]
        solver = mpm.Solver(stabilisation=stabilisation, petsc_options=EXACT)
        velocity, force = ufl.as_vector([speed, 0.0]), ufl.as_vector([0.0, -weight])
        if written:
            d, v = p.displacement, ufl.TestFunction(p.W)
            R = ufl.derivative(neo_hookean(d, young, 0.3) * p.dx, d, v)
            R -= density * ufl.inner(force, v) * p.dx_exact
            self.problem = mpm.DynamicParticleProblem(
                R, p, density, bcs=self.bcs, velocity=velocity, solver=solver, **options
            )
        else:
            tags = mpm.facet_tags(body, {1: mpm.region(y=0.0)})
            if dashpot:
                options["supports"] = [
                    mpm.boundary.dashpot(p, tags, 1, density * 10.0, density * 5.0)
                ]
            made = materials.Hencky(young, 0.3) if law == "hencky" else von_mises(young, strength)
            given = mpm.Body(
                p, made, density=density, body_force=force, velocity=velocity, f_bar=f_bar
            )
            self.problem = mpm.DynamicProblem(given, self.bcs, solver=solver, **options)
        self.looks = {
            "displacement": lambda: p.displacement.x.array,
            "velocity": lambda: self.problem.velocity.x.array,
            "energy": lambda: self.problem.kinetic_energy,
            "reaction": lambda: self.problem.reaction(self.bcs[0]),
        }
        if not written:
            self.looks["stress"] = lambda: p.point_stress


def thrown(scene):
    scene.problem.solve(time=0.3, dt=0.05)


MOTIONS = {
    "midpoint": {},
    "reflect": {"out_of_range": "reflect"},
    "conserving": {"scheme": "conserving"},
    "euler": {"scheme": "euler"},
    "ghost": {"stabilisation": "ghost"},
    "degree 2": {"degree": 2, "out_of_range": "reflect"},
    "F-bar": {"f_bar": "patch", "scheme": "conserving"},
    "yields": {"law": "von Mises"},
    "yields conserving": {"law": "von Mises", "scheme": "conserving", "strength": 2.5e3},
    "Rayleigh": {"rayleigh": (0.5, 1e-3), "scheme": "conserving"},
    "dashpot": {"dashpot": True},
    "written": {"written": True},
}


@pytest.mark.parametrize("kind", all_but(["yields conserving"], MOTIONS))
def test_each_kind_of_motion(kind):
    check(lambda **numbers: Thrown(**MOTIONS[kind], **numbers), MOTION, run=thrown)


class Wet:
    """A block of soil with water that is pressed together."""

    def __init__(self, young, push, drain, flow, storage, law=materials.Hencky, comm=WORLD):
        V = vectors(box([0.0, -0.4], [1.6, 1.6], [4, 5], QUADRILATERAL, comm), 2)
        body = box([0.0, 0.0], [0.7, 1.1], [2, 4], QUADRILATERAL, comm)
        self.particles = p = mpm.Particles(body, V, degree=2, quadrature_degree=4)
        values = {"young": young, "push": push, "drain": drain, "flow": flow, "storage": storage}
        self.named = named = {name: fem.Constant(body, value) for name, value in values.items()}
        tags = mpm.facet_tags(body, {1: mpm.region(y=1.1), 2: mpm.region(y=0.0)})
        self.bcs, k = [mpm.held(V, 0, x=0.0)], named["flow"]
        water = mpm.PoreFluid(
            permeability=lambda J: k * J**2,
            storage=named["storage"],
            density=1.0,
            drained=[(named["drain"], 1)],
            pressure=10.0,
        )
        given = mpm.Body(
            p,
            law(named["young"], 0.3),
            density=2.0,
            body_force=(0.0, -50.0),
            tractions=[(ufl.as_vector([0.0, -named["push"]]), 1)],
            facet_tags=tags,
            pore_fluid=water,
        )
        rest = mpm.boundary.fixed(p, tags, 2)
        self.problem = mpm.PorousProblem(
            given, self.bcs, supports=[rest], solver=mpm.Solver(petsc_options=EXACT)
        )
        self.looks = {
            "displacement": lambda: p.displacement.x.array,
            "pressure": lambda: self.problem.pore_pressure[0].x.array,
            "stress": lambda: p.point_stress,
            "support": lambda: self.problem.reaction(rest),
        }


SOILS = {
    "Hencky": materials.Hencky,
    "neo-Hooke": materials.NeoHooke,
    "small strains": materials.LinearElastic,
    "von Mises": lambda young, poisson: materials.VonMises(
        young, poisson, yield_stress=300.0, hardening=1e3
    ),
    "lagging": lambda young, poisson: materials.VonMises(
        young, poisson, yield_stress=100.0, hardening=1e3
    ).with_relaxation(0.2),
}


@pytest.mark.parametrize("law", all_but(["von Mises"], SOILS))
def test_each_soil_with_water(law):
    def run(scene):
        scene.problem.solve(time=0.4, dt=0.2)

    names = ["young", "push", "flow"] if law != "von Mises" else None
    check(lambda **numbers: Wet(**numbers, law=SOILS[law]), WATER, names, run=run)


class Warm:
    """A block that expands by its temperature, which comes in from one side."""

    def __init__(self, young, heat, spread, at, kind):
        grid = box([0.0, 0.0], [2.0, 2.0], [5, 5], QUADRILATERAL)
        V = vectors(grid)
        body = box([0.0, 0.0], [1.1, 0.9], [6, 6], QUADRILATERAL)
        self.particles = p = mpm.Particles(body, V, quadrature_degree=2)
        values = {"young": young, "heat": heat, "spread": spread}
        named = {name: fem.Constant(body, value) for name, value in values.items()}
        self.named = named | {"heat": fem.Constant(grid, heat)}
        Q = fem.functionspace(body if kind == "body" else grid, ("Lagrange", 1))
        T = mpm.ParticleField(p, Q, at=at, kind=kind, name="temperature")
        d, v, q = p.displacement, ufl.TestFunction(p.W), ufl.TestFunction(T.W)
        growth = 1.0 + named["spread"] * T
        F = (ufl.Identity(2) + ufl.grad(d)) / growth
        energy = named["young"] * (0.5 * ufl.tr(F.T * F) - ufl.ln(ufl.det(F)))
        energy += named["young"] * ufl.ln(ufl.det(F)) ** 2
        R = ufl.derivative(energy * p.dx, d, v)
        flows = (T - T.previous) * q * p.dx + ufl.inner(ufl.div(d) * q, T) * p.dx
        if at == "nodes":
            flows += 0.1 * ufl.inner(ufl.grad(T), ufl.grad(q)) * p.dx
        flows -= 0.3 * named["spread"] * (1.0 + T) * q * p.dx
        self.bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 1, y=0.0)]
        if at == "nodes" and kind == "total":
            side = mpm.held(Q, x=0.0, value=self.named["heat"])
            self.bcs.append(side)
        self.problem = mpm.ParticleProblem(
            [R, flows], p, bcs=self.bcs, fields=[T], solver=mpm.Solver(petsc_options=EXACT)
        )
        self.looks = {
            "displacement": lambda: p.displacement.x.array,
            "temperature": lambda: T.x.array,
        }


@pytest.mark.parametrize(
    ("at", "kind"),
    thinned(2, [("points", "total"), ("nodes", "total"), ("nodes", "increment")]),
)
def test_several_fields(at, kind):
    values = {"young": 10.0, "heat": 0.4, "spread": 0.2}
    names = list(values) if at == "nodes" and kind == "total" else ["young", "spread"]
    check(lambda **numbers: Warm(**numbers, at=at, kind=kind), values, names, steps=3)


def test_a_motion_is_what_it_is_without():
    ends = []
    for follows in (False, True):
        scene = Thrown(**MOTION, law="von Mises", scheme="conserving")
        if follows:
            named = [scene.named[name] for name in ("young", "density")]
            gradient = mpm.Sensitivity(scene.problem, named)
        for _ in scene.problem.steps(time=0.1, dt=0.02):
            if follows:
                gradient.of(lambda scene=scene: scene.particles.stress)
        energies = [(e.kinetic, e.lost, e.external) for e in scene.problem.history.energies]
        ends.append(looked(scene) | {"energies": np.array(energies)})
    for name, values in ends[0].items():
        assert np.array_equal(values, ends[1][name]), name


def test_motion_and_water_are_the_same_on_any_number_of_ranks():
    found = []
    for comm in (WORLD, MPI.COMM_SELF):
        scene = Thrown(**MOTION, law="von Mises", comm=comm)
        gradient = mpm.Sensitivity(scene.problem, [scene.named["young"], scene.named["density"]])
        scene.problem.solve(time=0.1, dt=0.05)
        moved = gradient.of(lambda s=scene: s.particles.stress)
        wet = Wet(**WATER, comm=comm)
        slopes = mpm.Sensitivity(wet.problem, [wet.named["young"], wet.named["flow"]])
        wet.problem.solve(time=0.2, dt=0.1)
        pressed = slopes.of(lambda s=wet: s.particles.stress)
        pairs = ((scene.particles, moved), (wet.particles, pressed))
        found.append([in_order(*pair) for pair in pairs])
    for one, other in zip(*found, strict=True):
        gaps = np.abs(one - other).max(axis=(0, 1, 2))
        assert (gaps < 1e-8 * np.abs(other).max(axis=(0, 1, 2))).all(), gaps
