# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs that depend on a few numbers, and what is looked at in the end."""

import numpy as np
from scenes import HEXAHEDRON, QUADRILATERAL, WORLD, box, neo_hookean, vectors

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials

#: Differences of whole runs are as good as Newton's method is exact.
EXACT = {"snes_rtol": 1e-13}
TOLERANCE = 1e-6
REACTIONS = ("reaction", "support", "side")
VON_MISES = {"young": 5e4, "strength": 1.2e3, "weight": 1e3}
LOADS = {
    "young": 5e4,
    "weight": 1e3,
    "push": 300.0,
    "pressure": 400.0,
    "moved": 0.02,
    "lifted": 0.03,
    "stress": 700.0,
}


def von_mises(young, strength):
    return materials.VonMises(young, 0.3, yield_stress=strength, hardening=2e3)


class Slump:
    """A block on a rough base under its weight.

    Args:
        law: Makes the law of Constants by name.
        values: Values of these by name, and ``weight``.
        material: Makes the law of the body mesh, instead.
        lid: Whether there is a rigid lid far above it.
        problem: The class of problems.
        free: Whether it is one of finite elements, without a background.
        **options: Of Body, Particles and the problem, as they are named here.

    Attributes:
        problem: The problem.
        named: Parameters by name, as a Sensitivity takes them.
        looks: Functions of the problem's state by name.
    """

    def __init__(
        self,
        law,
        values,
        cell=QUADRILATERAL,
        degree=1,
        stabilisation="auto",
        gdim=2,
        quadrature_degree=2,
        axisymmetric=False,
        mixed=None,
        material=None,
        lid=False,
        method="cpdi2",
        outside="error",
        problem=mpm.QuasiStaticProblem,
        comm=WORLD,
        free=False,
        **options,
    ):
        plane = gdim == 2
        low, high = [0.0] * gdim, [1.0, 2.0, 1.0][:gdim]
        kind = QUADRILATERAL if plane else HEXAHEDRON
        wide, cells = [2.0, 2.5, 2.0][:gdim], [6, 8] if plane else [4, 5, 4]
        V = vectors(box(low, wide, cells, kind, comm), degree)
        body = box(low, high, [6, 12] if plane else [4, 8, 4], cell, comm)
        self.particles = mpm.Particles(
            body,
            None if free else V,
            None if free else method,
            quadrature_degree=quadrature_degree,
            degree=degree,
            outside=outside,
        )
        V = self.particles.V
        of_law = {name: value for name, value in values.items() if name != "weight"}
        self.named = {name: fem.Constant(body, value) for name, value in of_law.items()}
        self.bcs = [mpm.held(V, i, **{"xyz"[i]: 0.0}) for i in range(gdim)]
        self.bcs += [mpm.held(V, 0, y=0.0)]
        self.weight = fem.Constant(body, values["weight"])
        force = ufl.as_vector([0.0, -self.weight, 0.0][:gdim])
        made = law(**self.named) if material is None else material(body)
        top = mpm.contact.plane((0.0, 9.0), (0.0, -1.0))
        terms = [mpm.contact.Rigid(self.particles, top)] if lid else []
        self.problem = problem(
            mpm.Body(self.particles, made, body_force=force, **options),
            self.bcs,
            axisymmetric=axisymmetric,
            terms=terms,
            mixed=mixed,
            solver=mpm.Solver(stabilisation=stabilisation, petsc_options=EXACT),
        )
        self.named["weight"] = self.weight
        points = self.problem.points[0]
        self.looks = {
            "displacement": lambda: self.particles.displacement.x.array,
            "stress": lambda: self.particles.point_stress,
            "reaction": lambda: self.problem.reaction(self.bcs[0]),
        }
        if getattr(points.laws.given[0], "inelastic", False):
            self.looks["plastic"] = lambda: points.last.variable("plastic_strain")


class Loaded:
    """A block with all kinds of loads and conditions at once.

    Args:
        support: Kind of support on its base.
        f_bar: With an average the initial stress grows with depth.
        **numbers: See ``LOADS``.
    """

    def __init__(
        self, young, weight, push, pressure, moved, lifted, stress, support="fixed", f_bar="none"
    ):
        V = vectors(box([0.0, -0.5], [2.0, 2.5], [6, 9], QUADRILATERAL))
        body = box([0.0, 0.0], [1.0, 2.0], [6, 12], QUADRILATERAL)
        self.particles = particles = mpm.Particles(body, V, quadrature_degree=2)
        of_body = {
            "young": young,
            "weight": weight,
            "push": push,
            "pressure": pressure,
            "lifted": lifted,
            "stress": stress,
        }
        named = {name: fem.Constant(body, value) for name, value in of_body.items()}
        self.named = named | {"moved": fem.Constant(V.mesh, moved)}
        tags = mpm.facet_tags(
            body, {1: mpm.region(y=2.0), 2: mpm.region(x=1.0), 3: mpm.region(y=0.0)}
        )
        self.bcs = [mpm.held(V, 0, x=0.0, value=self.named["moved"])]
        up, lifted = (0.1, 1.0), named["lifted"]
        if support == "fixed":
            rest = mpm.boundary.fixed(particles, tags, 3, ufl.as_vector([0.0, lifted]))
        else:
            rest = mpm.boundary.roller(particles, tags, 3, up, lifted)
        given = mpm.Body(
            particles,
            von_mises(named["young"], 2.5e3),
            density=named["weight"] / 10.0,
            body_force=(0.0, -10.0),
            tractions=[(ufl.as_vector([named["push"], 0.2 * named["push"]]), 1)],
            pressures=[(named["pressure"], 2)],
            facet_tags=tags,
            initial_stress=-named["stress"]
            * (1.0 if f_bar == "none" else 2.0 - ufl.SpatialCoordinate(body)[1])
            * ufl.Identity(3),
            f_bar=f_bar,
        )
        self.problem = mpm.QuasiStaticProblem(
            given, self.bcs, supports=[rest], solver=mpm.Solver(petsc_options=EXACT)
        )
        self.looks = {
            "displacement": lambda: particles.displacement.x.array,
            "stress": lambda: particles.stress,
            "plastic": lambda: self.problem.points[0].last.variable("plastic_strain"),
            "support": lambda: self.problem.reaction(rest),
            "side": lambda: self.problem.reaction(self.bcs[0]),
        }


class Written:
    """A residual in UFL: a neo-Hookean block, perhaps with an averaged volume ratio.

    Args:
        young: Young's modulus.
        poisson: Poisson's ratio.
        weight: Per volume.
        over: What the volume ratio is averaged over; ``None``: it is not.
    """

    def __init__(self, young, poisson, weight, over=None):
        V = vectors(box([0.0, 0.0], [2.0, 2.5], [6, 8], QUADRILATERAL))
        body = box([0.0, 0.0], [1.0, 2.0], [6, 12], QUADRILATERAL)
        self.particles = particles = mpm.Particles(body, V, quadrature_degree=2)
        values = {"young": young, "poisson": poisson, "weight": weight}
        self.named = {name: fem.Constant(body, value) for name, value in values.items()}
        young, poisson, weight = self.named.values()
        d, v = particles.displacement, ufl.TestFunction(particles.W)
        if over is None:
            R = ufl.derivative(neo_hookean(d, young, poisson) * particles.dx, d, v)
        else:
            ratio = mpm.AveragedVolumeRatio(particles, over)
            F = ufl.Identity(2) + ufl.grad(d)
            shape = ufl.tr(F.T * F) / ufl.det(F) - 2.0
            shear, bulk = young / (2.0 + 2.0 * poisson), young / (3.0 - 6.0 * poisson)
            energy = shear / 2.0 * shape + bulk / 2.0 * (ratio - 1.0) ** 2
            R = ratio.residual(energy * particles.dx)
        force = ufl.as_vector([0.0, -weight])
        R -= particles.load * ufl.inner(force, v) * particles.dx_exact
        self.bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, y=0.0)]
        self.problem = mpm.ParticleProblem(
            R, particles, bcs=self.bcs, symmetric=True, solver=mpm.Solver(petsc_options=EXACT)
        )
        self.looks = {
            "displacement": lambda: particles.displacement.x.array,
            "reaction": lambda: self.problem.reaction(self.bcs[0]),
            "volume": lambda: particles.volume,
        }


class Stacked:
    """A block on another one, the toe of which a line of the grid has just let go.

    Args:
        below: Young's modulus of the lower one.
        above: That of the upper one.
        weight: Per volume.
    """

    def __init__(self, below, above, weight):
        V = vectors(box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
        meshes = [
            box([0.3, 0.0], [1.3, 0.998], [4, 4], QUADRILATERAL),
            box([0.3, 0.0], [1.3, 0.4], [4, 2], QUADRILATERAL),
        ]
        x = meshes[1].geometry.x
        x[:, 0] = 0.3 + (x[:, 0] - 0.3) * (1.0 - 0.7 * x[:, 1] / 0.4)
        x[:, 1] += 1.0 + 5e-3
        bodies = [mpm.Particles(body, V) for body in meshes]
        laws = [materials.Hencky(young, 0.3) for young in (below, above)]
        given = [
            mpm.Body(particles, law, body_force=(0.0, -weight))
            for particles, law in zip(bodies, laws, strict=True)
        ]
        self.problem = mpm.QuasiStaticProblem(
            given, [mpm.held(V, y=0.0)], solver=mpm.Solver(petsc_options=EXACT)
        )
        self.named = {"below": (laws[0], "young"), "above": (laws[1], "young")}
        self.looks = {
            str(i): lambda own=own: own.displacement.x.array for i, own in enumerate(bodies)
        }


def size(values):
    """Return the Euclidean norm of an array of all ranks."""
    return float(np.sqrt(WORLD.allreduce(np.sum(np.asarray(values) ** 2))))


def looked(scene):
    """Return what is seen of a scene, by name."""
    return {name: np.array(look()) for name, look in scene.looks.items()}


def check(make, values, names=None, steps=3, change=2e-6, run=None):
    """Compare the derivatives of all looks by some numbers with differences of whole runs.

    Differences are relative to a derivative, or to a tenth of what is looked at by a relative
    change of the number. A reaction of a support is a penalty times a gap, which has fewer digits:
    it is compared with the reaction itself.

    Args:
        make: Makes a scene of numbers.
        values: By name.
        names: Those to differentiate by; all by default.
        steps: Steps of a run.
        change: Relative, of differences.
        run: Runs a scene.
    """
    names = list(values) if names is None else names
    run = (lambda scene: scene.problem.solve(steps)) if run is None else run
    scene = make(**values)
    gradient = mpm.Sensitivity(scene.problem, [scene.named[name] for name in names])
    run(scene)
    found = {look: gradient.of(see) for look, see in scene.looks.items()}
    seen, gaps = looked(scene), {}
    for number, name in enumerate(names):
        ends = []
        for sign in (1.0, -1.0):
            other = make(**values | {name: values[name] * (1.0 + sign * change)})
            run(other)
            ends.append(looked(other))
        for look, derivative in found.items():
            difference = (ends[0][look] - ends[1][look]) / (2.0 * change * values[name])
            share = 1.0 if look in REACTIONS else 0.1
            whole = max(size(difference), share * size(seen[look]) / abs(values[name]))
            gaps[name, look] = size(derivative[..., number] - difference) / (whole or 1.0)
    assert max(gaps.values()) < TOLERANCE, gaps
