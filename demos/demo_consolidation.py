# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.9: Biot in finite strain: pore pressure, years of settlement

# # Soft clay under an embankment
#
# It illustrates how to:
# - solve for displacement and pore pressure together, `PorousProblem`, in finite strain,
# - drain a body at its own boundary, load it on a path through time, and take steps that grow.
#
# ## Problem
#
# An embankment with a half width of 4 m is raised on 5 m of soft clay in 60 days. The water carries
# the load at first, and the clay yields at constant volume, down under the embankment and up beside
# it. Over the years the water drains through the surface, and the clay settles. With the
# effective first Piola stress $P'$, the pore pressure $p$ and $J = \det F$, on the undeformed clay,
#
# $$
# \mathrm{Div}\,(P' - p\, J F^{-T}) = 0, \qquad
# \dot J = \mathrm{Div}\,(J k\, F^{-1} F^{-T} \nabla p). \tag{1}
# $$
#
# The permeability $k$ (over the specific weight of water) falls as pores close: $k = k_0 J^4$. In
# $H^2 / (k M) = 14$ years pressure spreads through the thickness $H$; $M$ is the confined modulus.

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
DEPTH, WIDTH, HALF, LOAD, DAYS = 5.0, 20.0, 4.0, 40.0, 60.0  # m, kPa, days
YOUNG, POISSON, PERMEABILITY = 400.0, 0.3, 9e-6  # kPa, -, m2/(kPa d)

# A row of cells above the ground leaves room for the heave. Displacements are of degree 2, the
# pressure of degree 1: in (1) the clay is incompressible at first.

background = mesh.create_rectangle(comm, [[0, 0], [WIDTH, 6]], [20, 6], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 2, (2,)))
bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=WIDTH), mpm.held(V, y=0.0)]


def ground():
    """The clay, and tags of its surface: 1 where it is loaded, and 2."""
    body = mesh.create_rectangle(comm, [[0, 0], [WIDTH, DEPTH]], [40, 10], quadrilateral)
    loaded, free = (mpm.region(x=ends, y=DEPTH) for ends in ((0, HALF), (HALF, WIDTH)))
    return mpm.Particles(body, V, degree=2), mpm.facet_tags(body, {1: loaded, 2: free})


particles, tags = ground()
clay = mpm.materials.Hencky(YOUNG, POISSON)
q = fem.Constant(particles.mesh, (0.0, 0.0))
water = mpm.PoreFluid(lambda J: PERMEABILITY * J**4, drained=[(0.0, 1), (0.0, 2)])
wet = mpm.Body(particles, clay, tractions=[(q, 1)], facet_tags=tags, pore_fluid=water)
problem = mpm.PorousProblem(wet, bcs)
pressure = problem.pore_pressure[0]


def construction(t):
    q.value = (0.0, -LOAD * min(t / DAYS, 1.0))


def largest(values):
    return comm.allreduce(float(values.max(initial=0.0)), MPI.MAX)


# Steps grow longer and longer. On the way the mean pressure of each domain is drawn.

fig, axes = plt.subplots(3, 1, figsize=(7, 8), layout="constrained")
rows = []
for end, dt in ((60, 10), (180, 30), (1000, 100), (5000, 500), (30000, 2500)):
    for step in problem.steps(time=end, dt=dt, update=construction):
        down = particles.initial_centroid[:, 1] - particles.centroid[:, 1]
        rows.append((step.time, largest(down), largest(-down), largest(pressure.x.array)))
    if end in (60, 1000):
        means = pressure.x.array[pressure.W.dofmap.list[: particles.num_local]].mean(axis=1)
        ax = axes[end // 1000]
        drawn = mpm.plot.domains(particles, means, ax, cmap="Blues", vmin=0.0, vmax=LOAD)
        if comm.rank == 0:
            ax.fill([0, 0, HALF - 1, HALF], [4.5, 5.9, 5.9, 4.9], color="0.7", zorder=0)
            ax.set(xlim=(0, 14), ylim=(0, 6.2), ylabel="m", title=f"after {end} days")
            fig.colorbar(drawn, ax=ax, label="excess pressure, kPa")
time, settled, heaved, most = np.array(rows).T

# Without water the clay settles at once by as much as it does with water in the end.

dry, dry_tags = ground()
loaded = mpm.Body(dry, clay, tractions=[((0.0, -LOAD), 1)], facet_tags=dry_tags)
mpm.QuasiStaticProblem(loaded, bcs).solve(steps=4)
drained = largest(dry.initial_centroid[:, 1] - dry.centroid[:, 1])

if comm.rank == 0:
    print("  day  settlement, m  heave, m  largest pressure, kPa")
    for i in np.flatnonzero(np.isin(time, (60, 180, 1000, 5000, 30000))):
        print(f"{time[i]:5.0f}{settled[i]:15.3f}{heaved[i]:10.3f}{most[i]:15.1f}")
    print(f"without water: {drained:.3f} m")
    axes[2].semilogx(time, settled, time, heaved, time, drained + 0.0 * time, "--")
    axes[2].legend(["settlement", "heave beside it", "settlement without water"])
    axes[2].set(xlabel="days", ylabel="m")
    fig.savefig("consolidation.png", dpi=150)

assert abs(settled[-1] / drained - 1.0) < 5e-3 and most[-1] < 0.01 * LOAD

# ## Exercises
#
# 1. How long does half of the settlement take? (In a wide layer it is $0.197\, H^2 / (k M)$.)
# 2. Let the base drain as well: tag its facets, and add `(0.0, tag)` to `drained=`.
