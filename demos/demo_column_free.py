# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1.4: Von Mises, many times its limit load; cutbacks

# # An elasto-plastic column that collapses
#
# It illustrates how to:
# - follow a body to deformations that no mesh of it would survive as an updated one,
# - let the load step be cut back, and take a run that stops for what it is,
# - see what a singular transfer does to Newton's method, and what cures it.
#
# The pictures are figures 4 and 5 of Wang, Coombs, Augarde and Brown, *Implicit MPM with
# second-order convected particle domain interpolation*. There, a column of quadrilateral domains
# stops under a large load and one of triangles does not.
#
# ## Problem
#
# The right half of a column, 4 m wide and 8 m high, stands on a smooth base; its left side is
# the plane of symmetry (a roller), its right side is free. Its weight per volume $g_0$ grows
# to many times what the material can bear. The material is that of `demo_column_roller.py`,
# von Mises' with
#
# $$
# f = \frac{\sqrt{2 J_2}}{\rho_y} - 1 \le 0, \qquad E = 1\ \mathrm{MPa}, \quad \nu = 0.3, \quad
# \rho_y = 20\ \mathrm{kPa}. \tag{1}
# $$
#
# A column of height $H$ with free sides begins to yield where $g_0 H$ reaches about
# $\sqrt2 \rho_y$, here at $g_0 = 3.5$ kN/m3. At 160 kN/m3 it flows out to a sheet of 90 m by
# 0.6 m.
#
# ## Method
#
# A step looks for an increment $u$ of the background,
#
# $$
# d = d_n + T_n u, \qquad r(u) = T_n^T R_W(d_n + T_n u) = 0, \qquad K = T_n^T K_W T_n, \tag{2}
# $$
#
# where row $c$ of $T_n$ holds the background's basis at the present position of node $c$ of the
# domains. Two things make (2) harder than finite elements.
#
# *The kernel of* $T_n$. When a single node of the body enters a new cell, background nodes that
# no other node of the body sees get weight: several unknowns, one place where they act.
# Combinations of them move nothing, so $K$ is singular. That is harmless in exact arithmetic, as
# only $T_n u$ counts; but a factorisation returns noise of $10^{16}$ in those combinations, and
# $T_n u$ is then wrong in its second digit: domains fold. The cure is to factorise
#
# $$
# D^{-1/2} K D^{-1/2} + 10^{-13} I, \qquad D = |\mathrm{diag}\, K|, \tag{3}
# $$
#
# instead, while the residual stays the true one.
#
# *The reset.* The old equilibrium is none in the new space of increments: the first residual is a
# good part of the load, however small the step is. A line search helps: a Newton step is halved
# while a domain turns inside out, or while both the residual's norm and its work on the step stay
# large. Both cures are on by default (`shift=1e-13`, `line_search=True`).
#
# What is left is hourglass: quadrilaterals with one point have motions without strain, which are
# mild with two of them each way in a cell, and stop the run with one.
# With `on_distortion="split"` those that become concave, or keep a step from converging, are cut
# into triangles, which have no such motions. The cure is `quadrature_degree=2` with
# `f_bar="domain"`.
#
# ## Implementation

from mpi4py import MPI

import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
width, height, g0 = 4.0, 8.0, 20e3  # m, m, N/m3
young, poisson, rho_y = 1e6, 0.3, 20e3  # Pa, -, Pa
h = 0.5  # of the background's cells, m

# The background must be wide enough for the body to flow into. It may be larger than needed at no
# cost in the solver: only nodes that the body touches are unknowns.

background = mesh.create_rectangle(
    comm,
    [[0.0, 0.0], [20.0, 10.0]],
    [round(20.0 / h), round(10.0 / h)],
    mesh.CellType.quadrilateral,
)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
body = mesh.create_rectangle(
    comm,
    [[0.0, 0.0], [width, height]],
    [round(2 * width / h), round(2 * height / h)],
    mesh.CellType.triangle,
    diagonal=mesh.DiagonalType.left_right,
)
bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 1, y=0.0)]

particles = mpm.Particles(body, V)
problem = mpm.QuasiStaticProblem(
    mpm.Body(particles, mpm.materials.VonMises(young, poisson, rho_y=rho_y), body_force=(0.0, -g0)),
    bcs=bcs,
)

# A step that fails is halved and tried again; if the smallest step fails too, the package raises
# an `mpm.MPMError`, and the particles are where they were at the last converged step. A long run
# would also say `problem.save("column.ckpt")` after each step, and `problem.restore` to go on.

yield_violation = -np.inf
for step in problem.steps(40):
    yield_violation = max(yield_violation, np.max(problem.yield_function, initial=-np.inf))
yield_violation = comm.allreduce(yield_violation, MPI.MAX)

# ## Result
#
# What is measured: the highest and the farthest node of the body, the mean height
# $\bar y = \int y\, \mathrm{d}X / \int \mathrm{d}X$, and by how much the yield condition is
# violated over the run.

x, volume = particles.domains.reshape(-1, 2), particles.initial_volume
toe, top = (comm.allreduce(np.max(x[:, i], initial=0.0), MPI.MAX) for i in (0, 1))
y_mean = comm.allreduce(np.sum(particles.centroid[:, 1] * volume)) / comm.allreduce(volume.sum())
history = problem.history
if comm.rank == 0:
    print(f"{particles.num_global} triangles under {g0 / 1e3:g} kN/m3")
    print(f"{history.total_iterations} linear solves, {history.cutbacks} cutbacks")
    print(f"top {top:.3f} m, toe {toe:.2f} m, mean height {y_mean:.4f} m")

mpm.plot.scene(problem, "plastic_strain", "column_free.png")

assert abs(toe / 12.23 - 1.0) < 0.01 and abs(y_mean / 1.3307 - 1.0) < 0.005
assert yield_violation < 1e-8

# ## Exercises
#
# 1. Use quadrilaterals as large as cells. Where does the run stop? Then give the particles
#    `on_distortion="split"`, or `quadrature_degree=2` and the body `f_bar="domain"`.
# 2. Four times the weight needs a background four times as wide. How far does the toe get?
# 3. There turn the cures off, by `solver=mpm.Solver(shift=0.0)`, `line_search=False`, and both.
