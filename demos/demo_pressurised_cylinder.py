# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.5: Axisymmetric, a pressure that follows the surface; exact

# # A cylinder under inner pressure
#
# It illustrates how to:
# - solve a problem of revolution, `axisymmetric=True`,
# - apply a pressure that follows the surface as it turns and grows, `pressures=`,
# - make a body of polar coordinates, on a background that knows nothing of circles.
#
# ## Problem
#
# A long thick tube of inner radius $a = 1$ m and outer radius $b = 2$ m is blown up by a pressure
# $p = 80$ kPa inside; it cannot lengthen. The material is Hencky's, $E = 1$ MPa and $\nu = 0.3$.
# The pressure acts on the inner surface as it is: on the undeformed one, with normal $N$, by
#
# $$
# t = -p\, J F^{-T} N, \qquad J = \det F, \tag{1}
# $$
#
# whose derivative is part of the tangent, which is not symmetric. The tube is computed twice: as
# a strip in the $(r, z)$ plane, one background cell high, whose deformation gradient has the hoop
# stretch $1 + d_r / R$; and as a quarter of the ring in the $(x, y)$ plane, on a grid of squares.
#
# ## Reference
#
# With the present radius $r(R)$, $\lambda_r = r'$, $\lambda_\theta = r / R$ and the radial first
# Piola stress $P_r$, equilibrium is the boundary value problem
#
# $$
# r' = \lambda_r(P_r, r / R), \qquad
# P_r' = -\frac{1}{R} \Bigl( P_r - \frac{\tau_\theta}{\lambda_\theta} \Bigr), \qquad
# P_r(a) = -p\, \frac{r(a)}{a}, \quad P_r(b) = 0, \tag{2}
# $$
#
# solved by SciPy's `solve_bvp` to $10^{-10}$: the radii become 1.2080252 and 2.1408493.

from mpi4py import MPI

import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
a, b, pressure, INNER = 1.0, 2.0, 80e3, 1  # m, m, Pa, tag
young, poisson, N = 1e6, 0.3, 16  # Pa, -, background cells through the wall
EXACT = {a: 1.2080252432, b: 2.1408492820}


def problem_of(background, body, rollers, radius, axisymmetric):
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    return mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V),
            mpm.materials.Hencky(young, poisson),
            pressures=[(pressure, INNER)],
            facet_tags=mpm.facet_tags(body, {INNER: lambda x: np.isclose(radius(x), a)}),
        ),
        bcs=[mpm.held(V, component, **plane) for component, plane in rollers],
        axisymmetric=axisymmetric,
    )


# The strip, and the ring: a rectangle of radii and angles, whose vertices are then moved.

h = (b - a) / N
strip = problem_of(
    mesh.create_rectangle(comm, [[0.5, 0], [3, h]], [round(2.5 / h), 1], quadrilateral),
    mesh.create_rectangle(comm, [[a, 0], [b, h]], [2 * N, 2], quadrilateral),
    [(1, {"y": 0.0}), (1, {"y": h})],
    lambda x: x[0],
    axisymmetric=True,
)
body = mesh.create_rectangle(comm, [[a, 0], [b, np.pi / 2]], [2 * N, 4 * N], quadrilateral)
R, angle = body.geometry.x[:, :2].T.copy()
body.geometry.x[:, :2] = np.maximum(R * [np.cos(angle), np.sin(angle)], 0.0).T
ring = problem_of(
    mesh.create_rectangle(comm, [[0, 0], [2.5, 2.5]], [round(2.5 / h)] * 2, quadrilateral),
    body,
    [(0, {"x": 0.0}), (1, {"y": 0.0})],
    lambda x: np.hypot(x[0], x[1]),
    axisymmetric=False,
)


def radius_of(problem, at):
    particles = problem.particles
    before, now = particles.initial_domains.reshape(-1, 2), particles.domains.reshape(-1, 2)
    if problem is ring:
        before, now = (np.hypot(*x.T)[:, None] for x in (before, now))
    there = np.isclose(before[:, 0], at)
    return comm.allreduce(now[there, 0].sum()) / comm.allreduce(int(there.sum()))


errors = {}
for name, problem in (("strip", strip), ("ring", ring)):
    problem.solve(steps=10)
    errors[name] = [abs(radius_of(problem, at) / exact - 1.0) for at, exact in EXACT.items()]
    if comm.rank == 0:
        print(f"{name:6s} errors of r(a) and r(b):", *(f"{e:.1e}" for e in errors[name]))

x, sigma = ring.particles.centroid, ring.particles.stress
across = np.column_stack([-x[:, 1], x[:, 0]]) / np.linalg.norm(x, axis=1, keepdims=True)
hoop = np.einsum("ni,nij,nj->n", across, sigma[:, :2, :2], across)
mpm.plot.scene(ring, hoop / 1e3, "pressurised_cylinder.png", label="hoop stress, kPa")

assert max(map(max, errors.values())) < 1e-5

# ## Exercises
#
# 1. Compare the stress inside with the exact 164.1 kPa (hoop) for 4, 8 and 16 cells.
# 2. Raise the pressure. The tube has a limit load: near which pressure?
