# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.10: E and c of clay from a settlement curve, by derivatives of the run

# # Stiffness and strength of clay from a loading test
#
# It illustrates how to:
# - differentiate a run, with its plastic history, with respect to parameters of a law,
# - fit these parameters to a measured curve by the Gauss-Newton method,
# - estimate the uncertainty of the fit.
#
# ## Problem
#
# A flexible strip, 2 m wide, is loaded on undrained clay; its mean settlement $s_i$ is read at
# loads $q_i$ up to 100 kPa. At small loads the curve determines the stiffness $E$, at large ones
# the strength $c$. With the settlements $s(E, c)$ of a run and $x = (\ln E, \ln c)$ we look for
#
# $$
# \min_x\ \sum_i \left(\ln s_i(x) - \ln \bar s_i\right)^2, \qquad
# x \leftarrow x - J^+ (\ln s - \ln \bar s), \quad J_{ij} = \partial \ln s_i / \partial x_j. \tag{1}
# $$
#
# The readings here are synthetic: a run with $E$ = 12 MPa and $c$ = 25 kPa, and errors of 1 %.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
load, steps, error = 100e3, 10, 0.01
true, start = np.array([12e6, 25e3]), np.array([20e6, 35e3])

background = mesh.create_rectangle(comm, [[0.0, -3.0], [5.0, 0.5]], [20, 14], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
rollers = [mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=5.0), mpm.held(V, 1, y=-3.0)]


def settlements(values):
    """Settlements of one run at all loads, and their derivatives."""
    clay = mesh.create_rectangle(comm, [[0.0, -3.0], [5.0, 0.0]], [40, 24], quadrilateral)
    particles = mpm.Particles(clay, V, quadrature_degree=2)
    strip = mpm.facet_tags(clay, {1: lambda x: np.isclose(x[1], 0.0) & (x[0] < 1.0 + 1e-9)})
    law = mpm.materials.Tresca(young=values[0], poisson=0.45, cohesion=values[1])
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, law, pressures=[(load, 1)], facet_tags=strip, f_bar="patch"),
        bcs=rollers,
        solver=mpm.Solver(stabilisation="ghost"),
    )
    ds = ufl.Measure("ds", clay, subdomain_data=strip)
    mean = fem.form(-particles.displacement[1] * ds(1))  # the strip is 1 m to its axis

    def settlement():
        return comm.allreduce(fem.assemble_scalar(mean))

    gradient = mpm.Sensitivity(problem, [(law, "young"), (law, "cohesion")])
    found = [(settlement(), gradient.of(settlement)) for _ in problem.steps(steps)]
    return problem, np.array([s for s, _ in found]), np.array([slope for _, slope in found])


# One run gives a curve and its derivatives at each of its loads. A ghost penalty holds what small
# cuts of cells would let loose: derivatives are then smooth in the parameters.

problem, exact, _ = settlements(true)
measured = exact * (1.0 + error * np.random.default_rng(1).standard_normal(steps))
values, curves = start.copy(), []
for number in range(1, 6):
    _, found, slopes = settlements(values)
    curves.append(found)
    gap = np.log(found / measured)
    J = slopes * values / found[:, None]
    if comm.rank == 0:
        rms = np.sqrt(np.mean(gap**2))
        young, cohesion = values / (1e6, 1e3)
        told = f"E {young:.2f} MPa, c {cohesion:.2f} kPa"
        print(f"run {number}: {told}, misfit {100 * rms:.2f} %")
    change = np.linalg.lstsq(J, -gap, rcond=None)[0]
    values = values * np.exp(np.clip(change, -0.5, 0.5))

# ## Result
#
# Errors of the readings propagate to the parameters through (1): with the standard deviation
# $\sigma$ of $\ln \bar s$ their covariance is $\sigma^2 (J^T J)^{-1}$.

deviation = error * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
if comm.rank == 0:
    for name, value, part, right in zip("Ec", values, deviation, true, strict=True):
        told = f"standard deviation {100 * part:.1f} %; true {right:.4g}"
        print(f"{name} = {value:.4g} Pa, {told}")

# The picture: the readings, the curves of the runs, and the yielding clay at full load.

fig, axes = None, dict.fromkeys(("curves", "clay"))
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic(
        [["curves", "clay"]], figsize=(12, 4.2), layout="constrained", width_ratios=(1, 1.3)
    )
look = {"background": False, "title": "plastic strain at 100 kPa"}
mpm.plot.scene(problem, "plastic_strain", ax=axes["clay"], **look)
if comm.rank == 0:
    q = np.linspace(load / steps, load, steps) / 1e3
    ax = axes["curves"]
    for number, curve in enumerate(curves, 1):
        ax.plot(q, 1e3 * curve, color=plt.cm.viridis(1.0 - number / 6), label=f"run {number}")
    ax.plot(q, 1e3 * measured, "ko", mfc="none", label="readings")
    ax.set(xlabel="load, kPa", ylabel="settlement, mm", title="Fitted to a loading test")
    ax.invert_yaxis()
    ax.legend()
    axes["clay"].set(xlabel="x, m", ylabel="y, m")
    fig.savefig("calibration.png", dpi=110)

assert np.all(np.abs(values / true - 1.0) < 3.0 * deviation)
assert np.abs(change).max() < 1e-3

# ## Exercises
#
# 1. Use only readings at small loads, up to 40 kPa. What becomes of $c$ and of $J^T J$?
# 2. Take Poisson's ratio as a third parameter. Look at the deviations, and at the eigenvectors of
#    $J^T J$: which combination does the curve not determine?
# 3. Without `stabilisation="ghost"` plot the derivative by $E$ over $E$ within 10 %.
