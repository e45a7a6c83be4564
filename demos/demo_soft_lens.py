# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.13: A field of stiffness from settlements of the surface, by backward derivatives

# # A soft lens in the ground, seen from its surface
#
# It illustrates how to:
# - differentiate a misfit with respect to the stiffness in each cell, at the cost of about one run,
# - let a minimiser find a stiffness field from displacements of the surface,
# - see what such measurements reveal, and what they do not.
#
# ## Problem
#
# A plate of 1 m loads the surface of a ground of 8 m x 2.4 m at one place after the other, and each
# time the settlement of the whole surface is surveyed. Somewhere below there is a lens that is
# softer than the rest. With the stiffness $E_k$ in patches $k$ of 0.5 m x 0.4 m,
# $m_k = \ln (E_k / E_0)$, and the settlements $\bar u_i$ of the surface $\Gamma$ under load $i$ we
# look for
#
# $$
# \min_m\ \frac{1}{2 \sigma^2} \sum_i \int_\Gamma (u_i(m) - \bar u_i)^2\,\mathrm{d}s
#   + \frac{\beta}{2} \sum_{k \sim l} (m_k - m_l)^2, \tag{1}
# $$
#
# where the last term makes neighbours $k \sim l$ similar, wherever the surface reveals nothing. The
# surveys here are synthetic, from runs with the lens and errors of $\sigma$ = 0.2 mm.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import minimize

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
length, depth, load, young = 8.0, 2.4, 200e3, 20e6
places, sigma, beta = (1.5, 3.0, 4.5, 6.0), 0.2e-3, 0.5
across, down = 16, 6  # patches

background = mesh.create_rectangle(comm, [[0, -depth], [length, 0.4]], [32, 14], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
rollers = [mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=length), mpm.held(V, 1, y=-depth)]
ground = mesh.create_rectangle(comm, [[0, -depth], [length, 0]], [64, 24], quadrilateral)
top = mpm.facet_tags(ground, {1: mpm.region(y=0.0)})
X, ds = ufl.SpatialCoordinate(ground), ufl.Measure("ds", ground, subdomain_data=top)

stiffness = fem.Function(fem.functionspace(ground, ("DG", 0)))
x, y = stiffness.function_space.tabulate_dof_coordinates()[:, :2].T
patch = (across * x / length).astype(int) + across * (down * -y / depth).astype(int)
own = stiffness.function_space.dofmap.index_map.size_local


def loaded(place):
    """A problem with the plate at a place."""
    particles = mpm.Particles(ground, V, quadrature_degree=2)
    pressure = ufl.conditional(abs(X[0] - place) < 0.5, load, 0.0)
    body = mpm.Body(
        particles,
        mpm.materials.Hencky(stiffness, 0.3),
        tractions=[(ufl.as_vector([0.0, -pressure]), 1)],
        facet_tags=top,
    )
    return mpm.QuasiStaticProblem(body, rollers, solver=mpm.Solver(stabilisation="ghost"))


# A survey is the displacement of a run with the lens, to which errors are added. (The Functions on
# the body are of its undeformed mesh, so that those of one run can be compared with another's.)

lens = ((x - 5.0) / 1.3) ** 2 + ((y + 0.9) / 0.45) ** 2 < 1.0
true = np.where(lens, 0.25 * young, young)
stiffness.x.array[:] = true
surveys, random = [], np.random.default_rng(comm.rank)
for place in places:
    problem = loaded(place)
    problem.solve(steps=2)
    survey = problem.particles.displacement.copy()
    survey.x.array[:] += sigma * random.standard_normal(survey.x.array.size)
    survey.x.scatter_forward()
    surveys.append(survey)

# ## The misfit and its slope
#
# `mpm.Adjoint` goes backward through a run and gives the slope by the stiffness of each cell. The
# one by $m_k$ is the sum of $E\, \partial / \partial E$ over the cells of patch $k$ then.


def misfit(m):
    """(1) and its derivatives by the values of m."""
    stiffness.x.array[:] = young * np.exp(m[patch])
    total, slope = 0.0, np.zeros(len(m))
    for place, survey in zip(places, surveys, strict=True):
        problem = loaded(place)
        adjoint = mpm.Adjoint(problem, [stiffness])
        problem.solve(steps=2)
        off = (problem.particles.displacement[1] - survey[1]) / sigma
        form = 0.5 * off**2 * ds(1)
        total += comm.allreduce(fem.assemble_scalar(fem.form(form)))
        (of_cells,) = adjoint.of(form)
        of_cells *= stiffness.x.array
        slope += comm.allreduce(np.bincount(patch[:own], of_cells[:own], minlength=len(m)))
    field = m.reshape(down, across)
    for axis in (0, 1):
        steps = np.diff(field, axis=axis)
        total += 0.5 * beta * np.sum(steps**2)
        ends = [(1, 1) if axis == a else (0, 0) for a in (0, 1)]
        slope -= beta * np.diff(np.pad(steps, ends), axis=axis).ravel()
    return total, slope


# The slope is that of the runs as they are computed; a difference along a direction shows it.

m, way = np.zeros(across * down), np.cos(np.arange(across * down))
first, slope = misfit(m)
difference = (misfit(m + 1e-5 * way)[0] - misfit(m - 1e-5 * way)[0]) / 2e-5
found = minimize(misfit, m, jac=True, method="L-BFGS-B", options={"maxiter": 25})

# ## Result

stiffness.x.array[:] = young * np.exp(found.x[patch])
gap = comm.allreduce(np.abs(slope @ way / difference - 1.0), MPI.MAX)
within = np.array([np.sum(np.log(stiffness.x.array[:own][lens[:own]] / young)), np.sum(lens[:own])])
above = (np.abs(x - 2.0) < 1.0)[:own]
beside = np.array([np.sum(np.log(stiffness.x.array[:own][above] / young)), np.sum(above)])
(inside, cells), (outside, others) = comm.allreduce(np.array([within, beside]))
soft, stiff = np.exp(inside / cells), np.exp(outside / others)
if comm.rank == 0:
    told = f"{slope @ way:.2f}, by a difference {difference:.2f}"
    print(f"slope along a direction {told}")
    print(f"misfit {first:.1f} to {found.fun:.1f} in {found.nfev} evaluations")
    told = f"in the lens {soft:.2f}, left of it {stiff:.2f}"
    print(f"mean stiffness over {young / 1e6:.0f} MPa {told}")

# The picture: the stiffness with which the surveys were made, that found, and a survey.

problem = loaded(places[2])
problem.solve(steps=2)
fig, axes = None, [None] * 3
if comm.rank == 0:
    fig, axes = plt.subplots(3, 1, figsize=(8.5, 8.0), layout="constrained", sharex=True)
ratio = stiffness.x.array[:own] / young
for ax, values, title in zip(
    axes, (true[:own] / young, ratio), ("made with", "found"), strict=False
):
    look = {"background": False, "title": f"stiffness over 20 MPa, {title}", "limits": (0.2, 1.3)}
    mpm.plot.scene(problem, values, ax=ax, **look)
if comm.size == 1:
    nodes = problem.particles.W.tabulate_dof_coordinates()
    row = np.flatnonzero(np.isclose(nodes[:, 1], 0.0))
    row = row[np.argsort(nodes[row, 0])]
    for place, survey in zip(places, surveys, strict=True):
        settled = 1e3 * survey.x.array[1::2][row]
        axes[2].plot(nodes[row, 0], settled, ".", ms=3, label=f"plate at {place} m")
    settled = 1e3 * problem.particles.displacement.x.array[1::2][row]
    axes[2].plot(nodes[row, 0], settled, "k", lw=0.8, label="with the stiffness found")
    axes[2].set(xlabel="x, m", ylabel="mm", ylim=(-31, 3), title="surveys of the surface")
    axes[2].legend(fontsize="small", loc="lower center", ncols=3)
if comm.rank == 0:
    fig.savefig("soft_lens.png", dpi=110)

assert gap < 1e-5
assert soft < 0.6 and abs(stiff - 1.0) < 0.1 and found.fun < 0.1 * first

# ## Exercises
#
# 1. Load one place only, $x$ = 4.5 m. What is left of the lens?
# 2. Put the lens at a depth of 1.8 m. How much of it does the surface tell?
# 3. With $\beta$ = 0.005 the misfit is smaller. Is the field better?
