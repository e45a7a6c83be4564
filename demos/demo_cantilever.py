# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1.6: Hencky's material, plane strain: the tip goes down by 83 % of the length

# # An elastic cantilever that bends by more than its length allows to ignore
#
# It illustrates how to:
# - load a face of the body by a traction that rides on it,
# - support a body at its end, on a grid line,
# - follow a point of the body through the run.
#
# ## Problem
#
# A beam, $L = 10$ m long and 1 m deep, in plane strain and without weight, is held at $x = 0$. A
# dead load $P = 100$ kN/m, spread over its end face, pulls the tip down in 50 steps:
#
# $$
# R(d; v) = \int P_1 : \nabla v \,\mathrm{d}X
#   - \lambda \int_{X_1 = L} t \cdot v \,\mathrm{d}S = 0,
# \qquad t = (0, -P / 1\,\mathrm{m}), \tag{1}
# $$
#
# with $P_1$ the first Piola stress and $\lambda$ the load factor. The material is Hencky's with
# $E = 12$ MPa and $\nu = 0.2$. The beam's end moves down by 83 % and inwards by 55 % of its length.
#
# ## Reference
#
# Finite elements of degree 2 on the same continuum, converged to $10^{-4}$, bring the middle of the
# tip inwards by 0.554005 and down by 0.825387 of the length.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
length, depth, axis = 10.0, 1.0, 9.5  # m
young, poisson, load = 12e6, 0.2, 100e3  # Pa, -, N/m
REFERENCE = {0.2: (0.153344, 0.487205), 0.6: (0.429610, 0.751601), 1.0: (0.554005, 0.825387)}

# The background is 11 m by 10 m in cells of 0.5 m, with two by two domains in each.

quadrilateral = mesh.CellType.quadrilateral
background = mesh.create_rectangle(comm, [[0.0, 0.0], [11.0, 10.0]], [22, 20], quadrilateral)
V = fem.functionspace(background, ("Lagrange", 1, (2,)))
body = mesh.create_rectangle(
    comm, [[0.0, axis - depth / 2.0], [length, axis + depth / 2.0]], [40, 4], quadrilateral
)
clamp = mpm.held(V, x=0.0)

particles = mpm.Particles(body, V)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.Hencky(young, poisson),
        tractions=[((0.0, -load / depth), 1)],
        facet_tags=mpm.facet_tags(body, {1: mpm.region(x=length)}),
    ),
    bcs=[clamp],
)

X = particles.W.tabulate_dof_coordinates()[: particles.W.dofmap.index_map.size_local, :2]
at_tip = np.isclose(X, (length, axis)).all(axis=1)


def tip():
    d = particles.displacement.x.array.reshape(-1, 2)[: len(X)]
    return -comm.allreduce(d[at_tip].sum(axis=0)) / length


path = [(0.0, 0.0, 0.0)]
for step in problem.steps(50):
    path.append((step.load, *tip()))

shortening, deflection = tip()
error = max(abs(shortening - REFERENCE[1.0][0]), abs(deflection - REFERENCE[1.0][1]))
history = problem.history
if comm.rank == 0:
    solves = history.total_iterations
    print(f"{particles.num_global} particles, {solves} linear solves")
    tip = f"shortening / length {shortening:.6f}, "
    print(tip + f"deflection / length {deflection:.6f}")
    print(f"larger error against finite elements: {error:.1e}")

fig, axes = None, {"beam": None}
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic([["beam", "tip"]], figsize=(9, 5), layout="compressed")
    fig.get_layout_engine().set(w_pad=0.15)
mpm.plot.scene(problem, "mises", ax=axes["beam"], label="von Mises stress, Pa")
if comm.rank == 0:
    way = np.array(path)
    for i, name in enumerate(("shortening", "deflection")):
        (line,) = axes["tip"].plot(way[:, 0], way[:, 1 + i], label=name)
        points = [(at, values[i]) for at, values in REFERENCE.items()]
        axes["tip"].plot(*np.transpose(points), "o", color=line.get_color(), mfc="white")
    axes["tip"].set(xlabel="load over 100 kN/m", ylabel="of the tip, over the length")
    axes["tip"].set_title("Lines: particles; rings: finite elements")
    axes["tip"].legend(loc="lower right")
    fig.savefig("cantilever.png", dpi=130)

assert error < 1e-2 and history.total_iterations <= 240

# ## Exercises
#
# 1. Use degree 2 for `V` and `degree=2` for the particles, with cells twice as large.
# 2. Spread the load over the upper face, dead, and by `pressures=`. Which bends the beam further?
