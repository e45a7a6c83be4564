# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Each feature gives the same answer in nine frames and units.

A scene is made where it is easy to write and taken elsewhere by ``x -> L R x + t``, with units of
stress and time of their own; what it returns is taken back. Frames turn, mirror and swap the axes;
units are those of millimetres, atoms and continents; a map has coordinates of seven digits; the
bodies may be given in the other order.
"""

from typing import NamedTuple

import numpy as np
import pytest
import scenes
from marks import all_but
from posed import posed
from posed import staged as staged_with
from routes import on_route
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx import contact, materials

YOUNG, GRAVITY = 1e3, 20.0
EXACT, MAP = 1e-10, 1e-6
SLOPES = 1e-8  # of what Sensitivity finds by differences
AXES = {
    "turned": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "mirrored": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "swapped": [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
    "upside down": [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
}


class Frame(NamedTuple):
    """A frame of coordinates, and units of length, stress and time."""

    axes: str | None = None
    length: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    stress: float = 1.0
    time: float = 1.0
    swap: bool = False

    @property
    def R(self):
        return np.array(np.eye(3) if self.axes is None else AXES[self.axes], dtype=float)

    def point(self, x):
        """Take points ``(..., dim)`` of the scene to this frame."""
        x = np.asarray(x, dtype=float)
        dim = x.shape[-1]
        return self.length * x @ self.R[:dim, :dim].T + (*self.origin, 0.0)[:dim]

    def back(self, x):
        """Take points ``(..., dim)`` back."""
        dim = x.shape[-1]
        return (x - (*self.origin, 0.0)[:dim]) @ self.R[:dim, :dim] / self.length

    def vector(self, *v):
        """Turn a vector."""
        return tuple(float(c) for c in self.R[: len(v), : len(v)] @ np.array(v))

    def turned_back(self, values):
        """Turn tensors ``(n, 3, 3)`` back."""
        return np.einsum("ai,nab,bj->nij", self.R, values, self.R)


FRAMES = {
    "turned": Frame("turned"),
    "mirrored": Frame("mirrored"),
    "swapped": Frame("swapped"),
    "millimetres": Frame(length=1e3, stress=1e-6),
    "small": Frame(length=1e-9, stress=1e9, time=1e-6),
    "large": Frame(length=1e9, stress=1e-9, time=1e6),
    "turned kilometres": Frame("turned", length=1e-3, time=60.0),
    "map": Frame(origin=(512345.0, 5412345.0)),
    "order": Frame(swap=True),
}
#: Of a body around x[0] = 0, the radius in all of them.
AROUND = {
    "upside down": Frame("upside down"),
    "map": Frame(origin=(0.0, 5412345.0)),
    **{name: FRAMES[name] for name in ("millimetres", "small", "large", "order")},
}
LAWS = {
    "hencky": lambda s: materials.Hencky(YOUNG * s, 0.3),
    "neo hooke": lambda s: materials.NeoHooke(YOUNG * s, 0.3),
    "linear": lambda s: materials.LinearElastic(YOUNG * s, 0.3),
    "von mises": lambda s: materials.VonMises(YOUNG * s, 0.3, yield_stress=8 * s, hardening=50 * s),
    "tresca": lambda s: materials.Tresca(YOUNG * s, 0.3, 12 * s),
    "mohr coulomb": lambda s: materials.MohrCoulomb(YOUNG * s, 0.3, 9 * s, 25.0, 5.0),
    "drucker prager": lambda s: materials.DruckerPrager(YOUNG * s, 0.3, 9 * s, 25.0, 5.0),
    "davis": lambda s: materials.MohrCoulomb(YOUNG * s, 0.3, 9 * s, 25.0, 5.0).davis(),
    "softening": lambda s: materials.DruckerPrager(YOUNG * s, 0.3, 9 * s, 25.0).with_softening(
        10.0, cohesion=6 * s
    ),
    "undrained": lambda s: materials.Undrained(
        materials.MohrCoulomb(YOUNG * s, 0.3, 9 * s, 25.0, 5.0), 5 * YOUNG * s
    ),
    "cam clay": lambda s: materials.ModifiedCamClay(0.1, 0.02, 1.2, 400 * s, 60 * s, 30 * s),
    "small strain": lambda s: materials.SmallStrainVonMises(
        YOUNG * s, 0.3, yield_stress=12 * s, hardening=100 * s
    ),
}


class Scene:
    """Blocks on a floor in a frame, and what was seen of them.

    Args:
        frame: The frame.
        dim: Dimension.
        degree: Of background and bodies.
        cell: Of the bodies.
        law: Name of a law.
        particles: Options of the bodies.
    """

    def __init__(self, frame, dim=2, degree=1, cell=None, law="hencky", particles=None):
        self.frame, self.dim, self.degree = frame, dim, degree
        self.cell = cell or (QUADRILATERAL if dim == 2 else HEXAHEDRON)
        self.law, self.options = LAWS[law](frame.stress), particles or {}
        self.bodies, self.bcs, self.terms, self.seen = [], [], [], {}

    def mesh(self, lower, upper, n, cell):
        """Return a mesh of a box of the scene."""
        domain = scenes.box(lower, upper, n, cell)
        x = domain.geometry.x[:, : self.dim]
        x[:] = self.frame.point(x)
        return domain

    def on(self, axis, *places):
        """Return a marker of planes of the scene."""

        def found(x):
            at = self.frame.back(x[: self.dim].T)[:, axis]
            return (np.abs(at[:, None] - places) < 1e-6).any(axis=1)

        return found

    def hold(self, V, axis, *places):
        """Hold planes in their normal direction."""
        j = int(np.argmax(np.abs(self.frame.R[:, axis])))
        V.mesh.topology.create_connectivity(self.dim - 1, self.dim)
        facets = mesh.locate_entities(V.mesh, self.dim - 1, self.on(axis, *places))
        dofs = fem.locate_dofs_topological(V.sub(j), self.dim - 1, facets)
        self.bcs.append(fem.dirichletbc(0.0, dofs, V.sub(j)))

    def background(self, floor=0.0, top=2.5, held=True):
        """Return a space whose floor and sides are held."""
        lower = [0.0, floor, 0.0][: self.dim]
        upper = [3.0, top, 1.0][: self.dim]
        n = [round(2 * (b - a)) for a, b in zip(lower, upper, strict=True)]
        grid = QUADRILATERAL if self.dim == 2 else HEXAHEDRON
        V = scenes.vectors(self.mesh(lower, upper, n, grid), self.degree)
        self.hold(V, 0, 0.0)
        if held:
            self.hold(V, 1, floor)
        if self.dim == 3:
            self.hold(V, 2, 0.0, 1.0)
        return V

    def body(self, V, floor=0.0, size=(1.6, 1.55), left=0.0):
        """Return a block, which cuts cells of its background."""
        lower = [left, floor, 0.0][: self.dim]
        upper = [left + size[0], floor + size[1], 1.0][: self.dim]
        n = [7, 6, 4] if self.degree == 1 else [4, 3, 2]
        block = self.mesh(lower, upper, n[: self.dim], self.cell)
        self.bodies.append(mpm.Particles(block, V, degree=self.degree, **self.options))
        return self.bodies[-1]

    def top(self, body, height=1.55):
        """Return tags of a body's upper side."""
        return scenes.facet_tags(body.mesh, self.on(1, height))

    def problem(self, kind=mpm.QuasiStaticProblem, law=None, load=1.0, **options):
        """Return a problem of the bodies under a force."""
        f, order = self.frame, -1 if self.frame.swap else 1
        force = f.vector(*[0.15 * GRAVITY * load, -GRAVITY * load, 0.0][: self.dim])
        unit = f.stress / (f.length * self.density)
        given = {
            "density": self.density,
            "body_force": tuple(unit * c for c in force),
            "bcs": self.bcs[::order],
            "terms": self.terms[::order],
            "petsc_options": {"snes_rtol": 1e-13},
        }
        bodies = self.bodies[0] if len(self.bodies) == 1 else self.bodies[::order]
        self.made = posed(kind, bodies, law or self.law, **{**given, **options})
        return self.made

    @property
    def density(self):
        f = self.frame
        return f.stress * f.time**2 / f.length**2

    def answer(self):
        """Return what the scene has come to, in its own frame and units."""
        found = dict(self.seen)
        for number, body in enumerate(self.bodies):
            found[f"places {number}"] = self.frame.back(scenes.in_order(body, body.centroid))
            stress = self.frame.turned_back(scenes.in_order(body, body.stress))
            found[f"stress {number}"] = stress / self.frame.stress
            found[f"plastic strain {number}"] = scenes.in_order(body, body.plastic_strain)
        return found


def weight(frame, scene=None, steps=2, **options):
    """A block under its weight."""
    scene = Scene(frame, **(scene or {}))
    # (domains of cpdi turn about their middles, and some reach below these)
    room = 0.1 if scene.options.get("method") == "cpdi" else 0.0
    scene.body(scene.background(), room, left=room)
    scene.problem(**options).solve(steps)
    return scene


def over_an_edge(frame):
    """A block whose domains turn, and reach below the grid line that it stands on by very little.

    Round-off of its coordinates is no small part of that, nor of the weights of the nodes below,
    and the answer depends on these weights' ratios (7e-5 in a map's coordinates) but for a penalty.
    """
    scene = Scene(frame, particles={"method": "cpdi"})
    V = scene.background(-0.5, 2.0, held=False)
    scene.hold(V, 1, 0.0)
    scene.body(V, left=0.1)
    scene.problem(stabilisation="ghost").solve(2)
    return scene


def loaded(frame):
    """A block under a traction, and a pressure that follows."""
    scene = Scene(frame)
    body = scene.body(scene.background())
    tags = scenes.facet_tags(body.mesh, scene.on(1, 1.55), scene.on(0, 1.6))
    force = tuple(frame.stress * c for c in frame.vector(5.0, -15.0))
    loads = {"tractions": [(force, 1)], "pressures": [(7.0 * frame.stress, 2)]}
    scene.problem(facet_tags=tags, **loads).solve(2)
    return scene


def supported(frame, kind, floor=0.1, **options):
    """A block on a support of its own base, which gives way a little."""
    scene = Scene(frame)
    body = scene.body(scene.background(-1.0, 2.0, held=False), floor)
    tags = scenes.facet_tags(body.mesh, scene.on(1, floor))
    if kind == "fixed":
        support = mpm.boundary.fixed(body, tags, 1)
    else:
        support = mpm.boundary.roller(body, tags, 1, frame.vector(0.0, -1.0))
    scene.problem(supports=[support], **options).solve(2)
    return scene


def obstacle(frame, law, shape, friction=0.3, scene=None, **options):
    """A block that a plate or a disc is pressed into."""
    scene = Scene(frame, **(scene or {}))
    body = scene.body(scene.background())
    made = {
        "plane": lambda: contact.plane(frame.point([0.0, 1.55]), frame.vector(0.1, -1.0)),
        "flat": lambda: contact.plane(frame.point([0.0, 1.55]), frame.vector(0.0, -1.0)),
        "disc": lambda: contact.disc(frame.point([0.7, 2.55]), frame.length),
    }[shape]()
    around = options.get("axisymmetric", False)
    rigid = contact.Rigid(body, made, friction, law=law, axisymmetric=around)
    scene.terms.append(rigid)
    problem = scene.problem(**options)
    down = frame.length * np.array(frame.vector(0.0 if around else 0.02, -0.1))
    problem.solve(3, update=lambda t: rigid.move(tuple(t * down)))
    force = np.array(problem.reaction(rigid)) @ frame.R[:2, :2]
    scene.seen["force"] = force / (frame.stress * frame.length ** (2 if around else 1))
    return scene


def pair(frame, law, passes=2, **options):
    """A block on a block that may slide."""
    scene = Scene(frame)
    below = scene.body(scene.background(0.0, 2.0), size=(2.2, 1.0))
    above = scene.body(scene.background(0.5, 3.0, held=False), 1.0, size=(1.5, 0.9))
    bodies = (above, below) if frame.swap else (below, above)
    scene.terms.append(contact.Pair(*bodies, friction=0.4, law=law, passes=passes))
    scene.problem(**options).solve(3)
    return scene


def pressed(frame, shape, dim=2):
    """A block that obstacles of other shapes are pressed into."""
    scene = Scene(frame, dim)
    body = scene.body(scene.background())
    f = frame
    surface = f.point(np.array([[-0.4, 1.66], [0.4, 1.57], [1.0, 1.62], [2.2, 1.58]]))
    corners = np.array([[0.3, 1.56], [0.9, 1.56], [0.6, 2.0]])
    turns = np.linalg.det(f.R[:2, :2]) > 0.0
    made = {
        "polyline": lambda: contact.polyline(surface, outside=f.vector(0.1, -1.0)),
        "polygon": lambda: contact.polygon(f.point(corners[:: 1 if turns else -1])),
        "cylinder": lambda: contact.cylinder(
            f.point([0.7, 2.56, 0.0]), f.vector(0.0, 0.0, 1.0), f.length
        ),
        "sphere": lambda: contact.sphere(f.point([0.7, 2.56, 0.4]), f.length),
    }[shape]()
    scene.terms.append(rigid := contact.Rigid(body, made, 0.3))
    problem = scene.problem()
    down = f.length * np.array(f.vector(*(0.02, -0.06, 0.0)[:dim]))
    problem.solve(2, update=lambda t: rigid.move(tuple(t * down)))
    force = np.array(problem.reaction(rigid)) @ f.R[:dim, :dim]
    scene.seen["force"] = force / (f.stress * f.length ** (dim - 1))
    return scene


def tied(frame):
    """A block tied to a block with another background."""
    scene = Scene(frame)
    below = scene.body(scene.background(0.0, 2.0), size=(1.6, 1.0))
    above = scene.body(scene.background(0.5, 3.0, held=False), 1.0, size=(1.6, 0.9))
    tags = scene.top(below, 1.0)
    scene.terms.append(mpm.Tie(below, above, tags, 1, 1e5 * frame.stress / frame.length))
    scene.problem().solve(2)
    return scene


def nailed(frame):
    """A block with a nail that slips and yields, and a cable."""
    scene = Scene(frame)
    body, unit = scene.body(scene.background()), frame.stress * frame.length
    points = frame.point(np.linspace((0.2, 1.3), (1.5, 0.5), 9))
    bond = mpm.Bond(1e3 * frame.stress / frame.length, 2.0 * frame.stress)
    nail = mpm.Truss(body, points, 200.0 * unit, yield_force=unit, bond=bond)
    across = frame.point(np.linspace((0.3, 0.2), (1.4, 0.3), 7))
    cable = mpm.Truss(body, across, 100.0 * unit, compression=False)
    scene.terms += [nail, cable]
    scene.problem(load=3.0).solve(3)
    assert np.isclose(np.abs(nail.state.bond).max(), 2.0 * frame.stress)
    scene.seen["forces"] = np.concatenate([nail.force, cable.force]) / unit
    return scene


def wrapped(frame):
    """A block in space with a sheet on its top."""
    scene = Scene(frame, 3)
    body = scene.body(scene.background())
    tags = scene.top(body)
    surface = mesh.create_submesh(body.mesh, 2, tags.find(1))[0]
    sheet = mpm.Membrane(body, surface, 50.0 * frame.stress * frame.length, 0.3, compression=False)
    scene.terms.append(sheet)
    scene.problem().solve(2)
    scene.seen["forces"] = np.sort(sheet.force, axis=0) / (frame.stress * frame.length)
    return scene


def two(frame):
    """Two blocks that share a background."""
    scene = Scene(frame)
    V = scene.background()
    scene.body(V, 0.0, (1.5, 1.0))
    scene.body(V, 1.0, (1.0, 0.7))
    scene.problem().solve(2)
    return scene


def resting(frame, **options):
    """A rigid plate that comes to rest on a block."""
    scene = Scene(frame)
    body = scene.body(scene.background())
    g = frame.length / frame.time**2
    plate = contact.RigidBody(
        body,
        contact.plane(frame.point([0.8, 1.55]), frame.vector(0.0, -1.0)),
        5.0 * scene.density * frame.length**2,
        inertia=2.0 * scene.density * frame.length**4,
        centre=frame.point([0.8, 1.8]),
        friction=0.3,
        gravity=tuple(g * c for c in frame.vector(0.0, -GRAVITY)),
    )
    scene.terms.append(plate)
    problem = scene.problem(load=0.0, **options)
    if options.get("kind") is mpm.DynamicProblem:
        problem.solve(time=0.08 * frame.time, dt=0.02 * frame.time)
    else:
        problem.solve(2)
    scene.seen["centre"] = frame.back(np.array(plate.centre, dtype=float))
    return scene


def moving(frame, scene=None, **options):
    """A block that is thrown."""
    scene = Scene(frame, **(scene or {}))
    scene.body(scene.background())
    start = np.array(frame.vector(*[1.0, -2.0, 0.0][: scene.dim])) * frame.length / frame.time
    problem = scene.problem(mpm.DynamicProblem, velocity=tuple(start), **options)
    problem.solve(time=0.08 * frame.time, dt=0.02 * frame.time)
    energy = problem.history.energies[-1]
    around = options.get("axisymmetric", False)
    unit = frame.stress * frame.length ** (3 if around else scene.dim)
    scene.seen["energies"] = np.array([energy.kinetic, energy.strain]) / unit
    return scene


def fallen(frame, law="hencky", **options):
    """A block off the grid that is thrown on a floor, whose lower corners go through it."""
    scene = Scene(frame, law=law)
    body = scene.body(scene.background(), 0.45, (1.6, 1.1), 0.07)
    start = np.array(frame.vector(0.5, -10.0)) * frame.length / frame.time
    problem = scene.problem(mpm.DynamicProblem, velocity=tuple(start), scheme="euler", **options)
    problem.step(0.06 * frame.time)
    assert 1e-4 < scenes.largest(np.minimum(frame.back(body.domains)[..., 1], 0.0)) < 0.5
    for _ in range(2):
        problem.step(0.02 * frame.time)
    floor = problem.reaction(scene.bcs[1]) @ frame.R[:2, :2]
    scene.seen["floor"] = floor / (frame.stress * frame.length)
    return scene


def adapted(frame, law="hencky"):
    """A block whose nodes are freed until the error is small."""
    scene = Scene(frame, particles={"quadrature_degree": 3, "free": []}, law=law)
    body = scene.body(scene.background())
    problem = scene.problem()
    problem.solve(2, adapt=0.12)
    scene.seen["error"] = problem.error()
    owned = body.W.dofmap.index_map.size_local
    scene.seen["free"] = float(scenes.total(body, body.free[:owned]))
    assert scene.seen["free"] > 3
    return scene


def creeping(frame):
    """A block that yields in its own time, in motion with damping, over a base of dashpots."""
    s, f = frame.stress, frame
    law = materials.VonMises(YOUNG * s, 0.3, 8 * s, hardening=50 * s).with_relaxation(0.1 * f.time)
    scene = Scene(f)
    body = scene.body(scene.background(-1.0, 2.0, held=False), 0.1)
    tags = scenes.facet_tags(body.mesh, scene.on(1, 0.1))
    impedance = 20.0 * s * f.time / f.length
    base = mpm.boundary.dashpot(body, tags, 1, impedance, 0.5 * impedance)
    rayleigh = (1.0 / f.time, 0.01 * f.time)
    problem = scene.problem(mpm.DynamicProblem, law=law, supports=[base], rayleigh=rayleigh)
    problem.solve(time=0.16 * f.time, dt=0.02 * f.time)
    assert scenes.largest(body.plastic_strain) > 0.0
    return scene


def beside(frame, scheme):
    """A block in equilibrium on which another one, which is thrown, slides."""
    scene, f = Scene(frame), frame
    below = scene.body(scene.background(0.0, 2.0), size=(2.2, 1.0))
    above = scene.body(scene.background(0.5, 3.0, held=False), 1.0, size=(1.5, 0.9))
    scene.terms.append(contact.Pair(below, above, friction=0.4))
    start = np.array(f.vector(0.0, -2.0)) * f.length / f.time
    velocity = [None, tuple(start)][:: -1 if f.swap else 1]
    options = {"velocity": velocity, "quasi_static": [below], "scheme": scheme}
    problem = scene.problem(mpm.DynamicProblem, **options)
    problem.solve(time=0.08 * f.time, dt=0.02 * f.time)
    return scene


def derived(frame, backward=False):
    """Derivatives of a run by stiffness, strength and weight."""
    scene, s = Scene(frame, particles={"quadrature_degree": 2}), frame.stress
    body = scene.body(scene.background())
    young = fem.Constant(body.mesh, YOUNG * s)
    law = materials.VonMises(young, 0.3, 8 * s, hardening=50 * s)
    force = fem.Constant(body.mesh, np.zeros(2))
    unit = s / (frame.length * scene.density)
    force.value[:] = unit * np.array(frame.vector(0.15 * GRAVITY, -GRAVITY))
    problem = scene.problem(law=law, body_force=force)
    if backward:
        kept = mpm.Adjoint(problem, [young, (law, "rho_y")])
    else:
        kept = mpm.Sensitivity(problem, [young, (law, "rho_y")])
    problem.solve(3)
    down = ufl.inner(body.displacement, ufl.as_vector(frame.vector(0.3, -1.0))) * ufl.dx
    if backward:
        slopes = [
            np.sum(slope.x.array if hasattr(slope, "x") else slope) for slope in kept.of(down)
        ]
        scene.seen["backward"] = np.array(slopes) * s / frame.length**3
    else:
        values = np.ascontiguousarray(kept.of(lambda: body.stress[:, 2, 2]))
        scene.seen["slopes"] = scenes.in_order(body, values)
    return scene


def wet(frame):
    """A block that water flows out of."""
    scene = Scene(frame, degree=2, law="linear")
    body = scene.body(scene.background())
    f = frame
    force = tuple(f.stress * c for c in f.vector(0.0, -10.0))
    problem = scene.problem(
        mpm.PorousProblem,
        permeability=1e-3 * f.length**2 / (f.stress * f.time),
        storage=1e-4 / f.stress,
        drained=[(0.0, 1)],
        tractions=[(force, 1)],
        facet_tags=scene.top(body),
    )
    problem.solve(time=0.2 * f.time, dt=0.1 * f.time)
    water = problem.pore_pressure[0]
    values = water.x.array[water.W.dofmap.list[: body.num_local]]
    scene.seen["pore pressure"] = scenes.in_order(body, values) / f.stress
    return scene


def staged(frame):
    """A block whose load and law change, which is cut, and which is excavated."""
    scene = weight(frame)
    problem = scene.made
    problem.rebase()
    staged_with(problem, material=materials.Hencky(0.5 * YOUNG * frame.stress, 0.2))
    problem.solve(2)
    corner = frame.point([1.6, 1.55])
    size = 0.6 * frame.length
    problem.remove(lambda x: np.hypot(x[0] - corner[0], x[1] - corner[1]) < size)
    problem.solve(2)
    return scene


def split(frame):
    """A block with domains that are cut."""
    scene = weight(frame)
    scene.made.split([3, 17])
    scene.made.step()
    return scene


def level(frame, **scene):
    """Ground with a stress of its own, then a load."""
    scene = Scene(frame, **scene)
    body = scene.body(scene.background(), size=(3.0, 1.5))
    scene.hold(body.V, 0, 3.0)
    g = frame.stress / (frame.length * scene.density)
    gravity = tuple(g * c for c in frame.vector(0.0, -GRAVITY))
    surface = float(np.dot(frame.point([0.0, 1.5]), frame.vector(0.0, 1.0)))
    stress = mpm.geostatic(surface, scene.density, 0.5, gravity)
    problem = scene.problem(body_force=gravity, initial_stress=stress)
    problem.solve()
    problem.remove(scene_part(scene))
    problem.solve(2)
    return scene


def scene_part(scene):
    """Return a marker of an excavation."""

    def inside(x):
        at = scene.frame.back(x[: scene.dim].T)
        return (at[:, 0] > 2.0) & (at[:, 1] > 1.0)

    return inside


def controlled(frame):
    """A block whose corner is pulled down."""
    scene = Scene(frame)
    body = scene.body(scene.background())
    problem = scene.problem()
    control = mpm.DisplacementControl(
        body,
        0.05 * frame.length,
        point=frame.point([1.6, 1.55]),
        direction=frame.vector(0.0, -1.0),
    )
    problem.solve(2, control=control)
    scene.seen["load"] = float(body.load.value)
    return scene


def automatic(frame):
    """Steps that choose themselves."""
    scene = Scene(frame, law="von mises")
    scene.body(scene.background())
    problem = scene.problem()
    problem.solve("auto", tolerance=0.05)
    scene.seen["times"] = np.array([step.time for step in problem.history.steps])
    return scene


def reduced(frame):
    """A reduction of strength."""
    scene = Scene(frame, law="mohr coulomb")
    scene.body(scene.background())
    problem = scene.problem(load=0.3)
    problem.solve(1)
    found = mpm.strength_reduction(problem, step=0.25, tolerance=0.25, most=1.6)
    scene.seen["factor"] = found.factor
    return scene


def free(frame, what="body", **options):
    """A block of finite elements, or with nodes that are free as far as told."""
    scene = Scene(frame, particles={"quadrature_degree": 3}, law=options.pop("law", "hencky"))
    if what == "body":
        body = scene.body(None)
        scene.hold(body.W, 0, 0.0)
        scene.hold(body.W, 1, 0.0)
    else:

        def inside(x):
            at = frame.back(x[:2].T)
            return (at[:, 0] > 0.7) & (at[:, 1] < 1.1)

        scene.options["free"] = inside if what == "some" else what
        scene.body(scene.background())
    problem = scene.problem(**options)
    for number, _ in enumerate(problem.steps(2)):
        scene.seen[f"error {number}"] = problem.error()
    return scene


def softening(frame):
    """A block of which the strength falls by an average over a length."""
    scene = Scene(frame, particles={"quadrature_degree": 2})
    scene.body(scene.background())
    s = frame.stress
    law = materials.VonMises(YOUNG * s, 0.3, 8 * s, hardening=100 * s)
    law = law.with_softening(10.0, residual=0.7)
    problem = scene.problem(law=law, length=0.5 * frame.length)
    problem.solve(3)
    assert problem.history.steps[-1].alternations > 2
    scene.seen["turns"] = np.array([step.alternations for step in problem.history.steps])
    return scene


def cracking(frame, split="volumetric", **scene):
    """A block that is damaged under its weight."""
    scene = Scene(frame, **scene)
    body = scene.body(scene.background())
    s = frame.stress
    toughness = 5.0 * s * frame.length
    law = materials.Fracture(scene.law, toughness, 0.6 * frame.length, model="AT2", split=split)
    problem = scene.problem(law=law)
    problem.solve(2)
    damage = problem.damage[0]
    values = damage.field.x.array[damage.field.W.dofmap.list[: body.num_local]]
    scene.seen["damage"] = scenes.in_order(body, values).sum(axis=1)
    surface = frame.stress * frame.length**scene.dim
    scene.seen["surface energy"] = damage.surface_energy() / surface
    return scene


def under_water(frame):
    """A block with a water table in it."""
    scene = Scene(frame)
    body = scene.body(scene.background(), size=(3.0, 1.55))
    scene.hold(body.V, 0, 3.0)
    up, x = frame.vector(0.0, 1.0), ufl.SpatialCoordinate(body.mesh)
    level = float(np.dot(frame.point([0.0, 1.0]), up))
    below = level - ufl.dot(x, ufl.as_vector(up))
    weight = 0.5 * GRAVITY * frame.stress / frame.length
    pressure = ufl.conditional(ufl.gt(below, 0.0), weight * below, 0.0)
    scene.problem(pore_pressure=pressure).solve(2)
    return scene


def a_table(frame):
    """Ground with water beside it, by words: heights are along the last axis of space."""
    scene, f = Scene(frame, 3), frame
    body = scene.body(scene.background())
    weight = 0.5 * GRAVITY * f.stress / f.length
    level = float(f.point([0.0, 0.0, 0.7])[2])
    scene.problem(pore_pressure=mpm.WaterTable(level, weight)).solve(2)
    assert scenes.largest(body.displacement.x.array) > 0.0
    return scene


def kept(**options):
    return lambda frame: weight(frame, **options)


def by_reference(frame):
    """Weight, with tangents that DOLFINx assembles."""
    with on_route("reference"):
        return weight(frame)


def of(function, *args, **options):
    return lambda frame: function(frame, *args, **options)


SCENES = {
    "cpdi2": kept(),
    **{m: kept(scene={"particles": {"method": m}}) for m in ("cpdi", "gimp", "mpm")},
    "triangles": kept(scene={"cell": TRIANGLE}),
    "2 x 2": kept(scene={"particles": {"quadrature_degree": 2}}),
    "degree 2": kept(scene={"degree": 2}),
    "degree 3": kept(scene={"degree": 3}),
    "f_bar domain": kept(scene={"particles": {"quadrature_degree": 2}}, f_bar="domain"),
    "f_bar patch": kept(f_bar="patch"),
    "stabilised pressure": kept(mixed="stabilised pressure"),
    "pressure": kept(scene={"degree": 2}, mixed="pressure"),
    **{law: kept(scene={"law": law}) for law in list(LAWS)[1:]},
    "space": kept(scene={"dim": 3}),
    "tetrahedra": kept(scene={"dim": 3, "cell": TETRAHEDRON}, f_bar="patch"),
    "ghost penalty": kept(stabilisation="ghost"),
    "reference": by_reference,
    "loads": loaded,
    **{kind: of(supported, kind) for kind in ("fixed", "roller")},
    # (as over an edge)
    **{
        f"{kind} on a grid line": of(supported, kind, 0.0, stabilisation="ghost")
        for kind in ("fixed", "roller")
    },
    "cpdi over an edge": over_an_edge,
    "Rigid, penalty": of(obstacle, "penalty", "plane"),
    "Rigid, nitsche": of(obstacle, "nitsche", "plane"),
    "Rigid, disc": of(obstacle, "penalty", "disc"),
    "Pair, penalty": of(pair, "penalty"),
    "Pair, nitsche": of(pair, "nitsche"),
    "Tie": tied,
    "Truss": nailed,
    "Membrane": wrapped,
    "bodies": two,
    "RigidBody": of(resting, kind=mpm.DynamicProblem),
    "midpoint": moving,
    "conserving": of(moving, scheme="conserving"),
    "euler": of(moving, scheme="euler"),
    "water": wet,
    "stages": staged,
    "split": split,
    "geostatic": level,
    "displacement control": controlled,
    "automatic steps": automatic,
    "strength reduction": reduced,
    "finite elements": free,
    "free nodes": of(free, "some"),
    "free as long as they last": of(free, "auto", law="von mises"),
    "softening": softening,
    "fracture": cracking,
    "fracture in space": of(cracking, "spectral", dim=3),
    "water table": under_water,
    "WaterTable": a_table,
    "a floor": fallen,
    "a floor, yielding": of(fallen, "von mises"),
    "adaptivity": adapted,
    "adaptivity, soil": of(adapted, "mohr coulomb"),
    "free nodes, soil": of(free, "some", law="mohr coulomb"),
    "relaxation, dashpots": creeping,
    "quasi-static beside, euler": of(beside, "euler"),
    "quasi-static beside, midpoint": of(beside, "midpoint"),
    "RigidBody at rest": resting,
    "Sensitivity": derived,
    "Adjoint": of(derived, True),
    "polyline": of(pressed, "polyline"),
    "polygon": of(pressed, "polygon"),
    "cylinder": of(pressed, "cylinder", 3),
    "sphere": of(pressed, "sphere", 3),
    "multigrid": kept(scene={"degree": 2}, linear_solver="multigrid"),
    "ugimp": kept(scene={"particles": {"method": "ugimp"}}),
}
ROUND = {
    "cpdi2": kept(axisymmetric=True),
    "f_bar patch": kept(axisymmetric=True, f_bar="patch"),
    "degree 2": kept(scene={"degree": 2}, axisymmetric=True, mixed="pressure"),
    "von mises": kept(scene={"law": "von mises"}, axisymmetric=True),
    "Rigid": of(obstacle, "penalty", "flat", axisymmetric=True),
    "moving": of(moving, axisymmetric=True),
}
QUICK = (
    "cpdi2",
    "f_bar patch",
    "Rigid, penalty",
    "conserving",
    "mohr coulomb",
    "a floor",
    "adaptivity",
)


def compare(scene, frames):
    """Compare a scene in its own frame with that in others."""
    expected = scene(Frame()).answer()
    wrong = []
    for name, frame in frames.items():
        answer = scene(frame).answer()
        for key, one in expected.items():
            size = max(float(np.abs(one).max(initial=0.0)), 1e-3)
            gap = float(np.abs(np.asarray(answer[key]) - one).max(initial=0.0)) / size
            exact = SLOPES if key == "slopes" else EXACT
            if not gap < (MAP if name == "map" else exact):
                wrong.append(f"{name}: {key} {gap:.1e}")
    assert not wrong, wrong


@pytest.mark.parametrize("name", all_but(QUICK, SCENES))
def test_a_feature_in_other_frames_and_units(name):
    compare(SCENES[name], FRAMES)


@pytest.mark.parametrize("name", all_but(("cpdi2",), ROUND))
def test_a_body_of_revolution_in_other_frames_and_units(name):
    compare(ROUND[name], AROUND)
