# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.11: Lifts on soft ground, stage by stage, and the factor of safety

# # An embankment in lifts on soft clay
#
# It illustrates how to:
# - start from ground at rest (`initial_stress=mpm.geostatic(...)`),
# - build lift by lift with `problem.add`, each with its own material,
# - read settlement and heave after each stage, and the factor of safety at the end.
#
# ## Problem
#
# Soft clay 8 m deep, with an undrained strength $c_u$ = 12 kPa, bears an embankment of fill that is
# built in lifts of 0.5 m, faster than the clay can drain. One half of it is modelled. A wide strip
# would sink in at a pressure of
#
# $$
# q = (2 + \pi)\, c_u = 62\ \mathrm{kPa}, \tag{1}
# $$
#
# which is the weight of 3.1 m of fill. Slopes, and a clay layer that is not deep, help.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
WIDTH, DEPTH, LIFT, LIFTS = 30.0, 8.0, 0.5, 6  # m, m, m, -
FOOT, SLOPE = 10.0, 2.0  # m: half width at the ground; horizontal over vertical
GRAVITY = (0.0, -10.0)  # m/s2
CLAY, FILL = 1600.0, 2000.0  # densities, kg/m3

h = LIFT
background = mesh.create_rectangle(
    comm,
    [[0, 0], [WIDTH, DEPTH + 4.0]],
    [round(WIDTH / h), round((DEPTH + 4.0) / h)],
    quadrilateral,
)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=WIDTH), mpm.held(V, y=0.0)]

ground = mpm.Particles(
    mesh.create_rectangle(
        comm, [[0, 0], [WIDTH, DEPTH]], [round(2 * WIDTH / h), round(2 * DEPTH / h)], quadrilateral
    ),
    V,
)
clay = mpm.materials.Tresca(5e6, 0.45, cohesion=12e3)
fill = mpm.materials.MohrCoulomb(2e7, 0.3, cohesion=5e3, friction_angle=33.0)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        ground,
        clay,
        density=CLAY,
        body_force=GRAVITY,
        initial_stress=mpm.geostatic(DEPTH, CLAY, 0.9, GRAVITY),
    ),
    bcs=bcs,
)
problem.solve()  # in equilibrium as it is


def lift(number):
    """A lift: a trapezium at its design level."""
    body = mesh.create_rectangle(comm, [[0, 0], [1, 1]], [40, 2], quadrilateral)
    x = body.geometry.x
    x[:, 1] = DEPTH + LIFT * (number + x[:, 1])
    x[:, 0] *= FOOT - SLOPE * (x[:, 1] - DEPTH)
    return mpm.Particles(body, V)


X = ground.W.tabulate_dof_coordinates()
surface = np.isclose(X[:, 1], DEPTH)


def profile():
    """Where the ground's surface is, from the middle on."""
    moved = ground.displacement.x.array.reshape(-1, 2)[surface]
    order = np.argsort(X[surface, 0])
    return X[surface, 0][order], moved[order, 1]


# A lift is placed undeformed on what has settled, and its weight comes over the stage.

profiles, rows = [], []
for number in range(LIFTS):
    heap = mpm.Body(lift(number), fill, density=FILL, body_force=GRAVITY)
    problem.add(heap, name=f"lift {number + 1}")
    problem.solve(2)
    x, way = profile()
    down = -comm.allreduce(way.min(initial=0.0), MPI.MIN)
    up = comm.allreduce(way.max(initial=0.0), MPI.MAX)
    rows.append((LIFT * (number + 1), down, up))
    profiles.append((x, way))

figure, axes = plt.subplot_mosaic(
    [["built", "surface"], ["slide", "surface"]],
    figsize=(12, 6.3),
    width_ratios=[1.35, 1],
    layout="constrained",
)


def draw(ax, values, title, label):
    """All bodies, coloured."""
    top = comm.allreduce(max(v.max(initial=0.0) for v in values), MPI.MAX)
    for body, value in zip(problem.particles, values, strict=True):
        drawn = mpm.plot.domains(body, value, ax=ax, cmap="YlOrBr", vmin=0, vmax=top, linewidth=0.1)
    ax.set(xlim=(0, 24), ylim=(0, 11.5), xlabel="x, m", ylabel="y, m", title=title)
    if comm.rank == 0:
        figure.colorbar(drawn, ax=ax, label=label, shrink=0.8)


strains = [100 * body.plastic_strain for body in problem.particles]
draw(axes["built"], strains, "built", "plastic strain, %")

# What is left of safety is found by dividing the strength of clay and fill.

found = mpm.strength_reduction(problem, tolerance=0.02)
strains = [
    100 * body.plastic_strain - strain
    for body, strain in zip(problem.particles, strains, strict=True)
]
draw(axes["slide"], strains, f"strength divided by {found.factor:.2f}", "plastic strain since, %")

# ## Result

if comm.rank == 0:
    print("height, m   settlement, cm   heave, cm")
    for height, down, up in rows:
        print(f"{height:9.1f}{100 * down:17.1f}{100 * up:12.1f}")
    print(f"factor of safety {found.factor:.2f}")
for (x, way), (height, _, _) in zip(profiles, rows, strict=True):
    axes["surface"].plot(x, 100 * way, color=plt.cm.viridis(height / 3.5), label=f"{height:.1f} m")
axes["surface"].set(xlabel="x, m", ylabel="way of the ground's surface, cm", xlim=(0, 24))
axes["surface"].legend(title="height built")
if comm.rank == 0:
    figure.savefig("embankment.png", dpi=150)

# Settlements grow faster than the height, as more and more of the clay yields; beside the foot it
# heaves.

assert rows[-1][1] - rows[-2][1] > 3 * rows[0][1] and 1.1 < found.factor < 1.4

# ## Exercises
#
# 1. Build on to 5 m, with `DEPTH + 8.0`. At which height does it begin to sink? What does (1) say?
# 2. Let the clay soften: `.with_softening(20.0, cohesion=8e3)`. What is left of the safety?
# 3. Place a berm, a lift of 1 m beside the foot, before the fourth lift.
