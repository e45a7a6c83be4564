# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.5: A ring that shears in time, beside an exact motion

# # Generalised vortex
#
# It illustrates how to:
# - check a motion against an exact solution, by what depends on time in `update=`.
#
# ## Problem
#
# A ring $0.75 < R < 1.25$ shears in its middle and comes back (Kamojjala, Brannon, Sadeghirad &
# Guilkey 2015). A point at the radius $R$ turns by $a = \sin \pi t \, (1 - 16 (R - 1)^2)^2$, which
# changes no volume: of $P = \mu (F - F^{-T}) + \lambda \ln J \, F^{-T}$ there is the first term.
# The balance of momentum gives the body force along and across the radius of the turned point,
#
# $$
# b_r = \mu R a'^2 - \rho R \dot a^2, \qquad b_t = \rho R \ddot a - \mu (3 a' + R a'') . \tag{1}
# $$
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
rho, mu, lame, of_d = 1000.0, 1000.0 / 2.6, 300.0 / 0.52, {}
figure, axes = plt.subplots(1, 4, figsize=(15, 3.9), layout="constrained")


def ring(h):
    """Quadrilaterals of half a cell each way."""
    around, across = 4 * round(np.pi / h), round(1.0 / h)
    a, R = np.meshgrid(np.arange(around), np.linspace(0.75, 1.25, across + 1))
    points = R[..., None] * np.exp(2j * np.pi * a / around)[..., None].view(float)
    i, points = np.arange(a.size).reshape(a.shape), points.reshape(-1, 2)
    j = np.roll(i, -1, axis=1)
    cells = np.stack([i[:-1], i[1:], j[:-1], j[1:]], axis=-1).reshape(-1, 4)
    if comm.rank > 0:
        cells, points = cells[:0], points[:0]
    element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    return mesh.create_mesh(comm, cells.astype(np.int64), element, points)


# The exact traction acts on the straight sides, so that they are no error.
def run(degree, n, steps, draws):
    """Return times, errors and sizes of the displacement."""
    corners, body = [[-1.5, -1.5], [1.5, 1.5]], ring(1.0 / n)
    grid = mesh.create_rectangle(comm, corners, [3 * n, 3 * n], quadrilateral)
    V = fem.functionspace(grid, ("Lagrange", degree, (2,)))
    particles = mpm.Particles(body, V, degree=degree, quadrature_degree=2 * degree + 1)
    g, g_t, g_tt = (fem.Constant(body, 0.0) for _ in range(3))
    X = ufl.SpatialCoordinate(body)
    R = ufl.sqrt(ufl.dot(X, X))
    s, H = R - 1.0, (1.0 - 16.0 * (R - 1.0) ** 2) ** 2
    H1, H2 = -64.0 * s + 1024.0 * s**3, -64.0 + 3072.0 * s**2
    c, w = ufl.cos(g * H), ufl.sin(g * H)
    x = ufl.as_vector([c * X[0] - w * X[1], w * X[0] + c * X[1]])
    across = ufl.as_vector([-x[1], x[0]])
    b = (mu * (g * H1) ** 2 - rho * (g_t * H) ** 2) * x
    b += (rho * g_tt * H - mu * g * (3.0 * H1 / R + H2)) * across
    t = mu * (ufl.grad(x) - ufl.inv(ufl.grad(x)).T) * ufl.FacetNormal(body)
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    F = ufl.Identity(2) + ufl.grad(d)
    P = mu * (F - ufl.inv(F).T) + lame * ufl.ln(ufl.det(F)) * ufl.inv(F).T
    fine = {"quadrature_degree": 2 * degree + 3}
    dx, ds = (measure(body, metadata=fine) for measure in (ufl.dx, ufl.ds))
    residual = ufl.inner(P, ufl.grad(v)) * particles.dx
    residual -= ufl.inner(b, v) * dx + ufl.inner(t, v) * ds

    def update(t):
        g.value, g_t.value = np.sin(np.pi * t), np.pi * np.cos(np.pi * t)
        g_tt.value = -(np.pi**2) * np.sin(np.pi * t)

    def size(expression):
        square = fem.form(ufl.inner(expression, expression) * dx)
        return np.sqrt(comm.allreduce(fem.assemble_scalar(square)))

    update(0.0)
    problem = mpm.DynamicParticleProblem(residual, particles, rho, velocity=g_t * H * across)
    centre, found = particles.initial_centroid, []
    sector = np.arctan2(centre[:, 1], centre[:, 0]) // (np.pi / 8) % 2
    for step in problem.steps(time=1.0, dt=1.0 / steps, update=update, output_at=[0.25, 0.5]):
        found.append((step.time, size(d - (x - X)), size(x - X)))
        if draws and step.time in (0.25, 0.5, 1.0):
            ax = axes[[0.25, 0.5, 1.0].index(step.time)]
            mpm.plot.domains(particles, sector, ax=ax, cmap="coolwarm", edgecolor="face")
            ax.set(title=f"t = {step.time:g}", aspect="equal", xticks=[], yticks=[])
    return np.array(found).T


# ## Result

for degree, n, steps in ((1, 8, 20), (1, 16, 40), (2, 8, 40)):
    times, errors, sizes = run(degree, n, steps, (degree, n) == (1, 16))
    of_d[degree, n], label = errors[-1] / max(sizes), f"degree {degree}, cells 1/{n}"
    axes[3].semilogy(times, errors / max(sizes), label=label)
    if comm.rank == 0:
        print(f"{label}: error at the end {of_d[degree, n]:.4f}")
axes[3].set(xlabel="time", title="error of d over its largest")
axes[3].legend(fontsize=8)
if comm.rank == 0:
    figure.savefig("vortex.png", dpi=150)

# Degree 2 on the coarse background beats degree 1 on the fine one.

assert of_d[1, 16] < 0.4 * of_d[1, 8] and of_d[2, 8] < of_d[1, 16]

# ## Exercises
#
# Take `scheme="euler"`. Of which order is the error then?
