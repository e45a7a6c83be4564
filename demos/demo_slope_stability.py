# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1.8: Mohr-Coulomb, strength reduction: a weak seam decides

# # The factor of safety of a layered slope
#
# It illustrates how to:
# - give layers of a slope their own cohesion and friction,
# - find its factor of safety with one call, `mpm.strength_reduction`,
# - see where it slides: along a seam of weak clay, not on a circle.
#
# ## Problem
#
# A slope 10 m high, 2:1, of silt on a rough base: $c$ = 12 kPa, $\varphi$ = 22°. Between 1.25 and
# 2.5 m above its foot a seam of soft clay has $c$ = 8 kPa and $\varphi$ = 8°. Cohesion and friction
# of all layers are divided by a factor $F$,
#
# $$
# c_F = \frac{c}{F}, \qquad \tan \varphi_F = \frac{\tan \varphi}{F}, \tag{1}
# $$
#
# which grows until there is no equilibrium any more (Zienkiewicz, Humpheson & Lewis 1975). The last
# $F$ with equilibrium is the factor of safety. No slip surface has to be guessed: it is what the
# plastic strain shows. As a slope that slides may come to rest further down, a limit of the
# displacement, some times that by its weight, says what counts as standing.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
H, CREST, FOOT = 10.0, 12.5, 20.0  # m: height, width of crest and slope
h = H / 16  # background cells, m
DENSITY, GRAVITY, YOUNG = 2000.0, (0.0, -10.0), 1e8  # kg/m3, m/s2, Pa
SILT, SEAM = 1, 2

width = CREST + FOOT
cells = [round(width / h), round(H / h)]
background = mesh.create_rectangle(
    comm, [[0, 0], [width + 4 * h, H + 2 * h]], [cells[0] + 4, cells[1] + 2], quadrilateral
)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, y=0.0)]


def slope(seam):
    """The slope under its weight, with or without the seam."""
    body = mesh.create_rectangle(comm, [[0, 0], [width, H]], [2 * n for n in cells], quadrilateral)
    x = body.geometry.x
    x[:, 0] *= (CREST + FOOT * (1 - x[:, 1] / H)) / width
    layers = mpm.cell_tags(body, {SILT: mpm.region(y=(0, H)), SEAM: mpm.region(y=(2 * h, 4 * h))})
    silt = mpm.materials.MohrCoulomb(YOUNG, 0.3, cohesion=12e3, friction_angle=22.0)
    clay = mpm.materials.MohrCoulomb(YOUNG, 0.3, cohesion=8e3, friction_angle=8.0)
    soils = {SILT: silt, SEAM: clay if seam else silt}
    particles, weight = mpm.Particles(body, V), {"density": DENSITY, "body_force": GRAVITY}
    problem = mpm.QuasiStaticProblem(mpm.Body(particles, soils, cell_tags=layers, **weight), bcs)
    problem.solve(2)
    return problem


rows = [["without", "curves"], ["with", "curves"]]
figure, axes = plt.subplot_mosaic(rows, figsize=(13, 6), width_ratios=[2, 1], layout="constrained")
factors = {}
for name in ("without", "with"):
    problem = slope(name == "with")
    settled = problem.particles.displacement.x.array.copy()
    found = mpm.strength_reduction(problem)
    factors[name] = found.factor

    # How far the soil has moved since the reduction began.
    moved = (problem.particles.displacement.x.array - settled).reshape(-1, 2)
    way = np.linalg.norm(moved, axis=1)
    at = problem.particles.W.dofmap.list[: problem.particles.num_local]
    mean = way[at].mean(axis=1)
    colours = mpm.plot.domains(
        problem.particles, 100 * mean, ax=axes[name], cmap="magma_r", vmin=0, linewidth=0
    )
    if name == "with":
        axes[name].axhspan(2 * h, 4 * h, facecolor="none", edgecolor="C0", lw=1)
    axes[name].set(xlabel="x, m", ylabel="y, m", title=f"{name} seam: F = {found.factor:.2f}")
    if comm.rank == 0:
        figure.colorbar(colours, ax=axes[name], label="slide, cm", shrink=0.8)
    ways = 100 * np.array(found.displacements)
    axes["curves"].plot(ways, found.factors, "o-", label=f"{name} seam")

# ## Result

axes["curves"].set(xlabel="largest displacement, cm", ylabel="strength divided by")
axes["curves"].legend()
if comm.rank == 0:
    print(f"factor of safety without the seam  {factors['without']:.2f}")
    print(f"factor of safety with the seam     {factors['with']:.2f}")
    figure.savefig("slope_stability.png", dpi=150)

# Two layers of cells take a third of the slope's safety, and the slide is a wedge on the seam.

assert factors["with"] < 0.9 * factors["without"] and factors["with"] > 1.0

# ## Exercises
#
# 1. Halve the cells. How much do the factors fall? (Coarse cells are too strong.)
# 2. Place the seam below the base of the slope's middle. Where does it do least harm?
# 3. Give the silt a dilation of 22°. Does the factor depend on it?
