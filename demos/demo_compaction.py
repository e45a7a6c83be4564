# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1.2: Hencky's material to half its height, beside an exact stress

# # Compaction of an elastic column under its own weight
#
# It illustrates how to:
# - write a run as a function of the size of the cells,
# - sum what particles have over any number of ranks,
# - compare with an exact solution, and see the error fall as the background is refined.
#
# ## Problem
#
# A column of height $L = 50$ m stands between smooth walls on a smooth base and is loaded by its
# own weight, $g_0 = \rho_0\, g$ per undeformed volume, in 40 steps. It shortens to 48 % of its
# height, and every particle crosses many cells of the background. The material is Hencky's: stress
# is linear in the logarithmic strain,
#
# $$
# \tau = K\, \mathrm{tr}(\varepsilon)\, I + 2 G\, \mathrm{dev}\, \varepsilon, \qquad
# \varepsilon = \tfrac12 \ln (F F^T). \tag{1}
# $$
#
# ## Method
#
# A step's increment $u$ lives on the background, and the nodes of the particles' domains pick it up
# where they are at the moment; with the residual $R$ of finite elements on the body's mesh,
#
# $$
# d = d_n + T_n u, \qquad (T_n)_{ci} = N_i\bigl(X_c + d_n(X_c)\bigr), \qquad
# T_n^T R(d_n + T_n u) = 0. \tag{2}
# $$
#
# With one quadrature point in each domain this is CPDI2. The background is reset after each step by
# doing nothing: it never moved.
#
# ## Exact solution
#
# Nothing moves sideways, so the weight above a point, at the height $Y$ at first, is the stress.
# The stretch $e^{-w}$ follows from $\sigma_{yy} = -M w e^w$ with $M = E (1-\nu) /
# ((1+\nu)(1-2\nu))$, and the position $y$ by integration; $W$ is Lambert's function:
#
# $$
# \sigma_{yy} = -g_0\, (L - Y), \quad w = W\bigl(k\, (L - Y)\bigr), \quad k = \frac{g_0}{M}, \quad
# y(Y) = \frac1k \left[ w + \tfrac12 w^2 \right]_{w(Y)}^{w(0)}. \tag{3}
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
k = weight * (1.0 + poisson) * (1.0 - 2.0 * poisson) / (young * (1.0 - poisson))

# The background is one cell wide, the body has two by two quadrilaterals in each of its cells. The
# walls and the base are conditions on the background, as the background is where the unknowns live.


def run(elements):
    width, quadrilateral = height / elements, mesh.CellType.quadrilateral
    corners = [[0.0, 0.0], [width, height]]
    background = mesh.create_rectangle(comm, corners, [1, elements], quadrilateral)
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    body = mesh.create_rectangle(comm, corners, [2, 2 * elements], quadrilateral)
    bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=width), mpm.held(V, 1, y=0.0)]
    particles = mpm.Particles(body, V)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.Hencky(young, poisson),
            density=density,
            body_force=(0.0, -gravity),
        ),
        bcs=bcs,
    )
    problem.solve(steps=40)
    return particles, problem.history


# The exact solution (3); Lambert's function by Newton's method.


def lambert_w(x):
    w = np.log1p(x)
    for _ in range(50):
        w = w - (w - x * np.exp(-w)) / (1.0 + w)
    return w


def exact(Y):
    w, bottom = lambert_w(k * (height - Y)), lambert_w(k * height)
    return -weight * (height - Y), ((bottom + bottom**2 / 2.0) - (w + w**2 / 2.0)) / k


# Errors are means over the particles, weighted by their initial volumes. `particles` hands out
# arrays of the particles that this rank owns, so sums are summed over ranks too.


def mean(values, weights):
    return comm.allreduce(np.sum(values * weights)) / comm.allreduce(np.sum(weights))


def errors(particles):
    stress, position = exact(particles.initial_centroid[:, 1])
    of_stress = np.abs(particles.stress[:, 1, 1] - stress) / (weight * height)
    of_position = np.abs(particles.centroid[:, 1] - position) / height
    volume = particles.initial_volume
    return mean(of_stress, volume), mean(of_position, volume)


sizes = [8, 16, 32, 64]
runs = [run(elements) for elements in sizes]
found = np.array([errors(particles) for particles, _ in runs])

# ## Result

if comm.rank == 0:
    print("cells   error of stress   of position   linear solves")
    for elements, (stress, position), (_, history) in zip(sizes, found, runs, strict=True):
        solves = history.total_iterations
        print(f"{elements:5d}{stress:18.2e}{position:14.2e}{solves:16d}")

# The picture: the stress over the height with 16 cells, and how the errors fall.

particles, history = runs[1]
shown = comm.gather(np.column_stack([particles.stress[:, 1, 1] / 1e3, particles.centroid[:, 1]]))
if comm.rank == 0:
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    stress, position = exact(np.linspace(0.0, height, 400))
    left.plot(stress / 1e3, position, color="0.4", label="exact")
    left.plot(*np.concatenate(shown).T, "o", mfc="white", label="particles")
    left.set(xlabel="vertical Cauchy stress, kPa", ylabel="height now, m")
    right.loglog(sizes, found, "o-", label=["stress", "position"])
    right.set(xlabel="background cells over the height", ylabel="relative error")
    left.legend()
    right.legend()
    fig.savefig("compaction.png", dpi=130)

assert found[1, 0] < 2.7e-3 and found[1, 1] < 1e-3
assert history.total_iterations <= 130

# ## Exercises
#
# 1. Use `method="gimp"` and `"cpdi"`. Which digits change?
# 2. Why does `method="mpm"` not converge as the cells get smaller?
# 3. Use degree 2 for `V` and `degree=2` for the particles, with 4 and 8 cells.
