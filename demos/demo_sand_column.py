# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.4: Friction that rises with the rate, beside an experiment

# # A column of sand is let go
#
# It illustrates how to:
# - let sand fall and part, with friction that rises with the rate (`MuIRheology`),
# - begin with the stress of ground at rest (`initial_stress=`),
# - compare where the sand comes to rest with an experiment.
#
# ## Problem
#
# A column of dry sand, $r_0$ = 1 m wide and $h_0 = a\, r_0$ high, stands on a rough floor between a
# smooth wall and a gate, which is pulled away. Lube, Huppert, Sparks & Freundt (2005) found that
# the place $r_\infty$ where the front comes to rest hardly depends on the grains:
#
# $$
# (r_\infty - r_0) / r_0 = 1.2\, a \quad (a < 1.8), \qquad 1.9\, a^{2/3} \quad (a > 2.8). \tag{1}
# $$
#
# The sand keeps its volume as it flows. At rest it has the friction of Mohr-Coulomb's sand with
# $\varphi$ = 30°, in flow more by the inertial number (Jop, Forterre & Pouliquen 2006),
#
# $$
# \sqrt{J_2} \le \mu(I)\, P, \qquad \mu(I) = \mu_s + (\mu_2 - \mu_s) \frac{I}{I_0 + I}, \qquad
# I = \frac{d\, \dot\gamma}{\sqrt{P / \rho_s}}, \tag{2}
# $$
#
# with grains of $d = r_0/100$ and what was measured for glass beads, $\mu_2 - \mu_s$ = 0.26 and
# $I_0$ = 0.279. Pulled apart, it has no stress; what has opened closes without resistance.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
a, r0, h = 1.0, 1.0, 0.125  # -, m, m (background cells)
young, poisson, friction = 1e6, 0.3, np.sin(np.radians(30.0))  # Pa, -, -
density, gravity = 2000.0, (0.0, -10.0)  # kg/m3, m/s2
grain, grain_density = 0.01 * r0, density / 0.6  # m, kg/m3
end, dt, run_out = 1.45, 0.01, 1.2 * a  # s, s, -

# The floor is the background's lower end, held as a whole: sand that falls onto it stays there.

corners, quadrilateral = [[0.0, 0.0], [28 * h, 11 * h]], mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, corners, [28, 11], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
bcs = [mpm.held(V, y=0.0), mpm.held(V, 0, x=0.0)]
both = mesh.DiagonalType.left_right
body = mesh.create_rectangle(comm, [[0.0, 0.0], [r0, a * r0]], [16, 16], diagonal=both)
particles = mpm.Particles(body, V)

# Backward Euler takes the energy of the collisions away. A viscosity of E beta = 3 Pa s, next to
# nothing beside rho r0 sqrt(g r0) = 6300 Pa s, keeps domains together that are drawn out far.

sand = mpm.materials.MuIRheology(young, poisson, friction, friction + 0.26, grain, grain_density)
problem = mpm.DynamicProblem(
    mpm.Body(
        particles,
        sand,
        density=density,
        body_force=gravity,
        initial_stress=mpm.geostatic(a * r0, density, 0.5, gravity),
    ),
    bcs=bcs,
    scheme="euler",
    rayleigh=(0.0, 3e-6),
)

X = particles.W.tabulate_dof_coordinates()[:, 0]
times, fronts = [0.0], [0.0]
figure, axes = plt.subplots(2, 2, figsize=(13, 6.5), layout="constrained")
views = iter(axes.flat)
for step in problem.steps(time=end, dt=dt, output_at=[0.3, 0.6]):
    times.append(step.time)
    x = X + particles.displacement.x.array[::2]
    fronts.append(comm.allreduce(x.max(initial=0.0), MPI.MAX) / r0 - 1.0)
    if step.output:
        ax = next(views)
        mpm.plot.background(V, ax=ax, color="0.93")
        mpm.plot.domains(
            particles, particles.plastic_strain, ax=ax, cmap="YlOrBr", vmin=0, vmax=4, linewidth=0.2
        )
        ax.set(xlim=(0, 2.5), ylim=(-0.05, 1.1), ylabel="y, m", title=f"{step.time:.2f} s")
        ax.plot([0, r0, r0], [a * r0, a * r0, 0], color="0.4", ls="--", lw=1)
        ax.axvline(r0 * (1 + run_out), ymax=0.3, color="C0", lw=2)

# ## Result

kinetic = [energy.kinetic for energy in problem.history.energies]
ax = next(views)
ax.axhline(run_out, color="C0", label="Lube et al. (2005)")
ax.plot(times, fronts, color="C1", label="front of the sand")
ax.set(xlabel="time, s", ylabel="run-out over width", ylim=(0, 1.4))
ax.legend(loc="lower right")
if comm.rank == 0:
    print(f"run-out over width     {fronts[-1]:6.2f}")
    print(f"experiment, (1)        {run_out:6.2f}")
    figure.savefig("sand_column.png", dpi=150)

# The front is thin and moves with details: other steps and cells change it by ten per cent.

assert abs(fronts[-1] / run_out - 1.0) < 0.15 and kinetic[-1] < 0.02 * max(kinetic)

# ## Exercises
#
# 1. Take `MohrCoulomb(young, poisson, 0.0, 30.0, volume_correction=True)`. How far does it come?
# 2. Take `a = 3` and a larger background. What of (1) is left? And at 25° and 35°?
