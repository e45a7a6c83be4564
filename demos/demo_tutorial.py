# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1.1: Von Mises clay under its own weight, twenty lines

# # A first run: a block of clay slumps
#
# It illustrates how to:
# - create a background and a body, and apply boundary conditions,
# - assign a material and self-weight, and solve,
# - look at the result.
#
# A block of clay, 4 m wide and 4 m high, is too weak to stand: it spreads under its own weight
# until it is low enough. Half of it is modelled; its left side is the plane of symmetry.

from mpi4py import MPI

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

# The **background** is where the unknowns live. It never moves, and is large enough for the body to
# flow into. The **body** is another mesh: each of its cells is the domain of a particle, which goes
# where the background carries it. Here four quadrilaterals lie in each cell of the background.

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, [[0, 0], [9, 5]], [36, 20], quadrilateral)
body = mesh.create_rectangle(comm, [[0, 0], [2, 4]], [16, 32], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
particles = mpm.Particles(body, V)

# Conditions are on the background: no horizontal displacement on the plane of symmetry, no vertical
# one on the smooth base.

roller = mpm.held(V, 0, x=0.0)
floor = mpm.held(V, 1, y=0.0)

# The clay yields at a von Mises stress of 20 kPa. Its weight is applied in 20 equal steps.

clay = mpm.materials.VonMises(young=1e6, poisson=0.3, yield_stress=20e3)
problem = mpm.QuasiStaticProblem(
    mpm.Body(particles, clay, density=1800.0, body_force=(0.0, -9.81)), bcs=[roller, floor]
)
problem.solve(steps=20)

# What happened? Loads, supports and seconds are in the summary; the reaction of the base is the
# weight of the body.

summary, (_, carried) = problem.summary(), problem.reaction(floor)
top = comm.allreduce(particles.domains[:, :, 1].max(initial=0.0), MPI.MAX)
if comm.rank == 0:
    print(problem.history)
    print(f"height {top:.2f} m of 4 m; the base carries {carried / 1e3:.2f} kN/m")
mpm.plot.scene(problem, "plastic_strain", "tutorial.png")

assert abs(carried / (1800.0 * 9.81 * 8.0) - 1.0) < 1e-8

# ## Exercises
#
# 1. Print `problem.summary()`. Which part of the run takes longest?
# 2. Make the clay stronger, until it stands. A vertical cut of height $H$ stands up to about
#    $\rho g H / c = 3.8$, $c$ being the yield stress over $\sqrt 3$.
# 3. Make a movie: `mpm.plot.movie(problem, problem.steps(20), "slump.gif", "plastic_strain")`.
