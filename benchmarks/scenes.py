# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scenes of the cases as functions: the same bodies, backgrounds, loads and errors."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import basix
import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

sys.path.append(str(Path(__file__).resolve().parent / "cases"))

import kit


@dataclass
class Scene:
    """A problem, how many load steps it takes, and what to measure at the end.

    Attributes:
        problem: The problem, before its first step.
        steps: Load steps, or time steps.
        measure: Returns numbers by name, `error` among them.
        run: Makes the steps, where ``problem.solve(steps)`` does not.
    """

    problem: Any
    steps: int
    measure: Callable[[], dict[str, Any]]
    run: Callable[[], Any] | None = None

    def solve(self) -> None:
        """Make the steps."""
        if self.run is not None:
            self.run()
        else:
            solve(self.problem, self.steps)

    def account(self) -> dict[str, Any]:
        """Return how large it is, how far it came, and the linear solves of all attempts."""
        history = self.problem.history
        return {
            "particles": self.problem.bodies[0].num_global,
            "load": history.load[-1] if history.load else 0.0,
            "iterations": history.total_iterations,
            "cutbacks": history.cutbacks,
        }


def solve(problem: mpm.Problem, steps: int, **given: Any) -> None:
    """Make load steps; with nodes of bodies that are made for it freed where the background errs.

    As many are freed as are worth it, whatever the body's own elements err by.
    """
    if any(body.free_nodes is not None for body in problem.bodies):
        given["adapt"] = 1e-6
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "adapt=", UserWarning)
        problem.solve(steps, **given)


def rollers(V: fem.FunctionSpace, *planes: tuple[int, float]) -> list[fem.DirichletBC]:
    """Rollers on planes x[axis] = place of the background."""
    bcs = []
    for axis, place in planes:
        side = V.mesh.topology.dim - 1
        facets = mesh.locate_entities_boundary(
            V.mesh, side, lambda x, axis=axis, place=place: np.isclose(x[axis], place)
        )
        dofs = fem.locate_dofs_topological(V.sub(axis), side, facets)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
    return bcs


def particles_of(
    body: mesh.Mesh, V: fem.FunctionSpace, method: str, degree: int, rule: int | None = None
) -> mpm.Particles:
    """Return particles of a method; ``"fem"`` finite elements, ``"adapted"`` with nodes to free."""
    options: dict[str, Any] = {"degree": degree, "quadrature_degree": rule}
    if method == "fem":
        return mpm.Particles(body, **options)
    if method == "adapted":
        return mpm.Particles(body, V, free=[], **options)
    return mpm.Particles(body, V, method=method, **options)


def _column(
    elements: float,
    height: float,
    law: mpm.materials.Material,
    weight: float,
    domain: str,
    method: str,
    degree: int,
) -> tuple[mpm.Particles, mpm.QuasiStaticProblem]:
    """A column one cell wide between rollers, with two by two domains in a cell."""
    n = round(elements)
    upper = [height / n, height]
    V = fem.functionspace(kit.box(upper, [1, n], kit.DOMAINS["quad"]), ("Lagrange", degree, (2,)))
    body = kit.box(upper, [2, 2 * n], kit.DOMAINS[domain])
    particles = particles_of(body, V, method, degree)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, law, body_force=(0.0, -weight)),
        bcs=rollers(particles.V, (0, 0.0), (0, upper[0]), (1, 0.0)),
        solver=mpm.Solver(petsc_options_prefix="column_"),
    )
    return particles, problem


def compaction(
    size: float, domain: str = "quad", method: str = "cpdi2", degree: int = 1, steps: int = 40
) -> Scene:
    """Case A, `cases/compaction.py`: `size` cells over the height; `error` of the stress."""
    height, weight = COMPACTION["height"], COMPACTION["weight"]
    law = mpm.materials.Hencky(COMPACTION["young"], COMPACTION["poisson"])
    particles, problem = _column(size, height, law, weight, domain, method, degree)
    return Scene(problem, steps, lambda: column_error(particles, **COMPACTION))


COMPACTION = {"height": 50.0, "weight": 800.0, "young": 1e4, "poisson": 0.0}
COMPACTION_IN_SPACE = {"height": 10.0, "weight": 4e3, "young": 1e4, "poisson": 0.3}


def column_error(body: Any, height: float, weight: float, **_: float) -> dict[str, float]:
    """Return the mean error of the vertical stress of an elastic column between rollers.

    Args:
        body: Has `initial_centroid`, `initial_volume` and `stress`, as particles have them.
        height: Of the column, m.
        weight: N/m3; the vertical stress is that of what stands above.
    """
    up = body.initial_centroid.shape[1] - 1
    exact = -weight * (height - body.initial_centroid[:, up])
    off = np.abs(body.stress[:, up, up] - exact) / (weight * height)
    return {"error": kit.mean(off, body.initial_volume)}


def position_error(displacement: fem.Function) -> dict[str, float]:
    """Return the error of the vertical displacement of case D in L2, over the largest one.

    With c the weight over the modulus M and W Lambert's function a height X comes to
    (G(c h) - G(c (h - X))) / c, where G(z) = W + W^2 / 2, W = W(z).
    """
    height, weight, young, poisson = COMPACTION_IN_SPACE.values()
    c = weight * (1.0 + poisson) * (1.0 - 2.0 * poisson) / young / (1.0 - poisson)
    body = displacement.function_space.mesh
    degree = 2 * displacement.function_space.element.basix_element.degree + 2
    points, weights = basix.make_quadrature(getattr(basix.CellType, body.basix_cell().name), degree)
    cells = np.arange(body.topology.index_map(3).size_local, dtype=np.int32)
    X, u = (
        fem.Expression(e[2], points).eval(body, cells)
        for e in (ufl.SpatialCoordinate(body), displacement)
    )

    def grown(z: np.ndarray) -> np.ndarray:
        W = kit.lambert_w(z)
        return W + W**2 / 2.0

    off = u - (grown(c * height) - grown(c * (height - X))) / c + X
    largest = height - float(grown(c * height)) / c
    square = kit.total(off.reshape(len(cells), -1) ** 2 @ weights) / weights.sum()
    return {"error": float(np.sqrt(square / kit.total(len(cells)))) / largest}


def compaction_in_space(
    size: float, domain: str = "hex", method: str = "cpdi2", degree: int = 1, steps: int = 20
) -> Scene:
    """Case D, a column of 2.5 x 2.5 x 10 m, `size` cells over its width; `error` of the motion."""
    n, height = round(size), COMPACTION_IN_SPACE["height"]
    width = height / 4
    upper = [width, width, height]
    V = fem.functionspace(
        kit.box(upper, [n, n, 4 * n], kit.DOMAINS["hex"]), ("Lagrange", degree, (3,))
    )
    body = kit.box(upper, [2 * n, 2 * n, 8 * n], kit.DOMAINS[domain])
    particles = particles_of(body, V, method, degree)
    sides = [(axis, place) for axis in (0, 1) for place in (0.0, width)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.Hencky(COMPACTION_IN_SPACE["young"], COMPACTION_IN_SPACE["poisson"]),
            body_force=(0.0, 0.0, -COMPACTION_IN_SPACE["weight"]),
        ),
        bcs=rollers(particles.V, *sides, (2, 0.0)),
        solver=mpm.Solver(petsc_options_prefix="column_"),
    )
    return Scene(problem, steps, lambda: position_error(particles.displacement))


def column_roller(
    size: float, domain: str = "quad", method: str = "cpdi2", degree: int = 1, steps: int = 40
) -> Scene:
    """Case B, `cases/column_roller.py`: `error` of the vertical stress, `error_sxx`."""
    particles, problem = _column(
        size, ROLLER["height"], roller_law(), ROLLER["weight"], domain, method, degree
    )
    return Scene(problem, steps, lambda: roller_error(particles))


ROLLER = {"height": 10.0, "weight": 8e3, "young": 2e5, "poisson": 0.3, "rho_y": 20e3}


def roller_law() -> mpm.materials.VonMises:
    """Return the law of case B."""
    return mpm.materials.VonMises(ROLLER["young"], ROLLER["poisson"], rho_y=ROLLER["rho_y"])


def roller_error(body: Any) -> dict[str, float]:
    """Return mean errors of the stresses of case B; `body` as in `column_error`."""
    height, weight, young, poisson, rho_y = ROLLER.values()
    K, G = young / (3.0 * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
    M, c = K + 4.0 * G / 3.0, np.sqrt(2.0 / 3.0) * rho_y
    w_y = np.sqrt(1.5) * rho_y / (2.0 * G)
    s_yy = -weight * (height - body.initial_centroid[:, 1])
    elastic = kit.lambert_w(-s_yy / M)
    plastic = kit.lambert_w(-s_yy / K * np.exp(c / K)) - c / K
    s_xx = np.where(
        -s_yy < M * w_y * np.exp(w_y),
        -(K - 2.0 * G / 3.0) * elastic * np.exp(elastic),
        s_yy + np.sqrt(1.5) * rho_y * np.exp(plastic),
    )
    stress, volume = body.stress, body.initial_volume
    scale = weight * height
    return {
        "error": kit.mean(np.abs(stress[:, 1, 1] - s_yy) / scale, volume),
        "error_sxx": kit.mean(np.abs(stress[:, 0, 0] - s_xx) / scale, volume),
    }


def free_law() -> mpm.materials.VonMises:
    """Return the law of case C."""
    return mpm.materials.VonMises(1e6, 0.3, rho_y=20e3)


def column_free(
    size: float,
    domain: str = "tri",
    method: str = "cpdi2",
    degree: int = 1,
    steps: int = 40,
    f_bar: str = "none",
    weight: float = 20e3,
) -> Scene:
    """Case C, `cases/column_free.py`: `size` is that of a cell, m; `weight` in N/m3; `y_mean`."""
    width = max(20.0, weight / 1e3)
    cells = [round(width / size), round(10.0 / size)]
    background = kit.box([width, 10.0], cells, kit.DOMAINS["quad"])
    V = fem.functionspace(background, ("Lagrange", degree, (2,)))
    body = kit.box([4.0, 8.0], [round(8.0 / size), round(16.0 / size)], kit.DOMAINS[domain])
    rule = 2 if f_bar == "domain" else None
    particles = particles_of(body, V, method, degree, rule)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, free_law(), body_force=(0.0, -weight), f_bar=f_bar),
        bcs=rollers(particles.V, (0, 0.0), (1, 0.0)),
        solver=mpm.Solver(petsc_options_prefix="collapse_"),
    )

    def measure() -> dict[str, float]:
        return {"y_mean": kit.mean(particles.centroid[:, 1], particles.initial_volume)}

    return Scene(problem, steps, measure)


def clamp(V: fem.FunctionSpace) -> list[fem.DirichletBC]:
    """Hold the vertical displacement on x = 0."""
    facets = mesh.locate_entities_boundary(V.mesh, 1, lambda x: np.isclose(x[0], 0.0))
    return [fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(1), 1, facets), V.sub(1))]


CANTILEVER = (0.554005, 0.825387)  # finite elements: shortening, deflection over the length


def cantilever(
    size: float, domain: str = "quad", method: str = "cpdi2", degree: int = 1, steps: int = 50
) -> Scene:
    """Case E, `cases/cantilever.py`, clamped: `size` is that of a cell, m; `error` of the tip."""
    cells = [round(11.0 / size), round(10.0 / size)]
    background = kit.box([11.0, 10.0], cells, kit.DOMAINS["quad"])
    V = fem.functionspace(background, ("Lagrange", degree, (2,)))
    body = beam(size, domain)
    particles = particles_of(body, V, method, degree)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.Hencky(12e6, 0.2),
            tractions=[((0.0, -100e3), 1)],
            facet_tags=beam_end(body),
        ),
        bcs=rollers(particles.V, (0, 0.0)) + clamp(particles.V),
        solver=mpm.Solver(petsc_options_prefix="cantilever_"),
    )
    return Scene(problem, steps, lambda: tip_error(particles.displacement))


def beam(size: float, domain: str) -> mesh.Mesh:
    """Return the mesh of case E, two by two domains in a cell, and two over the depth at least."""
    return mesh.create_rectangle(
        kit.comm,
        [[0.0, 9.0], [10.0, 10.0]],
        [round(20.0 / size), max(2, round(2.0 / size))],
        kit.DOMAINS[domain],
        diagonal=mesh.DiagonalType.left_right,
    )


def beam_end(body: mesh.Mesh) -> mesh.MeshTags:
    """Return the tag 1 for the facets that carry the load."""
    ends = np.sort(mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[0], 10.0)))
    return mesh.meshtags(body, 1, ends, np.full(len(ends), 1, dtype=np.int32))


def tip_error(displacement: fem.Function) -> dict[str, float]:
    """Return the tip's shortening and deflection over the length, and the error of the worse."""
    X = displacement.function_space.tabulate_dof_coordinates()
    tip = np.isclose(X[:, 0], 10.0) & np.isclose(X[:, 1], 9.5)
    d = (displacement.x.array.reshape(-1, 2)[tip].mean(axis=0) / 10.0).tolist()
    off = [abs(-d[i] - exact) for i, exact in enumerate(CANTILEVER)]
    return {"shortening": -d[0], "deflection": -d[1], "error": max(off)}


# -- A block in space, squeezed between rough plates --------------------------------------

BLOCK = {"young": 10e6, "poisson": 0.3, "yield_stress": 100e3, "hardening": 1e6, "squeeze": 0.1}
#: Force on a quarter of a plate in N, extrapolated: `finite_elements.py --reference`.
BLOCK_FORCE = 236.44e3


def block_law() -> mpm.materials.VonMises:
    """Return the law of case P."""
    young, poisson, yield_stress, hardening, _ = BLOCK.values()
    return mpm.materials.VonMises(young, poisson, yield_stress=yield_stress, hardening=hardening)


def block(
    size: float,
    domain: str = "hex",
    method: str = "cpdi2",
    degree: int = 1,
    steps: int = 10,
    f_bar: str = "none",
) -> Scene:
    """Case P, an eighth of a cube of 2 m, `size` cells over 1 m; `error` of the force on a plate.

    The plates hold what lies on them and approach each other by a tenth.
    """
    n = round(size)
    h = 1.0 / n
    background = kit.box([1.0 + h] * 2 + [1.0 + h], [n + 1] * 3, kit.DOMAINS["hex"])
    V = fem.functionspace(background, ("Lagrange", degree, (3,)))
    body = kit.box([1.0] * 3, [2 * n] * 3, kit.DOMAINS[domain])
    rule = 2 if degree == 1 else None
    particles = particles_of(body, V, method, degree, rule)
    V = particles.V
    top = np.sort(mesh.locate_entities_boundary(body, 2, lambda x: np.isclose(x[2], 1.0)))
    plane = fem.Constant(body, 1.0)
    above = ufl.SpatialCoordinate(body)[2] + particles.displacement[2] - plane
    base = mesh.locate_entities_boundary(V.mesh, 2, lambda x: np.isclose(x[2], 0.0))
    plate = [
        fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(i), 2, base), V.sub(i))
        for i in range(3)
    ]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            block_law(),
            pressures=[(1e3 * BLOCK["young"] * above, 1)],
            facet_tags=mesh.meshtags(body, 2, top, np.full(len(top), 1, dtype=np.int32)),
            f_bar=f_bar,
        ),
        bcs=rollers(V, (0, 0.0), (1, 0.0)) + plate,
        solver=mpm.Solver(petsc_options_prefix="block_"),
    )

    def update(t: float) -> None:
        plane.value = 1.0 - BLOCK["squeeze"] * t
        particles.load.value = 1.0

    def measure() -> dict[str, float]:
        force = float(problem.reaction(plate[2])[2])
        return {"force": force, "error": abs(force / BLOCK_FORCE - 1.0)}

    return Scene(problem, steps, measure, lambda: solve(problem, steps, update=update))


# -- A rigid disc on an elastic block -------------------------------------------------------

HERTZ = {"radius": 6.0, "young": 1e3, "poisson": 0.3, "depth": 0.0108, "half": 0.2}


def lines(h: float, fine: float, end: float) -> np.ndarray:
    """Return places from 0 to end, h apart up to ``fine`` and farther apart beyond."""
    places = [h * i for i in range(round(fine / h) + 1)]
    while places[-1] < end:
        places.append(places[-1] + min(1.25 * (places[-1] - places[-2]), 0.4))
    return np.array(places)


def graded(x: np.ndarray, y: np.ndarray, parts: int) -> mesh.Mesh:
    """Return a mesh of quadrilaterals between lines, each interval in equal parts."""
    domain = kit.box([1.0, 1.0], [(len(x) - 1) * parts, (len(y) - 1) * parts], kit.DOMAINS["quad"])
    for i, places in enumerate((x, y)):
        at = domain.geometry.x[:, i] * (len(places) - 1)
        domain.geometry.x[:, i] = np.interp(at, np.arange(len(places)), places)
    return domain


def hertz_lines(size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the lines of the grid: ``size`` cells in half of the width that touches."""
    x = lines(HERTZ["half"] / size, 0.3, 3.0)
    return x, -x[::-1]


def hertz_top(body: mesh.Mesh) -> mesh.MeshTags:
    """Return the tag 1 for the facets that the disc may touch."""
    top = np.sort(mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[1], 0.0)))
    return mesh.meshtags(body, 1, top, np.full(len(top), 1, dtype=np.int32))


def hertz_error(x: np.ndarray, force: np.ndarray, length: np.ndarray) -> dict[str, float]:
    """Return the error of the pressure in the L2 norm, by means over facets.

    Args:
        x: Places of the facets' middles.
        force: Forces on the facets, N/m, downwards.
        length: Lengths of the facets.
    """
    stiff = HERTZ["young"] / (1.0 - HERTZ["poisson"] ** 2)
    half, exact = kit.hertz(x, force, length, stiff, HERTZ["radius"])
    off = force / length - exact
    return {
        "error": float(np.sqrt((off**2 * length).sum() / (exact**2 * length).sum())),
        "half_width": half,
    }


def hertz(
    size: float, domain: str = "quad", method: str = "cpdi2", degree: int = 1, steps: int = 8
) -> Scene:
    """Case H, a rigid disc on a block: `size` cells in half the width; `error` of the pressure."""
    x, y = hertz_lines(size)
    over = np.append(y, 0.4 * HERTZ["half"] / size)
    wide = np.append(x, 2.0 * x[-1] - x[-2])
    V = fem.functionspace(graded(wide, over, 1), ("Lagrange", degree, (2,)))
    particles = particles_of(graded(x, y, 2), V, method, degree)
    radius, depth = HERTZ["radius"], HERTZ["depth"]
    die = mpm.contact.Rigid(
        particles,
        mpm.contact.disc((0.0, radius), radius),
        facets=(hertz_top(particles.mesh), 1),
    )
    V = particles.V
    base = mesh.locate_entities_boundary(V.mesh, 1, lambda x: np.isclose(x[1], y[0]))
    floor = fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(V, 1, base), V)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, mpm.materials.LinearElastic(HERTZ["young"], HERTZ["poisson"])),
        bcs=[*rollers(V, (0, 0.0)), floor],
        terms=[die],
    )

    def measure() -> dict[str, float]:
        # points of a facet follow each other once they are sorted by their place
        order = np.argsort(die.points[:, 0])
        each = len(order) // (2 * (len(x) - 1))
        area, force = (
            values[order].reshape(-1, each).sum(axis=1)
            for values in (die.area, die.area * die.pressure)
        )
        ends = np.concatenate([[0.0], np.cumsum(area)])
        return hertz_error((ends[1:] + ends[:-1]) / 2, force, area)

    def run() -> None:
        solve(problem, steps, update=lambda t: die.move((0.0, -depth * t)))

    return Scene(problem, steps, measure, run)


# -- The generalised vortex -----------------------------------------------------------------


class Vortex:
    """The motion of `cases/vortex.py` on a mesh of its ring, with forces and traction.

    Args:
        cell: Size of the background's cells; two by two quadrilaterals are as large as one.
    """

    rho, young, poisson = 1000.0, 1000.0, 0.3
    mu = young / (2.0 * (1.0 + poisson))
    lame = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))

    def __init__(self, cell: float) -> None:
        turn, across = 4 * round(np.pi / cell), round(1.0 / cell)
        angle, radius = np.meshgrid(
            2.0 * np.pi * np.arange(turn) / turn, np.linspace(0.75, 1.25, across + 1)
        )
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
        number = np.arange(points[..., 0].size).reshape(across + 1, turn)
        after = np.roll(number, -1, axis=1)
        cells = np.stack([number[:-1], number[1:], after[:-1], after[1:]], axis=-1)
        element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
        self.mesh = mesh.create_mesh(
            kit.comm, cells.reshape(-1, 4).astype(np.int64), element, points.reshape(-1, 2)
        )
        X = self.X = ufl.SpatialCoordinate(self.mesh)
        R = ufl.sqrt(ufl.dot(X, X))
        s = R - 1.0
        self.H = 1 - 32 * s**2 + 256 * s**4
        H1, H2 = -64 * s + 1024 * s**3, -64 + 3072 * s**2
        self.g, self.g_t, self.g_tt = (fem.Constant(self.mesh, 0.0) for _ in range(3))
        c, w = ufl.cos(self.g * self.H), ufl.sin(self.g * self.H)
        self.x = ufl.as_vector([c * X[0] - w * X[1], w * X[0] + c * X[1]])
        self.velocity = self.g_t * self.H * ufl.as_vector([-self.x[1], self.x[0]])
        e_r = self.x / R
        e_t = ufl.as_vector([-e_r[1], e_r[0]])
        self.force = (
            self.mu * R * (self.g * H1) ** 2 - self.rho * R * (self.g_t * self.H) ** 2
        ) * e_r
        self.force += (
            self.rho * R * self.g_tt * self.H - self.mu * self.g * (3 * H1 + R * H2)
        ) * e_t
        F = ufl.grad(self.x)
        self.traction = self.mu * (F - ufl.inv(F).T) * ufl.FacetNormal(self.mesh)
        self.at(0.0)

    def at(self, t: float) -> None:
        """Set what depends on time."""
        self.g.value = np.sin(np.pi * t)
        self.g_t.value = np.pi * np.cos(np.pi * t)
        self.g_tt.value = -(np.pi**2) * np.sin(np.pi * t)

    def stress(self, d: Any) -> Any:
        """Return the first Piola stress of a displacement."""
        F = ufl.Identity(2) + ufl.grad(d)
        return self.mu * (F - ufl.inv(F).T) + self.lame * ufl.ln(ufl.det(F)) * ufl.inv(F).T

    def loads(self, w: Any, degree: int) -> Any:
        """Return the power of force and traction on a test function."""
        fine = {"quadrature_degree": 2 * degree + 3}
        dx, ds = (m(domain=self.mesh, metadata=fine) for m in (ufl.dx, ufl.ds))
        return ufl.inner(self.force, w) * dx + ufl.inner(self.traction, w) * ds

    def measured(self, d: fem.Function, degree: int) -> Callable[[], float]:
        """Return what gives the error of a displacement in L2 over the largest motion."""
        dx = ufl.dx(domain=self.mesh, metadata={"quadrature_degree": 2 * degree + 3})
        off = d - (self.x - self.X)
        forms = [fem.form(ufl.inner(e, e) * dx) for e in (off, self.x - self.X)]
        before = self.g.value.copy()
        self.at(0.5)
        largest = fem.assemble_scalar(forms[1])
        self.g.value = before
        return lambda: float(np.sqrt(fem.assemble_scalar(forms[0]) / largest))


def vortex(
    size: float, domain: str = "quad", method: str = "cpdi2", degree: int = 1, steps: int = 0
) -> Scene:
    """Case V, `cases/vortex.py` with `size` cells in 1; `error` of displacement at t = 1/2."""
    motion = Vortex(1.0 / size)
    half = int(np.ceil(1.3 * size + 0.3))
    square = [[-half / size] * 2, [half / size] * 2]
    background = mesh.create_rectangle(kit.comm, square, [2 * half] * 2, kit.DOMAINS["quad"])
    V = fem.functionspace(background, ("Lagrange", degree, (2,)))
    particles = particles_of(motion.mesh, V, method, degree, 2 * degree + 1)
    w = ufl.TestFunction(particles.W)
    residual = ufl.inner(motion.stress(particles.displacement), ufl.grad(w)) * particles.dx
    problem = mpm.DynamicParticleProblem(
        residual - motion.loads(w, degree),
        particles,
        motion.rho,
        velocity=motion.velocity,
        scheme="midpoint",
        symmetric=True,
    )
    error = motion.measured(particles.displacement, degree)
    count = steps or vortex_steps(size, degree)

    def run() -> None:
        problem.solve(time=0.5, dt=0.5 / count, update=motion.at)

    return Scene(problem, count, lambda: {"error": error()}, run)


def vortex_steps(size: float, degree: int) -> int:
    """Return the time steps up to t = 1/2."""
    return round(1.25 * size * degree**2)


def flow_in_steps(
    size: float, domain: str = "quad", method: str = "cpdi2", degree: int = 1, steps: Any = 20
) -> Scene:
    """Case F, case C on cells of 0.5 m: `size` equal steps, or the tolerance of automatic ones.

    `displacement` at the end is what is compared.
    """
    scene = column_free(0.5, domain, method, degree)
    particles = scene.problem.bodies[0]

    def measure() -> dict[str, Any]:
        return {"displacement": particles.displacement.x.array.tolist()}

    def run() -> None:
        if size < 1.0:
            scene.problem.solve(steps="auto", tolerance=size)
        else:
            scene.problem.solve(steps=round(size))

    return Scene(scene.problem, round(max(size, 1.0)), measure, run)


CASES: dict[str, Callable[..., Any]] = {
    "A": compaction,
    "B": column_roller,
    "C": column_free,
    "D": compaction_in_space,
    "E": cantilever,
    "F": flow_in_steps,
    "H": hertz,
    "P": block,
    "V": vortex,
}
