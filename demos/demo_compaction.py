# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1

# # Compaction of an elastic column under its own weight
#
# It illustrates how to:
# - make a body of particles from one mesh and a background from another,
# - solve for equilibrium at finite strain with `mpm.QuasiStaticProblem`,
# - read stress, volume and position of the particles, on any number of ranks,
# - compare with an exact solution, and see the error fall as the background is refined.
#
# ## Notation
#
# $X$ is a point of the undeformed body, $d(X)$ its displacement and $x = X + d$ its position;
# $F = I + \nabla d$. Stress is Kirchhoff's $\tau$ or Cauchy's $\sigma = \tau/\det F$; pressure
# is negative stress. $Y$ is the height of a point at first, $y$ its height now.
#
# ## Problem
#
# A column of height $L = 50$ m stands between smooth walls on a smooth base and is loaded by its
# own weight, $\rho_0 g$ per undeformed volume. The load grows in 40 steps. With the default
# stiffness the column shortens to 48 % of its height, so all that is measured here is measured
# at large strain, with every particle crossing many cells of the background.
#
# Equilibrium on the undeformed body reads: find $d$ such that for all $v$
#
# $$
# R(d; v) = \int P : \nabla v \,\mathrm{d}X - \int \rho_0\, b \cdot v \,\mathrm{d}X = 0,
# \qquad P = \tau F^{-T}. \tag{1}
# $$
#
# The material is Hencky's: stress is linear in the logarithmic strain,
#
# $$
# \tau = K\, \mathrm{tr}(\varepsilon)\, I + 2 G\, \mathrm{dev}\, \varepsilon, \qquad
# \varepsilon = \tfrac12 \ln (F F^T). \tag{2}
# $$
#
# ## Method
#
# The domains of the particles are the cells of the body's mesh. Let $W$ be the continuous
# Lagrange space on it, $V$ that on the background, and $d_n$ the displacement at the last
# converged step. The unknown of a step is an increment $u$ in $V$, which the nodes of the domains
# pick up where they are at the moment:
#
# $$
# d = d_n + T_n u, \qquad (T_n)_{ci} = N_i\bigl(X_c + d_n(X_c)\bigr), \tag{3}
# $$
#
# with $N_i$ the basis functions of the background and $c$ the nodes of the domains. Restricting
# (1) to such increments gives the equations of a step, which Newton's method solves:
#
# $$
# r(u) = T_n^T R_W(d_n + T_n u) = 0, \qquad K = T_n^T K_W T_n. \tag{4}
# $$
#
# With one quadrature point per domain this is CPDI2, the second-order convected particle domain
# interpolation. The background is reset after each step by doing nothing: it never moved. The
# older methods (`method=`) differ in the rows of $T_n$ alone; of them the point method `mpm`
# does not converge here, since the stress jumps whenever a particle crosses a cell.
#
# ## Exact solution
#
# Nothing moves sideways, so (1) is a balance over the height. Let $\delta = L - Y$ be the depth
# of a point at first, and $M = E (1-\nu) / ((1+\nu)(1-2\nu))$. The weight above a point does not
# change, and neither does the area that carries it:
#
# $$
# \sigma_{yy} = -g_0\, \delta, \qquad g_0 = \rho_0\, g. \tag{5}
# $$
#
# The stretch $\lambda = e^{-w}$ follows from $\sigma_{yy} = M \ln \lambda/\lambda = -M w e^w$,
# so that $w$ is Lambert's function, and integrating the stretch gives the position:
#
# $$
# w = W(k\, \delta), \quad k = \frac{g_0}{M}, \qquad
# y(Y) = \frac1k \left[ w + \tfrac12 w^2 \right]_{w(\delta)}^{w(L)}. \tag{6}
# $$
#
# Errors are means over the particles, weighted by their initial volumes $V_p^0$:
#
# $$
# e_\sigma = \frac{\sum_p |\sigma_{yy,p} - \sigma_{yy}(Y_p)|\, V_p^0}{g_0 L \sum_p V_p^0}, \qquad
# e_y = \frac{\sum_p |y_p - y(Y_p)|\, V_p^0}{L \sum_p V_p^0}. \tag{7}
# $$
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
height, density, gravity = 50.0, 80.0, 10.0  # m, kg/m3, m/s2
young, poisson = 1e4, 0.0  # Pa, -
weight = density * gravity

# The background is one cell wide, the body has two by two quadrilaterals in each of its cells. The
# walls and the base are conditions on the background, as the background is where the unknowns live.


def column(elements):
    width = height / elements
    quadrilateral = mesh.CellType.quadrilateral
    background = mesh.create_rectangle(
        comm, [[0.0, 0.0], [width, height]], [1, elements], quadrilateral
    )
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    body = mesh.create_rectangle(
        comm, [[0.0, 0.0], [width, height]], [2, 2 * elements], quadrilateral
    )

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
        mpm.materials.Hencky(young, poisson),
        density=density,
        body_force=(0.0, -gravity),
        bcs=bcs,
    )
    return particles, problem


# The exact solution (5), (6) as functions of the initial height; Lambert's function by Newton's
# method, which converges from $\ln(1 + x)$ for all $x \ge 0$.

k = weight * (1.0 + poisson) * (1.0 - 2.0 * poisson) / (young * (1.0 - poisson))


def lambert_w(x):
    w = np.log1p(x)
    for _ in range(50):
        w = w - (w - x * np.exp(-w)) / (1.0 + w)
    return w


def exact_stress(Y):
    return -weight * (height - Y)


def exact_position(Y):
    w, bottom = lambert_w(k * (height - Y)), lambert_w(k * height)
    return ((bottom + bottom**2 / 2.0) - (w + w**2 / 2.0)) / k


# The errors (7). `particles` hands out arrays of the particles that this rank owns, so sums are
# summed over ranks too.


def mean(values, weights):
    return comm.allreduce(np.sum(values * weights)) / comm.allreduce(np.sum(weights))


def errors(particles):
    Y, volume = particles.initial_centroid[:, 1], particles.initial_volume
    of_stress = np.abs(particles.stress[:, 1, 1] - exact_stress(Y)) / (weight * height)
    of_position = np.abs(particles.centroid[:, 1] - exact_position(Y)) / height
    return mean(of_stress, volume), mean(of_position, volume)


# A run on four backgrounds, coarse to fine.

sizes, runs = [8, 16, 32, 64], {}
for elements in sizes:
    particles, problem = column(elements)
    problem.solve(steps=40)
    runs[elements] = particles, problem.history, errors(particles)

# ## Result
#
# The residuals of the first step show Newton's method at work: once it is near, each of them is
# about the square of the one before.

particles, history, (error, error_position) = runs[16]
if comm.rank == 0:
    print("residuals of the first step:", *(f"{r:.0e}" for r in history.steps[0].residuals))
    print("cells   error of stress   of position   linear solves")
    for elements, (_, each, (of_stress, of_position)) in runs.items():
        print(f"{elements:5d}{of_stress:18.2e}{of_position:14.2e}{each.total_iterations:16d}")

# The picture shows the column before what it was at first, its stress over the height against
# (5), (6), and how the errors fall.

stress = comm.gather(particles.stress[:, 1, 1] / 1e3)
y = comm.gather(particles.centroid[:, 1])
fig, axes = None, {"column": None}
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic(
        [["column", "stress", "error"]],
        figsize=(14, 6),
        width_ratios=[0.6, 2.6, 2.6],
        layout="constrained",
    )
mpm.plot.domains(particles, ax=axes["column"], warp=0.0, facecolor="0.93", edgecolor="0.8")
colours = mpm.plot.domains(
    particles, particles.stress[:, 1, 1] / 1e3, ax=axes["column"], cmap="viridis_r"
)
if comm.rank == 0:
    axes["column"].set(xlim=(-1.0, 4.0), ylim=(-0.5, height + 0.5), xticks=[], ylabel="height, m")
    fig.colorbar(colours, ax=axes["column"], label="vertical Cauchy stress, kPa")
    Y = np.linspace(0.0, height, 400)
    axes["stress"].plot(exact_stress(Y) / 1e3, exact_position(Y), color="0.4", label="exact")
    axes["stress"].plot(np.concatenate(stress), np.concatenate(y), "o", label="particles")
    axes["stress"].set(xlabel="vertical Cauchy stress, kPa", ylabel="height now, m")
    axes["stress"].legend()
    found = np.array([run[2] for run in runs.values()])
    axes["error"].loglog(sizes, found[:, 0], "o-", label="stress")
    axes["error"].loglog(sizes, found[:, 1], "s-", label="position")
    axes["error"].set(xlabel="background cells over the height", ylabel="relative error (7)")
    axes["error"].legend()
    fig.savefig("compaction.png", dpi=160)

# The numbers are known.

d = particles.displacement.x.array.reshape(-1, 2)
own = particles.W.dofmap.index_map.size_local
now = particles.W.tabulate_dof_coordinates()[:own, 1] + d[:own, 1]
top = comm.allreduce(np.max(now, initial=0.0), MPI.MAX)
assert error < 2.7e-3 and error_position < 1e-3
assert history.total_iterations <= 130
assert abs(top - exact_position(height)) < 1e-2
