# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.1: Rubber under its weight: finite elements end at 55 % of the load, or go on

# # Where the body's own mesh fails, and particles go on
#
# It illustrates how to:
# - turn a finite element script into a material point method: what changes, and what does not,
# - run both on one mesh with one energy, and see where finite elements end,
# - let finite elements go on as particles by themselves where their mesh fails,
# - read why: nodes leave the ground and cells are crushed.
#
# ## Problem
#
# A column of soft rubber, 4 m wide and 4 m high (half of it is computed), sags under its own
# weight $g_0$ = 10 kN/m³ on a rough base. The stored energy is neo-Hookean, and infinite for a
# crushed cell,
#
# $$
# \Pi(d) = \int \frac{\mu}{2} (F : F - 2) - \mu \ln J + \frac{\kappa}{2} (\ln J)^2\, \mathrm{d}X
#   + \lambda \int g_0\, d_y\, \mathrm{d}X, \qquad F = I + \nabla d, \quad J = \det F. \tag{1}
# $$
#
# Finite elements look for $d$ in the space $W$ of the body's mesh. The material point method lets a
# step's increment be one of the background, $u$ in $V$, which $T_n$ takes to the body's nodes:
#
# $$
# \Pi'(d;\, w) = 0 \;\; \forall w \in W, \qquad \text{or} \qquad
# d = d_n + T_n u, \quad \Pi'(d;\, T_n v) = 0 \;\; \forall v \in V. \tag{2}
# $$
#
# The side of the column bulges and rolls onto the base. Finite elements know nothing of the
# base but for the nodes that are glued to it at first, so they go through it, and the cells at the
# corner are crushed. To the background the base is where its cells end: what comes down to it
# stays there, and increments as smooth as the background crush nothing smaller than its cells.

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

import ufl
from dolfinx import fem, mesh
from dolfinx.fem.petsc import NonlinearProblem

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
young, poisson, weight, STEPS = 1.5e4, 0.3, 1e4, 40  # Pa, -, N/m3
mu, kappa = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
body = mesh.create_rectangle(comm, [[0, 0], [2, 4]], [16, 32], mesh.CellType.triangle)


def energy(d, dx, load):
    """The energy (1), for both."""
    F = ufl.Identity(2) + ufl.grad(d)
    J = ufl.det(F)
    stored = mu / 2 * (ufl.inner(F, F) - 2) - mu * ufl.ln(J) + kappa / 2 * ufl.ln(J) ** 2
    return (stored + load * weight * d[1]) * dx


def held(space):
    """A roller on the left, a base that holds, in either space."""
    return [mpm.held(space, 0, x=0.0), mpm.held(space, y=0.0)]


# ## Finite elements
#
# The load grows in 40 steps; one that does not converge is halved, up to ten times.

W = fem.functionspace(body, ("Lagrange", 1, (2,)))
d, load = fem.Function(W), fem.Constant(body, 0.0)
residual = ufl.derivative(energy(d, ufl.dx, load), d, ufl.TestFunction(W))
options = {"snes_linesearch_type": "bt", "snes_rtol": 1e-8, "pc_type": "lu", "ksp_type": "preonly"}
finite_elements = NonlinearProblem(
    residual, d, bcs=held(W), petsc_options_prefix="fe_", petsc_options=options
)
reached, size = 0.0, 1.0 / STEPS
while reached < 1.0 and size * STEPS > 2**-10:
    before = d.x.array.copy()
    load.value = min(reached + size, 1.0)
    finite_elements.solve()
    if finite_elements.solver.getConvergedReason() > 0:
        reached, size = float(load.value), min(2.0 * size, 1.0 / STEPS)
    else:
        d.x.array[:] = before
        size /= 2.0
corners = W.tabulate_dof_coordinates()[:, :2] + d.x.array.reshape(-1, 2)
lowest = comm.allreduce(corners[:, 1].min(), MPI.MIN)

# ## Particles
#
# A background, and three words: the unknown, its test function and the load are the particles'.

background = mesh.create_rectangle(comm, [[0, 0], [9, 5]], [36, 20], mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))


def ran(particles):
    """Run; return how far particles came, and their lowest node."""
    whole = energy(particles.displacement, particles.dx, particles.load)
    problem = mpm.ParticleProblem(
        ufl.derivative(whole, particles.displacement, ufl.TestFunction(particles.W)),
        particles,
        bcs=held(V),
    )
    problem.solve(STEPS)
    return problem.history.load[-1], comm.allreduce(particles.domains[:, :, 1].min(), MPI.MIN)


particles = mpm.Particles(body, V)
end, ground = ran(particles)

# ## Both, node by node
#
# With `free="auto"` all nodes have unknowns of their own at first, as those of finite elements. The
# background takes over those of cells that are about to be crushed, and those at the base.

both = mpm.Particles(body, V, free="auto")
both_end, both_ground = ran(both)
own = slice(0, both.W.dofmap.index_map.size_local)
free = comm.allreduce(int(both.free[own].sum())) / both.W.dofmap.index_map.size_global

# ## Result

if comm.rank == 0:
    print(f"finite elements: load {reached:.3f}, lowest node {lowest:6.3f} m")
    print(f"particles:       load {end:.3f}, lowest node {ground:6.3f} m")
    print(f"both:            load {both_end:.3f}, lowest {both_ground:6.3f} m;", f"{free:.0%} free")

# The last state of each; that of the finite elements is lent to particles for the picture.

lent = mpm.Particles(body, V)
lent.displacement.interpolate(d)
fig, axes = None, [None] * 3
if comm.rank == 0:
    fig, axes = plt.subplots(1, 3, figsize=(16, 4.4), layout="compressed")
mpm.plot.scene(lent, "volume_ratio", ax=axes[0], title=f"finite elements end at {reached:.0%}")
mpm.plot.scene(particles, "volume_ratio", ax=axes[1], title=f"particles at {end:.0%} of the load")
mpm.plot.scene(both, "volume_ratio", ax=axes[2], title=f"both, {free:.0%} of the nodes free")
x = comm.gather(both.node_positions[own][~both.free[own], :2])
if comm.rank == 0:
    axes[2].plot(*np.concatenate(x).T, "o", ms=4, mfc="none", color="#d62728", label="carried")
    axes[2].legend(loc="upper right")
    fig.savefig("mesh_fails.png", dpi=130, bbox_inches="tight")

assert reached < 0.7 and lowest < -0.05
assert end == both_end == 1.0 and min(ground, both_ground) > -1e-9
assert free > 0.5

# ## Exercises
#
# 1. With `young = 5e4` both get to the end. How far apart are they? Refine both meshes.
# 2. Give the finite elements a background of their own: does `method="mpm"` or `"gimp"` (with
#    quadrilaterals) end earlier than CPDI2?
# 3. Put the background of the particles half a cell lower. What holds the base then?
