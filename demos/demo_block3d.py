# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2

# # A block squeezed between plates
#
# It illustrates how to:
# - solve in three dimensions, with hexahedra or tetrahedra as particle domains,
# - choose a frame in which the conditions on the background stay what they are,
# - drive a body by a plane that moves: a pressure that depends on the displacement,
# - follow a path, `update=`, and find a reaction,
# - make a picture in space.
#
# ## Problem
#
# A cube of 2 m lies between two stiff plates, which come together until its height is 60 % of what
# it was. Between rough plates it bulges to a barrel; between smooth ones it stays a block, for
# which the answer is known. The material is von Mises', perfectly plastic:
#
# $$
# f = \frac{\sqrt{2 J_2}}{\rho_y} - 1 \le 0, \qquad E = 10\ \mathrm{MPa}, \quad \nu = 0.3, \quad
# \sigma_y = \sqrt{3/2}\, \rho_y = 100\ \mathrm{kPa}. \tag{1}
# $$
#
# ## Frame and conditions
#
# Three planes of symmetry leave an eighth of the cube, 1 m each way. Conditions are on nodes of the
# background, which is reset after each step: a set of nodes that is right at first must be right
# at the end. The nodes near a plate that moves are not such a set. So the plate stays, at
# $z = 0$, and the plane of symmetry half-way between the plates comes down to it:
#
# - on the background's nodes at $z = 0$, $u = 0$ (rough) or $u_z = 0$ (smooth),
# - on those at $x = 0$ and at $y = 0$, $u_x = 0$ and $u_y = 0$,
# - the top of the body stays in the plane $z = h(t) = 1 - 0.4\, t$.
#
# The last is a condition on the body, whose top is where it was made and rides along. A pressure
# does it, on facets that are tagged,
#
# $$
# p = k\, (z - h(t)), \qquad z = X_z + d_z, \qquad k = 1000\, E / L, \tag{2}
# $$
#
# a bed of very stiff springs, without friction. It acts along the normal of the deformed facets and
# depends on $d$; both are in the tangent. Material that rolls from the side onto the plate
# meets the nodes at $z = 0$ and stays there.
#
# ## What is known
#
# Volume changes by elasticity alone. Between smooth plates the Kirchhoff stress is $-\sigma_y$
# along $z$, so that at the relative height $\lambda$ the force on a plate and the volume are
#
# $$
# N = \sigma_y \frac{A_0}{\lambda}, \qquad
# J = \exp\Bigl(-\frac{\sigma_y}{3 K}\Bigr). \tag{3}
# $$
#
# At rough plates the force is larger, as friction holds the ends together. Elements of low order
# exaggerate it: they cannot flow at constant volume as freely as the material (locking), and the
# force falls with the size of the cells. The shape is hardly touched by that.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
young, poisson, yield_stress = 10e6, 0.3, 100e3  # Pa, -, Pa
squeeze, stiffness, elements = 0.4, 1000.0 * young, 4  # m, Pa/m, cells in 1 m
TOP = 1

# The background is a cell higher than the eighth and twice as wide; a cell holds two hexahedra
# each way, which have eight quadrature points here: with
# a single one they have modes of motion without any strain there, and in a flow as free as this
# one those grow until domains are lost.

h = 1.0 / elements
background = mesh.create_box(
    comm,
    [[0.0, 0.0, 0.0], [2.0, 2.0, 1.0 + h]],
    [2 * elements, 2 * elements, elements + 1],
    mesh.CellType.hexahedron,
)
V = fem.functionspace(background, ("Lagrange", 1, (3,)))
body = mesh.create_box(
    comm,
    [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]],
    [2 * elements] * 3,
    mesh.CellType.hexahedron,
)
particles = mpm.Particles(body, V, quadrature_degree=2)

# Conditions on the background's three planes. Those of the plate are one for each direction.


def held(component, plane):
    facets = mesh.locate_entities_boundary(background, 2, lambda x: np.isclose(x[plane], 0.0))
    dofs = fem.locate_dofs_topological(V.sub(component), 2, facets)
    return fem.dirichletbc(0.0, dofs, V.sub(component))


plate = held(2, 2)
bcs = [held(0, 0), held(1, 1), plate, held(0, 2), held(1, 2)]

# The plane (2) is UFL on the body mesh, as any load may be. Loads are multiplied by
# `particles.load`; a path sets it to one if the load's size is its own affair.

top = mesh.locate_entities_boundary(body, 2, lambda x: np.isclose(x[2], 1.0))
tags = mesh.meshtags(body, 2, np.sort(top), np.full(len(top), TOP, dtype=np.int32))
plane = fem.Constant(body, 1.0)
above = ufl.SpatialCoordinate(body)[2] + particles.displacement[2] - plane
problem = mpm.QuasiStaticProblem(
    particles,
    mpm.materials.VonMises(young, poisson, yield_stress=yield_stress),
    bcs=bcs,
    pressures=[(stiffness * above, TOP)],
    facet_tags=tags,
)


def update(t):
    plane.value = 1.0 - squeeze * t
    particles.load.value = 1.0


curve = [(0.0, 0.0)]
for step in problem.steps(40, update):
    curve.append((squeeze * step.load, problem.reaction(plate)[2]))

# ## Result
#
# The height, from the nodes of the top; the barrel, the largest over the smallest distance from
# the axis along the edge of the side face that lies in the plane $y = 0$; the volume, which should
# be about that of (3); and the reaction of the whole plate, four times the quarter's.

# Sums and extremes over all ranks, each a collective call.


def total(values):
    return comm.allreduce(float(np.sum(values)), MPI.SUM)


def mean(values, weights):
    return total(values * weights) / total(weights)


def largest(values):
    return comm.allreduce(float(np.max(values, initial=-np.inf)), MPI.MAX)


def nodes(particles):
    """Present positions of the nodes that this rank owns."""
    own, gdim = particles.W.dofmap.index_map.size_local, particles.mesh.geometry.dim
    d = particles.displacement.x.array.reshape(-1, gdim)[:own]
    return particles.W.tabulate_dof_coordinates()[:own, :gdim] + d


own = particles.W.dofmap.index_map.size_local
X, x = particles.W.tabulate_dof_coordinates()[:own], nodes(particles)
height = 2.0 * mean(x[:, 2], np.isclose(X[:, 2], 1.0))
profile = np.isclose(X[:, 0], 1.0) & np.isclose(X[:, 1], 0.0)
barrel = largest(x[profile, 0]) / -largest(-x[profile, 0])
bulk = young / (3.0 * (1.0 - 2.0 * poisson))
J = np.exp(-yield_stress / (3.0 * bulk))
volume_error = total(particles.volume) / (J * total(particles.initial_volume)) - 1.0
reaction = 4.0 * curve[-1][1]
smooth = 4.0 * yield_stress / (1.0 - curve[-1][0])

if comm.rank == 0:
    print(f"{particles.num_global} particles, {problem.history.total_iterations} linear solves")
    print(f"height {height:.5f} m of 2 m, barrel {barrel:.4f}")
    print(f"volume off by {100 * volume_error:.3f} %")
    print(f"force on a plate {reaction / 1e3:.2f} kN (smooth plates: {smooth / 1e3:.2f} kN)")

# The picture: the force over the approach of the plates. The body itself goes to a file for
# ParaView or pyvista: `mpm.plot.grid` gives the domains with all that is known of them.

grid = mpm.plot.grid(particles)
if comm.rank == 0:
    grid.save("block3d.vtu")
    way, force = np.array(curve).T
    fig, ax = plt.subplots(figsize=(6, 4.5), layout="constrained")
    ax.plot(100.0 * way, 4.0 * force / 1e3, "o-", label="rough plates")
    line = np.linspace(0.0, way[-1], 50)
    ax.plot(100 * line, 4e-3 * yield_stress / (1 - line), "--", label="smooth plates, exact (3)")
    ax.set(xlabel="approach of the plates, % of the height", ylabel="force on a plate, kN")
    ax.legend()
    fig.savefig("block3d.png", dpi=160)

# The numbers are known.

assert abs(height - 1.2) < 1e-3 and 1.4 < barrel < 1.55
assert abs(volume_error) < 0.015 and reaction > smooth
