# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.7: Von Mises in motion: inertia carries the toe further

# # A column slumps in time
#
# It illustrates how to:
# - let a body move in time with `mpm.DynamicProblem`,
# - read what becomes of its energy in `history.energies`,
# - compare the motion with equilibrium: inertia carries the toe further.
#
# ## Problem
#
# The right half of a column 8 m wide and 8 m high stands on a smooth base. It is let go at $t = 0$
# under its whole weight, $\rho_0\, g$ = 10 kN/m3. The material is von Mises' with $E$ = 1 MPa,
# $\nu$ = 0.3 and $\rho_y$ = 20 kPa, far too weak to stand. Balance of momentum,
#
# $$
# \rho_0\, \dot v = \mathrm{Div}\, P + \rho_0\, b, \qquad \dot d = v, \tag{1}
# $$
#
# is solved with velocities at the body's nodes. In each step the sum
#
# $$
# E_\mathrm{kin} + E_\mathrm{strain} + D - W_\mathrm{ext} + L \tag{2}
# $$
#
# of kinetic and elastic energy, plastic dissipation, work of the weight and what the background
# cannot follow ($L$) stays what it was, to round-off.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
young, poisson, rho_y = 1e6, 0.3, 20e3  # Pa, -, Pa
density, gravity = 1000.0, 10.0  # kg/m3, m/s2
end, dt = 2.0, 0.02  # s

quadrilateral = mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, [[0.0, 0.0], [20.0, 10.0]], [40, 20], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 1, y=0.0)]


def column():
    """The body under its weight."""
    body = mesh.create_rectangle(comm, [[0.0, 0.0], [4.0, 8.0]], [16, 32], quadrilateral)
    law = mpm.materials.VonMises(young, poisson, rho_y=rho_y)
    return mpm.Body(mpm.Particles(body, V), law, density=density, body_force=(0.0, -gravity))


def toe(body):
    """How far a body reaches."""
    return comm.allreduce(body.particles.domains[..., 0].max(initial=0.0), MPI.MAX)


# In equilibrium the weight grows slowly; in motion it acts at once.

still = column()
mpm.QuasiStaticProblem(still, bcs).solve(steps=40)

moving = column()
problem = mpm.DynamicProblem(moving, bcs, scheme="conserving")
times, toes = [0.0], [4.0]
for step in problem.steps(time=end, dt=dt):
    times.append(step.time)
    toes.append(toe(moving))

# ## Result

energies, rest = problem.history.energies, toe(still)
last = energies[-1]
largest = max(energy.kinetic for energy in energies)
drift = max(abs(energy.balance - energies[0].balance) for energy in energies) / largest
if comm.rank == 0:
    print(f"toe in equilibrium      {rest:6.2f} m")
    print(f"toe after {end:g} s           {toes[-1]:6.2f} m")
    print(f"largest kinetic energy  {largest / 1e3:6.0f} kJ/m")
    print(f"work of the weight      {last.external / 1e3:6.0f} kJ/m")
    print(f"plastic dissipation     {last.dissipated / 1e3:6.0f} kJ/m")

kinds = {"external": "work of the weight", "dissipated": "dissipated", "kinetic": "kinetic"}
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4), layout="constrained")
mpm.plot.background(V, ax=left, color="0.92")
mpm.plot.domains(still.particles, ax=left, facecolor="none", edgecolor="C1", linewidth=0.4)
mpm.plot.domains(
    moving.particles, moving.particles.plastic_strain, ax=left, cmap="YlGnBu", vmin=0.0
)
left.set(xlim=(0, 14), ylim=(0, 8.2), xlabel="x, m", ylabel="y, m")
left.set_title("Plastic strain after 2 s; orange: in equilibrium")
for name, label in kinds.items():
    right.plot(times, [getattr(energy, name) / 1e3 for energy in energies], label=label)
right.set(xlabel="time, s", ylabel="kJ/m")
right.legend()
if comm.rank == 0:
    figure.savefig("slump.png", dpi=150)

# The column has moved half as far again as without inertia. All energy is accounted for.

assert toes[-1] > 1.4 * 8.01
assert drift < 1e-11

# ## Exercises
#
# 1. Go on to 6 s. How far does the toe come, and what is left of the kinetic energy?
# 2. Take `scheme="euler"` and halve `dt` twice. How much of the work does the scheme itself take
#    (`energies[-1].lost`), and what is its order?
# 3. Let go of a column of triangles. Which of the two bodies is stiffer, and why?
