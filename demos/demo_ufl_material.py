# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.2: A neo-Hookean energy, grips that ride on the body

# # Your own material in UFL: a rubber block is squeezed and turned
#
# It illustrates how to:
# - turn a hyperelasticity script for finite elements into a material point method,
# - write a support on the body itself, a grip that rides on it, as a boundary term in UFL,
# - prescribe a path with `update=`: squeeze first, then turn by a right angle,
# - check objectivity: a body that turns must not be strained by turning.
#
# ## Problem
#
# A block of rubber, 2 by 1, is held at its left and right faces by two glued grips. They move
# towards each other until the block is 30 % shorter, and then turn about its centre by 90
# degrees, carrying it through the whole background. The stored energy is neo-Hookean (plane
# strain), and the grips hold the faces $\Gamma$ by a thin layer of stiff glue:
#
# $$
# \Pi(d) = \int \frac{\mu}{2} (F : F - 2) - \mu \ln J + \frac{\kappa}{2} (\ln J)^2\, \mathrm{d}X
#    + \int_\Gamma \frac{k}{2}\, |d - \bar d(t)|^2\, \mathrm{d}S. \tag{1}
# $$
#
# Dirichlet conditions live on the background, which never moves: they suit walls and floors. A
# grip that turns holds the *body*, so it is written on the body, whose facets are fixed in its
# mesh. With a rotation $R$ by the angle $\theta$ and a shortening $s$,
#
# $$
# \bar d(t) = X_c + R(\theta(t))\, \mathrm{diag}(1 - s(t), 1)\, (X - X_c) - X. \tag{2}
# $$
#
# A rotation is linear in the present position, so the background represents it exactly: while the
# grips turn, the energy cannot grow.

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
young, poisson, ANGLE = 1e4, 0.3, np.pi / 2  # Pa, -, -
mu, kappa = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
glue, CENTRE = 100 * young, np.array([0.01, 0.03])  # Pa/m, m


def stored(d):
    """The energy of the rubber, as in any script for finite elements."""
    F = ufl.Identity(2) + ufl.grad(d)
    J = ufl.det(F)
    return mu / 2 * (ufl.inner(F, F) - 2) - mu * ufl.ln(J) + kappa / 2 * ufl.ln(J) ** 2


# The block lies off the grid lines of a background of 3 by 3, two by two domains in a cell.
# Quadrilaterals take 2 by 2 quadrature points: one would not see hourglass modes.


def run(shortening, steps):
    background = mesh.create_rectangle(comm, [[-1.5, -1.5], [1.5, 1.5]], [24, 24], quadrilateral)
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    half = np.array([1.0, 0.5])
    corners = [CENTRE - half, CENTRE + half]
    body = mesh.create_rectangle(comm, corners, [32, 16], quadrilateral)
    particles = mpm.Particles(body, V, quadrature_degree=3)

    left, right = mpm.region(x=CENTRE[0] - half[0]), mpm.region(x=CENTRE[0] + half[0])
    tags = mpm.facet_tags(body, {1: lambda x: left(x) | right(x)})
    ds = ufl.Measure("ds", domain=body, subdomain_data=tags, metadata={"quadrature_degree": 3})
    s, theta = fem.Constant(body, 0.0), fem.Constant(body, 0.0)
    X, centre = ufl.SpatialCoordinate(body), ufl.as_vector(CENTRE)
    R = ufl.as_matrix([[ufl.cos(theta), -ufl.sin(theta)], [ufl.sin(theta), ufl.cos(theta)]])
    grips = centre + R * ufl.as_matrix([[1 - s, 0], [0, 1]]) * (X - centre) - X

    # Unknown, test functions and measure are the particles'. That is all.

    d, v = particles.displacement, ufl.TestFunction(particles.W)
    energy = stored(d) * particles.dx + glue / 2 * ufl.inner(d - grips, d - grips) * ds(1)
    problem = mpm.ParticleProblem(ufl.derivative(energy, d, v), particles)

    def path(t):
        begin = 0.5 if shortening else 0.0  # of the turn
        s.value = shortening * min(t / 0.5, 1.0)
        theta.value = ANGLE * max(t - begin, 0.0) / (1.0 - begin)

    total = fem.form(energy)
    track = []
    for step in problem.steps(steps, update=path):
        track.append((step.load, comm.allreduce(fem.assemble_scalar(total))))
    return problem, np.array(track)


# ## Result
#
# The squeezed and turned block; and one that is turned only, which must follow as a rigid body.

problem, track = run(0.3, 40)
turning = track[track[:, 0] >= 0.5 - 1e-12, 1]
rigid, _ = run(0.0, 20)
F = rigid.particles.deformation_gradient
strain = np.abs(np.swapaxes(F, 1, 2) @ F - np.eye(3)).max(initial=0.0)
strain = comm.allreduce(strain, MPI.MAX)
if comm.rank == 0:
    for name, at in (("squeezed", 19), ("turned by 45 degrees", 29), ("turned by 90 degrees", 39)):
        print(f"{name:21s} energy {track[at, 1]:.4f} J/m")
    print(f"strain of a rigid turn: {strain:.0e}")
mpm.plot.scene(problem, "volume_ratio", "ufl_material.png")

assert np.all(np.diff(turning) < 1e-9 * turning[0])
assert strain < 1e-8

# ## Exercises
#
# 1. Make finite elements of it: a Function on the body's mesh, DOLFINx's `NonlinearProblem`. Is
#    their energy below the particles'? (It must be: the background can only stiffen the body.)
# 2. Give the block a Mooney-Rivlin energy. Which lines change?
