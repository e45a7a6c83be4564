# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.15: A pit dug beside a sheet pile, anchored or not: bending moments by stages

# # A sheet pile beside a pit
#
# It illustrates how to:
# - put a wall much thinner than the cells into the ground, as cells with free nodes,
# - dig in stages, and place a grouted anchor in between,
# - read bending moments of the wall and the force in its anchor after each stage.
#
# ## Problem
#
# A sheet pile of 10 m with a bending stiffness of $E I$ = 30 MNm2/m is in 13 m of sand, on the
# left of which a pit is dug in steps of 1 m. Without an anchor the wall is a cantilever that the
# sand at its foot holds. With one, 1.5 m below its head and put in after the second step, it is a
# beam on two supports, and its largest moment is on the side of the pit. In both cases the moment
# $M$ and the shear force $Q$ of the wall follow from the earth pressures $p$ of both sides and the
# shear stresses $\tau$ on its faces, a thickness $t$ apart,
#
# $$
# Q' = p, \qquad M' = Q + t\, \tau, \tag{1}
# $$
#
# which the sand decides as it yields.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
WIDTH, DEPTH, PIT, LENGTH, THICKNESS = 20.0, 13.0, 7.0, 10.0, 0.2  # m
WEIGHT, GRAVITY = 1.8, (0.0, -10.0)  # t/m3, m/s2: forces in kN
TOE, MIDDLE, EDGE = DEPTH - LENGTH, PIT + THICKNESS / 2, PIT + THICKNESS
SAND, STEEL, BASE, SIDES = 1, 2, 1, 2

# Ground and wall are one mesh, with one cell across the wall. Degree 2 bends without locking, and
# free nodes in the wall and around it let it bend within the cells of the background.

across = np.concatenate(
    [
        np.linspace(0.0, PIT, 15),
        np.linspace(EDGE, EDGE + 6.0, 13),
        np.linspace(EDGE + 6.0, WIDTH, 8)[1:],
    ]
)
background = mesh.create_rectangle(comm, [[-0.5, -0.5], [20.5, 14.0]], [42, 29], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 2, (2,)))
sand = mpm.materials.MohrCoulomb(20e3, 0.3, cohesion=1.0, friction_angle=32.0, dilation_angle=4.0)
steel = mpm.materials.Hencky(12 * 30e3 / THICKNESS**3, 0.0)
axis = np.linspace((MIDDLE, TOE), (MIDDLE, DEPTH), 21)


def ground():
    """Level ground at rest with the wall in it, and tags of its cells."""
    body = mpm.grid(comm, [across, np.linspace(0.0, DEPTH, 27)], quadrilateral)
    wall = mpm.region(x=(PIT, EDGE), y=(TOE, DEPTH))
    cells = mpm.cell_tags(body, {SAND: mpm.region(y=(0.0, DEPTH)), STEEL: wall})
    ends = mpm.facet_tags(
        body,
        {BASE: mpm.region(y=0.0), SIDES: lambda x: np.isclose(np.abs(x[0] - 10.0), 10.0)},
    )
    near = mpm.region(x=(PIT - 0.5, EDGE + 0.5), y=(TOE - 0.5, DEPTH))
    particles = mpm.Particles(body, V, degree=2, free=near)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            {SAND: sand, STEEL: steel},
            density=WEIGHT,
            body_force=GRAVITY,
            cell_tags=cells,
            facet_tags=ends,
            initial_stress=mpm.geostatic(DEPTH, WEIGHT, 0.5, GRAVITY),
        ),
        supports=[
            mpm.boundary.fixed(particles, ends, BASE),
            mpm.boundary.roller(particles, ends, SIDES, normal=(1, 0)),
        ],
    )
    problem.solve()  # in equilibrium as it is
    return problem, particles, cells


# The anchor is a bar from the wall, with a free length of 6 m, which touches the ground at its ends
# alone (`degree=1`), and a body of grout. It is prestressed.

HEAD, GROUT, END = (MIDDLE, DEPTH - 1.5), (13.0, 9.7), (17.5, 8.4)


def anchor(particles):
    """A prestressed strand, per metre of wall."""
    points = np.vstack([HEAD, np.linspace(GROUT, END, 10)])
    return mpm.Truss(particles, points, 40e3, prestress=60.0, degree=1)


def dig(depths, anchored):
    """Dig; return the problem, and what wall and anchor bear each time."""
    problem, particles, cells = ground()
    strand, rows = None, []
    for depth in depths:
        if anchored and depth == 3.0:
            strand = anchor(particles)
            problem.stage("anchor", terms=[strand])
            problem.solve(2)
        pit = mpm.region(x=(0.0, PIT), y=(DEPTH - depth, DEPTH))
        problem.remove(pit, name=f"{depth:g} m")
        problem.solve(4)
        head = mpm.probe(particles, (MIDDLE, DEPTH))
        force = 0.0 if strand is None else strand.force[0]
        rows.append((depth, -head[0], force, mpm.section_forces(particles, axis, (cells, STEEL))))
    return problem, rows


free, cantilever = dig([1.0, 2.0, 3.0, 4.0], anchored=False)
held, supported = dig([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], anchored=True)

# ## Result

if comm.rank == 0:
    print("pit, m   wall       head, mm   moments, kNm/m   anchor, kN/m")
    for name, rows in (("free", cantilever), ("anchored", supported)):
        for depth, way, force, found in rows:
            low, high = found.moment.min(), found.moment.max()
            beside = f"{low:10.1f} {high:6.1f}{force:14.1f}"
            print(f"{depth:6.0f}   {name:9s}{1e3 * way:10.1f}{beside}")

figure, axes = plt.subplot_mosaic(
    [["scene", "free", "held"]], figsize=(13, 5.2), width_ratios=[2.2, 1, 1], layout="constrained"
)
look = {"cmap": "YlOrBr", "limits": (0.0, 0.01), "background": False}
mpm.plot.scene(held, "plastic_strain", ax=axes["scene"], **look)
axes["scene"].plot(*supported[-1][3].position.T, color="steelblue", linewidth=4)
axes["scene"].set(xlabel="x, m", ylabel="y, m")
for name, rows, title in (("free", cantilever, "free"), ("held", supported, "anchored")):
    ax = axes[name]
    for depth, _, _, found in rows:
        shade = plt.cm.viridis((depth - 1.0) / 6.0)
        ax.plot(found.moment, found.position[:, 1], color=shade, label=f"{depth:g} m")
    ax.axvline(0.0, color="black", linewidth=0.8)
    ax.set(xlabel="bending moment, kNm/m", ylabel="height, m", title=title, xlim=(-50, 50))
    ax.legend(title="pit", loc="lower right" if name == "free" else "lower left")
if comm.rank == 0:
    figure.savefig("sheet_pile.png", dpi=130)

# By (1) the shear force jumps at the anchor by the part of its force that is across the wall, and
# moments vanish at the ends of the wall.

*_, (_, _, force, found) = supported
height = found.position[:, 1]
k = np.searchsorted(height, HEAD[1])
below, above = (
    np.polyval(np.polyfit(height[i : i + 2], found.shear[i : i + 2], 1), HEAD[1])
    for i in (k - 2, k)
)
strand = np.subtract(GROUT, HEAD)
jump = force * strand[0] / np.linalg.norm(strand)
if comm.rank == 0:
    print(f"shear force at the anchor jumps by {below - above:.1f} kN/m")
    print(f"across the wall the anchor bears {jump:.1f} kN/m")
assert abs(below - above - jump) < 0.05 * jump
assert abs(found.moment[[0, -1]]).max() < 0.1 * abs(found.moment).max()
assert force > supported[2][2] and supported[3][1] < 0.5 * cantilever[3][1]

# ## Exercises
#
# 1. Dig on to 5 m beside the free wall. By how much do its moment and the way of its head grow?
# 2. Let the wall slip: a body of finite elements of its own, and a `Pair` with friction on either
#    side.
# 3. Make the wall 2 m shorter, and dig to 7 m beside the anchored one. What becomes of its moment?
