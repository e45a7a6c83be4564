# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A penalty beside Nitsche's method on the body's own boundary: docs/supports-measured.md."""

from __future__ import annotations

import sys
from functools import cache, partial
from typing import Any

from mpi4py import MPI

import numpy as np
from case_runs import ROOT, Table, scientific

import ufl
from dolfinx import fem, mesh
from dolfinx.fem.petsc import LinearProblem

import mpm_dolfinx as mpm

sys.path.append(str(ROOT / "tests"))
import scenes

LENGTH, HEIGHT, ANGLE = 4.0, 2.0, np.radians(30.0)
YOUNG, POISSON, PRESSURE = 1e3, 0.3, 10.0
BASE, WALL, TOP = 1, 2, 3
CELLS = (0.5, 0.25, 0.125)
FINE = 128  # cells of the finite elements along the block's length


def block(n: int) -> tuple[mesh.Mesh, mesh.MeshTags]:
    """The block upright, with n quadrilaterals along its length, and its tagged sides."""
    body = scenes.box(
        [0.0, 0.0], [LENGTH, HEIGHT], [n, n // 2], scenes.QUADRILATERAL, MPI.COMM_SELF
    )
    sides = scenes.at(1, 0.0), scenes.at(0, 0.0), scenes.at(1, HEIGHT)
    return body, scenes.facet_tags(body, *sides)


def stress(u: Any) -> Any:
    return scenes.linear_stress(u, YOUNG, POISSON)


def load(x: Any, normal: Any, v: Any) -> Any:
    """The work of a pressure that grows along the top; x in the block's own directions."""
    return -PRESSURE * (1.0 + x / LENGTH) * ufl.dot(normal, v)


@cache
def exact() -> Any:
    """Displacement of finite elements of degree 2, by position in the block's own directions."""
    body, tags = block(FINE)
    V = fem.functionspace(body, ("Lagrange", 2, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=body, subdomain_data=tags)
    work = load(ufl.SpatialCoordinate(body)[0], ufl.FacetNormal(body), v)
    bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)]
    a = ufl.inner(stress(u), ufl.grad(v)) * ufl.dx
    direct = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    found = LinearProblem(
        a, work * ds(TOP), bcs=bcs, petsc_options=direct, petsc_options_prefix="block_"
    ).solve()
    x = np.round(V.tabulate_dof_coordinates()[:, :2], 9) + 0.0
    return dict(zip(map(tuple, x), found.x.array.reshape(-1, 2), strict=True))


def error(gamma: float, nitsche: bool, h: float) -> float:
    """Error of the displacement of the turned block, relative to that of finite elements."""
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    Q = np.array([[c, -s], [s, c]])
    body, tags = block(round(2.0 * LENGTH / h))
    X = body.geometry.x[:, :2].copy()
    body.geometry.x[:, :2] = X @ Q.T
    low = body.geometry.x[:, :2].min(axis=0) - 1.4 * h
    n = np.ceil((body.geometry.x[:, :2].max(axis=0) + 1.4 * h - low) / h).astype(int)
    grid = scenes.box(low, low + n * h, list(n), scenes.QUADRILATERAL, MPI.COMM_SELF)
    particles = mpm.Particles(body, scenes.vectors(grid))
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    x, normal = ufl.SpatialCoordinate(body), ufl.FacetNormal(body)
    ds = ufl.Measure("ds", domain=body, subdomain_data=tags)
    R = ufl.inner(stress(d), ufl.grad(v)) * particles.dx
    R -= particles.load * load(ufl.dot(x, ufl.as_vector(Q[:, 0])), normal, v) * ds(TOP)
    lmbda, mu = scenes.lame(YOUNG, POISSON)
    modulus = lmbda + 2.0 * mu
    for tag in (BASE, WALL):
        if nitsche:
            held, virtual = ufl.dot(normal, d), ufl.dot(normal, v)
            forces = [ufl.dot(normal, ufl.dot(stress(w), normal)) for w in (d, v)]
            R += (gamma * modulus * 2.0 / h * held * virtual) * ds(tag)
            R -= (forces[0] * virtual + forces[1] * held) * ds(tag)
        else:
            outward = Q @ ([0.0, -1.0] if tag == BASE else [-1.0, 0.0])
            hold = mpm.boundary.roller(
                particles, tags, tag, tuple(outward), modulus=modulus, penalty=gamma
            )
            R += hold.residual
    mpm.ParticleProblem(R, particles).solve(steps=1)
    x = np.round(particles.W.tabulate_dof_coordinates()[:, :2] @ Q, 9) + 0.0
    reference = np.array([exact()[tuple(at)] for at in x])
    gap = d.x.array.reshape(-1, 2) @ Q - reference
    return float(np.linalg.norm(gap) / np.linalg.norm(reference))


def way(gamma: float, nitsche: bool) -> list[str]:
    return [scientific(error(gamma, nitsche, h), 2) for h in CELLS]


def tables() -> dict[str, Table]:
    rows = {
        "penalty, $\\gamma = 1$": (1.0, False),
        "penalty, $\\gamma = 10$": (10.0, False),
        "penalty, $\\gamma = 100$": (100.0, False),
        "penalty, $\\gamma = 10^3$": (1e3, False),
        "penalty, $\\gamma = 10^5$": (1e5, False),
        "Nitsche, $\\gamma = 10$": (10.0, True),
        "Nitsche, $\\gamma = 100$": (100.0, True),
    }
    return {
        "supports/penalty": Table(
            "supports-measured",
            ["", *(f"{h:g}" for h in CELLS)],
            {label: partial(way, *values) for label, values in rows.items()},
            quick=["penalty, $\\gamma = 10^3$"],
        )
    }
