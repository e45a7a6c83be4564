# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.8: Motion in space over a triangulated hillside, friction

# # A block slides over terrain
#
# It illustrates how to:
# - make a rigid terrain of heights on a grid, and let a body slide over it with friction,
# - run in time and in space, and read contact and energies step by step,
# - compare the run-out with the energy line.
#
# ## Problem
#
# A slab of soft rock, 0.8 m by 0.8 m and 0.2 m thick, is let go on a hillside that ends in a
# plain, between two banks. It is elastic, with $E$ = 2 MPa and 2 t/m3, and its base has
# the friction $\mu$ = 0.25. The height of the ground is
#
# $$
# z(x, y) = w \tan 30^\circ \log\left(1 + e^{(x_0 - x) / w}\right)
#     + \tfrac{1}{2} \max(|y| - 0.6, 0)^2, \qquad x_0 = 2.5\ \mathrm{m}, \ w = 0.5\ \mathrm{m},
# $$
#
# so that it goes over from the slope into the plain within some $w$. On a way of which $dx$ is
# horizontal and on which the slope turns by $d\theta$, gravity gives and friction takes
#
# $$
# d\left(\tfrac{1}{2} v^2\right) = -g\, dz - \mu \left(g\, dx + v^2\, d\theta\right), \tag{1}
# $$
#
# since the ground bears $g \cos\theta$ and what turns the motion. Without the last part the body
# would stop where its centre has fallen by $H = \mu L$ over a horizontal way $L$, whatever the
# slope: the *energy line* of Heim (1932). The bend stops it earlier.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np
import pyvista

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
friction, gravity = 0.25, 9.81
bend, foot, slope = 0.5, 2.5, np.tan(np.radians(30.0))


def height(x, y):
    """Height of the ground."""
    bank = np.maximum(np.abs(y) - 0.6, 0.0)
    return bend * slope * np.logaddexp(0.0, (foot - x) / bend) + 0.5 * bank**2


x, y = np.linspace(-0.5, 8.5, 121), np.linspace(-1.4, 1.4, 29)
ground = mpm.contact.terrain(x, y, height(x[:, None], y))

# The slab follows the ground, a millimetre above it. The background is a box of cells around the
# way; only those near the slab have unknowns in a step.

h = 0.2
slab = mesh.create_box(
    comm, [[0.2, -0.4, 0.0], [1.0, 0.4, 0.2]], [8, 8, 2], mesh.CellType.hexahedron
)
place = slab.geometry.x
place[:, 2] += height(place[:, 0], place[:, 1]) + 1e-3
corners = [[-0.4, -1.0, -0.27], [8.0, 1.0, 2.13]]
cells = np.rint((np.array(corners[1]) - corners[0]) / h).astype(int)
grid = mesh.create_box(comm, corners, cells, mesh.CellType.hexahedron)
V = fem.functionspace(grid, ("Lagrange", 1, (3,)))
particles = mpm.Particles(slab, V, quadrature_degree=2)

base = mpm.contact.Rigid(particles, ground, friction)
problem = mpm.DynamicProblem(
    mpm.Body(
        particles, mpm.materials.Hencky(2e3, 0.3), density=2.0, body_force=(0.0, 0.0, -gravity)
    ),
    scheme="conserving",
    terms=[base],
)

# ## Run
#
# Until it rests. The conserving scheme loses no energy but by friction.

mass = particles.initial_volume
volume = comm.allreduce(mass.sum())


def centre():
    """Centre of mass, on all ranks."""
    return comm.allreduce(mass @ particles.centroid) / volume


track, dt = [(*centre(), 0.0)], 0.07
shapes = [mpm.plot.grid(particles)]
for step in problem.steps(time=6.0, dt=dt):
    speed = np.linalg.norm(problem.momentum) / (2.0 * volume)
    track.append((*centre(), speed))
    if len(track) in (14, 20, 27):
        shapes.append(mpm.plot.grid(particles))
    if speed < 0.02 and len(track) > 10:
        break
shapes.append(mpm.plot.grid(particles))

# ## Result
#
# Equation (1), by small steps along the ground, gives the way of a point.

along, _, up, speed = np.array(track).T
fine = np.linspace(along[0], 8.0, 20001)
z = height(fine, 0.0)
angle = np.arctan(np.gradient(z, fine))
energy = [0.0]
for dx, dz, turn in zip(np.diff(fine), np.diff(z), np.diff(angle), strict=True):
    change = -gravity * dz - friction * (gravity * dx + 2.0 * energy[-1] * turn)
    energy.append(energy[-1] + change)
    if energy[-1] < 0.0:
        break
exact = fine[len(energy) - 1] - along[0]
way, fall = along[-1] - along[0], up[0] - up[-1]
if comm.rank == 0:
    solves, fastest = problem.history.total_iterations, np.sqrt(2 * max(energy))
    print(f"{particles.num_global} particles, {solves} linear solves")
    fallen = f"fall over way {fall / way:.3f}"
    print(f"way {way:.3f} m, of a point {exact:.3f} m, {fallen}")
    print(f"largest speed {speed.max():.2f} m/s, of a point {fastest:.2f} m/s")

# The picture: the slab at five moments, and heights along the way.

if comm.rank == 0:
    plotter = pyvista.Plotter(off_screen=True, window_size=(1800, 900), lighting="three lights")
    X, Y = np.meshgrid(x[x < 6.5], y, indexing="ij")
    plotter.add_mesh(pyvista.StructuredGrid(X, Y, height(X, Y)), color="#a59d8f")
    moments = [0, 13, 19, 26, len(track) - 1]
    for shape, moment in zip(shapes, moments, strict=True):
        shape["speed"] = np.full(shape.n_cells, speed[moment])
        colours = {"scalars": "speed", "clim": (0.0, speed.max()), "cmap": "viridis"}
        plotter.add_mesh(shape, show_edges=True, show_scalar_bar=False, **colours)
    plotter.view_vector((0.5, -1.6, 1.0), viewup=(0.0, 0.0, 1.0))
    plotter.camera.zoom(1.7)
    image = plotter.screenshot(return_img=True)
    fig, (top, ax) = plt.subplots(2, figsize=(11, 8), layout="compressed", height_ratios=(2, 1))
    top.imshow(image)
    top.set_axis_off()
    bar = plt.cm.ScalarMappable(plt.Normalize(0.0, speed.max()), "viridis")
    fig.colorbar(bar, ax=top, label="speed, m/s", shrink=0.7)
    ax.fill_between(fine, z, -0.3, color="#b9b2a6", lw=0)
    ax.plot(along, up, "o-", ms=3, label="centre of the slab")
    ax.plot(along, up + speed**2 / (2.0 * gravity), color="#D55E00", label="centre and $v^2 / 2g$")
    ax.plot(fine, up[0] - friction * (fine - along[0]), "k--", lw=1, label="energy line")
    ax.set(xlim=(0.5, 6.0), ylim=(-0.1, 1.4), xlabel="x, m", ylabel="height, m")
    ax.legend()
    fig.savefig("landslide.png", dpi=110)

assert abs(way - exact) < 0.02 * exact
assert fall / way > friction

# ## Exercises
#
# 1. Take `scheme="euler"`. How much of the energy is lost by time steps of 0.05 s?
# 2. Make the bend sharper, `bend = 0.25`. Does equation (1) still hold?
# 3. Put a bump into `height`, or read a surface of your own by `mpm.contact.read_surface`.
