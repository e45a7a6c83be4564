# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.11: Rubber cracks: a phase field at stretches beyond 2

# # A rubber sheet with a notch tears
#
# It illustrates how to:
# - let a body crack, by replacing its elastic law with a law of fracture,
# - continue through the moment in which the load drops to zero,
# - compare the energy of a crack with the toughness.
#
# ## Problem
#
# A sheet of rubber, 100 mm by 100 mm, has a notch of a fifth of its width, and is pulled to more
# than twice its length. The energy of its deformation and of the crack,
#
# $$
# \Pi(d, \alpha) = \int \left((1 - \alpha)^2\, \psi^+(F) + \psi^-(F)\right) \mathrm{d}X
#   + \frac{3 G_c}{8} \int \frac{\alpha}{l} + l\, |\nabla \alpha|^2 \,\mathrm{d}X, \tag{1}
# $$
#
# is least in the displacement $d$ and the damage $\alpha$, which is 0 where the sheet is whole,
# 1 in the crack, and never falls. $\psi^+$ is the neo-Hookean energy but for that of a volume that
# is pressed together. The crack is smeared over $l$.
#
# Stretched so far, a mesh would not survive the snap of the two halves. Here increments of the
# displacement live on a background, and the damage on the sheet's own mesh.

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
side, notch, h = 0.1, 0.02, 0.005  # m; cells of the background
young, poisson, toughness, length = 1e6, 0.3, 4e4, 0.01  # Pa, -, J/m2, m

# ## Bodies
#
# The notch is as high as two cells of the background: what lies in one cell moves together, so that
# lips that are closer would stick. The middle of the sheet is the middle of a cell.

sheet = mesh.create_rectangle(comm, [[0, 0], [side, side]], [40, 40], quadrilateral)
cells = np.arange(sheet.topology.index_map(2).size_local, dtype=np.int32)
x, y = mesh.compute_midpoints(sheet, 2, cells)[:, :2].T
whole = ~((x < notch) & (np.abs(y - side / 2) < h))
body = mesh.create_submesh(sheet, 2, cells[whole])[0]
grid = mesh.create_rectangle(
    comm, [[-2 * h, -2.5 * h], [24 * h, 57.5 * h]], [26, 60], quadrilateral
)
V = fem.functionspace(grid, ("Lagrange", 1, (2,)))
particles = mpm.Particles(body, V, quadrature_degree=2)

rubber = mpm.materials.NeoHooke(young, poisson)
law = mpm.materials.Fracture(rubber, toughness, length)
grips = mpm.facet_tags(body, {1: mpm.region(y=0.0), 2: mpm.region(y=side)})
lower = mpm.boundary.fixed(particles, grips, 1)
upper = mpm.boundary.fixed(particles, grips, 2, value=(0.0, 1.5 * side))
problem = mpm.QuasiStaticProblem(mpm.Body(particles, law), supports=[lower, upper])

# ## Solution
#
# Displacements and damage are found in turn within each step. The step in which the sheet tears
# takes nearly a hundred turns; after it the run has nothing left to do.

stretches, forces = [1.0], [0.0]
cracks = problem.damage[0]
for step in problem.steps(15):
    stretches.append(1 + 1.5 * step.load)
    forces.append(problem.reaction(upper)[1])
    if forces[-1] < 0.1 * max(forces):
        break

# ## Result
#
# On a mesh a crack takes $1 + 3 h / (8 l)$ times the toughness, with the width of what is broken
# for $h$: here one of the sheet's own cells, as those of the background cover half as much of a
# sheet that is stretched to twice its length.

torn = cracks.surface_energy() / (toughness * (side - notch))
on_mesh = 1 + 3 * (h / 2) / (8 * length)
turns = problem.history.steps[-1].alternations
if comm.rank == 0:
    print(f"torn at a stretch of {stretches[-1]:.2f}, in one step")
    print(f"largest force: {max(forces) / 1e3:.1f} kN/m")
    print(f"energy over toughness: {torn:.3f}, on this mesh {on_mesh:.3f}")

fig, axes = None, [None, None]
if comm.rank == 0:
    fig, axes = plt.subplots(1, 2, figsize=(10, 5.4), layout="compressed")
    axes[1].plot(stretches, np.array(forces) / 1e3, "o-")
    axes[1].set(xlabel="stretch", ylabel="force, kN/m")
look = {"cmap": "Blues_r", "background": False, "lines": False}
mpm.plot.scene(problem, "damage", ax=axes[0], **look)
if comm.rank == 0:
    fig.savefig("notch.png", dpi=130, bbox_inches="tight")

assert forces[-1] < 0.1 * max(forces) and turns > 20
assert abs(torn / on_mesh - 1) < 0.1

# ## Exercises
#
# 1. Sharpen the notch: make $h$ and $l$ half as large. At which stretch does the sheet tear, and
#    what is its energy then?
# 2. Close the crack again: let `upper` go back to zero. Which part of the law lets the faces
#    bear pressure?
# 3. Put a stiff disc into the sheet by `cell_tags`, with an elastic law of its own. Where does the
#    crack go?
