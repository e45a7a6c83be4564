# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.9

# # Soft clay under an embankment
#
# It illustrates how to:
# - solve for displacement and pore pressure together, `PorousProblem`, in finite strain,
# - drain a body at its own boundary, and load it on a path through time,
# - go through long times in steps that grow.
#
# ## Problem
#
# An embankment of half a width of 4 m is raised on 5 m of soft clay in 60 days. The clay cannot
# lose its water as fast: at first the water carries the load, and the clay gives way without a
# change of volume, down under the embankment and up beside it. Over the years the water leaves
# through the surface, the base being impervious, and the clay settles.
#
# With the deformation gradient $F$, $J = \det F$, the effective first Piola stress $P'$ and the
# pore pressure $p$, clay and water obey, on the undeformed clay,
#
# $$
# \mathrm{Div}\,(P' - p\, J F^{-T}) = 0, \qquad
# \dot J = \mathrm{Div}\,(J k\, F^{-1} F^{-T} \nabla p), \tag{1}
# $$
#
# the first being equilibrium and the second the balance of water, with the permeability $k$ (over
# the specific weight of water). One time rules: that in which pressure spreads through the
# thickness $H$,
#
# $$
# \frac{H^2}{c_v}, \qquad c_v = k M, \qquad M = \frac{E (1 - \nu)}{(1 + \nu)(1 - 2 \nu)}, \tag{2}
# $$
#
# here 14 years. As pores close, $k$ falls; it is taken for $k_0 J^4$.

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
DEPTH, WIDTH, HALF = 5.0, 20.0, 4.0  # m
LOAD, DAYS = 40.0, 60.0  # kPa, time of construction
YOUNG, POISSON, PERMEABILITY = 400.0, 0.3, 9e-6  # kPa, -, m2/(kPa d)
LOADED, FREE = 1, 2

# The background has a row of cells above the ground, as room for the heave. Displacements are of
# degree 2, the pressure is of degree 1: in (1) the clay is incompressible at first.

background = mesh.create_rectangle(comm, [[0, 0], [WIDTH, 6]], [20, 6], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 2, (2,)))


def held(component, where):
    facets = mesh.locate_entities_boundary(background, 1, where)
    dofs = fem.locate_dofs_topological(V.sub(component), 1, facets)
    return fem.dirichletbc(0.0, dofs, V.sub(component))


base = held(1, lambda x: np.isclose(x[1], 0))
held_all = [
    held(0, lambda x: np.isclose(x[0], 0) | np.isclose(x[0], WIDTH)),
    held(0, lambda x: np.isclose(x[1], 0)),
    base,
]


def ground():
    """The clay, its loaded and its free surface."""
    body = mesh.create_rectangle(comm, [[0, 0], [WIDTH, DEPTH]], [40, 10], quadrilateral)
    top = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[1], DEPTH))
    top = np.sort(top)
    loaded = mesh.compute_midpoints(body, 1, top)[:, 0] < HALF
    tags = mesh.meshtags(body, 1, top, np.where(loaded, LOADED, FREE).astype(np.int32))
    return mpm.Particles(body, V, degree=2), tags


particles, tags = ground()
clay = mpm.materials.Hencky(YOUNG, POISSON)
q = fem.Constant(particles.mesh, (0.0, 0.0))
problem = mpm.PorousProblem(
    particles,
    clay,
    lambda J: PERMEABILITY * J**4,
    bcs=held_all,
    tractions=[(q, LOADED)],
    drained=[(0.0, LOADED), (0.0, FREE)],
    facet_tags=tags,
)
pressure = problem.pore_pressure[0]


def construction(t):
    q.value = (0.0, -LOAD * min(t / DAYS, 1.0))


def largest(values):
    return comm.allreduce(float(values.max(initial=0.0)), MPI.MAX)


def way_down(body):
    """How far each particle has gone down."""
    return body.initial_centroid[:, 1] - body.centroid[:, 1]


# Time goes from the beginning of construction to 80 years, in longer and longer steps. On the way
# the excess pressure is drawn, at its mean in each domain.

fig, (early, late, course) = plt.subplots(3, 1, figsize=(7, 8), layout="constrained")
rows = [(0.0, 0.0, 0.0, 0.0)]
for end, dt in ((60, 10), (180, 30), (1000, 100), (5000, 500), (30000, 2500)):
    for step in problem.steps(end, dt, construction):
        down = way_down(particles)
        rows.append((step.time, largest(down), largest(-down), largest(pressure.x.array)))
    if end in (60, 1000):
        means = pressure.x.array[pressure.W.dofmap.list[: particles.num_local]].mean(axis=1)
        ax = early if end == 60 else late
        drawn = mpm.plot.domains(particles, means, ax, cmap="Blues", vmin=0.0, vmax=LOAD)
        if comm.rank == 0:
            ax.fill([0, 0, HALF - 1, HALF], [4.5, 5.9, 5.9, 4.9], color="0.7", zorder=0)
            ax.set(xlim=(0, 14), ylim=(0, 6.2), ylabel="m", title=f"after {end} days")
            fig.colorbar(drawn, ax=ax, label="excess pressure, kPa")
time, settled, heaved, most = np.array(rows).T

# Without water the clay settles at once by what it does in the end with it. That is another
# problem, and tells whether (1) has come to rest.

dry, dry_tags = ground()
mpm.QuasiStaticProblem(
    dry, clay, bcs=held_all, tractions=[((0.0, -LOAD), LOADED)], facet_tags=dry_tags
).solve(steps=4)
drained = largest(way_down(dry))

if comm.rank == 0:
    print("  day  settlement, m  heave, m  largest pressure, kPa")
    for day in (60, 180, 1000, 5000, 30000):
        i = np.flatnonzero(np.isclose(time, day))[0]
        print(f"{day:5d}{settled[i]:15.3f}{heaved[i]:10.3f}{most[i]:15.1f}")
    print(f"without water: {drained:.3f} m")
    course.semilogx(time[1:], settled[1:], label="settlement")
    course.semilogx(time[1:], heaved[1:], label="heave beside it")
    course.axhline(drained, color="0.5", ls="--", label="settlement without water")
    course.set(xlabel="days", ylabel="m")
    course.legend()
    fig.savefig("consolidation.png", dpi=150)

# The pressure is highest at the end of construction, when the clay has gone down by two fifths of
# what it will; what had heaved has mostly sunk again in the end.

assert most.argmax() == np.flatnonzero(time == DAYS)[0] and most[-1] < 0.01 * LOAD
assert abs(settled[-1] / drained - 1.0) < 5e-3

# ## Exercises
#
# 1. How long does half of the settlement after construction take, and what does that say about (2)?
#    (In a layer of infinite width it is $0.197\, H^2 / c_v$.)
# 2. Build in ten days, and in two years. Where does it matter?
# 3. Take `mpm.materials.VonMises(YOUNG, POISSON, yield_stress=20.0)` for clay. Does the clay bear
#    the embankment when it is built in ten days? In ten years?
# 4. Let the base drain as well: tag its facets, and add `(0.0, tag)` to `drained=`.
