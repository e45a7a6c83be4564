# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1.3: Von Mises, finite strain, beside an exact stress

# # An elasto-plastic column between rollers
#
# It illustrates how to:
# - solve an elasto-plastic problem at finite strain with `mpm.materials.VonMises`,
# - go through the load steps one by one and look at the yield function after each,
# - compare the stress of the particles with an exact solution that has a yield front.
#
# The picture is figure 3 of Wang, Coombs, Augarde and Brown, *Implicit MPM with second-order
# convected particle domain interpolation*: Cauchy stress against vertical position.
#
# ## Problem
#
# A column of height $L = 10$ m, with rollers on both sides and at its base, carries its own
# weight $g_0 = \rho_0\, g = 8$ kPa/m, which grows in 40 steps. It shortens by 12 %, and its lower
# part yields. The material is von Mises', perfectly plastic, on Hencky elasticity:
#
# $$
# f = \frac{\sqrt{2 J_2}}{\rho_y} - 1 \le 0, \qquad
# \tau = K\, \mathrm{tr}(\varepsilon_e)\, I + 2 G\, \mathrm{dev}\, \varepsilon_e. \tag{1}
# $$
#
# ## Exact solution
#
# The weight above a point, at the depth $\delta$ at first, is the vertical stress,
# $\sigma_{yy} = -g_0 \delta$; the stretch $e^{-w}$ follows from the material. With $W$ Lambert's
# function, $M = K + \tfrac43 G$ and $c = \sqrt{2/3}\, \rho_y$, above and below the yield front,
#
# $$
# w = W\Bigl(\frac{g_0 \delta}{M}\Bigr), \;\; \sigma_{xx} = -(K - \tfrac23 G)\, w\, e^w; \qquad
# w = W\Bigl(\frac{g_0 \delta}{K} e^{c/K}\Bigr) - \frac{c}{K}, \;\;
# \sigma_{xx} = \sigma_{yy} + \sqrt{\tfrac32}\, \rho_y\, e^w. \tag{2}
# $$
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
height, density, gravity = 10.0, 800.0, 10.0  # m, kg/m3, m/s2
young, poisson, rho_y = 2e5, 0.3, 20e3  # Pa, -, Pa
elements = 32
weight, width = density * gravity, height / elements

# Background and body, each a DOLFINx mesh; two domains each way in a cell. The rollers are
# conditions on the background.

corners, quadrilateral = [[0.0, 0.0], [width, height]], mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, corners, [1, elements], quadrilateral)
body = mesh.create_rectangle(comm, corners, [2, 2 * elements], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=width), mpm.held(V, 1, y=0.0)]

particles = mpm.Particles(body, V)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.VonMises(young, poisson, rho_y=rho_y),
        density=density,
        body_force=(0.0, -gravity),
    ),
    bcs=bcs,
)

# `steps` hands out each converged step. By how much does the worst particle violate (1)?

violation = -np.inf
for step in problem.steps(40):
    violation = max(violation, np.max(problem.yield_function, initial=-np.inf))
violation = comm.allreduce(violation, MPI.MAX)

# The exact solution (2) at initial heights: the stresses and the vertical stretch.

K, G = young / (3.0 * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
M, c = K + 4.0 * G / 3.0, np.sqrt(2.0 / 3.0) * rho_y
w_y = np.sqrt(1.5) * rho_y / (2.0 * G)
yield_depth = M * w_y * np.exp(w_y) / weight


def lambert_w(x):
    w = np.log1p(x)
    for _ in range(50):
        w = w - (w - x * np.exp(-w)) / (1.0 + w)
    return w


def exact(Y):
    depth = np.maximum(height - Y, 0.0)
    yields, s_yy = depth > yield_depth, -weight * depth
    plastic = lambert_w(-s_yy / K * np.exp(c / K)) - c / K
    w = np.where(yields, plastic, lambert_w(-s_yy / M))
    s_xx = -(K - 2.0 * G / 3.0) * w * np.exp(w)
    return s_yy, np.where(yields, s_yy + np.sqrt(1.5) * rho_y * np.exp(w), s_xx), np.exp(-w)


# ## Result
#
# Errors are means over the particles, relative to $g_0 L$.


def error(found, wanted):
    volume = particles.initial_volume
    off = comm.allreduce(np.sum(np.abs(found - wanted) * volume))
    return off / comm.allreduce(volume.sum()) / (weight * height)


stress = particles.stress
s_yy, s_xx, _ = exact(particles.initial_centroid[:, 1])
errors = error(stress[:, 1, 1], s_yy), error(stress[:, 0, 0], s_xx)
if comm.rank == 0:
    solves = problem.history.total_iterations
    print(f"{particles.num_global} particles, {solves} linear solves")
    print(f"error of s_yy {errors[0]:.2e}, of s_xx {errors[1]:.2e}")
    print(f"the yield function is at most {max(violation, 0.0):.0e}")

# Figure 3: markers are the particles, lines the exact solution. The present height is the integral
# of the stretch.

shown = comm.gather(np.column_stack([particles.centroid[:, 1], stress[:, 1, 1], stress[:, 0, 0]]))
if comm.rank == 0:
    edges = np.linspace(0.0, height, 20001)
    stretch = exact((edges[1:] + edges[:-1]) / 2.0)[2]
    heights = np.concatenate([[0.0], np.cumsum(stretch * np.diff(edges))])
    fig, ax = plt.subplots(figsize=(9, 5), layout="constrained")
    y, *values = np.concatenate(shown).T
    for found, line, name, marker in zip(values, exact(edges), ("yy", "xx"), "os", strict=False):
        (drawn,) = ax.plot(heights, line / 1e3, label=rf"$\sigma_{{{name}}}$ exact")
        ax.plot(y, found / 1e3, marker, color=drawn.get_color(), mfc="white", label="particles")
    ax.axvspan(0.0, np.interp(height - yield_depth, edges, heights), color="0.93", zorder=0)
    ax.set(xlabel="vertical position, m", ylabel="Cauchy stress, kPa")
    ax.set_title("Below the front (grey) the column yields")
    ax.legend(loc="lower right")
    fig.savefig("column_roller.png", dpi=130)

assert errors[0] < 1.2e-3 and errors[1] < 9.7e-4
assert violation < 1e-8 and problem.history.total_iterations <= 135

# ## Exercises
#
# 1. Halve the cells: by how much do the errors fall? Where are they largest, and why?
# 2. Print `step.residuals` of the first and of the last step. Newton's method is quadratic in both.
# 3. Draw `mpm.plot.history(problem, "run.png")`. In which step does the column begin to yield?
