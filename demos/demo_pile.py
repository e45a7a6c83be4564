# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.8: Undrained clay, adhesion, six radii deep; axisymmetric

# # A pile is pressed into clay
#
# It illustrates how to:
# - drive an obstacle in by many radii, in an axisymmetric problem,
# - let clay adhere to a surface, and find where it is in contact.
#
# ## Problem
#
# A pile of radius $R$ = 0.25 m with a tip of 60° is pressed 1.5 m down into soft undrained clay
# (von Mises): strength in shear $c$ = 5 kPa, $G = 100\, c$, $\nu$ = 0.49, 2 t/m3, at first under
# the same stress in all directions. It adheres to the pile with $\alpha c$, $\alpha$ = 0.5.
# With the depth $L$ of the tip's shoulder and the length $\ell$ where clay touches the shaft,
#
# $$
# Q_\text{shaft} = 2 \pi R \ell\, \alpha c, \quad
# Q_\text{tip} = A\, (\sigma_v + \sqrt{3}\, \alpha c + N c), \tag{1}
# $$
#
# with the stress $\sigma_v$ of the ground at the shoulder. What adheres is exact, on the shaft and
# on the cone of section $A$. Clay stands by itself near the ground, so $\ell$ is less than $L$. Of
# $N$ there are estimates: for a round foundation $6 + 0.6 L / R \leq 9$ (Skempton 1951).
#
# A mesh does not part below a tip. So the clay has a hole on the axis, filled by a thin smooth
# rod of radius $R/4$ that does not move. The pile goes down along it and widens the hole.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
R, c, G, nu, density, gravity = 0.25, 5.0, 500.0, 0.49, 2.0, (0.0, -9.81)
adhesion, way, h = 0.5 * c, 6 * R, R / 4


def lines(n, m):
    """Places `h` apart up to `n h`, then `m` more, each a fifth farther."""
    return h * np.append(np.arange(n + 1), n + np.cumsum(1.2 ** np.arange(1, m + 1)))


def grid(x, y, parts):
    """A mesh with given lines, and with `parts` cells between each two."""
    end = [len(x) - 1, len(y) - 1]
    shape = [parts * n for n in end]
    made = mesh.create_rectangle(comm, [(0.0, 0.0), end], shape, mesh.CellType.quadrilateral)
    for i, along in enumerate((x, y)):
        made.geometry.x[:, i] = np.interp(made.geometry.x[:, i], np.arange(len(along)), along)
    return made


across, down = lines(8, 12), -lines(30, 8)[::-1]
room = grid(across, np.append(down, h * np.arange(1, 7)), 1)
V = fem.functionspace(room, ("Lagrange", 1, (2,)))
clay = mpm.Particles(grid(across[1:], down, 2), V, quadrature_degree=2)
bcs = [mpm.held(V, 0, x=across[-1]), mpm.held(V, 1, y=down[0])]

# The stiffness of contact is in proportion to a modulus: 4 G here. By default it is the confined
# one, 51 G for this $\nu$, and points stick and slip by turns from one iteration to the next.

rod = mpm.contact.box((-h, -20 * R), (h, 20 * R))
shoulder, tip = (R - h) * np.sqrt(3.0), -h * np.sqrt(3.0)
outline = [(0, tip), (R, shoulder), (R, 20 * R), (-R, 20 * R), (-R, shoulder)]
steel = mpm.contact.polygon(outline, radius=0.3 * R)
hole, ground = mpm.region(x=h), mpm.region(y=0.0)
free = mpm.facet_tags(clay.mesh, {1: lambda x: hole(x) | ground(x)})
look = {"facets": (free, 1), "axisymmetric": True, "modulus": 4 * G}
adheres = mpm.contact.Coulomb(cohesion=adhesion, stiffness=0.1)
pile = mpm.contact.Rigid(clay, steel, adheres, **look)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        clay,
        mpm.materials.VonMises(2 * G * (1 + nu), nu, rho_y=np.sqrt(2.0) * c),
        density=density,
        body_force=gravity,
        f_bar="patch",
        initial_stress=mpm.geostatic(0.0, density, 1.0, gravity),
    ),
    bcs=bcs,
    terms=[pile, mpm.contact.Rigid(clay, rod, **look)],
    axisymmetric=True,
)


def gathered(values):
    """Values at the points of all ranks."""
    return np.concatenate(comm.allgather(values))


# Weight and the clay on the rod come before the path, on which they would grow with time. Points
# of the shaft, from 0.1 R above the shoulder where it is round no more, stand for the length half
# way to their neighbours.

problem.solve(1)
rows = []
for _ in problem.steps(80, update=lambda t: pile.move((0.0, -way * t))):
    level = shoulder + pile.offset[1]
    z = gathered(pile.points[:, 1])
    order = np.argsort(z)
    z, touches = z[order], gathered(pile.touches)[order]
    force = -gathered(pile.area * pile.traction[:, 1])[order]
    on = z > level + 0.1 * R
    rows.append((-level, force[on].sum(), force[~on].sum(), np.gradient(z)[on & touches].sum()))

# ## Result
#
# Above a depth of 1.3 radii a gap remains for good. Below, the clay returns to the shaft behind the
# tip, at first only a little of it and in the end nearly all. So from $L = 2 R$ on the force grows
# faster than that of a shaft in contact all along (grey), by 17 %; it is the adhesion of the clay
# in contact. $N$ rises and falls as facet after facet turns round the shoulder.

L, shaft, end, length = np.array(rows).T
borne, section = 2.0 * np.pi * R * adhesion, np.pi * (R**2 - h**2)
N = (end / section - density * 9.81 * np.maximum(L, 0.0) - np.sqrt(3.0) * adhesion) / c
skempton = np.minimum(6.0 + 0.6 * L / R, 9.0)
deep = L > 2.0 * R
touched = shaft[deep].sum() / (borne * length[deep].sum())
ratio = float(np.mean(N[deep] / skempton[deep]))
if comm.rank == 0:
    solves = problem.history.total_iterations
    print(f"{clay.num_global} domains, {solves} linear solves")
    print(f"force on the shaft over that of (1)  {touched:.3f}")
    print(f"N over Skempton's, mean              {ratio:.2f}")

axes = dict.fromkeys(("clay", "force", "N"))
if comm.rank == 0:
    figure, axes = plt.subplot_mosaic([list(axes)], figsize=(14, 5.2), layout="compressed")
    figure.get_layout_engine().set(w_pad=0.15)
view = {"limits": (0.0, 2.0), "background": False, "title": ""}
mpm.plot.scene(problem, "plastic_strain", ax=axes["clay"], **view)
if comm.rank == 0:
    axes["clay"].set(xlim=(-0.4, 1.2), ylim=(-2.1, 0.4), xlabel="r, m", ylabel="z, m")
    ax = axes["force"]
    ax.plot(shaft, L, "C1", lw=3, alpha=0.6, label="shaft")
    ax.plot(borne * length, L, "k--", lw=1, label=r"$2 \pi R \ell\, \alpha c$")
    ax.plot(borne * L, L, "0.6", lw=1, label=r"$2 \pi R L\, \alpha c$")
    ax.set(xlabel="force, kN", ylabel="depth L of the shoulder, m", xlim=(0.0, 4.0))
    axes["N"].plot(N, L, label="tip")
    axes["N"].plot(skempton, L, "k--", lw=1, label="Skempton (1951)")
    axes["N"].set(xlabel="N", xlim=(0.0, 11.0))
    for name, place in (("force", "upper right"), ("N", "lower left")):
        axes[name].set_ylim(L[-1], 0.0)
        axes[name].legend(loc=place)
    figure.savefig("pile.png", dpi=110)

assert abs(touched - 1.0) < 0.03
assert abs(ratio - 1.0) < 0.15

# ## Exercises
#
# 1. Take all of the strength on the shaft, or none. What becomes of $N$?
# 2. Take $R$ = 0.5 m, all lengths twice as large. How many radii down does clay touch the shaft?
# 3. Pull the pile out again. What holds it?
