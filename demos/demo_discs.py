# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.10: Elastic impact: momentum, angular momentum and energy

# # Two discs collide
#
# It illustrates how to:
# - throw bodies with `velocity=`, and let them touch by a common background,
# - choose a scheme: what `"conserving"` keeps, and what `"euler"` takes.
#
# ## Problem
#
# Two elastic discs of radius 0.2 fly towards each other (Sulsky, Chen & Schreyer 1994). The
# material is Hencky's with $E$ = 1000, $\nu$ = 0.3 and $\rho_0$ = 1000; the velocities are
# $(0.1, 0.1)$ and $(-0.1, -0.1)$. Contact is that of the nodes which both see in a cell. Each step
#
# $$
# T^T \left[ \tfrac{2}{\Delta t} M \left( \tfrac{1}{\Delta t} T u - v_n \right) + f^* \right] = 0,
# \qquad v_{n+1} = \tfrac{2}{\Delta t} T u - v_n \tag{1}
# $$
#
# with the force $f^*$ of the stress
# $F_m \left[ \tfrac12 (S_n + S_{n+1}) + c\, (E_{n+1} - E_n) \right]$ (Gonzalez 2000) keeps energy
# and both momenta, whatever cells the discs pass. Backward Euler takes the force at the end of the
# step instead, and $v_{n+1} = T u / \Delta t$.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

import basix.ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
radius, speed, end, dt, looked_at = 0.2, 0.1, 3.5, 0.02, [1.94, 3.5]
quadrilateral = mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, [[-0.2, -0.2], [1.2, 1.2]], [28, 28], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))


def disc(centre, n=14):
    """A square of n x n quadrilaterals, mapped to a disc."""
    q = np.linspace(-1.0, 1.0, n + 1)
    xi, eta = (a.ravel() for a in np.meshgrid(q, q, indexing="ij"))
    x, y = xi * np.sqrt(1.0 - eta**2 / 2.0), eta * np.sqrt(1.0 - xi**2 / 2.0)
    points = radius * np.sqrt(0.5) * np.stack([x - y, x + y], axis=1) + centre
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    cells = np.stack([i[:-1, :-1], i[1:, :-1], i[:-1, 1:], i[1:, 1:]], axis=-1).reshape(-1, 4)
    if comm.rank > 0:
        cells, points = cells[:0], points[:0]
    element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    return mesh.create_mesh(comm, cells.astype(np.int64), element, points)


figure, axes = plt.subplots(1, 4, figsize=(15, 3.9), layout="constrained")


def draw(ax, problem, t):
    mpm.plot.scene(problem, "mises", ax=ax, title=f"t = {t:.2f}", limits=(0.0, 160.0), lines=False)
    ax.set(xlim=(-0.05, 1.05), ylim=(-0.05, 1.05), xticks=[], yticks=[])


def collide(scheme, draws):
    """Let the discs collide; return the problem."""
    rubber, bodies = mpm.materials.Hencky(1000.0, 0.3), []
    for centre, way in (((0.2, 0.2), speed), ((0.8, 0.8), -speed)):
        particles = mpm.Particles(disc(centre), V, quadrature_degree=3)
        bodies.append(mpm.Body(particles, rubber, density=1000.0, velocity=(way, way)))
    problem = mpm.DynamicProblem(
        bodies,
        scheme=scheme,
        out_of_range="reflect",
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )
    if draws:
        draw(axes[0], problem, 0.0)
    for step in problem.steps(time=end, dt=dt, output_at=looked_at):
        if draws and step.time in looked_at:
            draw(axes[1 + looked_at.index(step.time)], problem, step.time)
    return problem


runs = {scheme: collide(scheme, scheme == "conserving") for scheme in ("conserving", "euler")}

# ## Result

ends = {}
for (scheme, problem), colour in zip(runs.items(), ("C0", "C3"), strict=True):
    energies = problem.history.energies
    times = [energy.time for energy in energies]
    kinetic = np.array([energy.kinetic for energy in energies])
    whole = np.array([energy.kinetic + energy.strain for energy in energies])
    ends[scheme] = whole[-1] / whole[0]
    axes[3].plot(times, whole / whole[0], colour, label=f"{scheme}, all")
    axes[3].plot(times, kinetic / whole[0], colour, ls=":", label=f"{scheme}, kinetic")
    if comm.rank == 0:
        print(f"{scheme:10s}  energy, end over start  {ends[scheme]:.3f}")
        print(f"{scheme:10s}  kinetic energy, least {min(kinetic) / whole[0]:.3f}")
    assert np.abs(problem.momentum).max() < 1e-11
axes[3].set(xlabel="time", title="energy over that at the start", ylim=(0.0, 1.05))
axes[3].legend(fontsize=8)
if comm.rank == 0:
    figure.savefig("discs.png", dpi=150)

# For a moment nearly all energy is in the strain. The discs part by themselves; what they do not
# get back as speed is in their vibrations. Backward Euler has lost a quarter of the energy.

assert abs(ends["conserving"] - 1.0) < 1e-11 and ends["euler"] < 0.85

# ## Exercises
#
# 1. Take `out_of_range="project"`. How much energy is `lost` (`history.energies[-1]`)?
# 2. Halve `dt` for `"euler"`. What is the order of its loss?
# 3. Give each disc a V of its own, and let them touch by `mpm.contact.Pair`. What changes?
