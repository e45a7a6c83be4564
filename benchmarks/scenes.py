# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scenes of the cases as functions: the same bodies, backgrounds, loads and errors."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

sys.path.append(str(Path(__file__).resolve().parent / "cases"))

import kit


@dataclass
class Scene:
    """A problem, how many load steps it takes, and what to measure at the end."""

    problem: mpm.QuasiStaticProblem
    steps: int
    measure: Callable[[], dict[str, float]]


def _rollers(V: fem.FunctionSpace, *planes: tuple[int, float]) -> list[fem.DirichletBC]:
    """Rollers on planes x[axis] = place of the background."""
    bcs = []
    for axis, place in planes:
        facets = mesh.locate_entities_boundary(
            V.mesh, 1, lambda x, axis=axis, place=place: np.isclose(x[axis], place)
        )
        dofs = fem.locate_dofs_topological(V.sub(axis), 1, facets)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
    return bcs


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
    particles = mpm.Particles(body, V, method=method, degree=degree)
    problem = mpm.QuasiStaticProblem(
        particles,
        law,
        body_force=(0.0, -weight),
        bcs=_rollers(V, (0, 0.0), (0, upper[0]), (1, 0.0)),
        petsc_options_prefix="column_",
    )
    return particles, problem


def compaction(
    size: float, domain: str = "quad", method: str = "cpdi2", degree: int = 1, steps: int = 40
) -> Scene:
    """Case A, `cases/compaction.py`: `size` cells over the height; `error` of the stress."""
    height, weight = 50.0, 800.0
    law = mpm.materials.Hencky(1e4, 0.0)
    particles, problem = _column(size, height, law, weight, domain, method, degree)

    def measure() -> dict[str, float]:
        exact = -weight * (height - particles.initial_centroid[:, 1])
        off = np.abs(particles.stress[:, 1, 1] - exact) / (weight * height)
        return {"error": kit.mean(off, particles.initial_volume)}

    return Scene(problem, steps, measure)


def column_roller(
    size: float, domain: str = "quad", method: str = "cpdi2", degree: int = 1, steps: int = 40
) -> Scene:
    """Case B, `cases/column_roller.py`: `error` of the vertical stress, `error_sxx`."""
    height, weight = 10.0, 8e3
    young, poisson, rho_y = 2e5, 0.3, 20e3
    law = mpm.materials.VonMises(young, poisson, rho_y=rho_y)
    particles, problem = _column(size, height, law, weight, domain, method, degree)
    K, G = young / (3.0 * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
    M, c = K + 4.0 * G / 3.0, np.sqrt(2.0 / 3.0) * rho_y
    w_y = np.sqrt(1.5) * rho_y / (2.0 * G)

    def measure() -> dict[str, float]:
        s_yy = -weight * (height - particles.initial_centroid[:, 1])
        elastic = kit.lambert_w(-s_yy / M)
        plastic = kit.lambert_w(-s_yy / K * np.exp(c / K)) - c / K
        s_xx = np.where(
            -s_yy < M * w_y * np.exp(w_y),
            -(K - 2.0 * G / 3.0) * elastic * np.exp(elastic),
            s_yy + np.sqrt(1.5) * rho_y * np.exp(plastic),
        )
        stress, volume = particles.stress, particles.initial_volume
        scale = weight * height
        return {
            "error": kit.mean(np.abs(stress[:, 1, 1] - s_yy) / scale, volume),
            "error_sxx": kit.mean(np.abs(stress[:, 0, 0] - s_xx) / scale, volume),
        }

    return Scene(problem, steps, measure)


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
    particles = mpm.Particles(body, V, method=method, degree=degree, quadrature_degree=rule)
    problem = mpm.QuasiStaticProblem(
        particles,
        mpm.materials.VonMises(1e6, 0.3, rho_y=20e3),
        body_force=(0.0, -weight),
        bcs=_rollers(V, (0, 0.0), (1, 0.0)),
        petsc_options_prefix="collapse_",
        f_bar=f_bar,
    )

    def measure() -> dict[str, float]:
        return {"y_mean": kit.mean(particles.centroid[:, 1], particles.initial_volume)}

    return Scene(problem, steps, measure)


def _clamp(V: fem.FunctionSpace) -> list[fem.DirichletBC]:
    """Hold the vertical displacement on x = 0."""
    facets = mesh.locate_entities_boundary(V.mesh, 1, lambda x: np.isclose(x[0], 0.0))
    return [fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(1), 1, facets), V.sub(1))]


CANTILEVER = (0.554005, 0.825387)  # finite elements: shortening, deflection over the length


def cantilever(
    size: float, domain: str = "quad", method: str = "cpdi2", degree: int = 1, steps: int = 50
) -> Scene:
    """Case E, `cases/cantilever.py`, clamped: `size` is that of a cell, m; `error` of the tip."""
    length, axis = 10.0, 9.5
    cells = [round(11.0 / size), round(10.0 / size)]
    background = kit.box([11.0, 10.0], cells, kit.DOMAINS["quad"])
    V = fem.functionspace(background, ("Lagrange", degree, (2,)))
    body = mesh.create_rectangle(
        kit.comm,
        [[0.0, axis - 0.5], [length, axis + 0.5]],
        [round(20.0 / size), max(2, round(2.0 / size))],
        kit.DOMAINS[domain],
        diagonal=mesh.DiagonalType.left_right,
    )
    ends = np.sort(mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[0], length)))
    particles = mpm.Particles(body, V, method=method, degree=degree)
    problem = mpm.QuasiStaticProblem(
        particles,
        mpm.materials.Hencky(12e6, 0.2),
        bcs=_rollers(V, (0, 0.0)) + _clamp(V),
        tractions=[((0.0, -100e3), 1)],
        facet_tags=mesh.meshtags(body, 1, ends, np.full(len(ends), 1, dtype=np.int32)),
        petsc_options_prefix="cantilever_",
    )
    X = particles.W.tabulate_dof_coordinates()
    tip = np.isclose(X[:, 0], length) & np.isclose(X[:, 1], axis)

    def measure() -> dict[str, float]:
        d = particles.displacement.x.array.reshape(-1, 2)[tip].mean(axis=0) / length
        off = [abs(-d[i] - exact) for i, exact in enumerate(CANTILEVER)]
        return {"shortening": -d[0], "deflection": -d[1], "error": max(off)}

    return Scene(problem, steps, measure)


CASES: dict[str, Callable[..., Any]] = {
    "A": compaction,
    "B": column_roller,
    "C": column_free,
    "E": cantilever,
}
