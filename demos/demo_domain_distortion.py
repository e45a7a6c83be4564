# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.3: How domains of each method tile a sheared body

# # What becomes of particle domains
#
# It illustrates how to:
# - choose a method, `method="mpm"`, `"gimp"`, `"cpdi"` or `"cpdi2"`,
# - look at the particles' own domains, `particles.domains`, and see gaps and overlaps,
# - prescribe a motion: all dofs of the background, along a path given by `update=`.
#
# ## Four kinds of domain
#
# Methods differ in what the region about a particle does when the background moves by $u$. With
# the particle's position $x_p$ and $F_p = R_p U_p$, the corner that was at $X_c$ is
#
# $$
# \begin{aligned}
# \text{CPDI2:}\quad & x_c \leftarrow x_c + u(x_c), \\
# \text{CPDI:}\quad & x_c = x_p + F_p\, (X_c - X_p), \\
# \text{GIMP:}\quad & x_c = x_p + \mathrm{diag}(U_{11}, U_{22})\, (X_c - X_p).
# \end{aligned} \tag{1}
# $$
#
# CPDI2's corners belong to all the domains that meet there, which can neither part nor overlap.
# CPDI's fit as long as $F$ is the same for neighbours, GIMP's as long as nothing turns or shears.
# How far neighbours are apart is the largest distance between corners that were one at first,
#
# $$
# g = \frac{1}{h} \max_{X_c = X_{c'}} |x_c - x_{c'}|, \tag{2}
# $$
#
# relative to the size $h$ of a domain.
#
# ## Motion
#
# A square of 8 by 8 particles goes through a swirl. It is the flow of a steady velocity, so the
# increment over a step moves a node of the background from $x$ to $\varphi_{\Delta t}(x)$:
#
# $$
# \varphi_t(X) = R\bigl(\tfrac{\pi}{2}\, t\, e^{-|X|^2}\bigr)\, X. \tag{3}
# $$

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
METHODS = ("mpm", "gimp", "cpdi", "cpdi2")


def swirl(x, t):
    angle = np.pi / 2.0 * t * np.exp(-np.sum(x**2, axis=1))
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1]])


# Conditions are totals: the path adds up increments. `total` is where the last step ended.


def moved(method):
    background = mesh.create_rectangle(comm, [[-3, -3], [3, 3]], [12, 12], quadrilateral)
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    body = mesh.create_rectangle(comm, [[-1, -1], [1, 1]], [8, 8], quadrilateral)
    particles = mpm.Particles(body, V, method=method)
    value = fem.Function(V)
    every = np.arange(V.dofmap.index_map.size_local + V.dofmap.index_map.num_ghosts)
    bc = fem.dirichletbc(value, every.astype(np.int32))
    problem = mpm.QuasiStaticProblem(mpm.Body(particles, mpm.materials.Hencky(1.0, 0.3)), bcs=[bc])
    x = V.tabulate_dof_coordinates()[:, :2]
    total, last = np.zeros_like(value.x.array), 0.0

    def update(t):
        value.x.array[:] = total + (swirl(x, t - last) - x).ravel()

    for step in problem.steps(20, update=update):
        total[:] = value.x.array
        last = step.load
    return particles


def apart(particles):
    before, now = (
        np.concatenate(comm.allgather(x.reshape(-1, 2)))
        for x in (particles.initial_domains, particles.domains)
    )
    _, group = np.unique(np.round(before, 9), axis=0, return_inverse=True)
    group = group.ravel()
    spread = [now[group == g] - now[group == g][0] for g in range(group.max() + 1)]
    return max(np.linalg.norm(s, axis=1).max() for s in spread) / 0.25


# ## Result

runs = {method: moved(method) for method in METHODS}
gaps = {method: apart(particles) for method, particles in runs.items()}
fig, axes = None, [None] * len(METHODS)
if comm.rank == 0:
    fig, axes = plt.subplots(1, 4, figsize=(13, 3.6), layout="constrained")
for ax, (method, particles) in zip(axes, runs.items(), strict=True):
    mpm.plot.background(particles.V, ax=ax)
    mpm.plot.domains(particles, ax=ax, facecolor=(0.3, 0.5, 0.8, 0.4))
    if comm.rank == 0:
        print(f"{method:6s} neighbours are up to {gaps[method]:.2f} domains apart")
        ax.set(xlim=(-1.7, 1.7), ylim=(-1.7, 1.7), title=f"{method}: {gaps[method]:.2f} apart")
if comm.rank == 0:
    fig.savefig("domain_distortion.png", dpi=130)

assert gaps["cpdi2"] < 1e-12 < gaps["cpdi"] < gaps["gimp"]

# ## Exercises
#
# 1. Replace the swirl by a simple shear, then by a rigid rotation. Which methods are exact?
# 2. Stretch by `x * [2.0**t, 1.0]`, also with boxes of fixed size, `method="ugimp"`.
