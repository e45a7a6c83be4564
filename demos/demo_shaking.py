# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.12: Waves come in and leave through dashpots; plastic settlement

# # An embankment is shaken
#
# It illustrates how to:
# - begin a motion with an equilibrium: `mpm.DynamicProblem(..., after=static)`,
# - let waves leave through a boundary, and come in through it: `mpm.boundary.dashpot`,
# - read from the account of energies what the soil has dissipated.
#
# ## Problem
#
# An embankment of clay, 10 m high with slopes of 1 : 1.5, stands on elastic rock. First it carries
# its weight. Then a wave of shear rises in the rock: three seconds of a velocity $\dot g(t)$ with
# 2 Hz. Below the body the rock goes on without end. A half-space in which that wave rises and any
# wave falls pulls at the body with (Joyner & Chen 1975)
#
# $$
# t_x = 2\, \rho\, c_s\, \dot g - \rho\, c_s\, \dot d_x, \qquad c_s = \sqrt{G / \rho}, \tag{1}
# $$
#
# a traction and a dashpot (Lysmer & Kuhlemeyer 1969). The vertical displacement is zero there.
# Without the embankment, the surface of the rock would move with $2\, \dot g$. The clay is von
# Mises' with the undrained strength $c_u$, which is $\rho_y / \sqrt 2$ in plane strain.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
gravity, end, dt = 9.81, 4.5, 0.015  # m/s2, s, s
frequency, speed = 2.0, 0.25  # Hz, m/s: of the wave
rho_rock, shear_rock = 2400.0, 2400.0 * 600.0**2  # kg/m3, Pa: c_s = 600 m/s
rho_clay, shear_clay, strength = 2000.0, 2000.0 * 150.0**2, 55e3  # c_s = 150 m/s; Pa

quadrilateral = mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, [[-32.0, 0.0], [32.0, 16.0]], [64, 16], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))

# The two bodies have the same $V$, so they stick to each other. The embankment is a rectangle whose
# sides are inclined.

rock = mesh.create_rectangle(comm, [[-28.0, 1.0], [28.0, 5.0]], [112, 8], quadrilateral)
clay = mesh.create_rectangle(comm, [[-18.0, 5.0], [18.0, 15.0]], [72, 20], quadrilateral)
clay.geometry.x[:, 0] *= 1.0 - (clay.geometry.x[:, 1] - 5.0) / 12.0
bodies = [mpm.Particles(rock, V), mpm.Particles(clay, V)]
laws = [
    mpm.materials.Hencky(2.6 * shear_rock, 0.3),
    mpm.materials.VonMises(2.6 * shear_clay, 0.3, rho_y=np.sqrt(2.0) * strength),
]
weight = (0.0, -gravity)
embankment = mpm.Body(bodies[1], laws[1], density=rho_clay, body_force=weight)

tags = mpm.facet_tags(rock, {1: mpm.region(y=1.0)})

# Equilibrium first, on a base that is held. The last steps are under constant load.

bedrock = mpm.Body(bodies[0], laws[0], density=rho_rock, body_force=weight)
held = mpm.boundary.fixed(bodies[0], tags, 1)
static = mpm.QuasiStaticProblem([bedrock, embankment], supports=[held])
static.solve(steps=5)
static.step()
static.step()

# Then the motion. What held the base is replaced by a roller, the dashpot and the wave.

resistance = np.sqrt(rho_rock * shear_rock)  # rho c_s
wave = fem.Constant(rock, (0.0, 0.0))
supports = [
    mpm.boundary.roller(bodies[0], tags, 1, (0.0, -1.0)),
    mpm.boundary.dashpot(bodies[0], tags, 1, 0.0, resistance),
]
problem = mpm.DynamicProblem(
    [bedrock.replace(tractions=[(wave, 1)], facet_tags=tags), embankment],
    supports=supports,
    after=static,
)


def rising(t):
    """Velocity of the wave that rises."""
    return speed * np.sin(np.pi * t / 3.0) ** 2 * np.sin(2 * np.pi * frequency * t) * (t < 3.0)


def update(t):
    """Set the traction of the wave."""
    wave.value = (2.0 * resistance * rising(t), 0.0)


def mean_velocity(number, where):
    """The mean horizontal velocity of nodes that a marker chooses."""
    body = bodies[number]
    chosen = where(body.W.tabulate_dof_coordinates().T)[: body.W.dofmap.index_map.size_local]
    v = problem.velocity[number].x.array.reshape(-1, 2)[: len(chosen), 0]
    return comm.allreduce(v[chosen].sum()) / comm.allreduce(int(chosen.sum()))


def height():
    """Of the embankment's crest."""
    return comm.allreduce(bodies[1].domains[..., 1].max(initial=-np.inf), MPI.MAX)


first, times, below, above = height(), [0.0], [0.0], [0.0]
for step in problem.steps(time=end, dt=dt, update=update):
    times.append(step.time)
    below.append(mean_velocity(0, lambda x: x[1] < 1.01))
    above.append(mean_velocity(1, lambda x: x[1] > 14.99))

# ## Result

energies = problem.history.energies
kinetic = np.array([energy.kinetic for energy in energies])
drift = max(abs(energy.balance - energies[0].balance) for energy in energies) / kinetic.max()
quickest, settlement = np.abs(above).max(), first - height()
plastic = bodies[1].plastic_strain
most = comm.allreduce(plastic.max(initial=0.0), MPI.MAX)
if comm.rank == 0:
    print(f"largest velocity of the crest      {quickest:8.2f} m/s")
    print(f"largest velocity of the rock       {np.abs(below).max():8.2f} m/s")
    print(f"settlement of the crest            {100 * settlement:8.1f} cm")
    print(f"largest plastic strain             {most:8.3f}")
    dissipated = energies[-1].dissipated / 1e3
    print(f"dissipated in the clay             {dissipated:8.0f} kJ/m")
    print(f"kinetic energy, end over largest   {kinetic[-1] / kinetic.max():8.1e}")

figure, (left, right) = plt.subplots(
    1, 2, figsize=(13, 3.6), layout="constrained", width_ratios=[2, 1]
)
mpm.plot.domains(bodies[0], ax=left, facecolor="0.82", edgecolor="0.75", linewidth=0.3)
colours = mpm.plot.domains(
    bodies[1], plastic, ax=left, cmap="YlOrBr", vmin=0.0, edgecolor="0.6", linewidth=0.2
)
left.set(xlabel="x, m", ylabel="y, m", xlim=(-28.5, 28.5), ylim=(0.5, 15.8))
left.set_title(f"Plastic strain after the shaking; settlement {100 * settlement:.0f} cm")
right.plot(times, above, "C1", label="crest")
right.plot(times, below, "C0", label="base of the rock")
right.set(xlabel="time, s", ylabel="horizontal velocity, m/s")
right.legend()
if comm.rank == 0:
    figure.colorbar(colours, ax=left, shrink=0.75)
    figure.savefig("shaking.png", dpi=150)

# The crest swings more than the rock does. Afterwards the waves have left through the base, and the
# embankment is at rest, lower and wider. All energy is accounted for.

assert quickest > 1.2 * np.abs(below).max()
assert settlement > 0.0 and kinetic[-1] < 1e-2 * kinetic.max()
assert drift < 1e-9

# ## Exercises
#
# 1. Hold the base by `mpm.boundary.fixed(..., value=...)` on the path of the rock's surface instead
#    of (1). How long does the embankment go on swinging?
# 2. Take an elastic embankment, and find the frequency at which the crest swings most.
# 3. How much stronger must the clay be for a settlement of less than a centimetre?
