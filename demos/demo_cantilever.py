# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 1

# # An elastic cantilever that bends by more than its length allows to ignore
#
# It illustrates how to:
# - load a face of the body by a traction that rides on it,
# - support a body at its end, on a grid line,
# - follow a point of the body through the run.
#
# The bending of a slender beam is hard for material point methods: its faces cut the background's
# cells anywhere, and where a face leaves a sliver of the body in a cell, the nodes of that cell
# have next to no stiffness. Codes of low order stop after a fraction of this load, or need a grid
# that is fine enough to hide it.
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
# ## Method
#
# A step's increment $u$ lives in the background space $V$ of degree $k$, and moves the nodes of
# domains whose displacement is of degree $m$ (`degree=` of the particles):
#
# $$
# d = d_n + T_n u, \qquad (T_n)_{ci} = N_i\bigl(X_c + d_n(X_c)\bigr). \tag{2}
# $$
#
# Domains of degree 2 or 3 have curved edges and several quadrature points. Where a cell is filled
# below one half, the increments of degree $k \ge 2$ are tied to the polynomials of the neighbours
# $K_1$, $K_2$ of each facet $F$ by a ghost penalty (`stabilisation=`),
#
# $$
# \sum_F \frac{\gamma\, G}{h^2} \int_{K_1 \cup K_2} (u_1 - u_2) \cdot (v_1 - v_2) \,\mathrm{d}x,
# \qquad \gamma = 10^{-4}, \tag{3}
# $$
#
# where $u_1$, $u_2$ are the polynomials of $u$ in either cell, continued over both. It vanishes for
# polynomials of degree $k$, so it takes no accuracy away.
#
# ## Reference
#
# Finite elements of degree 2 on the same continuum, converged to $10^{-4}$, give shortening and
# deflection of the middle of the tip over the length:
#
# $$
# \begin{array}{lcc}
# \text{root} & \text{shortening} & \text{deflection} \\
# \text{clamped} & 0.554005 & 0.825387 \\
# \text{pinned} & 0.555218 & 0.828139
# \end{array} \tag{4}
# $$
#
# Clamped, both components vanish on the root; pinned, only the horizontal one does, and the
# vertical one in the root's middle. (The inextensible elastica of a thin beam is another problem.)
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
ends = np.sort(mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[0], length)))
tags = mesh.meshtags(body, 1, ends, np.full(len(ends), 1, dtype=np.int32))

# The root stays on the grid line $x = 0$, so its condition is the background's.

side = mesh.locate_entities_boundary(background, 1, lambda x: np.isclose(x[0], 0.0))
clamp = fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(V, 1, side), V)

particles = mpm.Particles(body, V)
problem = mpm.QuasiStaticProblem(
    particles,
    mpm.materials.Hencky(young, poisson),
    bcs=[clamp],
    tractions=[((0.0, -load / depth), 1)],
    facet_tags=tags,
)

# The tip is the body's node at half depth of its end.

X = particles.W.tabulate_dof_coordinates()[: particles.W.dofmap.index_map.size_local, :2]
at_tip = np.isclose(X, (length, axis)).all(axis=1)


def tip():
    """Shortening and deflection of the tip over the length."""
    d = particles.displacement.x.array.reshape(-1, 2)[: len(X)]
    return -comm.allreduce(d[at_tip].sum(axis=0)) / length


path = [(0.0, 0.0, 0.0)]
for step in problem.steps(50):
    path.append((step.load, *tip()))

# ## Result

shortening, deflection = tip()
error = max(abs(shortening - REFERENCE[1.0][0]), abs(deflection - REFERENCE[1.0][1]))
history = problem.history
if comm.rank == 0:
    print(f"{particles.num_global} particles, {history.total_iterations} linear solves")
    print(f"shortening / length {shortening:.6f}, deflection / length {deflection:.6f}")
    print(f"larger error against finite elements (4): {error:.1e}")

# The picture: the beam on its background, and the tip's way beside that of the finite elements.

stress = particles.stress
deviator = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
mises = np.sqrt(1.5) * np.linalg.norm(deviator, axis=(1, 2))
fig, axes = None, {"beam": None}
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic([["beam", "tip"]], figsize=(13, 5.6), layout="constrained")
mpm.plot.background(V, ax=axes["beam"], color="0.88")
mpm.plot.domains(particles, ax=axes["beam"], warp=0.0, facecolor="0.94", edgecolor="0.75")
colours = mpm.plot.domains(particles, mises / 1e6, ax=axes["beam"], cmap="YlGnBu", vmin=0.0)
if comm.rank == 0:
    axes["beam"].set(xlim=(0.0, 11.0), ylim=(0.0, 10.0), xlabel="x, m", ylabel="y, m")
    fig.colorbar(colours, ax=axes["beam"], label="von Mises stress, MPa", shrink=0.8)
    way = np.array(path)
    for i, name in enumerate(("shortening", "deflection")):
        (line,) = axes["tip"].plot(way[:, 0], way[:, 1 + i], label=name)
        points = [(at, values[i]) for at, values in REFERENCE.items()]
        axes["tip"].plot(*np.transpose(points), "o", color=line.get_color(), mfc="white")
    axes["tip"].set(xlabel="load over 100 kN/m", ylabel="of the tip, over the length")
    axes["tip"].set_title("Lines: particles; rings: finite elements")
    axes["tip"].legend(loc="lower right")
    fig.savefig("cantilever.png", dpi=160)

# The numbers are known.

assert error < 1e-2
assert history.total_iterations <= 240 and history.cutbacks == 0
