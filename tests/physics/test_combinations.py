# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Any two features of a problem together: they work, or a sentence says that they do not.

``docs/combinations.md`` has what is refused; each pair of features is built and run here.
"""

import contextlib
import itertools
import re
from pathlib import Path

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from marks import all_but, slow
from posed import posed, staged
from scenes import HEXAHEDRON, QUADRILATERAL, WORLD

import ufl
from dolfinx import fem, la

import mpm_dolfinx as mpm
from mpm_dolfinx.contact.rotation import rotation
from mpm_dolfinx.io import Kept
from mpm_dolfinx.materials import (
    DruckerPrager,
    Fracture,
    Hencky,
    ModifiedCamClay,
    MohrCoulomb,
    VonMises,
)
from mpm_dolfinx.solvers import linear

PAGE = Path(__file__).resolve().parents[2] / "docs" / "combinations.md"
EXACT = {"quadrature_degree": 8}
GRAVITY, YOUNG, POISSON = 10.0, 1e3, 0.3

#: The pairs are run by sixths; each feature by itself is in the first.
SIXTHS = [0, *slow(1, 2, 3, 4, 5)]

#: Part of the weight that may be left: steps that solve in turn end at 1e-6 of the forces.
BALANCED, IN_TURN = 1e-7, 3e-6


def softening():
    """Return a law whose hardening keeps it from failing where it softens."""
    return VonMises(YOUNG, POISSON, rho_y=3.0, hardening=300.0).with_softening(20.0, residual=0.7)


#: What each feature asks for. Two that ask one option for different values exclude each other.
FEATURES = {
    "gimp": {"method": "gimp"},
    "cpdi": {"method": "cpdi"},
    "mpm": {"method": "mpm"},
    "degree 2": {"degree": 2},
    "degree 3": {"degree": 3},
    "f_bar domain": {"f_bar": "domain", "quadrature": 2},
    "f_bar patch": {"f_bar": "patch"},
    "axisymmetric": {"axisymmetric": True, "dim": 2},
    "3-D": {"dim": 3},
    "bodies on one V": {"bodies": "one V"},
    "bodies on several V": {"bodies": "several V"},
    "Tie": {"bodies": "tied"},
    "Term": {"term": True},
    "support": {"support": True},
    "pressure": {"pressure": True},
    "background form": {"background": True},
    "VonMises": {"law": VonMises(YOUNG, POISSON, rho_y=6.0)},
    "MohrCoulomb": {"law": MohrCoulomb(YOUNG, POISSON, 4.0, 30.0)},
    "DruckerPrager": {"law": DruckerPrager(YOUNG, POISSON, 4.0, 30.0)},
    "ModifiedCamClay": {"law": ModifiedCamClay(0.02, 0.004, 2.5, 400.0, 5.0, 1.0)},
    "ghost": {"stabilisation": "ghost"},
    "path": {"stage": "path"},
    "control": {"stage": "control"},
    "split": {"split": True},
    "rebase": {"rebase": True},
    "repartition": {"repartition": True},
    "checkpoint": {"checkpoint": True},
    "delete": {"delete": True},
    "automatic steps": {"automatic": True},
    "mixed pressure": {"mixed": "pressure", "degree": 2},
    "multigrid": {"linear_solver": "multigrid"},
    "contact": {"contact": "penalty"},
    "Nitsche's contact": {"contact": "nitsche"},
    "stabilised pressure": {"mixed": "stabilised pressure"},
    "RigidBody": {"contact": "rigid body"},
    "finite elements": {"method": "fem"},
    "free nodes": {"method": "cpdi2", "free": "some"},
    "adaptivity": {"method": "cpdi2", "free": "found"},
    "free as long as they last": {"method": "cpdi2", "free": "auto"},
    "length": {"law": softening(), "length": 0.6},
    "Fracture": {"law": Fracture(Hencky(YOUNG, POISSON), 10.0, 1.2, model="AT2")},
    "Truss": {"truss": True},
}


class Springs(mpm.Term, Kept):
    """Springs at the nodes of a body, which soften with each step."""

    key = "springs"

    def __init__(self, body):
        super().__init__([body])
        self.stiffness = 0.5
        space = body.W.dofmap
        sizes = (n * space.bs for n in (space.index_map.size_local, space.index_map.size_global))
        self.K = PETSc.Mat().createAIJ([tuple(sizes)] * 2, nnz=1, comm=body.mesh.comm)
        self.K.setUp()

    def residuals(self):
        force = self.K.createVecLeft()
        force.array_w[:] = self.stiffness * scenes.own(self.bodies[0].displacement)
        return [force]

    def tangents(self):
        diagonal = self.K.createVecLeft()
        diagonal.set(self.stiffness)
        self.K.setDiagonal(diagonal)
        self.K.assemble()
        return {(0, 0): self.K}

    def pull(self):
        """Return the force on the body at the displacement that it has."""
        body = self.bodies[0]
        present = la.vector(body.W.dofmap.index_map, 1)
        present.array[:] = 0.0
        present.array[body.W.dofmap.list[: body.num_local][~body.deleted]] = 1.0
        present.scatter_reverse(la.InsertMode.add)
        force = -self.residuals()[0].array_r.reshape(-1, body.mesh.geometry.dim)
        return WORLD.allreduce(force[present.array[: len(force)] > 0.0].sum(axis=0))

    def kept(self):
        return [self]

    def numbers(self):
        return {"stiffness": self.stiffness}

    def restore(self, taken):
        self.stiffness = taken.numbers["stiffness"]


class Scene:
    """A block on a base, or two on each other, with what features ask for.

    Args:
        wanted: Options of the features.
    """

    def problem_of(self, bodies, law, **options):
        """Return the problem."""
        return posed(mpm.QuasiStaticProblem, bodies, law, **options)

    speed = 0.0

    def __init__(self, wanted):
        self.wanted = wanted
        self.dim = wanted.get("dim", 2)
        self.degree = wanted.get("degree", 1)
        self.springs, self.goal = None, None
        self.start = np.zeros(self.dim)
        self.start[-1] = -self.speed
        self.supports = []
        n, h = (2, 1.0) if self.dim == 3 and "delete" not in wanted else (4, 0.5)
        if self.dim == 2 and self.degree > 1:
            n, h = 2, 1.0
        two = "bodies" in wanted
        V = self.space(0.0, 2.0 if wanted.get("bodies") == "one V" else 1.0, h)
        bodies = [self.body(V, 0.0, n)]
        self.wall = fem.Constant(bodies[0].V.mesh, np.zeros(self.dim))
        self.wall.value[-1] = -0.3 if "delete" in wanted else 0.0
        self.bases = [self.base(bodies[0].V, 0.0, self.wall)]
        if two:
            above = V
            if wanted["bodies"] == "several V":
                above = self.space(1.0, 2.0, h)
            elif wanted["bodies"] == "tied":
                above = self.space(1.0 - 1.5 * h, 2.0, h)
            bodies.append(self.body(above, 1.0, n))
            above = bodies[1].V
            if wanted["bodies"] != "tied" and above is not bodies[0].V:
                self.bases.append(self.base(above, 1.0, fem.Constant(above.mesh, self.wall.value)))
        self.problem = self.made(bodies, two)

    def space(self, bottom, top, h):
        """Return a background space with a cell of room, but below where particles are to leave."""
        lower, upper = np.full(self.dim, -h), np.full(self.dim, 1.0 + h)
        lower[-1], upper[-1] = bottom if "delete" in self.wanted else bottom - h, top + h
        if "axisymmetric" in self.wanted:
            lower[0] = 0.0
        cells = np.ceil((upper - lower) / h - 1e-9).astype(int)
        cell = HEXAHEDRON if self.dim == 3 else QUADRILATERAL
        return scenes.vectors(scenes.box(lower, lower + h * cells, cells, cell), self.degree)

    def body(self, V, bottom, n):
        """Return a unit block."""
        cell = HEXAHEDRON if self.dim == 3 else QUADRILATERAL
        lower, upper = np.zeros(self.dim), np.ones(self.dim)
        lower[-1], upper[-1] = bottom, bottom + 1.0
        method = self.wanted.get("method", "cpdi2")

        def free(x):
            """Some nodes, of the first body also where it is held, but none where bodies meet."""
            height = x[self.dim - 1] - bottom
            return (x[0] > 0.4) & (height > (0.1 if bottom > 0.0 else -0.1)) & (height < 0.6)

        return mpm.Particles(
            scenes.box(lower, upper, [n] * self.dim, cell),
            None if method == "fem" else V,
            method=method,
            degree=self.degree,
            quadrature_degree=self.wanted.get("quadrature") if self.degree == 1 else None,
            outside="delete" if "delete" in self.wanted else "error",
            free={"some": free, "found": [], "auto": "auto"}.get(self.wanted.get("free")),
        )

    def base(self, V, bottom, value):
        """Return the condition that holds a bottom."""
        dofs = fem.locate_dofs_geometrical(V, lambda x: x[self.dim - 1] < bottom + 1e-9)
        return fem.dirichletbc(value, dofs, V)

    def made(self, bodies, two):
        """Return the problem."""
        wanted, first, up = self.wanted, bodies[0], self.dim - 1
        spaces = [first.V] if bodies[-1].V is first.V else [body.V for body in bodies]
        sides = [side_of(V) for V in spaces]
        self.bodies, self.two, terms = bodies, two, []
        self.side = side = scenes.facet_tags(first.mesh, scenes.at(0, 1.0))
        if "support" in wanted:
            self.grip = fem.Constant(first.mesh, self.wall.value)
            self.supports = [mpm.boundary.fixed(first, side, 1, self.grip)]
        if wanted.get("bodies") == "tied":
            top = scenes.facet_tags(first.mesh, scenes.at(up, 1.0))
            axisymmetric = wanted.get("axisymmetric", False)
            terms.append(mpm.Tie(*bodies, top, 1, 1e5, axisymmetric=axisymmetric))
        if "term" in wanted:
            self.springs = Springs(first)
            terms.append(self.springs)
        self.nail = self.contact = None
        if "truss" in wanted:
            self.nail = self.nailed(first)
            terms.append(self.nail)
        if "contact" in wanted:
            self.contact = self.touching(bodies)
            terms.append(self.contact)
        background = None
        if "background" in wanted:
            u, v = first.increment, ufl.TestFunction(first.V)
            background = 1e-3 * ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx
        names = (
            "f_bar",
            "axisymmetric",
            "stabilisation",
            "mixed",
            "linear_solver",
            "length",
        )
        return self.problem_of(
            bodies if two else first,
            wanted.get("law", Hencky(YOUNG, POISSON)),
            body_force=(*[0.0] * up, -GRAVITY),
            bcs=[*self.bases, *sides],
            tractions=(),
            pressures=self.pressures(),
            facet_tags=self.tags(),
            supports=self.supports,
            background=background,
            terms=terms,
            petsc_options={"snes_rtol": wanted.get("rtol", 1e-11)},
            **{name: wanted[name] for name in names if name in wanted},
        )

    def nailed(self, body):
        """Return a nail that goes up through a body and slips in it."""
        lower, upper = np.full(self.dim, 0.1), np.full(self.dim, 0.8)
        bond = mpm.Bond(100.0, 0.5)
        axisymmetric = "axisymmetric" in self.wanted
        points = np.linspace(lower, upper, 7)
        return mpm.Truss(body, points, 30.0, bond=bond, axisymmetric=axisymmetric)

    def tags(self):
        """Return the tags of a side of the first body, on its present mesh."""
        side = self.bodies[0].carry(self.side)
        return [side, None] if self.two else side

    def pressures(self):
        """Return the pressure on it, if there is one."""
        own = [(5.0, 1)] if "pressure" in self.wanted else []
        return [own, []] if self.two else own

    def touching(self, bodies, before=None):
        """Return a wall at a side, or a rigid one whose weight presses it there, or on the top.

        Args:
            bodies: The bodies.
            before: A rigid one, to which this is to be an equal.
        """
        first, axisymmetric = bodies[0], "axisymmetric" in self.wanted
        out = np.eye(self.dim)[0]
        if self.wanted["contact"] != "rigid body":
            law = self.wanted["contact"]
            wall = mpm.contact.plane(out, -out)
            return mpm.contact.Rigid(first, wall, 0.3, axisymmetric=axisymmetric, law=law)
        centre = np.full(self.dim, 0.6 if "delete" in self.wanted else 0.4)
        centre[0] = 1.0
        if axisymmetric:
            first, out, centre = bodies[-1], np.eye(2)[1], np.array([0.0, float(len(bodies))])
        normal, motion = -out, {"velocity": self.start}
        if before is not None:
            normal, centre = rotation(before.angle) @ normal, before.centre
            motion = {"velocity": before.velocity, "spin": before.spin}
        return mpm.contact.RigidBody(
            first,
            mpm.contact.plane(centre, normal),
            0.1,
            inertia=None if axisymmetric else 0.02,
            centre=centre,
            friction=0.3,
            gravity=-GRAVITY * out,
            axisymmetric=axisymmetric,
            **motion,
        )

    def change(self):
        """Take the bodies to other meshes or ranks."""
        problem = self.problem
        if "split" in self.wanted:
            body = problem.bodies[0]
            every = [pair for part in WORLD.allgather(heights(body)) for pair in part]
            problem.split([max(every)[1]])
        if "rebase" in self.wanted:
            problem.rebase()
        if "repartition" in self.wanted:
            problem.repartition(0.0)

    def put_equals(self, law):
        """Begin a stage with a law, and equals of all conditions, loads, supports and contacts."""
        problem, first = self.problem, self.problem.bodies[0]
        spaces = list({id(body.V): body.V for body in problem.bodies}.values())
        known = enumerate(zip(spaces, self.bases, strict=False))  # (what is tied has none)
        self.bases = [self.base(V, 1.0 * i, base.g) for i, (V, base) in known]
        given = {"facet_tags": self.tags()}
        if self.supports:
            self.supports = [mpm.boundary.fixed(first, self.side, 1, self.grip)]
            given["supports"] = self.supports
        if "pressure" in self.wanted:
            given["pressures"] = self.pressures()
        if self.contact is not None:
            old = self.contact
            self.contact = self.touching(problem.bodies, old)
            given["terms"] = [self.contact if term is old else term for term in problem.terms]
        if self.nail is not None:
            old = self.nail
            self.nail = self.nailed(first)
            terms = given.get("terms", problem.terms)
            given["terms"] = [self.nail if term is old else term for term in terms]
        up = np.zeros(self.dim)
        up[-1] = -GRAVITY
        bcs = [*self.bases, *(side_of(V) for V in spaces)]
        staged(problem, material=law, bcs=bcs, body_force=tuple(up), **given)

    def steps(self, goal=None):
        """Return the second stage.

        Args:
            goal: Of the displacement control, where another scene has begun it.
        """
        body, stage = self.problem.bodies[0], self.wanted.get("stage")
        down = self.wall.value[-1]

        def path(t):
            self.wall.value[-1] = down + 0.01 * t
            if self.supports:
                self.grip.value[-1] = down + 0.01 * t

        count, options = 2, {}
        if "automatic" in self.wanted:
            count, options = "auto", {"tolerance": 0.5, "output_at": [0.5]}
        if self.wanted.get("free") == "found":
            options["adapt"] = 0.02
        if stage == "path" or (stage is None and (count == "auto" or options)):
            return self.problem.steps(count, update=path, **options)
        if stage == "control":
            point, direction = corner(body), [*[0.0] * (self.dim - 1), 1.0]
            control = mpm.DisplacementControl(body, 0.0, point=point, direction=direction)
            self.goal = control.present() - 0.002 if goal is None else goal
            control = mpm.DisplacementControl(body, self.goal, point=point, direction=direction)
            return self.problem.steps(count, control=control, **options)
        return self.step(body)

    def step(self, body):
        """Make one step with more load."""
        body.load.value = 1.1
        yield self.problem.step()

    def require_equilibrium(self):
        """Compare the weight with all forces that carry it."""
        problem = self.problem
        weight = 0.0
        for number, body in enumerate(problem.bodies):
            masses = problem.built.masses(number)[~body.deleted]
            weight += GRAVITY * float(body.load.value) * WORLD.allreduce(masses.sum())
        held = sum(problem.reaction(s)[-1] for s in (*self.bases, *self.supports))
        if self.contact is not None:
            held += problem.reaction(self.contact)[-1]
        if "pressure" in self.wanted:
            held += self.pressed()
        if self.springs is not None:
            held += self.springs.pull()[-1]
        in_turn = any(step.alternations for step in problem.history.steps)
        assert held == pytest.approx(weight, rel=IN_TURN if in_turn else BALANCED)

    def pressed(self):
        """Return the vertical force of the pressure on the deformed side."""
        body = self.problem.bodies[0]
        F = ufl.Identity(self.dim) + ufl.grad(body.displacement)
        area = -ufl.det(F) * ufl.dot(ufl.inv(F).T, ufl.FacetNormal(body.mesh))
        if "axisymmetric" in self.wanted:
            area *= 2.0 * np.pi * (ufl.SpatialCoordinate(body.mesh) + body.displacement)[0]
        ds = ufl.ds(body.mesh, subdomain_data=body.carry(self.side), metadata=EXACT)
        form = 5.0 * body.load * area[self.dim - 1] * ds(1)
        if body.deletion is not None:
            form = body.deletion.present_only(form)
        return WORLD.allreduce(fem.assemble_scalar(fem.form(form)))


def side_of(V):
    """Return the condition that holds the side at the axis, in its normal direction."""
    part, (whole, _) = V.sub(0), V.sub(0).collapse()
    dofs = fem.locate_dofs_geometrical((part, whole), lambda x: x[0] < 1e-9)
    return fem.dirichletbc(0.0, dofs[0], part)


def heights(body):
    """Return height and index of this rank's particles."""
    up = body.mesh.geometry.dim - 1
    rows = zip(body.centroid[:, up], body.global_index, strict=True)
    return [(round(float(z), 6), int(index)) for z, index in rows]


def corner(body):
    """Return the upper node of the body's mesh at the axis."""
    dim = body.mesh.geometry.dim
    every = np.concatenate(WORLD.allgather(body.mesh.geometry.x[:, :dim]))
    return max(every.tolist(), key=lambda x: (round(x[-1], 6), -round(x[0], 6)))


def run(wanted, directory):
    """Run a scene: its weight, what changes its meshes, another stage, perhaps interrupted."""
    scene = Scene(wanted)
    scene.problem.solve()
    if "delete" in wanted:
        assert scene.problem.history.statistics["lost_particles"] > 0
    else:
        scene.require_equilibrium()
    scene.change()
    steps = scene.steps()
    if "checkpoint" not in wanted:
        finish(scene, steps)
        return
    if "stage" in wanted or "automatic" in wanted or wanted.get("free") == "found":
        next(steps)
    scene.problem.save(directory / "state")
    finish(scene, steps)
    again = Scene(wanted)
    again.problem.restore(directory / "state")
    finish(again, again.steps(scene.goal))
    for one, two in zip(scene.problem.bodies, again.problem.bodies, strict=True):
        gap = scenes.in_order(one, one.centroid) - scenes.in_order(two, two.centroid)
        assert np.abs(gap).max() <= (0.0 if WORLD.size == 1 else 1e-9)


def finish(scene, steps):
    """Run what is left of the second stage."""
    for _ in steps:
        scene.require_equilibrium()
    times = [step.time for step in scene.problem.history.steps]
    assert times == sorted(set(times)) and times[-1] == 2.0


# -- The page ----------------------------------------------------------------------------


#: What is the same in motion, has no sense there, or is refused for the same reason as at rest.
STILL = ("path", "control", "automatic steps", "adaptivity")
SCHEMES = ("midpoint", "conserving", "euler")
#: Of motions: by a scheme, or in equilibrium below a body that moves.
KINDS = (*SCHEMES, "quasi_static")


@contextlib.contextmanager
def saying(what):
    """Tell what was run where a test fails."""
    try:
        yield
    except BaseException as error:
        error.add_note(what)
        raise


def refused_by(sentence):
    """Expect an error with a sentence, or none."""
    if sentence is None:
        return contextlib.nullcontext()
    return pytest.raises(mpm.MPMError, match=re.escape(sentence))


def excludes(one, other):
    """Return whether two features want different values of one option."""
    return any(one[key] is not other[key] for key in one.keys() & other.keys())


def rows_of(title, columns):
    """Return the cells of the page's table below a title, without marks of code."""
    section = PAGE.read_text(encoding="utf-8").split(f"\n## {title}\n")[1].split("\n## ")[0]
    below = re.split(r"^\| --- .*$", section, flags=re.MULTILINE)[1]
    return re.findall(rf"^\|{columns * ' (.*?) [|]'}$", below, re.MULTILINE)


def names_in(cell):
    """Return the names that a cell lists."""
    return cell.replace("`", "").split(", ")


def refusals(title):
    """Return the sentences by which a table of the page refuses pairs of names."""
    found = {}
    for these, others, sentence in rows_of(title, 3):
        for pair in itertools.product(names_in(these), names_in(others)):
            assert frozenset(pair) not in found, pair
            found[frozenset(pair)] = re.match("`([^`]+)`", sentence)[1]
    return found


AT_REST, IN_MOTION, WITH_WATER = map(refusals, ("At rest", "In motion", "With water"))


def test_the_page_has_each_feature_and_no_other():
    listed = [name for cell, _ in rows_of("The features", 2) for name in names_in(cell)]
    assert listed == list(FEATURES)
    kinds = {*KINDS, "water"}
    assert {name for pair in AT_REST for name in pair} <= {*FEATURES}
    for table in (IN_MOTION, WITH_WATER):
        for pair in table:
            assert len(pair & kinds) == 1 and pair - kinds <= {*FEATURES} - {*STILL}


def test_a_body_of_revolution_is_in_the_plane():
    with pytest.raises(mpm.MPMError, match=r"An axisymmetric body is a mesh in the \(r, z\) plane"):
        Scene({"axisymmetric": True, "dim": 3})


def test_nothing_is_refused_that_excludes_itself():
    for one, other in AT_REST:
        assert not excludes(FEATURES[one], FEATURES[other])


@pytest.mark.parametrize("sixth", SIXTHS)
@pytest.mark.parametrize("feature", all_but(list(FEATURES)[::2], FEATURES))
@pytest.mark.filterwarnings("ignore:adapt=0.02 is not met")
@pytest.mark.filterwarnings("ignore:The run is complete, but the domains")
def test_a_feature_with_those_before_it(feature, sixth, mpi_tmp_path, monkeypatch):
    monkeypatch.setattr(linear, "COARSEST", 12)
    before = list(FEATURES)[: list(FEATURES).index(feature) + 1]
    for other in before[::-1][sixth::6]:
        if excludes(FEATURES[feature], FEATURES[other]):
            continue
        refused = AT_REST.get(frozenset((feature, other)))
        with saying(f"{feature} with {other}"), refused_by(refused):
            run(FEATURES[feature] | FEATURES[other], mpi_tmp_path)


# -- In motion ---------------------------------------------------------------------------


class Moving(Scene):
    """The same scene, let go: it begins with a velocity and full weight.

    Args:
        wanted: Options of the features.
        scheme: Of the motion.
    """

    speed = 0.1

    def __init__(self, wanted, scheme):
        self.scheme = scheme
        super().__init__(wanted)

    def problem_of(self, bodies, law, **options):
        """Return the problem."""
        start, still = tuple(self.start), []
        if "quasi_static" in self.wanted:
            start, still = [None, start], [bodies[0]]
        return posed(
            mpm.DynamicProblem,
            bodies,
            law,
            1.0,
            velocity=start,
            scheme=self.scheme,
            rayleigh=(0.5, 0.0 if isinstance(law, Fracture) else 1e-3),
            quasi_static=still,
            **options,
        )


def move(wanted, scheme, directory):
    """Run a scene in motion: two steps, what changes its meshes, two more, perhaps from a file."""

    def path(t):
        scene.wall.value[-1] = -3.0 * min(t, 0.1) if "delete" in wanted else 0.02 * t

    scene = Moving(wanted, scheme)
    dt = 0.1 if "delete" in wanted else 0.01
    scene.problem.solve(time=2 * dt, dt=dt, update=path)
    if "delete" in wanted:
        assert scene.problem.history.statistics["lost_particles"] > 0
    scene.change()
    if "checkpoint" in wanted:
        scene.problem.save(directory / "state")
    scene.problem.solve(time=4 * dt, dt=dt, update=path)
    energies = scene.problem.history.energies
    size = max(max(energy.kinetic, abs(energy.external)) for energy in energies)
    assert np.ptp([energy.balance for energy in energies]) < 1e-9 * size
    assert energies[-1].damping > 0.0
    if "checkpoint" in wanted:
        whole, scene = scene, Moving(wanted, scheme)
        scene.problem.restore(directory / "state")
        scene.problem.solve(time=4 * dt, dt=dt, update=path)
        one, two = (s.problem.bodies[0] for s in (whole, scene))
        assert np.array_equal(one.centroid, two.centroid)


@pytest.mark.parametrize(
    "feature", all_but(("Tie", "support"), [f for f in FEATURES if f not in STILL])
)
@pytest.mark.filterwarnings("ignore:The run is complete, but the domains")
def test_a_feature_in_motion(feature, mpi_tmp_path, monkeypatch):
    monkeypatch.setattr(linear, "COARSEST", 12)
    for kind in KINDS:
        options, scheme = FEATURES[feature], kind
        if kind == "quasi_static":
            options, scheme = {"bodies": "one V"} | options | {"quasi_static": True}, "midpoint"
        refused = IN_MOTION.get(frozenset((feature, kind)))
        with saying(f"{feature}, {kind}"), refused_by(refused):
            move(options, scheme, mpi_tmp_path)


# -- With water --------------------------------------------------------------------------


class Wet(Scene):
    """The same scene of degree 2 with water in its pores, which cannot leave.

    Args:
        wanted: Options of the features.
    """

    def __init__(self, wanted):
        super().__init__({"degree": 2} | wanted)

    def problem_of(self, bodies, law, **options):
        """Return the problem."""
        if options["background"] is None:
            del options["background"]
        return posed(mpm.PorousProblem, bodies, law, 1e-2, **options)

    def require_its_volume(self):
        """Compare the volume of each body with that of the beginning, as no water has left."""
        for body in self.problem.bodies:
            if any(p.particles is body for p in self.problem.pore_pressure):
                volume = WORLD.allreduce(float(body.undeformed.point_volumes().sum()))
                before = WORLD.allreduce(float(body.initial_volume.sum()))
                assert volume == pytest.approx(before, rel=1e-7)


def consolidate(wanted, directory):
    """Run a scene with water: two steps, what changes its meshes, two more, perhaps from a file."""

    def path(t):
        scene.wall.value[-1] = -0.3 * t if "delete" in wanted else 0.02 * t

    scene = Wet(wanted)
    scene.problem.solve(time=0.2, dt=0.1, update=path)
    scene.require_equilibrium()
    scene.change()
    if "checkpoint" in wanted:
        scene.problem.save(directory / "state")
    scene.problem.solve(time=0.4, dt=0.1, update=path)
    scene.require_equilibrium()
    scene.require_its_volume()
    if "checkpoint" in wanted:
        whole, scene = scene, Wet(wanted)
        scene.problem.restore(directory / "state")
        scene.problem.solve(time=0.4, dt=0.1, update=path)
        one, two = (s.problem.bodies[0] for s in (whole, scene))
        assert np.array_equal(one.centroid, two.centroid)


@pytest.mark.parametrize(
    "feature", all_but(("support", "repartition"), [f for f in FEATURES if f not in STILL])
)
def test_a_feature_with_water(feature, mpi_tmp_path, monkeypatch):
    monkeypatch.setattr(linear, "COARSEST", 12)
    with refused_by(WITH_WATER.get(frozenset((feature, "water")))):
        consolidate(FEATURES[feature], mpi_tmp_path)


# -- Stages ------------------------------------------------------------------------------


#: What does not go together with a stage that takes cells away, and why.
NO_STAGES = {
    "rebase": "are concave or deleted, so the body cannot be rebased",
    "Fracture": "Fracture does not go with remove()",
}


def stages(wanted):
    """Run a scene: its weight, a corner that is taken away, other meshes, another load."""
    scene = Scene(wanted)
    problem, up = scene.problem, scene.dim - 1
    problem.solve()
    body = problem.bodies[-1]
    top = WORLD.allreduce(float(body.initial_centroid[:, -1].max(initial=-1.0)), MPI.MAX) - 0.3
    problem.remove(lambda x: (x[up] > top) & (x[0] > 0.5), body=len(problem.bodies) - 1)
    problem.solve(2)
    scene.require_equilibrium()
    scene.change()
    weight = (*[0.0] * up, -GRAVITY)
    problem.stage(bodies=[body.replace(body_force=weight) for body in problem.setup.given])
    problem.solve(1)
    scene.require_equilibrium()
    assert problem.history.time == 3.0


@pytest.mark.parametrize(
    "feature",
    all_but(
        ("f_bar patch", "MohrCoulomb", "repartition", "support"),
        [f for f in FEATURES if f not in STILL],
    ),
)
@pytest.mark.filterwarnings("ignore:The run is complete, but the domains")
def test_a_feature_with_stages(feature):
    if feature in NO_STAGES:
        with pytest.raises(mpm.MPMError, match=re.escape(NO_STAGES[feature])):
            stages(FEATURES[feature])
    else:
        stages(FEATURES[feature])


# -- The error ---------------------------------------------------------------------------

#: Methods whose particles do not hang together.
APART = ("gimp", "cpdi", "mpm")
#: What changes the body's elements, and with them their error.
OTHER_ELEMENTS = ("split",)


@pytest.mark.parametrize(
    "feature",
    all_but(("f_bar patch", "repartition", "gimp", "RigidBody", "Truss"), [f for f in FEATURES]),
)
@pytest.mark.filterwarnings("ignore:The run is complete, but the domains")
def test_a_feature_with_an_estimate_of_the_error(feature):
    """It can be asked at any time, changes nothing, and what only moves data does not change it."""
    scene = Scene(FEATURES[feature])
    if feature in APART:
        with pytest.raises(mpm.MPMError, match="do not hang together"):
            scene.problem.error()
        return
    assert scene.problem.error() == 0.0
    scene.problem.solve()
    found = scene.problem.error()
    assert 0.0 < found < 1.0 and scene.problem.error() == pytest.approx(found, rel=1e-12)
    scene.change()
    if feature not in OTHER_ELEMENTS:
        assert scene.problem.error() == pytest.approx(found, rel=1e-5)
    for _ in scene.steps():
        assert 0.0 < scene.problem.error() < 1.0
    shares = [scene.problem.error_of_particles(i) for i in range(len(scene.problem.bodies))]
    whole = WORLD.allreduce(sum(float((own**2).sum()) for own in shares))
    assert whole == pytest.approx(scene.problem.error() ** 2, rel=1e-9)


# -- All nodes free --------------------------------------------------------------------------

#: What changes meshes or ranks, asks for nodes to be carried, or acts on the background itself.
NOT_OF_ELEMENTS = (
    *APART,
    *("bodies on one V", "split", "rebase", "repartition", "checkpoint", "delete"),
    *("background form", "mixed pressure", "stabilised pressure"),
    *("finite elements", "free nodes", "adaptivity", "free as long as they last"),
)


def outcome(scene):
    """Return where particles are, their stress, and the vertical forces on what holds them."""
    problem = scene.problem
    found = {}
    for number, body in enumerate(problem.bodies):
        for name in ("centroid", "stress"):
            found[name, number] = scenes.in_order(body, getattr(body, name))
    held = [*scene.bases, *scene.supports, *([scene.contact] if scene.contact else [])]
    found["forces", 0] = np.array([problem.reaction(one)[-1] for one in held])
    return found


def require_equal(one, other, tolerance):
    """Compare outcomes, relative to the largest value of each kind."""
    for key, values in one.items():
        gap = np.abs(values - other[key]).max()
        assert gap < tolerance * np.abs(values).max(), (key, gap)


@pytest.mark.parametrize(
    "feature",
    all_but(
        ("f_bar patch", "Tie", "RigidBody", "path", "length", "Truss"),
        [f for f in FEATURES if f not in NOT_OF_ELEMENTS],
    ),
)
def test_all_nodes_free_are_finite_elements_and_may_be_carried(feature):
    """With what moves on the background's own lines, too; as they are carried nothing moves."""
    runs = []
    for nodes in ("finite elements", "free as long as they last"):
        scene = Scene({"rtol": 1e-13} | FEATURES[feature] | FEATURES[nodes])
        scene.problem.solve()
        runs.append(scene)
    elements, scene = runs
    require_equal(outcome(elements), outcome(scene), 1e-8)
    problem = scene.problem
    for _ in range(2):  # (from where the step's background, contact and averages are those of now)
        problem.step()
    before, error = outcome(scene), problem.error()
    for body in problem.bodies:
        body.free = []
    require_equal(before, outcome(scene), 1e-15)
    assert problem.error() == pytest.approx(error, rel=1e-4)
    problem.step()
    require_equal(before, outcome(scene), 1e-6)
    for other in runs:
        for _ in other.steps():
            other.require_equilibrium()


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(
    "feature",
    all_but(
        ("VonMises", "contact"),
        [f for f in FEATURES if f not in (*NOT_OF_ELEMENTS, *STILL)],
    ),
)
@pytest.mark.filterwarnings("ignore:Time steps of")
def test_all_nodes_free_move_as_finite_elements_do(feature, scheme):
    """Let go, and led by lines of the background that move; the account closes over a change."""
    if frozenset((feature, scheme)) in IN_MOTION:
        return
    runs = []
    for nodes in ("finite elements", "free as long as they last"):
        scene = Moving({"rtol": 1e-13} | FEATURES[feature] | FEATURES[nodes], scheme)

        def path(t, scene=scene):
            scene.wall.value[-1] = 0.02 * t

        scene.problem.solve(time=0.03, dt=0.01, update=path)
        runs.append(scene)
    require_equal(outcome(runs[0]), outcome(runs[1]), 1e-8)
    for body in scene.problem.bodies:
        body.free = []
    scene.problem.solve(time=0.05, dt=0.01, update=path)
    energies = scene.problem.history.energies
    size = max(max(energy.kinetic, abs(energy.external)) for energy in energies)
    assert np.ptp([energy.balance for energy in energies]) < 1e-9 * size


# -- Equals ------------------------------------------------------------------------------


def equal(law):
    """Return another material that is the same law."""
    return law.with_parameters()


def carrier(law):
    """Return a law that carries the stress, as its stiffness differs by round-off."""
    name = "shear_modulus" if "shear_modulus" in law.parameters else "young"
    return law.with_parameters(**{name: float(np.nextafter(law.parameters[name], np.inf))})


def at_rest(wanted, between):
    """Run a scene at rest, with something between its two stages."""
    scene = Scene({"rtol": 1e-13} | wanted)
    scene.problem.solve()
    scene.change()
    between(scene)
    for _ in scene.steps():
        pass
    return scene


def in_motion(wanted, between, scheme="midpoint"):
    """Run a scene in motion, with something after its second step."""

    def path(t):
        scene.wall.value[-1] = -3.0 * min(t, 0.1) if "delete" in wanted else 0.02 * t

    scene = Moving({"rtol": 1e-13} | wanted, scheme)
    dt = 0.1 if "delete" in wanted else 0.01
    scene.problem.solve(time=2 * dt, dt=dt, update=path)
    scene.change()
    between(scene)
    scene.problem.solve(time=4 * dt, dt=dt, update=path)
    return scene


def with_water(wanted, between):
    """Run a scene with water, with something after its second step."""

    def path(t):
        scene.wall.value[-1] = -0.3 * t if "delete" in wanted else 0.02 * t

    # Motions that few resist are not at rest at 1e-13, by cubics and by iteration not at 1e-14.
    rtol = 1e-15 if wanted in (FEATURES["degree 3"], FEATURES["multigrid"]) else 1e-14
    scene = Wet({"rtol": rtol} | wanted)
    scene.problem.solve(time=0.2, dt=0.1, update=path)
    scene.change()
    between(scene)
    scene.problem.solve(time=0.4, dt=0.1, update=path)
    return scene


def require_no_event(run, wanted, *options):
    """Put equals of all that a problem has into its second half: nothing changes.

    The law is once an equal one, which goes on with the history, and once one that carries the
    stress, to round-off, which may grow where water is locked in. (A law of fracture stays.)
    """
    law = wanted.get("law", Hencky(YOUNG, POISSON))
    plain = run(wanted, lambda scene: None, *options)
    others = [(equal, 1e-12), *([] if isinstance(law, Fracture) else [(carrier, 1e-10)])]
    for other, tolerance in others:
        staged = run(wanted, lambda scene: scene.put_equals(other(law)), *options)
        for mine, its in zip(staged.problem.bodies, plain.problem.bodies, strict=True):
            for name in ("centroid", "stress"):
                one, two = getattr(mine, name), getattr(its, name)
                size = WORLD.allreduce(np.abs(two).max(initial=0.0), MPI.MAX)
                assert np.abs(one - two).max(initial=0.0) < tolerance * size


@pytest.mark.parametrize(
    "feature", all_but(("degree 2", "f_bar patch", "VonMises", "length", "Fracture"), FEATURES)
)
@pytest.mark.filterwarnings("ignore:The run is complete, but the domains")
def test_equals_change_nothing_at_rest(feature, monkeypatch):
    monkeypatch.setattr(linear, "COARSEST", 12)
    require_no_event(at_rest, FEATURES[feature])


@pytest.mark.parametrize(
    "feature", all_but(("stabilised pressure",), [f for f in FEATURES if f not in STILL])
)
@pytest.mark.filterwarnings("ignore:The run is complete, but the domains")
def test_equals_change_nothing_in_motion(feature, monkeypatch):
    monkeypatch.setattr(linear, "COARSEST", 12)
    for scheme in SCHEMES:
        if frozenset((feature, scheme)) not in IN_MOTION:
            require_no_event(in_motion, FEATURES[feature], scheme)


@pytest.mark.parametrize(
    "feature",
    all_but(
        ("MohrCoulomb",),
        [f for f in FEATURES if f not in STILL and frozenset((f, "water")) not in WITH_WATER],
    ),
)
@pytest.mark.filterwarnings("ignore:The run is complete, but the domains")
def test_equals_change_nothing_with_water(feature, monkeypatch):
    monkeypatch.setattr(linear, "COARSEST", 12)
    require_no_event(with_water, FEATURES[feature])
