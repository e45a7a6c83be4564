# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.13: Finite elements beside particles, contact, an estimate of the error

# # A steel footing pushed deep into clay
#
# It illustrates how to:
# - combine a finite element body and particles in one problem,
# - let them interact by frictional contact,
# - estimate the error, and see where it comes from.
#
# ## Problem
#
# A block of steel, $2b$ = 1 m wide, is pushed 0.25 m into weightless clay: a quarter of its width.
# Clay is von Mises' with the undrained shear strength $c$ = 50 kPa, and flows around the block's
# edge. Steel is elastic, its shape hardly changes, and it needs no background: its nodes have
# unknowns of their own,
#
# $$
# T = \begin{pmatrix} T_\mathrm{clay} & 0 \\ 0 & I \end{pmatrix} .
# $$
#
# At small depths the force on the block is Prandtl's, $(2 + \pi)\, c$ times its width; as the block
# sinks, clay heaves beside it and has to be lifted and sheared too.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
b, width, depth, settlement = 0.5, 2.5, 1.5, 0.25  # m
young, cohesion = 1e4, 50.0  # kPa
h = 0.125  # m, cells of the background


def rectangle(lower, upper, n):
    return mesh.create_rectangle(comm, [lower, upper], n, quadrilateral)


# The right half: clay below y = 0 in four domains a cell, on a background that has room for the
# heave, and the block on it. The cells are a little higher than two domains, so that no line of
# the background lies on the clay's surface.

columns, rows, room = round(width / h), round(depth / h), 6
top = 1.0125 * h * (rows + room) - depth
background = rectangle([0.0, -depth], [width, top], [columns, rows + room])
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
ground = rectangle([0.0, -depth], [width, 0.0], [2 * columns, 2 * rows])
clay = mpm.Particles(ground, V, quadrature_degree=2)
steel = mpm.Particles(rectangle([0.0, 0.0], [b, 0.5], [5, 5]))  # finite elements

# Conditions of the clay are on the background, those of the block on its own space.

down = mpm.held(steel.W, value=(0.0, -settlement), y=0.5)
bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=width), mpm.held(V, y=-depth), down]
soil = mpm.materials.VonMises(young, 0.49, rho_y=np.sqrt(2.0) * cohesion)
problem = mpm.QuasiStaticProblem(
    [mpm.Body(clay, soil, f_bar="patch"), mpm.Body(steel, mpm.materials.Hencky(2e8, 0.3))],
    bcs,
    terms=[mpm.contact.Pair(steel, clay, friction=0.3)],
)

# The error is asked after each step; it is that of strains and stresses, in energy.

depths, factors, errors = [0.0], [0.0], [np.nan]
for step in problem.steps(25):
    depths.append(settlement * step.load)
    factors.append(-problem.reaction(down)[1] / (cohesion * b))
    errors.append(problem.error())

# ## Result

if comm.rank == 0:
    print(problem.summary().splitlines()[0])
    for number in (5, 15, 25):
        print(
            f"{100 * depths[number]:4.1f} cm: force {factors[number]:.2f} c B,",
            f"error {errors[number]:.0%}",
        )

# The picture: how the clay flows, where the error comes from, and the force.

fig, axes = None, {"flow": None, "error": None}
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic(
        [["flow", "error", "force"]], figsize=(16, 4.5), layout="compressed"
    )
mpm.plot.scene(problem, "plastic_strain", ax=axes["flow"], limits=(0.0, 1.0))
shares = [problem.error_of_particles(0), problem.error_of_particles(1)]
mpm.plot.scene(problem, shares, ax=axes["error"])
if comm.rank == 0:
    for name, title in (("flow", "Plastic strain"), ("error", "Shares of the error")):
        axes[name].set(xlim=(0.0, 1.75), ylim=(-1.25, 0.5), xlabel="x, m", ylabel="y, m")
        axes[name].set_title(title)
    axes["force"].axhline(2.0 + np.pi, color="0.2", ls="--", label="Prandtl")
    axes["force"].plot(100.0 * np.array(depths), factors, label="force over $c B$")
    axes["force"].set(xlabel="depth, cm", ylim=(0.0, None))
    axes["force"].legend(loc="lower right")
    fig.savefig("steel_footing.png", dpi=130)

assert problem.history.stopped is None
assert 1.0 < factors[5] / (2.0 + np.pi) < 1.25
assert factors[-1] > factors[5] and errors[-1] < 0.2

# ## Exercises
#
# 1. Halve `h`. How do force and error change?
# 2. Make the contact smooth. What is different beside the block?
# 3. Give the clay no background either, `mpm.Particles(ground)`, and hold `clay.W`: at this depth
#    its finite elements have half the error. Push deeper: where does the run end, and why?
