# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1

# # An elasto-plastic column between rollers
#
# It illustrates how to:
# - solve an elasto-plastic problem at finite strain with `mpm.materials.VonMises`,
# - go through the load steps one by one and look at the yield function after each,
# - compare the stress of the particles with an exact solution that has a yield front,
# - check the linear limit: a stiff body at small strain.
#
# The picture is figure 3 of Wang, Coombs, Augarde and Brown, *Implicit MPM with second-order
# convected particle domain interpolation*: Cauchy stress against vertical position.
#
# ## Notation
#
# $Y$ is the height of a point at first, $y$ now; $\delta = L - Y$ its depth at first. $\tau$ is
# Kirchhoff's, $\sigma$ Cauchy's stress; $K$ and $G$ are the bulk and shear modulus,
# $M = K + \tfrac43 G$. Pressure is negative stress. $W$ is Lambert's function.
#
# ## Problem
#
# A column of height $L = 10$ m, with rollers on both sides and at its base, carries its own
# weight $g_0 = \rho_0\, g = 8$ kPa/m, which grows in 40 steps. Nothing can move sideways, so the
# problem is one-dimensional and has an exact solution; but the material does not know that, and
# sees a stress that is no multiple of a single number. With $E = 200$ kPa the column shortens by
# 12 %, and its lower part yields.
#
# The material is von Mises', perfectly plastic, on Hencky elasticity:
#
# $$
# f = \frac{\sqrt{2 J_2}}{\rho_y} - 1 \le 0, \qquad
# \tau = K\, \mathrm{tr}(\varepsilon_e)\, I + 2 G\, \mathrm{dev}\, \varepsilon_e. \tag{1}
# $$
#
# The update over a step is the implicit backward Euler method: given the trial strain
# $\varepsilon_e^{\mathrm{tr}}$, find the elastic strain and the multiplier such that
#
# $$
# f = 0, \qquad
# \varepsilon_e - \varepsilon_e^{\mathrm{tr}} + \Delta\gamma \frac{\partial f}{\partial \tau} = 0
# \tag{2}
# $$
#
# wherever the trial stress is beyond yield. The yield condition thus holds at the end of each
# step to round-off, however large the step is.
#
# ## Method
#
# The equations of a step are those of `demo_compaction.py`: an increment of the background
# carries the nodes of the domains along,
#
# $$
# d = d_n + T_n u, \qquad r(u) = T_n^T R_W(d_n + T_n u) = 0, \tag{3}
# $$
#
# and Newton's method solves them with the tangent that is consistent with (2).
#
# ## Exact solution
#
# The weight above a point gives the vertical stress at once, and the stretch $\lambda = e^{-w}$
# follows from the material. Let $c = \sqrt{2/3}\, \rho_y$. Above the depth $\delta_y$
#
# $$
# \sigma_{yy} = -g_0 \delta, \qquad w = W(g_0 \delta / M), \qquad
# \sigma_{xx} = -(K - \tfrac23 G)\, w\, e^w, \tag{4}
# $$
#
# and below it the material yields,
#
# $$
# \sigma_{yy} = -g_0 \delta, \qquad
# w = W\Bigl( \frac{g_0 \delta}{K} e^{c/K} \Bigr) - \frac{c}{K}, \qquad
# \sigma_{xx} = \sigma_{yy} + \sqrt{3/2}\, \rho_y\, e^w, \tag{5}
# $$
#
# where $\delta_y = M w_y e^{w_y} / g_0$ with $w_y = \sqrt{3/2}\, \rho_y / (2 G)$. In both parts
# $\sigma_{zz} = \sigma_{xx}$. At small strain (4), (5) become
#
# $$
# \sigma_{xx} = \frac{\nu}{1 - \nu}\, \sigma_{yy} \quad (\delta < \delta_y), \qquad
# \sigma_{xx} = \sigma_{yy} + \sqrt{3/2}\, \rho_y \quad (\delta > \delta_y), \tag{6}
# $$
#
# with $\delta_y = \sqrt{3/2}\, \rho_y (1-\nu) / ((1 - 2\nu)\, g_0)$.
#
# The error of a component is a mean over the particles, weighted by initial volume:
#
# $$
# e = \frac{\sum_p |\sigma_p - \sigma(Y_p)|\, V_p^0}{g_0 L \sum_p V_p^0}. \tag{7}
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

# Background and body, each a DOLFINx mesh; two domains each way in a cell.

corners, quadrilateral = [[0.0, 0.0], [width, height]], mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, corners, [1, elements], quadrilateral)
body = mesh.create_rectangle(comm, corners, [2, 2 * elements], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))

# The rollers are conditions on the background: on both sides, and at the base.

bcs = []
for axis, places in ((0, (0.0, width)), (1, (0.0,))):
    facets = mesh.locate_entities_boundary(
        background, 1, lambda x, i=axis, at=places: np.isclose(x[i][:, None], at).any(axis=1)
    )
    dofs = fem.locate_dofs_topological(V.sub(axis), 1, facets)
    bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))

particles = mpm.Particles(body, V)
problem = mpm.QuasiStaticProblem(
    particles,
    mpm.materials.VonMises(young, poisson, rho_y=rho_y),
    density=density,
    body_force=(0.0, -gravity),
    bcs=bcs,
)

# `steps` hands out each converged step. After each, the yield function (1) is looked at: by how
# much does the worst particle violate it?

yield_violation = -np.inf
for step in problem.steps(40):
    yield_violation = max(yield_violation, np.max(problem.yield_function, initial=-np.inf))
yield_violation = comm.allreduce(yield_violation, MPI.MAX)

# The exact solution at initial heights: the stresses and the vertical stretch.

K, G = young / (3.0 * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
M = K + 4.0 * G / 3.0
c, w_y = np.sqrt(2.0 / 3.0) * rho_y, np.sqrt(1.5) * rho_y / (2.0 * G)
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


# The present height is the integral of the stretch, by the midpoint rule.

edges = np.linspace(0.0, height, 20001)
stretch = exact((edges[1:] + edges[:-1]) / 2.0)[2]
heights = np.concatenate([[0.0], np.cumsum(stretch * np.diff(edges))])

# ## Result
#
# The errors (7). Newton's method is quadratic in the elastic first step and in the plastic last
# one: the relative residuals tell.


def mean(values, weights):
    return comm.allreduce(np.sum(values * weights)) / comm.allreduce(np.sum(weights))


volume, stress = particles.initial_volume, particles.stress
s_yy, s_xx, _ = exact(particles.initial_centroid[:, 1])
error_syy = mean(np.abs(stress[:, 1, 1] - s_yy), volume) / (weight * height)
error_sxx = mean(np.abs(stress[:, 0, 0] - s_xx), volume) / (weight * height)
top = comm.allreduce(np.max(particles.domains[:, :, 1], initial=0.0), MPI.MAX)
if comm.rank == 0:
    print(f"{particles.num_global} particles, {problem.history.total_iterations} linear solves")
    print(f"top of the column: {top:.5f} m (exact {heights[-1]:.5f} m)")
    print(f"error of s_yy {error_syy:.2e}, of s_xx {error_sxx:.2e}")
    print(f"largest yield function {yield_violation:.1e}")
    for name, step in (("first", problem.history.steps[0]), ("last", problem.history.steps[-1])):
        print(f"residuals of the {name} step:", *(f"{r:.0e}" for r in step.residuals))

# Figure 3: markers are the particles, lines the exact solution. Beside it stands the column,
# coloured by plastic strain, before what it was at first.

shown = comm.gather(np.column_stack([particles.centroid[:, 1], stress[:, 1, 1], stress[:, 0, 0]]))
fig, axes = None, {"column": None}
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic(
        [["column", "stress"]], figsize=(12, 6.2), width_ratios=[0.5, 4.0], layout="constrained"
    )
mpm.plot.domains(particles, ax=axes["column"], warp=0.0, facecolor="0.93", edgecolor="0.8")
colours = mpm.plot.domains(
    particles, 100.0 * particles.plastic_strain, ax=axes["column"], cmap="cividis", vmin=0.0
)
if comm.rank == 0:
    axes["column"].set(xlim=(-0.4 * width, 1.4 * width), ylim=(-0.1, height + 0.1), xticks=[])
    fig.colorbar(colours, ax=axes["column"], label="plastic strain, %", shrink=0.55)
    y, *values = np.concatenate(shown).T
    for found, line, name, marker in zip(values, exact(edges), ("yy", "xx"), "os", strict=False):
        drawn = axes["stress"].plot(heights, line / 1e3, label=rf"$\sigma_{{{name}}}$ exact")
        colour = drawn[0].get_color()
        axes["stress"].plot(y, found / 1e3, marker, color=colour, mfc="white", label="particles")
    front = np.interp(height - yield_depth, edges, heights)
    axes["stress"].axvspan(0.0, front, color="0.93", zorder=0)
    axes["stress"].set(xlabel="vertical position, m", ylabel="Cauchy stress, kPa")
    axes["stress"].set_title("Below the front (grey) the column yields")
    axes["stress"].legend(loc="lower right")
    fig.savefig("column_roller.png", dpi=160)

# The numbers are known.

assert error_syy < 1.2e-3 and error_sxx < 9.7e-4
assert abs(top - heights[-1]) < 2e-3
assert yield_violation < 1e-8
assert problem.history.total_iterations <= 135 and problem.history.cutbacks == 0
