# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.12: Softening with a length of its own, on turned grids

# # A shear band that does not follow the mesh
#
# It illustrates how to:
# - give softening an internal length, `mpm.Body(..., length=...)`,
# - rotate a background relative to the body that it carries,
# - measure the width of a band.
#
# ## Problem
#
# A specimen of clay, 1 by 2, is pressed between smooth plates, the lower of which holds its right
# half. Its shear strength falls with the plastic strain $\kappa$ from 1 to 0.3,
#
# $$
# c = \frac{\sigma_y}{\sqrt3} = 0.3 + 0.7\, e^{-15 \kappa}, \tag{1}
# $$
#
# and a spot on its left side is weaker by 10 %. Once it yields, all further strain localises in a
# band at 45 degrees. With (1) alone the band is one domain wide, and results depend on the mesh.
# With a length $l$ strength follows $2 \bar\kappa - \kappa$, averaged over the reference body,
#
# $$
# \bar\kappa - l^2 \nabla^2 \bar\kappa = \kappa, \qquad
# \partial \bar\kappa / \partial n = 0. \tag{2}
# $$
#
# A straight band of simple shear has then $\kappa \propto 1 + \sqrt2 \cos(x/l)$ at the distance
# $|x| < 3/4\, \pi l$ from its middle, and a uniform band of the same second moment is as wide as
#
# $$
# w = 3.44\, l. \tag{3}
# $$
#
# ## Implementation
#
# The same specimen is carried by two backgrounds: one of cells of 1/10 along its sides, and one of
# cells of 1/12, turned by 30 degrees. Its own domains are half as large each way.

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
length, pressed = 0.12, 0.04


def specimen(cells, angle):
    """Return particles on a background that is turned, in degrees."""
    half = np.ceil(1.5 * cells) / cells
    n = round(2 * half * cells)
    corners = [[-half, -half], [half, half]]
    background = mesh.create_rectangle(comm, corners, [n, n], quadrilateral)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    x = background.geometry.x
    x[:, :2] = x[:, :2] @ np.array([[c, s], [-s, c]]) + [0.5, 1.0]
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    counts = [2 * cells, 4 * cells]
    body = mesh.create_rectangle(comm, [[0, 0], [1, 2]], counts, quadrilateral)
    return mpm.Particles(body, V, quadrature_degree=2)


def press(particles):
    """Return forces, and plastic strain of the last step and of all."""
    body = particles.mesh
    strength = fem.Function(fem.functionspace(body, ("Discontinuous Lagrange", 0)))
    strength.interpolate(lambda x: 1.0 - 0.1 * np.exp(-40.0 * (x[0] ** 2 + (x[1] - 0.5) ** 2)))
    strength.x.array[:] *= np.sqrt(3.0)
    clay = mpm.materials.VonMises(1e3, 0.3, yield_stress=strength)
    clay = clay.with_softening(15.0, residual=0.3)
    tags = mpm.facet_tags(body, {1: mpm.region(y=0), 2: mpm.region(y=2)})
    foot = mpm.facet_tags(body, {1: mpm.region(x=(0.5, 1), y=0)})
    plates = [
        mpm.boundary.roller(particles, tags, 1, normal=(0.0, -1.0)),
        mpm.boundary.roller(particles, tags, 2, normal=(0.0, -1.0), value=pressed),
        mpm.boundary.roller(particles, foot, 1, normal=(1.0, 0.0)),
    ]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, clay, f_bar="patch", length=length), supports=plates
    )
    forces, strains = [0.0], [np.zeros(particles.num_local)]
    for _ in problem.steps(8):
        forces.append(-problem.reaction(plates[1])[1])
        strains.append(particles.plastic_strain)
    return np.array(forces), strains[-1] - strains[-2], strains[-1]


def width(particles, rate):
    """Return the width of a uniform band with the same second moment (3)."""
    weights, x = rate * particles.initial_volume, particles.initial_centroid
    total = comm.allreduce(weights.sum())
    away = x - comm.allreduce(weights @ x) / total
    moments = comm.allreduce(np.einsum("n,ni,nj->ij", weights, away, away)) / total
    return float(np.sqrt(12.0 * np.linalg.eigvalsh(moments)[0]))


scenes = [specimen(10, 0.0), specimen(12, 30.0)]
results = [press(particles) for particles in scenes]

# ## Result

curves = [forces for forces, _, _ in results]
widths = [width(p, rate) for p, (_, rate, _) in zip(scenes, results, strict=True)]
if comm.rank == 0:
    print("cells  angle  force at the end  width of the band")
    for cells, angle, forces, wide in zip((10, 12), (0, 30), curves, widths, strict=True):
        print(f"1/{cells:<4} {angle:4d}  {forces[-1]:16.4f}  {wide:17.3f}")

fig, axes = plt.subplots(1, 3, figsize=(12.0, 5.5), width_ratios=[1.0, 1.0, 1.2])
for particles, (_, _, strain), ax, title in zip(
    scenes, results, axes, ("cells of 1/10", "cells of 1/12, turned"), strict=False
):
    mpm.plot.domains(particles, strain, ax=ax, cmap="YlGnBu", vmin=0.0, vmax=0.15, linewidth=0.2)
    x = particles.V.mesh.geometry.x
    lines = x[particles.V.mesh.geometry.dofmaps[0]][:, [0, 1, 3, 2, 0]]
    for line in lines:
        ax.plot(line[:, 0], line[:, 1], color="0.6", lw=0.4, zorder=0)
    ax.set(xlim=(-0.2, 1.2), ylim=(-0.1, 2.1), title=title)
for forces, style, label in zip(curves, ("-", "--"), ("1/10", "1/12, turned"), strict=True):
    axes[2].plot(np.linspace(0.0, pressed, len(forces)), forces, style, label=label)
axes[2].set(xlabel="displacement of the plate", ylabel="force", ylim=(0.0, None))
axes[2].legend()
fig.tight_layout()
if comm.rank == 0:
    fig.savefig("shear_band.png", dpi=100)

assert np.allclose(curves[0][1:], curves[1][1:], rtol=0.02)
assert abs(widths[0] / widths[1] - 1.0) < 0.05
assert abs(widths[0] / (3.44 * length) - 1.0) < 0.1  # its ends are cut by the sides

# ## Exercises
#
# 1. Take the length away (`length=None`) and look at both curves.
# 2. Halve `length` and double `decay`: what happens to the force over the displacement?
# 3. Place the weak spot elsewhere. Can the band be made to follow the other diagonal?
