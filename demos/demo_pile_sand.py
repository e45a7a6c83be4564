# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.9: Mohr-Coulomb, a hole widened to four times its radius

# # A pile is pressed into sand
#
# It illustrates how to:
# - expand a cavity to four times its radius, compared with an exact solution,
# - drive a pile into sand under pressure, and check the force against the load on the base.
#
# ## Problem
#
# Sand under the same stress $p_0$ = 100 kPa in all directions, which also acts on its top, gets a
# pile of radius $R$ = 0.25 m with a smooth tip of 60°, along a thin guide of radius $a_0 = R/4$ as
# in [the demo in clay](demo_pile.md). There is no weight, as in a calibration chamber. The sand
# (Mohr-Coulomb) has $\varphi$ = 30°, no dilation, $c$ = 1 kPa, $E$ = 10 MPa and $\nu$ = 0.3.
#
# Installation is often taken for the widening of a hole, for which there is an exact solution (Yu
# and Houlsby 1991). With $\alpha = \tan^2(45° + \varphi/2)$, $Y = 2 c \sqrt \alpha$ and $q = Y +
# (\alpha - 1) p_0$ the pressure $p$ widens a long hole, $k = 1$, or a round one, $k = 2$, by
#
# $$
# \Big(\frac{a}{a_0}\Big)^{k + 1} = \frac{\rho^{-\gamma}}{(1 - \delta)^{k + 1} - \gamma e^{-\xi}
# \sum_n \frac{\xi^n}{n!\, (n - \gamma)} (\rho^{n - \gamma} - 1)}, \quad
# \rho = \frac{(k + \alpha)(Y + (\alpha - 1)\, p)}{(k + 1)\, \alpha q}, \tag{1}
# $$
#
# $\gamma = \frac{(k + 1)\, \alpha}{k (\alpha - 1)}$, $\delta = \frac{q}{2 (k + \alpha) G}$, $\xi =
# \frac{(k + 1)(1 + (2 - k) \nu)(1 - 2 \nu)\, q}{(\alpha - 1) E}$. By a rule the pressure of the
# round one is that on a smooth tip (Ladanyi and Johnston 1974).
#
# ## Implementation

from math import factorial

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
R, p0, E, nu, c, phi, beta = 0.25, 100.0, 1e4, 0.3, 1.0, np.pi / 6, np.pi / 6
h = a0 = R / 4
sand = mpm.materials.MohrCoulomb(E, nu, cohesion=c, friction_angle=30.0)


def pressure(ratio, k, most):
    """The pressure, below `most`, that widens a hole by a ratio: (1)."""
    alpha, p = np.tan(np.pi / 4 + phi / 2) ** 2, np.linspace(2 * p0, most, 500)
    Y = 2 * c * np.sqrt(alpha)
    q, g = Y + (alpha - 1) * p0, (k + 1) * alpha / k / (alpha - 1)
    delta = q * (1 + nu) / (k + alpha) / E
    xi = (k + 1) * (1 + (2 - k) * nu) * (1 - 2 * nu) * q / (alpha - 1) / E
    rho = (k + alpha) * (Y + (alpha - 1) * p) / (k + 1) / alpha / q
    terms = [xi**n / factorial(n) / (n - g) * (rho ** (n - g) - 1) for n in range(20)]
    power = rho**-g / ((1 - delta) ** (k + 1) - g * np.exp(-xi) * sum(terms))
    return np.interp(ratio, power ** (1 / (k + 1)), p)


def lines(n):
    """Places `h` apart up to `n h`, then 15 more, each 1.3 times as far."""
    return h * np.append(np.arange(n + 1), n + np.cumsum(1.3 ** np.arange(1, 16)))


def grid(x, y, parts):
    """A mesh with given lines, and with `parts` cells between each two."""
    end = [len(x) - 1, len(y) - 1]
    shape = [parts * n for n in end]
    made = mesh.create_rectangle(comm, [(0.0, 0.0), end], shape, mesh.CellType.quadrilateral)
    for i, along in enumerate((x, y)):
        made.geometry.x[:, i] = np.interp(made.geometry.x[:, i], np.arange(len(along)), along)
    return made


def body(x, y, above):
    """Sand around a hole, with rollers on side, base and, if closed, top."""
    V = fem.functionspace(grid(x, np.append(y, above), 1), ("Lagrange", 1, (2,)))
    bcs = [mpm.held(V, 0, x=x[-1]), mpm.held(V, 1, y=y[0])]
    if len(above) == 0:
        bcs.append(mpm.held(V, 1, y=y[-1]))
    return mpm.Particles(grid(x[1:], y, 2), V, quadrature_degree=2), bcs


soil = {"material": sand, "f_bar": "domain", "initial_stress": -p0 * np.eye(3)}

# ### A hole is widened
#
# One row of cells between rollers. At first the hole is held, while what it bore comes to act.

ring, bcs = body(lines(8), np.array([0.0, h]), [])
wall = mpm.facet_tags(ring.mesh, {1: mpm.region(x=a0)})
wide = fem.Constant(ring.mesh, 0.0)
held = mpm.boundary.roller(ring, wall, 1, normal=(-1.0, 0.0), value=wide)
problem = mpm.QuasiStaticProblem(mpm.Body(ring, **soil), bcs, supports=[held], axisymmetric=True)
problem.solve(1)
hole = []
for _ in problem.steps(20, update=lambda t: setattr(wide, "value", (a0 - R) * t)):
    radius = a0 - float(wide.value)
    hole.append((radius, problem.reaction(held)[0] / (2 * np.pi * radius * h)))
a, p = np.array(hole).T
exact = pressure(a / a0, 1, 580.0)

# ### A pile widens it
#
# Both the hole and the top, whose edge it turns down, may touch the pile.

down = -lines(30)[::-1]
ground, bcs = body(lines(8), down, h * np.arange(1, 7))
shoulder, tip = (R - a0) / np.tan(beta), -a0 / np.tan(beta)
outline = [(0, tip), (R, shoulder), (R, 20 * R), (-R, 20 * R), (-R, shoulder)]
bore, surface = mpm.region(x=a0), mpm.region(y=0.0)
top = mpm.facet_tags(ground.mesh, {1: surface})
free = mpm.facet_tags(ground.mesh, {1: lambda x: bore(x) | surface(x)})
look = {"facets": (free, 1), "axisymmetric": True, "modulus": E}
guide = mpm.contact.Rigid(ground, mpm.contact.box((-a0, -40.0), (a0, 40.0)), **look)
pile = mpm.contact.Rigid(ground, mpm.contact.polygon(outline, radius=0.4 * R), **look)
problem = mpm.QuasiStaticProblem(
    mpm.Body(ground, pressures=[(p0, 1)], facet_tags=top, **soil),
    bcs,
    terms=[pile, guide],
    axisymmetric=True,
)
problem.solve(1)
rows = []
for _ in problem.steps(50, update=lambda t: pile.move((0.0, -5 * R * t))):
    base = problem.reaction(bcs[1])[1] - p0 * np.pi * (lines(8)[-1] ** 2 - R**2)
    rows.append((-shoulder - pile.offset[1], -problem.reaction(pile)[1], base))

# ## Result
#
# The hole takes the exact pressure. The base bears what the pile presses with, besides $p_0$ on the
# rest of the top (of which the tip takes less at first). The force passes the rule at a depth of
# 0.6 radii and is 46 % above it at 3.7 (55 % with `penalty=4`): the rule knows nothing of the sand
# that is driven down.

L, force, base = np.array(rows).T
rule = np.pi * (R**2 - a0**2) * pressure(R / a0, 2, 970.0)
deep, error = L > 2 * R, abs(p / exact - 1).max()
ratio, balance = force[deep].mean() / rule, abs(base[deep] / force[deep] - 1).max()
if comm.rank == 0:
    solves = problem.history.total_iterations
    print(f"{ground.num_global} domains, {solves} linear solves")
    print(f"hole: pressure {p[-1]:.0f} kPa, exact {exact[-1]:.0f} kPa")
    print(f"pile: force {force[-1]:.0f} kN, by the base {base[-1]:.0f} kN")
    print(f"pile: from 2 radii on {ratio:.2f} of the rule")

axes = dict.fromkeys(("sand", "hole", "force"))
if comm.rank == 0:
    figure, axes = plt.subplot_mosaic([list(axes)], figsize=(14, 5.2), layout="compressed")
view = {"limits": (0.0, 2.0), "background": False, "title": ""}
mpm.plot.scene(problem, "plastic_strain", ax=axes["sand"], **view)
if comm.rank == 0:
    axes["sand"].set(xlim=(-0.4, 1.2), ylim=(-1.9, 0.4), xlabel="r, m", ylabel="z, m")
    axes["hole"].plot(a / a0, exact, "k--", lw=1, label="exact (1)")
    axes["hole"].plot(a / a0, p, "o", ms=4, label="computed")
    axes["hole"].set(xlabel="radius of the hole over $a_0$", ylabel="pressure, kPa", ylim=(0, 700))
    axes["force"].plot(force, L, label="pile")
    axes["force"].plot(base, L, "k:", label="by the base")
    axes["force"].axvline(rule, color="0.6", label="rule")
    axes["force"].set(xlabel="force, kN", ylabel="depth L, m", xlim=0.0, ylim=(L[-1], L[0]))
    axes["hole"].legend(loc="lower right")
    axes["force"].legend(loc="lower left")
    figure.savefig("pile_sand.png", dpi=110)

assert error < 0.04
assert balance < 0.01
assert abs(ratio - 1.4) < 0.1

# ## Exercises
#
# 1. Give the pile a friction of 0.2. How much more does the tip bear, and what does the shaft?
# 2. Take a tip of 40°, or sand three times as stiff. What of the rule?
