# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.14: Softening in motion: a slope of sensitive clay fails ever further back

# # A slope of sensitive clay fails backwards
#
# It illustrates how to:
# - let a body soften with a length in large motion, `mpm.Body(..., length=...)`,
# - begin a motion from an equilibrium, `after=`, with strength that is lost then,
# - follow where the ground fails, and where it comes to rest.
#
# ## Problem
#
# Clay that was leached by rain has a strength of its own until it is stirred. A first slide leaves
# a steep scarp, which fails in turn: in Sainte-Monique, Quebec, until 100 m of ground were lost.
#
# Here the slope is 5 m high, of 45 degrees, on a rough base. The undrained strength
#
# $$
# c = c_r + (c_0 - c_r)\, e^{-\beta \kappa}, \quad c_0 = 3\, c_r = 15\ \mathrm{kPa}, \tag{1}
# $$
#
# falls with the plastic strain $\kappa$, by its average over a length $l$: by two thirds in a
# slip of $2\sqrt3\,(3/4\,\pi + 1)\, l / \beta$ = 0.25 m. By Taylor's chart the slope needs
# $c = 0.16\, \gamma H$ = 17 kPa. It has stood, being much stronger, and is let go with $c_0$.
#
# ## Implementation
#
# Triangles cannot fold; patches of them keep their volume. Backward Euler takes the energy of what
# collides. A viscosity of $E \beta_R$ = 50 Pa s is nothing beside $\rho H \sqrt{g H}$ = 75 kPa s.

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
height, crest, cells = 5.0, 18.0, 8  # m, m; background cells in the height
young, density, gravity = 5e6, 2150.0, 9.81  # Pa, kg/m3, m/s2
peak, residual, decay, length = 15e3, 5e3, 30.0, 0.65  # Pa, Pa, -, m
end, dt = 7.0, 0.1  # s
toe, h = crest + height, height / cells
quadrilateral, both = mesh.CellType.quadrilateral, mesh.DiagonalType.left_right
grid = [[0.0, 0.0], [7 * height, height + 2 * h]]
background = mesh.create_rectangle(comm, grid, [7 * cells, cells + 2], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
counts, corners = [round(2 * toe / h), 2 * cells], [[0.0, 0.0], [toe, height]]
body = mesh.create_rectangle(comm, corners, counts, diagonal=both)
x = body.geometry.x
x[:, 0] *= 1.0 - x[:, 1] / toe
particles = mpm.Particles(body, V)

strength = fem.Constant(body, 10.0 * np.sqrt(3.0) * peak)
clay = mpm.materials.VonMises(young, 0.49, yield_stress=strength)
clay = clay.with_softening(decay, residual=residual / peak)
weight = {"density": density, "body_force": (0.0, -gravity)}
slope = mpm.Body(particles, clay, **weight, f_bar="patch", length=length)
bcs = [mpm.held(V, y=0.0), mpm.held(V, 0, x=0.0)]
standing = mpm.QuasiStaticProblem(slope, bcs)
standing.solve(steps=2)
standing.step()

strength.value = np.sqrt(3.0) * peak
damping = (0.0, 50.0 / young)
problem = mpm.DynamicProblem(slope, bcs, scheme="euler", rayleigh=damping, after=standing)

X = particles.W.tabulate_dof_coordinates()[:, :2]
top = np.isclose(X[:, 1], height)


def reach():
    """How far the front is from the toe, and what has moved from the crest."""
    d = particles.displacement.x.array.reshape(-1, 2)
    gone = top & (np.hypot(*d.T) > 0.1 * height)
    front = comm.allreduce((X + d)[:, 0].max(initial=toe), MPI.MAX)
    scarp = comm.allreduce(X[gone, 0].min(initial=crest), MPI.MIN)
    return front - toe, crest - scarp


figure, axes = plt.subplots(4, 1, figsize=(11, 10), layout="constrained")
views, curve = iter(axes), [(0.0, 0.0, 0.0)]
for step in problem.steps(time=end, dt=dt, output_at=[1.0, 3.0, end]):
    curve.append((step.time, *reach()))
    if step.output:
        ax, strain = next(views), particles.plastic_strain
        colours = mpm.plot.domains(particles, strain, ax=ax, cmap="YlOrBr", vmax=1.5, linewidth=0.2)
        ax.plot([0.0, crest, toe], [height, height, 0.0], "k--", lw=0.8)
        ax.set(xlim=(0.0, 32.0), ylim=(0.0, 5.3), ylabel="y, m")
        ax.set_title(f"{step.time:.1f} s", loc="left")

# ## Result

times, run_out, back = np.array(curve).T
kinetic = [energy.kinetic for energy in problem.history.energies]
if comm.rank == 0:
    print(f"run-out       {run_out[-1]:5.2f} m")
    print(f"retrogression {back[-1]:5.2f} m")
    print(f"kinetic energy left: {kinetic[-1] / max(kinetic):.1%}")
    figure.colorbar(colours, ax=axes[:3], label="plastic strain", shrink=0.6)
    for values, label in ((run_out, "run-out"), (back, "retrogression")):
        axes[3].plot(times, values, label=label)
    axes[3].set(xlabel="time, s", ylabel="m", ylim=(0.0, None))
    axes[3].legend()
    figure.savefig("retrogression.png", dpi=110)

# It stops before it runs out of clay: what has spread holds the scarp.

assert back[-1] > 2.0 * run_out[-1] and back[-1] < crest
assert kinetic[-1] < 0.02 * max(kinetic)

# ## Exercises
#
# 1. Make the top shorter, `crest = 10.0`. Does the front feel it?
# 2. Take `cells = 12`. Where do front and scarp come to rest?
# 3. Give `length=None` on both backgrounds. What of the bands?
