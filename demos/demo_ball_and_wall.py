# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.7: Rubber bodies in space: impacts and friction, energy kept account of

# # A ball rolls down and hits a wall
#
# It illustrates how to:
# - let bodies in 3-D collide: each has a background of its own, and each two a `Pair`,
# - check the balance of energy and momentum of a motion with impacts and friction.
#
# ## Problem
#
# A ball of radius $R$ = 0.35 m is released on an incline of 30° that ends in a plain. There a gate
# of three blocks stands, two pillars and a lintel that lies on them. All are of soft rubber with
# $E$ = 0.5 MPa, $\nu$ = 0.3 and 1 t/m3, a little damped; friction is $\mu$ = 0.4 everywhere.
#
# Some things are known without solving: kinetic energy, the energy of strains and contacts, and the
# losses by friction and damping add up to the work of the weight; momentum along $x$ is the impulse
# of the ground, the only external force; and rolling takes 7/5 of the energy of sliding.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np
import pyvista

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, hexahedron = MPI.COMM_WORLD, mesh.CellType.hexahedron
R, gravity, friction, density = 0.35, 9.81, 0.4, 1000.0
foot, bend, slope, at = 1.3, 0.12, np.tan(np.radians(30.0)), 2.1


def height(x):
    return bend * slope * np.logaddexp(0.0, (foot - x) / bend)


along = np.linspace(-1.0, 6.0, 141)
ground = mpm.contact.terrain(along, np.linspace(-2.0, 2.0, 3), height(along)[:, None] * np.ones(3))
ball = mesh.create_box(comm, [[-1.0] * 3, [1.0] * 3], [4] * 3, hexahedron)
corners = ball.geometry.x.T.copy()
for i, (a, b, c) in enumerate(((0, 1, 2), (1, 0, 2), (2, 1, 0))):
    x, y, z = (corners[k] for k in (a, b, c))
    mapped = R * x * np.sqrt(1.0 - y**2 / 2.0 - z**2 / 2.0 + (y * z) ** 2 / 3.0)
    ball.geometry.x[:, i] = mapped + (0.3 + R / 2, 0.0, height(0.3) + R * np.sqrt(0.75))[i]
lower = np.array([[at, -0.6, 0.0], [at, 0.2, 0.0], [at, -0.6, 0.5]])
upper = lower + np.array([[0.25, 0.4, 0.5], [0.25, 0.4, 0.5], [0.25, 1.2, 0.25]])
cells = [[1, 2, 2], [1, 2, 2], [1, 4, 1]]
blocks = [mesh.create_box(comm, [lower[i], upper[i]], cells[i], hexahedron) for i in range(3)]
grid = mesh.create_box(comm, [[-0.41, -1.13, -0.21], [5.59, 1.07, 1.59]], [30, 11, 9], hexahedron)
bodies = [
    mpm.Particles(body, fem.functionspace(grid, ("Lagrange", 1, (3,))), quadrature_degree=2)
    for body in (ball, *blocks)
]
grounds = [mpm.contact.Rigid(body, ground, friction) for body in bodies]
meet = (1, 3), (2, 3), (0, 1), (0, 2), (0, 3)
pairs = [mpm.contact.Pair(bodies[i], bodies[j], friction, passes=1) for i, j in meet]
rubber, contacts = mpm.materials.Hencky(5e5, 0.3), [*grounds, *pairs]
weight = {"density": density, "body_force": (0.0, 0.0, -gravity)}
heavy = [mpm.Body(body, rubber, **weight) for body in bodies]
problem = mpm.DynamicProblem(heavy, terms=contacts, scheme="conserving", rayleigh=(0.0, 1e-3))
mass = density * comm.allreduce(bodies[0].initial_volume.sum())
rows, shapes, pushed, rolls = [], [], [0.0], []
for step in problem.steps(time=1.4, dt=0.02, output_at=[0.5, 0.9, 1.1]):
    energy, duration = problem.history.energies[-1], step.time - (rows[-1][0] if rows else 0.0)
    pushed.append(duration * sum(problem.reaction(base)[0] for base in grounds))
    rows.append((step.time, energy.kinetic, energy.internal, energy.damping, energy.external))
    touched = any(comm.allreduce(bool(pair.touches.any()), MPI.LOR) for pair in pairs[2:])
    if not touched and len(rolls) == len(rows) - 1:
        rolls.append(energy.kinetic / (problem.momentum @ problem.momentum / (2.0 * mass)))
    if step.output:
        shapes.append((step.time, [mpm.plot.grid(body) for body in bodies]))

# ## Result

time, kinetic, internal, taken, work = np.array(rows).T
hit, ratio, impulse = time[len(rolls)], rolls[-1], sum(pushed)
momentum, balance = problem.momentum[0], problem.history.energies[-1].balance
if comm.rank == 0:
    print(f"{sum(body.num_global for body in bodies)} particles")
    print(f"hits the wall after         {hit:.2f} s")
    print(f"energy over that of sliding {ratio:.2f}")
    print(f"momentum along the way      {momentum:.1f} kg m/s")
    print(f"impulses of the ground      {impulse:.1f} kg m/s")
    print(f"friction and damping took   {taken[-1]:.0f} J of {work[-1]:.0f} J")

    layout = [["0", "1"], ["2", "3"], ["book", "book"]]
    fig, axes = plt.subplot_mosaic(layout, figsize=(12, 10), layout="constrained")
    X, Y = np.meshgrid(along[along < 4.5], [-1.0, 1.0], indexing="ij")
    for i, (t, parts) in enumerate(shapes):
        plotter = pyvista.Plotter(off_screen=True, window_size=(1200, 700))
        plotter.add_mesh(pyvista.StructuredGrid(X, Y, height(X)), color="#a59d8f")
        for part, colour in zip(parts, ["#d95f02", "#7570b3", "#7570b3", "#1b9e77"], strict=True):
            plotter.add_mesh(part, color=colour, show_edges=True)
        plotter.view_vector((0.75, -1.6, 0.9), viewup=(0.0, 0.0, 1.0))
        plotter.camera.zoom(1.9)
        axes[str(i)].imshow(plotter.screenshot(return_img=True))
        axes[str(i)].set_axis_off()
        axes[str(i)].set_title(f"{t:.2f} s")
    look = {"labels": ["kinetic", "of strain and contact", "taken"]}
    look["colors"] = ["#4c78a8", "#f2a65a", "#9a9a9a"]
    axes["book"].stackplot(time, kinetic, internal, taken, **look)
    axes["book"].plot(time, work, "k--", label="work of weight")
    axes["book"].set(xlabel="time, s", ylabel="energy, J", xlim=(0.0, time[-1]))
    axes["book"].legend(loc="upper left")
    fig.savefig("ball_and_wall.png", dpi=110)

assert abs(momentum / impulse - 1.0) < 1e-6 and abs(balance) < 1e-6 * work[-1]
assert abs(ratio / 1.4 - 1.0) < 0.05

# ## Exercises
#
# 1. Without friction between it and the ground the ball slides. When does it hit the wall?
# 2. Take `scheme="euler"`. How much energy does the scheme take (`lost`) besides?
# 3. Make a movie: `mpm.plot.movie(problem, problem.steps(time=1.4, dt=0.02), "wall.gif", "mises")`.
