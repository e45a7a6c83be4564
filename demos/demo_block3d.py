# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.6: Von Mises in space, hexahedra, rough plates

# # A block squeezed between plates
#
# It illustrates how to:
# - solve in three dimensions, with hexahedra as particle domains,
# - choose a frame in which the conditions on the background stay what they are,
# - drive a body by a plane that moves: a pressure that depends on the displacement.
#
# ## Problem
#
# A cube of 2 m lies between two stiff rough plates, which come together until its height is 60 % of
# what it was, and it bulges to a barrel. The material is von Mises', perfectly plastic, with the
# yield stress $\sigma_y$ = 100 kPa. Between smooth plates it would stay a block; at the relative
# height $\eta$ the force on a plate would then be
#
# $$
# N = \sigma_y \frac{A_0}{\eta}. \tag{1}
# $$
#
# Three planes of symmetry leave an eighth of the cube. Conditions are on nodes of the background,
# and those near a plate that moves are other ones in each step. So the plate stays, at $z = 0$, and
# the plane of symmetry half-way between the plates comes down to it. That is a condition on the
# body, whose top is where it was made and rides along; a pressure does it,
#
# $$
# p = k\, (z - h(t)), \qquad z = X_3 + d_3, \qquad h(t) = 1 - 0.4\, t, \tag{2}
# $$
#
# a bed of very stiff springs. It depends on $d$, and so does the normal it acts along; both are in
# the tangent. Material that rolls from the side onto the plate meets the nodes at $z = 0$, and
# stays there.

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, hexahedron = MPI.COMM_WORLD, mesh.CellType.hexahedron
young, poisson, yield_stress = 10e6, 0.3, 100e3  # Pa, -, Pa
squeeze, stiffness, TOP = 0.4, 1e10, 1  # m, Pa/m, tag

# A cell of the background holds two hexahedra each way. They have eight quadrature points: with one
# they would have modes of motion without any strain there, which grow in a flow as free as this.

background = mesh.create_box(comm, [[0, 0, 0], [2, 2, 1.25]], [8, 8, 5], hexahedron)
V = fem.functionspace(background, ("Lagrange", 1, (3,)))
body = mesh.create_box(comm, [[0, 0, 0], [1, 1, 1]], [8, 8, 8], hexahedron)
particles = mpm.Particles(body, V, quadrature_degree=2)

plate = mpm.held(V, 2, z=0.0)
rough = [mpm.held(V, 0, z=0.0), mpm.held(V, 1, z=0.0)]
symmetry = [mpm.held(V, 0, x=0.0), mpm.held(V, 1, y=0.0)]
plane = fem.Constant(body, 1.0)
above = ufl.SpatialCoordinate(body)[2] + particles.displacement[2] - plane
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.VonMises(young, poisson, yield_stress=yield_stress),
        pressures=[(stiffness * above, TOP)],
        facet_tags=mpm.facet_tags(body, {TOP: mpm.region(z=1.0)}),
        f_bar="patch",
    ),
    bcs=[plate, *rough, *symmetry],
)

# Loads are multiplied by `particles.load`; a path sets it to one if the load's size is its own
# affair.


def update(t):
    plane.value = 1.0 - squeeze * t
    particles.load.value = 1.0


curve = [(0.0, 0.0)]
for step in problem.steps(40, update=update):
    curve.append((squeeze * step.load, 4.0 * problem.reaction(plate)[2]))

# ## Result
#
# The force is above that of smooth plates, as friction holds the ends together. The picture shows
# the eighth from the middle of the block: what is dark below sticks to the plate.

way, force = np.array(curve).T
volume = [comm.allreduce(v.sum()) for v in (particles.volume, particles.initial_volume)]
if comm.rank == 0:
    print("approach, m   force, kN   between smooth plates (1)")
    for i in (10, 20, 30, 40):
        smooth = 4 * yield_stress / (1 - way[i])
        print(f"{way[i]:11.2f}{force[i] / 1e3:12.1f}{smooth / 1e3:16.1f}")
view = {"camera": (-1.0, -1.5, 0.6), "background": False}
mpm.plot.scene(problem, "plastic_strain", "block3d.png", **view)

assert abs(volume[0] / volume[1] - 1.0) < 0.02
assert force[-1] > 4.0 * yield_stress / (1.0 - squeeze)

# ## Exercises
#
# 1. Elements of low order cannot flow at constant volume as freely as the material (locking): leave
#    `f_bar="patch"` out. How much larger is the force?
# 2. Make the plate smooth: leave out `rough`. Is (1) met?
# 3. Use tetrahedra for the body.
