# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.3: Undrained clay: the limit load beside Prandtl's

# # Bearing capacity of a strip footing
#
# It illustrates how to:
# - drive a problem by a support on the body's own facets, and read its force,
# - recognise volumetric locking in a limit load, and cure it by `f_bar="patch"`,
# - grade the cells of a background and of a body.
#
# ## Problem
#
# A smooth rigid strip of half width $b$ = 0.5 m is pushed into weightless undrained soil, of which
# the right half is 5 m by 5 m, with rollers at both sides and a smooth base. The soil is von
# Mises', perfectly plastic on Hencky elasticity,
#
# $$
# f = \frac{\sqrt{2 J_2}}{\rho_y} - 1 \le 0, \qquad E = 10\ \mathrm{GPa}, \quad \nu = 0.48, \quad
# c = \frac{\rho_y}{\sqrt2} = 490\ \mathrm{kPa}. \tag{1}
# $$
#
# The mean pressure under the strip cannot exceed Prandtl's
#
# $$
# p_\mathrm{lim} = (2 + \pi)\, c = 2519\ \mathrm{kPa}, \tag{2}
# $$
#
# the same for a smooth and a rough strip. The strip moves by 2 mm; strains stay small since $E$ is
# 14 000 times $\rho_y$.
#
# At the limit load all of the motion is plastic, and plastic flow keeps the volume, one condition
# at each quadrature point. A background cell has two unknowns to meet such conditions with: with
# 2 by 2 particles the body *locks*, the pressure passes the limit and goes on rising. With
# `f_bar="patch"` the material sees, with the mean $\bar J$ over domains of about one background
# cell,
#
# $$
# \bar F = (\bar J / J)^{1/2} F. \tag{3}
# $$
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
half_width, size, settlement = 0.5, 5.0, 0.002  # m
young, poisson, cohesion = 1e7, 0.48, 490.0  # kPa, -, kPa
limit = (2.0 + np.pi) * cohesion
h = 0.125

# The lines of the body: cells of `h` where the soil flows, 1.75 m to the side and 1 m deep,
# and from there on each a fifth longer than the one before.


def lines(fine):
    """Grid lines from 0 to `size`, at first `h` apart."""
    cells = np.full(round(fine / h), h)
    longer = h * 1.2 ** np.arange(1, 100)
    longer = longer[: 1 + np.argmax(np.cumsum(longer) >= size - cells.sum())]
    longer *= (size - cells.sum()) / longer.sum()
    return np.concatenate([[0.0], np.cumsum(cells), cells.sum() + np.cumsum(longer)])


def divided(along, parts):
    """Lines that divide each interval of others into equal parts."""
    places = np.arange((len(along) - 1) * parts + 1) / parts
    return np.interp(places, np.arange(len(along)), along)


def grid(x, y):
    """A mesh with given grid lines: a rectangle's with its vertices moved."""
    n = [len(x) - 1, len(y) - 1]
    domain = mesh.create_rectangle(comm, [[0.0, 0.0], n], n, mesh.CellType.quadrilateral)
    for axis, along in enumerate((x, y)):
        place = domain.geometry.x[:, axis]
        place[:] = np.interp(place, np.arange(len(along)), along)
    return domain


across, up = lines(1.75), size - lines(1.0)[::-1]

# The background has the same lines but for two shifts, and two more rows of cells above the ground
# as room for the heave. The strip's edge is a singular point, and two things about it are decided
# by the lines around it (docs/supports.md has the numbers). The soil under the strip is held as
# one piece as far as the background's cells under its facets reach: if its last corner passes a
# line, as it is pressed outwards by up to 1 mm, the next cell is held too. So a line is 0.04 cells
# beyond the edge. And the soil beside the strip can only leave it behind where the two lie on
# different sides of a horizontal line; if that happens late, the pressure falls. So the ground
# starts 0.1 mm above a line, which the strip passes at once.

beyond, over = 0.04 * h, 1e-4  # m
taper = np.clip((size - across) / 2.0, 0.0, 1.0) * (across > 0.0)
heights = np.append(up - over * np.clip(up, 0.0, 1.0), size - over + h * np.arange(1, 3))
background = grid(across + beyond * taper, heights)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
body = grid(divided(across, 2), divided(up, 2))

particles = mpm.Particles(body, V, quadrature_degree=2)

# Rollers on grid lines, and the strip: it presses on the facets of the body that lie under it.

tags = mpm.facet_tags(body, {1: mpm.region(x=(0.0, half_width), y=size)})
footing = mpm.boundary.roller(particles, tags, 1, normal=(0.0, -1.0), value=settlement)

problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.VonMises(young, poisson, rho_y=np.sqrt(2.0) * cohesion),
        f_bar="patch",
    ),
    bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=size), mpm.held(V, 1, y=0.0)],
    supports=[footing],
)

# The Dirichlet values are totals at full load, so the load factor is the share of the settlement.

path = [(0.0, 0.0)]
for step in problem.steps(40):
    path.append((step.load, -problem.reaction(footing)[1] / half_width))

# ## Result
#
# The mean pressure at the end over the limit (2); by how much the pressure rose over the last
# tenth of the settlement: a limit load has been reached if that is nothing; and the largest fall
# below an earlier pressure, over the limit.

load, pressure = np.array(path).T
before = float(np.interp(0.9 * load[-1], load, pressure))
drop = float(np.max(np.maximum.accumulate(pressure) - pressure)) / limit
ratio, plateau = pressure[-1] / limit, pressure[-1] / before - 1.0
if comm.rank == 0:
    print(f"{particles.num_global} particles, {problem.history.total_iterations}", "linear solves")
    print(f"pressure {pressure[-1]:.0f} kPa, limit {limit:.0f} kPa,", f"ratio {ratio:.3f}")
    rise, fall = f"{100 * plateau:.2f} %", f"{100 * drop:.2f} %"
    print(f"rise over the last tenth {rise}, largest fall {fall}")

# The picture: where the soil flows, with the displacement magnified, and the pressure.

fig, axes = None, {"soil": None}
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic([["soil", "path"]], figsize=(13, 4.5), layout="compressed")
mpm.plot.scene(problem, "plastic_strain", ax=axes["soil"], warp=20.0, limits=(0.0, 0.01))
if comm.rank == 0:
    axes["soil"].set(xlim=(0.0, 2.0), ylim=(size - 1.15, size + 0.18), xlabel="x, m", ylabel="y, m")
    axes["soil"].set_title("Soil under the strip, displacement times 20")
    axes["path"].axhline(limit, color="0.2", ls="--", label="Prandtl")
    axes["path"].plot(1e3 * settlement * load, pressure, label="particles")
    axes["path"].set(xlabel="settlement, mm", ylabel="mean pressure, kPa")
    axes["path"].legend()
    fig.savefig("footing.png", dpi=130)

assert 0.98 < ratio < 1.03
assert abs(plateau) < 0.005 and drop < 0.003

# ## Exercises
#
# 1. Leave `f_bar` out. How far does the pressure rise?
# 2. Make the strip rough, `mpm.boundary.fixed`. Prandtl's limit is the same; is the computed one?
# 3. Put lines of the background at the edge, `beyond = 0`, or the ground, `over = 0`: what changes?
