# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Problems made from scenes."""

from __future__ import annotations

from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from posed import posed

from dolfinx import fem, mesh
from stress import generator

import mpm_dolfinx as mpm
from mpm_dolfinx import _compat


class Run(NamedTuple):
    """A problem with what drives it.

    Attributes:
        problem: The problem.
        bodies: Its bodies.
        density: Mass per undeformed volume.
        gravity: Force per mass at full load.
        material: The law.
        young: Young's modulus.
        bcs: The Dirichlet conditions.
        update: What sets the loads at t in (0, 1], or None for a ramp.
        factor: The load factor at t.
        youngs: Young's modulus of each domain of each body, or that of all.
        second: What sets the loads at t in a second stage, or None.
        contact: The contact, or None.
        time: End and step of a motion, as arguments, or None.
        rigid: What drives a rigid body and what it is, or None.
    """

    problem: Any
    bodies: list[Any]
    density: float
    gravity: Any
    material: Any
    young: float
    bcs: list[Any]
    update: Any
    factor: Any
    youngs: list[Any]
    second: Any = None
    contact: Any = None
    time: Any = None
    rigid: Any = None

    @property
    def touch(self):
        """What tells of the points in contact: of a rigid body its contact, or None."""
        return self.contact if self.rigid is None else self.contact.contacts[0]


def grid(comm, lower, upper, n, cell, diagonal):
    """Return a structured mesh."""
    kind = getattr(mesh.CellType, cell)
    if len(n) == 3:
        return mesh.create_box(comm, [lower, upper], n, kind)
    return mesh.create_rectangle(
        comm, [lower, upper], n, kind, diagonal=getattr(mesh.DiagonalType, diagonal)
    )


def wobble(x, amount):
    """Return displacements that look random and depend on positions alone."""
    dim = x.shape[1]
    phase = x @ np.array([[127.1, 311.7], [269.5, 183.3], [74.7, 246.1]])[:dim]
    values = np.sin(phase) * 43758.5453
    values = 2.0 * (values - np.floor(values)) - 1.0
    return amount * np.column_stack([values, values[:, 0] * values[:, 1]])[:, :dim]


def shaped(x, data):
    """Return the positions of a body's nodes, from those of the unit square or cube."""
    shape, dim = data["shape"], x.shape[1]
    size, origin = np.array(data["size"]), np.array(data["origin"])
    if shape == "jitter":
        spacing = np.array([1.0 / n for n in data["n"]])
        inner = np.all((x > 1e-9) & (x < 1 - 1e-9), axis=1)[:, None]
        x = x + inner * spacing * wobble(np.round(x, 9), 0.25)
    if shape == "disc":
        a = 2.0 * x - 1.0
        x = 0.5 + 0.5 * np.column_stack(
            [a[:, 0] * np.sqrt(1 - 0.45 * a[:, 1] ** 2), a[:, 1] * np.sqrt(1 - 0.45 * a[:, 0] ** 2)]
        )
    if shape == "ring":
        radius, angle = 0.5 + 0.5 * x[:, 1], 0.5 * np.pi * (1.0 - x[:, 0])
        x = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    if shape == "trapezium":
        x = np.column_stack([0.5 + (x[:, 0] - 0.5) * (1.0 - 0.5 * x[:, 1]), x[:, 1]])
    if shape == "wave":
        x = np.column_stack([x[:, 0], x[:, 1] + 0.1 * np.sin(6.0 * x[:, 0])])
    x = x * size
    if shape == "turned":
        c, s = np.cos(data["angle"]), np.sin(data["angle"])
        turn = np.eye(dim)
        turn[:2, :2] = [[c, -s], [s, c]]
        x = x @ turn.T
    return x + origin


def make_body(comm, data, unit):
    dim = len(data["n"])
    domain = grid(comm, [0.0] * dim, [1.0] * dim, data["n"], data["cell"], data["diagonal"])
    domain.geometry.x[:, :dim] = unit * shaped(domain.geometry.x[:, :dim].copy(), data)
    return domain


def make_background(comm, data, low, high, floor):
    """Return a background around a box, without room left of (0) and below (1) it in ``floor``."""
    h = data["h"] * (1.0 if data.get("unit") is None else data["unit"])
    room = max(data["room"] * h / data["h"], h)
    shift = np.array(data["shift"]) * h / data["h"]
    cells_below = np.full(len(low), int(np.ceil(room / h - 1e-9)))
    for axis in floor:
        cells_below[axis] = 0
    lower = low - cells_below * h + shift
    n = np.maximum(1, np.ceil((high + room - lower) / h - 1e-9).astype(int))
    upper = lower + n * h
    domain = grid(comm, lower, upper, [int(k) for k in n], data["cell"], data["diagonal"])
    if data["jitter"] > 0.0:
        dim = len(low)
        x = domain.geometry.x[:, :dim]
        place = (x - lower) / h
        inner = np.all((place > 1e-6) & (place < n - 1e-6), axis=1)[:, None]
        x += inner * h * wobble(np.round(place, 6), data["jitter"])
    return domain, lower, upper, h


def fold(domain, place):
    """Invert a triangle, or make a quadrilateral cross itself, in the middle (collective)."""
    x = domain.geometry.x
    low, high = box_of([domain])
    corners = x[_compat.geometry_dofmap(domain)]
    gap = np.linalg.norm(corners[:, :, :2].mean(axis=1) - low - place * (high - low), axis=1)
    mine = (gap.min(initial=np.inf), domain.comm.rank, corners[gap.argmin()])
    _, _, corners = min(domain.comm.allgather(mine), key=lambda one: one[:2])
    moved = corners.copy()
    if len(corners) == 3:
        moved[0] += 2.2 * (corners[1:].mean(axis=0) - corners[0])
    else:
        moved[:2] = corners[1::-1]
    before = x.copy()
    for old, new in zip(corners, moved, strict=True):
        x[np.abs(before - old).max(axis=1) < 1e-9 * np.abs(high - low).max()] = new


def stiffnesses(body, scene, young):
    """Return Young's modulus as a DG0 Function, stiff in a part of a body."""
    result = fem.Function(fem.functionspace(body, ("DG", 0)))
    cells = np.arange(len(result.x.array), dtype=np.int32)
    x = mesh.compute_midpoints(body, 2, cells)[:, :2] / scene["units"][0]
    low, high = (v / scene["units"][0] for v in box_of([body]))
    place = (x - low) / (high - low)
    marked = {
        "top": place[:, 1] > 0.5,
        "inside": (np.abs(place - 0.5) < 0.3).all(axis=1),
        "checks": (np.floor(4.0 * place).sum(axis=1) % 2).astype(bool),
        "some": wobble(np.round(place, 6), 1.0)[:, 0] > 0.5,
    }[scene["stiff"]]
    result.x.array[:] = young * np.where(marked, scene["contrast"], 1.0)
    return result


def box_of(bodies):
    """Return the lower and upper corner of bodies on all ranks."""
    comm, dim = bodies[0].comm, bodies[0].geometry.dim
    points = np.concatenate([b.geometry.x[:, :dim] for b in bodies])
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    return low, high


def hold(V, marker, component=None):
    """Return a condition, and its value, on all nodes of V where a marker holds."""
    if component is None:
        value = fem.Constant(V.mesh, np.zeros(V.mesh.geometry.dim))
        return fem.dirichletbc(value, fem.locate_dofs_geometrical(V, marker), V), value
    value = fem.Constant(V.mesh, 0.0)
    sub = V.sub(component)
    dofs = fem.locate_dofs_geometrical((sub, sub.collapse()[0]), marker)[0]
    return fem.dirichletbc(value, dofs, sub), value


def supports(V, kind, low, high, lower, h):
    """Return conditions; the last value is that of the grip that moves."""
    near = 1e-6 * h
    if kind == "none":
        return []
    if kind == "edge":
        return [hold(V, lambda x: x[0] < lower[0] + 0.5 * h + near)]
    if kind == "clamp":
        return [hold(V, lambda x: x[0] < low[0] + 1.5 * h + near)]
    if kind == "stand":
        return [hold(V, lambda x: x[1] < low[1] + near)]
    if kind == "sunk":
        return [hold(V, lambda x: x[1] < low[1] + 1.5 * h + near)]
    if kind == "roll":
        return [
            hold(V, lambda x: x[0] < low[0] + near, 0),
            hold(V, lambda x: x[1] < low[1] + near, 1),
        ]
    assert kind == "grips"
    return [
        hold(V, lambda x: x[0] < low[0] + 0.6 * h + near),
        hold(V, lambda x: x[0] > high[0] - 0.6 * h - near),
    ]


def make_material(data, stress):
    """Return the law of a scene and its Young's modulus."""
    laws = {"hencky": mpm.materials.Hencky, "linear": mpm.materials.LinearElastic}
    if data["law"] in laws:
        return laws[data["law"]](stress, data["poisson"]), stress
    if "cohesion" in data:
        elastic, strength = (stress, data["poisson"]), data["cohesion"] * stress
        if data["law"] == "tresca":
            return mpm.materials.Tresca(*elastic, strength), stress
        laws = {
            "mohr_coulomb": mpm.materials.MohrCoulomb,
            "drucker_prager": mpm.materials.DruckerPrager,
        }
        return laws[data["law"]](
            *elastic,
            strength,
            data["friction"],
            data["dilation"],
            volume_correction=data["volume_correction"],
        ), stress
    laws = {"von_mises": mpm.materials.VonMises, "small": mpm.materials.SmallStrainVonMises}
    return laws[data["law"]](
        stress,
        data["poisson"],
        rho_y=data["rho_y"] * stress,
        hardening=data["hardening"] * stress,
    ), stress


def shape_of(data):
    """Return an obstacle."""
    name, size, radius = data["shape"], data["size"], data["radius"]
    if name == "plane":
        return mpm.contact.plane(data["point"], data["normal"])
    c = np.array(data["centre"])
    if name == "disc":
        kind = mpm.contact.disc if len(c) == 2 else mpm.contact.sphere
        return kind(c, size)
    if name == "cylinder":
        return mpm.contact.cylinder(c, (0.0, 0.0, 1.0), size)
    if name == "box":
        return mpm.contact.box(c - size, c + size, radius)
    if name == "polygon":
        corners = c + size * np.array([[0.0, -1.0], [0.9, 0.2], [0.5, 1.0], [-0.6, 0.7]])
        return mpm.contact.polygon(corners, radius)
    if name == "cavity":
        return mpm.contact.cavity(mpm.contact.disc(c, size))
    if name == "polyline":
        corners = c + size * np.array([[-0.8, -1.0], [0.8, -1.0], [0.6, 0.9], [-0.7, 0.6]])
        return mpm.contact.polyline(corners[[0, 1, 2, 3, 0]], radius=radius, pivot=c)
    if name == "triangles":
        corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        halves = [(q[0], *q[k : k + 2]) for q in sides for k in (1, 2)]
        return mpm.contact.triangulated(c + size * corners, halves, radius=radius, pivot=c)
    assert name == "ellipse"

    def capsule(y):
        arm = y - c
        arm = arm - np.clip(arm[:, :1], -0.4 * size, 0.4 * size) * np.array([1.0, 0.0])
        return np.linalg.norm(arm, axis=1) - 0.6 * size

    return mpm.contact.signed_distance(capsule, c)


def make_contact(scene, bodies):
    """Return the contact of a scene."""
    data = scene["contact"]
    law = mpm.contact.Coulomb(data["friction"], cohesion=data["cohesion"])
    if "obstacle" in data:
        shape, penalty = shape_of(data["obstacle"]), data["penalty"]
        if "rigid" in data:
            about = data["rigid"]
            given = {k: about[k] for k in ("mass", "inertia", "gravity", "fixed")}
            moves = about["velocity"] is not None
            if moves:
                turns = about["spin"] if shape.dim == 2 else (0.0, 0.0, about["spin"])
                given |= {"velocity": about["velocity"], "spin": turns}
            if not any(about["gravity"]):
                given["gravity"] = None
            centre = data["obstacle"].get("centre", data["obstacle"].get("point"))
            return mpm.contact.RigidBody(
                bodies[0], shape, friction=law, centre=centre, penalty=penalty, **given
            )
        return mpm.contact.Rigid(
            bodies[0], shape, law, penalty=penalty, law=data.get("law", "penalty")
        )
    passes, penalty = data["passes"], data["penalty"]
    return mpm.contact.Pair(bodies[1], bodies[0], law, passes=passes, penalty=penalty)


def make(scene, comm) -> Run:
    """Return the problem of a scene (collective).

    Raises:
        MPMError: What the package says of the input.
    """
    length, stress = scene["units"]
    shapes = [scene["body"], *([scene["second"]] if "second" in scene else [])]
    meshes = [make_body(comm, data, length) for data in shapes]
    if scene.get("fold") == "body":
        fold(meshes[0], scene["place"])
    low, high = box_of(meshes)
    support = scene["support"]
    if support == "stand" and any(data["shape"] not in generator.FLAT for data in shapes):
        support = "sunk"
    floor = {"stand": (1,), "roll": (0, 1)}.get(support, ())
    # The parallelograms of CPDI reach beyond the faces of the body.
    if scene["method"] == "cpdi":
        floor = ()
    background, lower, _, h = make_background(
        comm, {**scene["background"], "unit": length}, low, high, floor
    )
    if scene.get("fold") == "background":
        fold(background, scene["place"])
    dim = scene["dim"]
    V = fem.functionspace(background, ("Lagrange", scene.get("degree", 1), (dim,)))
    options = {"method": scene["method"], "quadrature_degree": scene["quadrature_degree"]}
    options |= {k: scene[k] for k in ("outside",) if k in scene}
    if "update" in scene and scene["method"] == "gimp":
        options["method"] = "gimp" if scene["update"] == "stretch" else "ugimp"
    if "domain_degree" in scene:
        options["degree"] = scene["domain_degree"]
    pair = "passes" in scene.get("contact", {})
    spaces = [V for _ in meshes]
    if pair:
        other = background
        if "second_background" in scene:
            data = {**scene["second_background"], "unit": length}
            other = make_background(comm, data, low, high, ())[0]
        spaces[1] = fem.functionspace(other, ("Lagrange", scene.get("degree", 1), (dim,)))
    bodies = [mpm.Particles(body, W, **options) for body, W in zip(meshes, spaces, strict=True)]
    if support == "press":
        held = [
            hold(V, lambda x: x[1] < low[1] + 0.5 * h),
            hold(spaces[1], lambda x: x[1] > high[1] - 0.6 * h),
        ]
    else:
        held = supports(V, support, low, high, lower, h)
    touch = make_contact(scene, bodies) if "contact" in scene else None
    bcs = [bc for bc, _ in held]
    motion = length * np.array(scene.get("motion", [0.0] * dim))
    if held and "motion" in scene:
        held[-1][1].value[:] = motion

    def factor(t):
        if scene["path"] == "reverse":
            return float(np.interp(t, [0.0, 0.25, 0.75, 1.0], [0.0, 1.0, -1.0, 0.0]))
        if scene["path"] == "cycle":
            return float(np.sin(4.0 * np.pi * t))
        return t

    def update(t):
        for body in bodies:
            body.load.value = factor(t)
        if touch is not None and "rigid" in scene["contact"]:
            about = scene["contact"]["rigid"]
            moment = t * about["moment"]
            touch.push(t * np.array(about["force"]), moment if dim == 2 else (0.0, 0.0, moment))
        elif touch is not None and "obstacle" in scene["contact"]:
            touch.move(t * np.array(scene["contact"]["way"]), t * scene["contact"]["turn"])
        elif support == "press":
            held[-1][1].value[:] = t * np.array(scene["contact"]["way"])
        if "motion" in scene:
            held[-1][1].value[:] = factor(t) * motion

    # A weight is a force per volume over Young's modulus and length.
    density = stress / length
    gravity = np.array(scene["weight"])
    material, young = make_material(scene["material"], stress)
    youngs = [young for _ in bodies]
    if "contrast" in scene:
        field = stiffnesses(meshes[0], scene, young)
        youngs = [field.x.array[: bodies[0].num_local].copy()]
        material = material.with_parameters(young=field)
    force = fem.Constant(meshes[0], gravity) if "second_weight" in scene else tuple(gravity)

    def second(t):
        gravity[:] = (1.0 - t) * np.array(scene["weight"]) + t * np.array(scene["second_weight"])
        force.value[:] = gravity

    kind, more, time = mpm.QuasiStaticProblem, {}, None
    if touch is not None:
        more = {"terms": [touch]}
    if "motion_of" in scene:
        about, kind = scene["motion_of"], mpm.DynamicProblem
        up, along = np.eye(dim)[1], np.eye(dim)[0]
        speeds = [tuple(about["speed"] * up)] + [tuple(0.1 * about["speed"] * along)] * (
            len(bodies) - 1
        )
        more |= {
            "velocity": speeds if len(bodies) > 1 else speeds[0],
            **{k: about[k] for k in ("scheme", "out_of_range")},
        }
        time = {"time": about["time"], "dt": about["time"] / scene["steps"]}
    problem = posed(
        kind,
        bodies if len(bodies) > 1 else bodies[0],
        material,
        density=density,
        body_force=force,
        bcs=bcs,
        petsc_options_prefix=f"stress_{scene['number']}_",
        **more,
        **scene.get("options", {}),
    )
    return Run(
        problem,
        bodies,
        density,
        gravity,
        material,
        young,
        bcs,
        None if scene["path"] == "ramp" or time is not None else update,
        factor,
        youngs,
        second if "second_weight" in scene else None,
        touch,
        time,
        scene.get("contact", {}).get("rigid"),
    )
