# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.1: Rubber in space, rotation of 270 degrees

# # A rubber bar is twisted by three quarters of a turn
#
# It illustrates how to:
# - solve a problem in three dimensions with rotations as large as one likes,
# - move the ends of a body by supports that ride on it, along a path,
# - make a movie in space by one call.
#
# ## Problem
#
# A square bar of rubber, 1 by 1 by 4, lies along the $z$ axis, in the air: nothing of it meets a
# boundary of the background. Its lower end is held, its upper end turns about the axis by the angle
# $\theta(t) = \tfrac32 \pi\, t$:
#
# $$
# d = R(\theta)\,(X - X_c) - (X - X_c), \qquad
# R = \begin{pmatrix} \cos\theta & -\sin\theta & 0 \\ \sin\theta & \cos\theta & 0 \\ 0 & 0 & 1
# \end{pmatrix} \quad \text{on } X_3 = 4. \tag{1}
# $$
#
# Each domain turns through many cells of the background. The moment that the supports bear is that
# of the tractions about the axis; for small angles it is $G J_t\, \theta / L$ with $J_t = 0.1406$.

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, hexahedron = MPI.COMM_WORLD, mesh.CellType.hexahedron
YOUNG, POISSON, LENGTH, ANGLE = 1e6, 0.3, 4.0, 1.5 * np.pi  # Pa, -, m, -
LOWER, UPPER = 1, 2

# The bar lies off the planes of the background, whose cells are 0.4 m wide; its own are 0.2 m.

background = mesh.create_box(comm, [[-1, -1, -0.4], [1, 1, 4.4]], [5, 5, 12], hexahedron)
V = fem.functionspace(background, ("Lagrange", 1, (3,)))
body = mesh.create_box(comm, [[-0.5, -0.5, 0], [0.5, 0.5, LENGTH]], [5, 5, 20], hexahedron)
particles = mpm.Particles(body, V, quadrature_degree=2)

# Both ends are tagged; the supports (1) are penalties on these facets, wherever they go.

tagged = mpm.facet_tags(body, {LOWER: mpm.region(z=0.0), UPPER: mpm.region(z=LENGTH)})

theta = fem.Constant(body, 0.0)
x, y, _ = ufl.SpatialCoordinate(body)
turned = [ufl.cos(theta) * x - ufl.sin(theta) * y, ufl.sin(theta) * x + ufl.cos(theta) * y]
turn = ufl.as_vector([turned[0] - x, turned[1] - y, 0.0])
problem = mpm.QuasiStaticProblem(
    mpm.Body(particles, mpm.materials.Hencky(YOUNG, POISSON)),
    supports=[
        mpm.boundary.fixed(particles, tagged, LOWER),
        mpm.boundary.fixed(particles, tagged, UPPER, value=turn),
    ],
)


def path(t):
    theta.value = ANGLE * t


# The torque follows from the work: the shear stress times its lever, over a slice of the bar.


def torque():
    x, y = particles.centroid[:, 0], particles.centroid[:, 1]
    stress, volume = particles.stress, particles.volume
    moment = np.sum((x * stress[:, 1, 2] - y * stress[:, 0, 2]) * volume)
    return comm.allreduce(moment) / LENGTH


curve = [(0.0, 0.0)]


def recorded():
    for step in problem.steps(24, update=path):
        curve.append((float(theta.value), torque()))
        yield step


mpm.plot.movie(
    problem, recorded(), "twist.gif", "mises", label="von Mises stress, Pa", every=2, dpi=70
)
mpm.plot.scene(problem, "mises", "twist.png", label="von Mises stress, Pa")

# ## Result

linear = YOUNG / (2.0 * (1.0 + POISSON)) * 0.1406 / LENGTH
if comm.rank == 0:
    print(problem.history)
    print("angle, degrees   torque, kNm   linear theory")
    for angle, moment in curve[4::4]:
        row = f"{np.degrees(angle):12.1f}{moment / 1e3:16.2f}"
        print(row + f"{linear * angle / 1e3:14.2f}")

J = particles.volume / particles.initial_volume
least = comm.allreduce(J.min(initial=1.0), MPI.MIN)
assert abs(curve[1][1] / (linear * curve[1][0]) - 1.0) < 0.2
assert least > 0.8

# ## Exercises
#
# 1. The first torque is off the linear theory: a bar of five cells is too stiff, and held ends
#    cannot warp. Refine the bar in its cross-section and make it longer.
# 2. Let the upper end move towards the lower one by 1 m while it turns.
# 3. Use `degree=2` for the particles and for `V`, with half as many cells.
