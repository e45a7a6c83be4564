# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.9: Elastic die and block: contact of two bodies, friction

# # Ironing
#
# It illustrates how to:
# - give two bodies a background each, so that they do not stick to each other,
# - let them meet by `mpm.contact.Pair`, with friction,
# - hold a body on its own boundary along a path, and read forces and tractions of a contact.
#
# ## Problem
#
# An elastic die with a round face is pressed into an elastic block by $0.02$, and then drawn along
# it by $1.4$. Both are of Hencky's law with $E$ = 1000 and $\nu$ = 0.3. Where a point of one body
# has come behind a facet of the other, at a gap $g < 0$, the surfaces act on each other with
#
# $$
# p = k\, \langle -g \rangle, \qquad |t| \le \mu\, p, \tag{1}
# $$
#
# pressure $p$ and shear traction $t$, which reaches its bound where the point slides. The stiffness
# $k$ is that of one layer of domains. As long as the die slides the forces on it should be steady:
# normal force $N$ and $T = \mu N$, whatever facets, domains and background cells it passes.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
friction, depth, way, radius = 0.3, 0.02, 1.4, 0.6
steps, h = 40, 0.125

quadrilateral = mesh.CellType.quadrilateral


def background(corner):
    """A background of its own, which need not match the other one."""
    x, y = corner
    domain = mesh.create_rectangle(
        comm, [[x, y], [x + 36 * h, y + 14 * h]], [36, 14], quadrilateral
    )
    return fem.functionspace(domain, ("Lagrange", 1, (2,)))


die = mesh.create_rectangle(comm, [[0.3, 0.6], [1.1, 1.0]], [10, 5], quadrilateral)
x = die.geometry.x
x[:, 1] += (radius - np.sqrt(radius**2 - (x[:, 0] - 0.7) ** 2)) * (1.0 - (x[:, 1] - 0.6) / 0.4)
block = mesh.create_rectangle(comm, [[0.0, 0.0], [3.0, 0.6]], [48, 9], quadrilateral)

a = mpm.Particles(die, background((-0.47, -0.46)), quadrature_degree=2)
b = mpm.Particles(block, background((-0.45, -0.49)), quadrature_degree=2)
touch = mpm.contact.Pair(a, b, friction)

# The die is held on its top, the block on its base. The top goes along a path of the parameter $t$:
# down up to $t = 0.2$, then to the right. `value=` of a support is a displacement.

top = mpm.facet_tags(die, {1: mpm.region(y=1.0)})
base = mpm.facet_tags(block, {1: mpm.region(y=0.0)})
position = fem.Constant(die, (0.0, 0.0))
problem = mpm.QuasiStaticProblem(
    [
        mpm.Body(a, mpm.materials.Hencky(1e3, 0.3), facet_tags=top),
        mpm.Body(b, mpm.materials.Hencky(1e3, 0.3), facet_tags=base),
    ],
    supports=[mpm.boundary.fixed(a, top, 1, value=position), mpm.boundary.fixed(b, base, 1)],
    terms=[touch],
)


def path(t):
    """Where the top is at t."""
    position.value[:] = way * max(0.0, t - 0.2) / 0.8, -depth * min(1.0, t / 0.2)


figure, axes = plt.subplot_mosaic(
    [["bodies"], ["forces"]], figsize=(9, 6.5), layout="constrained", height_ratios=(3, 2)
)


def draw(ax):
    """Draw the largest shear stress of both, and tractions on the die."""
    for body in (a, b):
        s = body.stress
        shear = np.hypot(0.5 * (s[:, 0, 0] - s[:, 1, 1]), s[:, 0, 1])
        drawn = mpm.plot.domains(body, shear, ax=ax, cmap="magma_r", vmin=0, vmax=25, lw=0.2)
    where = comm.gather(touch.points[touch.touches])
    acts = comm.gather(touch.traction[touch.touches])
    if comm.rank == 0:
        style = {"color": "C0", "width": 0.0015, "scale": 500}
        ax.quiver(*np.concatenate(where).T, *np.concatenate(acts).T, **style)
        ax.set(xlim=(0.0, 3.0), ylim=(-0.02, 1.08), xticks=[], yticks=[])
        ax.set_title("largest shear stress, tractions on the die")
        figure.colorbar(drawn, ax=ax, shrink=0.8)


forces, solves = [], []
for step in problem.steps(steps, update=path):
    force = problem.reaction(touch)
    forces.append((step.load, -force[0], force[1]))
    solves.append(step.iterations)
    if len(forces) == 28:
        draw(axes["bodies"])
t, shear, normal = np.array(forces).T

# ## Result

slides = t > 0.5
scatter = normal[slides].std() / normal[slides].mean()
ratio = shear[slides] / normal[slides]
if comm.rank == 0:
    print(f"normal force while it slides   {normal[slides].mean():.2f}")
    print(f"its scatter                    {100 * scatter:.2f} %")
    least, most = ratio.min(), ratio.max()
    print(f"T / N, mean (least, most)      {ratio.mean():.3f}", f"({least:.3f}, {most:.3f})")
    print(f"linear solves in a step        {np.mean(solves):.1f}")

    ax = axes["forces"]
    ax.plot(t, normal, "C0", label="$N$")
    ax.plot(t, shear, "C3", label="$T$")
    ax.plot(t, friction * normal, "C3:", label=r"$\mu N$")
    ax.set(xlabel="$t$", ylabel="force on the die", ylim=(0.0, None))
    ax.legend(loc="center right")
    figure.savefig("ironing.png", dpi=150)

# Drawn aside by 0.04, the die already slides. From there on both forces are steady, though facets
# of 0.08 slide over facets of 0.06, and each meets the kinks between the other body's facets.
# $T / N$ is not quite $\mu$: each point has $|t| = \mu p$ (1), but along facets that incline.

assert scatter < 5e-3 and 0.29 < ratio.min() and ratio.max() < 0.31
assert problem.history.cutbacks == 0 and np.mean(solves) < 4.0

# ## Exercises
#
# 1. Take `passes=1`, and then exchange the two bodies. Which one should have the points?
# 2. Take `penalty=1000`. How do scatter and the number of linear solves change, and why?
# 3. Give both bodies the same V and leave the pair out. What bears the die now, and does it slide?
