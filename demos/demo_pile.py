# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.8

# # A pile is pressed into clay
#
# It illustrates how to:
# - drive an obstacle in for many of its radii, in a body of revolution,
# - begin with the stress of the ground, which keeps clay on the shaft,
# - let clay adhere to a surface, and part the force of a contact.
#
# ## Problem
#
# A pile of radius $R$ = 0.25 m with a tip of 60° is pressed 1.5 m down into very soft clay. The
# clay is undrained (von Mises) with the strength $c$ = 5 kPa in shear, $G = 100\, c$, $\nu$ =
# 0.49 and 2 t/m3. Its stress is the same in all directions at first. It adheres to the pile
# with $\alpha c$, $\alpha$ = 0.5. With the level $L$ of the tip's shoulder below the ground,
# the force is
#
# $$
# Q = \pi R^2 (\sigma_v + N c) + 2 \pi R\, \alpha c\, (L - L_0), \qquad
# N \approx 6 \left( 1 + 0.2\, \frac{L}{2R} \right) \leq 9, \tag{1}
# $$
#
# with the stress $\sigma_v$ of the ground at the shoulder. The slope of the second term is
# exact where clay is pressed on the shaft. Near the ground, down to $L_0$, it stands off. $N$
# is Skempton's rule (1951) for round foundations. For cones far deeper than here there are
# numerical solutions: $N$ = 10.8 (Teh and Houlsby 1991) and 11.4 (Lu et al. 2004) with this
# stiffness and adhesion.
#
# A mesh of clay cannot part below a tip. So it has a hole around the axis, filled by a thin
# smooth rod of radius $R/4$ that does not move: the pile goes down along it, and its tip widens
# the hole. The rod takes the place of 6 % of the clay that is pushed aside.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
R, c, G, poisson, density, adhesion = 0.25, 5.0, 500.0, 0.49, 2.0, 0.5
gravity, depth, way, h = (0.0, -9.81), 3.0, 1.5, 0.0625


def lines(fine, end):
    """Places from 0 to `end`, at first `h` apart, then each a fifth farther."""
    steps = h * 1.2 ** np.maximum(np.arange(100) - round(fine / h) + 1, 0)
    along = np.append(0.0, np.cumsum(steps))
    along = along[: np.searchsorted(along, end) + 1]
    stretch = (end - fine) / (along[-1] - fine)
    return np.where(along > fine, fine + (along - fine) * stretch, along)


def grid(x, y):
    """A mesh of quadrilaterals with given lines."""
    n = len(x) - 1, len(y) - 1
    made = mesh.create_rectangle(comm, [(0.0, 0.0), n], n, mesh.CellType.quadrilateral)
    places = made.geometry.x
    for i, along in enumerate((x, y)):
        places[:, i] = np.interp(places[:, i], np.arange(len(along)), along)
    return made


def halved(along):
    """Lines with one more between each two."""
    return np.interp(np.arange(2 * len(along) - 1) / 2, np.arange(len(along)), along)


# The background reaches from the axis to 14 radii, and above the ground. The clay begins at the
# rod.

across, down = lines(2 * R, 14 * R), -lines(7.5 * R, depth)[::-1]
room = np.append(down, h * np.arange(1, 7))
V = fem.functionspace(grid(across, room), ("Lagrange", 1, (2,)))
clay = mpm.Particles(grid(halved(across)[2:], halved(down)), V, quadrature_degree=2)


def held(component, where):
    """A roller on dofs of the background."""
    space, facets = V.sub(component), mesh.locate_entities_boundary(V.mesh, 1, where)
    return fem.dirichletbc(0.0, fem.locate_dofs_topological(space, 1, facets), space)


# The stiffness of contact is in proportion to a modulus: 4 G here. By default it is the
# confined one, 51 G for this $\nu$, and points stick and slip by turns from one iteration to
# the next.

rod = mpm.contact.box((-h, -2 * depth), (h, 2 * depth))
shoulder, tip = (R - h) * np.sqrt(3.0), -h * np.sqrt(3.0)
outline = [(0, tip), (R, shoulder), (R, 2 * depth), (-R, 2 * depth), (-R, shoulder)]
free = mesh.locate_entities_boundary(
    clay.mesh, 1, lambda x: np.isclose(x[0], h) | np.isclose(x[1], 0.0)
)
tags = mesh.meshtags(clay.mesh, 1, np.sort(free), np.full(len(free), 1, np.int32))
look = {"facet_tags": tags, "tag": 1, "axisymmetric": True, "modulus": 4 * G}
guide = mpm.contact.Rigid(clay, rod, **look)
pile = mpm.contact.Rigid(
    clay,
    mpm.contact.polygon(outline, radius=0.3 * R),
    mpm.contact.Coulomb(cohesion=adhesion * c),
    tangential_penalty=0.1,
    **look,
)
problem = mpm.QuasiStaticProblem(
    clay,
    mpm.materials.VonMises(2 * G * (1 + poisson), poisson, rho_y=np.sqrt(2.0) * c),
    density=density,
    body_force=gravity,
    bcs=[
        held(0, lambda x: np.isclose(x[0], 14 * R)),
        held(1, lambda x: np.isclose(x[1], -depth)),
    ],
    terms=[pile, guide],
    axisymmetric=True,
    f_bar="patch",
    initial_stress=mpm.geostatic(0.0, density, 1.0, gravity),
)

rows = []
for step in problem.steps(80, update=lambda t: pile.move((0.0, -way * t))):
    level = shoulder + pile.offset[1]
    force = -pile.area * pile.traction[:, 1]
    beside = pile.points[:, 1] > level + 0.1 * R
    parts = [comm.allreduce(float(force[part].sum())) for part in (beside, ~beside)]
    rows.append((-level, *parts))

# ## Result
#
# The forces rise and fall a little, as facet after facet turns round the shoulder.

L, shaft, end = np.array(rows).T
N = (end / (np.pi * R**2) - density * 9.81 * np.maximum(L, 0.0)) / c
skempton = 6.0 * (1.0 + 0.1 * L / R)
deep, exact = L > 2.0 * R, 2.0 * np.pi * R * adhesion * c
slope, offset = np.polyfit(L[deep], shaft[deep], 1)
ratio = float(np.mean(N[deep] / skempton[deep]))
if comm.rank == 0:
    solves, begins = problem.history.total_iterations, -offset / slope
    print(f"{clay.num_global} domains, {solves} linear solves")
    print(f"shaft: {slope:.2f} kN/m, exact {exact:.2f}, from {begins:.2f} m on")
    print(f"tip: N = {N[-16:].mean():.1f} at the end, {ratio:.2f} of Skempton's")

axes = dict.fromkeys(("clay", "force", "N"))
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic([list(axes)], figsize=(14, 5.2), layout="compressed")
view = {"limits": (0.0, 2.0), "background": False, "title": ""}
mpm.plot.scene(problem, "plastic_strain", ax=axes["clay"], **view)
if comm.rank == 0:
    axes["clay"].set(xlim=(-0.4, 1.2), ylim=(-2.1, 0.4), xlabel="r, m", ylabel="z, m")
    axes["force"].plot(shaft + end, L, label="pile")
    axes["force"].plot(shaft, L, label="shaft")
    known = shaft[deep].mean() + exact * (L[deep] - L[deep].mean())
    axes["force"].plot(known, L[deep], "k--", lw=1, label="slope of (1)")
    axes["force"].set(xlabel="force, kN", ylabel="depth of the shoulder, m", xlim=0.0)
    axes["N"].plot(N, L, label="tip")
    axes["N"].plot(skempton, L, "k--", lw=1, label="Skempton")
    axes["N"].axvspan(10.8, 11.4, color="0.85", label="cones in great depth")
    axes["N"].set(xlabel="N", xlim=(0.0, 13.0))
    for name in ("force", "N"):
        axes[name].set_ylim(L[-1], 0.0)
        axes[name].legend(loc="lower left" if name == "N" else "upper right")
    fig.savefig("pile.png", dpi=110)

assert abs(slope / exact - 1.0) < 0.1
assert abs(ratio - 1.0) < 0.15

# ## Exercises
#
# 1. Take all of the strength on the shaft, or none. What becomes of $N$?
# 2. Take half of the density. How far down is the clay off the shaft?
# 3. Pull the pile out again. What holds it?
