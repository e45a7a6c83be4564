# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.2: Displacement control beyond a limit load

# # A shallow arch that snaps through
#
# It illustrates how to:
# - go on beyond a limit load by displacement control,
# - read the load factors that are found, and the displacements they belong to,
# - compare a path of equilibria that no run by load can follow with finite elements.
#
# ## Problem
#
# An elastic arch in plane strain, 20 m wide, 1 m high at its middle and 0.5 m deep, is clamped at
# both ends; its axis is a sine. A dead pressure $p_0$ = 10 kPa times the load factor $\lambda$ acts
# on the 2 m around the crown. By symmetry the left half will do:
#
# $$
# R(d; v) = \int P_1 : \nabla v \,\mathrm{d}X
#   + \lambda \int_{X_1 > 9\,\mathrm{m}} p_0\, v_2 \,\mathrm{d}S = 0, \tag{1}
# $$
#
# with $P_1$ the first Piola stress of Hencky's material, $E = 12$ MPa, $\nu = 0.2$. The load grows
# to a limit, where the arch is half a metre lower. There it *snaps*: under that load the next
# equilibrium has the crown 1 m lower still, and the arch hangs. A run by load ends at the limit,
# or jumps to the hanging arch.
#
# ## Method
#
# Between the two are equilibria with less load. The crown's way down $w = -d_2$ grows on all
# of the path, so it is given in equal steps, and $\lambda$ is found with the increment $u$ of the
# background:
#
# $$
# R(d_n + T_n u;\, T_n v) = 0 \;\; \forall v, \qquad w(d_n + T_n u) = w_{n+1}. \tag{2}
# $$
#
# Each of Newton's steps takes two solves with one factor, `docs/limit-loads.md` says how.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
half, rise, depth, way = 10.0, 1.0, 0.5, 2.4  # m
young, poisson, pressure = 12e6, 0.2, 10e3  # Pa, -, Pa

# The background reaches from below the arch that hangs to above the one that stands. Its basis and
# the domains are of degree 2. The body's cells are half as long as the background's and follow
# the axis.

quadrilateral = mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, [[0.0, -3.0], [half, 3.0]], [20, 12], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 2, (2,)))
body = mesh.create_rectangle(comm, [[0.0, 0.0], [half, depth]], [40, 4], quadrilateral)


def axis(x):
    return rise * np.sin(np.pi / 2.0 * x / half)


body.geometry.x[:, 1] += axis(body.geometry.x[:, 0])

# The upper face near the crown is tagged; the load rides on it.

near = mpm.region(x=(half - 1.0, half))
tags = mpm.facet_tags(body, {1: lambda x: near(x) & np.isclose(x[1] - axis(x[0]), depth)})

particles = mpm.Particles(body, V, degree=2)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.Hencky(young, poisson),
        tractions=[((0.0, -pressure), 1)],
        facet_tags=tags,
    ),
    bcs=[mpm.held(V, x=0.0), mpm.held(V, 0, x=half)],
)

# What is controlled is the way of a point of the body, which need not be a node.

crown = mpm.DisplacementControl(
    particles, way, point=(half, rise + depth / 2.0), direction=(0.0, -1.0)
)
fig, axes = None, {"arch": None}
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic([["arch", "path"]], figsize=(13, 4.4), layout="constrained")
mpm.plot.background(V, ax=axes["arch"], color="0.9")
mpm.plot.domains(particles, ax=axes["arch"], facecolor="0.96", edgecolor="0.75", linewidth=0.3)
path = [(0.0, 0.0)]
for step in problem.steps(24, control=crown):
    path.append((crown.present(), step.load))
    if abs(path[-1][0] - 1.0) < 0.5 * way / 24:
        mpm.plot.domains(particles, ax=axes["arch"], facecolor="0.96", edgecolor="0.75")

# ## Result
#
# Finite elements of degree 2 on the same continuum (80 by 4 cells, right to 1e-3) need these load
# factors for these ways down.

REFERENCE = {
    **{0.2: 0.105233, 0.4: 0.147589, 0.5: 0.152921, 0.6: 0.151423, 0.8: 0.136940},
    **{1.0: 0.119336, 1.2: 0.111730, 1.4: 0.128146, 1.6: 0.184572, 1.8: 0.297552},
    **{2.0: 0.482094, 2.2: 0.751074, 2.4: 1.115785},
}
w, load = np.array(path).T
limit, valley = load[w <= 1.0].max(), load[(w > 0.6) & (w < 1.6)].min()
error = max(
    abs(load[np.argmin(abs(w - at))] - exact) for at, exact in REFERENCE.items() if at <= 1.4
)
error /= REFERENCE[0.5]
if comm.rank == 0:
    print(f"limit load {limit:.5f} (finite elements {REFERENCE[0.5]:.5f})")
    print(f"valley {valley:.5f} (finite elements {REFERENCE[1.2]:.5f})")
    print(f"largest error over the limit load, until the arch hangs: {error:.1e}")

# The picture: the arch as it stands, at 1 m and at the end, and its path beside that of the
# finite elements.

stress = particles.stress[:, 0, 0] / 1e6
span = comm.allreduce(np.max(np.abs(stress), initial=0.0), MPI.MAX)
colours = mpm.plot.domains(
    particles, stress, ax=axes["arch"], cmap="RdBu_r", vmin=-span, vmax=span, linewidth=0.1
)
if comm.rank == 0:
    axes["arch"].set(xlim=(0.0, half), ylim=(-2.4, 2.2), xlabel="x, m", ylabel="y, m")
    fig.colorbar(colours, ax=axes["arch"], label="stress along, MPa", shrink=0.6)
    axes["path"].plot(w, load, label="particles")
    axes["path"].plot(*zip(*REFERENCE.items(), strict=True), "o", label="finite elements")
    axes["path"].set(xlim=(0.0, 1.85), ylim=(0.0, 0.3))
    axes["path"].set(xlabel="crown's way down, m", ylabel="load over 10 kPa")
    axes["path"].legend()
    fig.savefig("snap_through.png", dpi=160)

# The path is that of the finite elements.

assert error < 5e-3 and problem.history.cutbacks == 0

# ## Exercises
#
# 1. Leave `control=` out, and print `path[-1]` in the loop. What does the arch do at the limit?
# 2. Make the arch higher, up to 4 m, and its background. Does the crown's way still grow on all of
#    the path?
