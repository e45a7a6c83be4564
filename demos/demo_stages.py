# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1.5: Layers; weight, a strip load on the crest, unloading

# # A layered slope, loaded in stages
#
# It illustrates how to:
# - assign materials and densities to layers by cell tags,
# - go from stage to stage: weight, a load on the crest, and its removal,
# - prescribe a load path, `update=`, while the weight stays.
#
# ## Problem
#
# A bank of soil, 4 m high, has a soft layer of 1 m at its foot. First its weight is applied (stage
# 1), then a strip load $q$ of 2 m grows on the crest to 100 kPa (stage 2), and is taken away again
# (stage 3). In each stage the work of the stresses balances that of weight and load,
#
# $$
# \int P : \nabla v\, \mathrm{d}X = \lambda \int \rho\, b \cdot v\, \mathrm{d}X
#   + \lambda \int_{\Gamma_q} q(t) \cdot v\, \mathrm{d}S, \tag{1}
# $$
#
# where the load factor $\lambda$ goes from 0 to 1 in the first stage and stays there. What a stage
# has applied remains, unless the next one changes it.

from mpi4py import MPI

import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
WIDTH, HEIGHT, STRIP = 10.0, 4.0, 2.0  # m
LOAD, GRAVITY = 100e3, 9.81  # Pa, m/s2
SOFT, STIFF, CREST = 1, 2, 3

# The body is a rectangle whose vertices are moved so that its right side becomes the slope.

background = mesh.create_rectangle(comm, [[0, 0], [13, 5]], [52, 20], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
body = mesh.create_rectangle(comm, [[0, 0], [WIDTH, HEIGHT]], [80, 32], quadrilateral)
body.geometry.x[:, 0] -= 0.15 * body.geometry.x[:, 0] * body.geometry.x[:, 1]

layers = mpm.cell_tags(body, {SOFT: mpm.region(y=(0, 1)), STIFF: mpm.region(y=(1, HEIGHT))})
strip = mpm.facet_tags(body, {CREST: mpm.region(x=(1, 1 + STRIP), y=HEIGHT)})

density = fem.Function(fem.functionspace(body, ("Discontinuous Lagrange", 0)))
density.interpolate(lambda x: np.where(x[1] < 1.0, 1700.0, 2000.0))
side = mpm.held(V, 0, x=0.0)
base_x, base_y = (mpm.held(V, i, y=0.0) for i in (0, 1))

# The load $q$ in (1) is a Constant on the body, which a path sets.

q = fem.Constant(body, (0.0, 0.0))
particles = mpm.Particles(body, V)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        {
            SOFT: mpm.materials.VonMises(1e7, 0.4, yield_stress=30e3),
            STIFF: mpm.materials.VonMises(3e7, 0.3, yield_stress=70e3),
        },
        density=density,
        body_force=(0.0, -GRAVITY),
        tractions=[(q, CREST)],
        cell_tags=layers,
        facet_tags=strip,
    ),
    bcs=[side, base_x, base_y],
)


def settlement():
    """The largest way down of a particle."""
    way = particles.initial_centroid[:, 1] - particles.centroid[:, 1]
    return comm.allreduce(way.max(initial=0.0), MPI.MAX)


def load(t):
    q.value = (0.0, -LOAD * t)


rows = []
for name, path in (("weight", None), ("load", load), ("unload", lambda t: load(1.0 - t))):
    problem.solve(steps=5, update=path)
    rows.append((name, settlement(), problem.reaction(base_y)[1]))

# After the last stage the base carries as much as after the first; the settlement is larger,
# because the soft layer has yielded.

if comm.rank == 0:
    print("stage    settlement, m    base, kN/m")
    for name, way, force in rows:
        print(f"{name:8s}{way:14.4f}{force / 1e3:14.3f}")
mpm.plot.scene(problem, "plastic_strain", "stages.png")

assert abs(rows[2][2] / rows[0][2] - 1.0) < 1e-8 and rows[2][1] > rows[0][1]

# ## Exercises
#
# 1. The width of the loaded facets is the difference of the reactions over 100 kPa. Is it still
#    `STRIP` where the strip begins at 1.02 m, within a facet?
# 2. How large may the load be? Let it grow to 300 kPa and see where the settlement runs away.
# 3. Dig: take the strip's load away first, then let the density of the upper layer go to half of
#    its value on a path. (`density` is a Function; what is `problem.reaction(base_y)` then?)
