# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1.7: Von Mises under its weight, beside AMPLE's result

# # Collapse of an elasto-plastic block
#
# It illustrates how to:
# - follow the collapse of a slope of 45 degrees and more from a body that is a square,
# - read the displacement of single nodes of the body, step by step,
# - know why more particles per cell make low-order domains stiffer, and the cure.
#
# The example is that of AMPLE (Coombs & Augarde 2020, Adv. Eng. Softw. 139), run there with GIMP.
#
# ## Problem
#
# The right half of a block 16 m wide and 8 m high stands on a smooth base, with a roller at the
# plane of symmetry. Its weight $\rho_0\, g$ = 10 kN/m3 is applied in 40 steps. The material is von
# Mises', perfectly plastic, on Hencky elasticity,
#
# $$
# f = \frac{\sqrt{2 J_2}}{\rho_y} - 1 \le 0, \qquad E = 1\ \mathrm{MPa}, \quad \nu = 0.3, \quad
# \rho_y = 20\ \mathrm{kPa}. \tag{1}
# $$
#
# A free vertical cut of height $H$ fails where $\rho_0 g H / c$ exceeds about 3.8, with
# $c = \rho_y/\sqrt2$; here it is 5.7. So the block collapses, and comes to rest by spreading.
#
# ## Locking
#
# Plastic flow keeps the volume: each quadrature point asks for $\det F \approx 1$. A background
# cell has two unknowns for that. With 2 by 2 particles it has four conditions, with 6 by 6
# thirty-six: the body *locks*. With `f_bar="patch"` the material sees
#
# $$
# \bar F = (\bar J / J)^{1/2} F, \tag{2}
# $$
#
# $\bar J$ being the mean of $J$ over a patch as large as a background cell: one condition.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
size = 8.0  # m
young, poisson, rho_y = 1e6, 0.3, 20e3  # Pa, -, Pa
density, gravity = 1000.0, 10.0  # kg/m3, m/s2

# The background leaves the toe room to move by 8 m. Three by three domains lie in a cell.

quadrilateral = mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, [[0.0, 0.0], [16.0, 9.0]], [16, 9], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
body = mesh.create_rectangle(comm, [[0.0, 0.0], [size, size]], [24, 24], quadrilateral)

bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 1, y=0.0)]

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

X = particles.W.tabulate_dof_coordinates()[:, :2]


def displacement(corner, component):
    at = np.isclose(X, corner).all(axis=1)
    found = particles.displacement.x.array.reshape(-1, 2)[at, component]
    return comm.allreduce(np.max(found, initial=-np.inf), MPI.MAX)


path = [(0.0, 0.0, 0.0)]
for step in problem.steps(40):
    path.append((step.load, displacement((0.0, size), 1), displacement((size, 0.0), 0)))

_, u_top, u_toe = path[-1]
history = problem.history
if comm.rank == 0:
    print(f"{particles.num_global} particles, {history}")
    print(f"top of the plane of symmetry {u_top:.3f} m, toe {u_toe:.3f} m")

# The crosses are AMPLE's particles next to the corner, half a domain away from the node.

fig, axes = None, {"body": None}
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic(
        [["body", "path"]], figsize=(13, 4.2), width_ratios=[2.0, 1.0], layout="compressed"
    )
mpm.plot.scene(problem, "plastic_strain", ax=axes["body"])
if comm.rank == 0:
    load, top, toe = np.array(path).T
    axes["path"].plot(100 * load, toe, label="toe, sideways")
    axes["path"].plot(100 * load, -top, label="top, down")
    ample = [(25, 0.0756), (50, 0.231), (62.5, 1.055), (75, 1.802), (87.5, 2.329), (100, 2.656)]
    axes["path"].plot(*np.array(ample).T, "x", color="0.2", label="top, AMPLE")
    axes["path"].set(xlabel="weight, %", ylabel="displacement, m")
    axes["path"].legend()
    fig.savefig("collapse.png", dpi=130)

assert abs(u_top / -2.70 - 1.0) < 0.01 and abs(u_toe / 5.79 - 1.0) < 0.01

# ## Exercises
#
# Give each cell 6 by 6 particles, and then use `f_bar="patch"`. How far does the toe come?
