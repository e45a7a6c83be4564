# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.14: An elastic bracket: where the error sits, and a few nodes that take it away

# # How large is the error, and where does it come from?
#
# It illustrates how to:
# - ask how large the error of a step is, and draw where it comes from,
# - have nodes freed there until it is as small as is asked for,
# - see what that costs beside finite elements.
#
# ## Problem
#
# An elastic bracket, an L with arms 2 m long and 1 m wide, is held at the end of one arm, and a
# traction pulls at the end of the other. For linear elasticity its work tells the error in energy,
#
# $$
# e = \sqrt{1 - W_h / W} , \qquad W_h = \int_\Gamma t \cdot d_h \, \mathrm{d}S , \tag{1}
# $$
#
# where $W$ is that of the exact displacement, which is infinitely steep at the corner.
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
law = mpm.materials.LinearElastic(2.5e3, 0.25)  # kPa
traction = (0.0, -1.0)  # kPa

# One step, with a tolerance for the error or without, of the bracket in cells 1 / n. Nodes can be
# freed of bodies that are made with `free=`, here at first none; without a background all are free.


def bracket(n):
    square = mesh.create_rectangle(comm, [[0.0, 0.0], [2.0, 2.0]], [2 * n, 2 * n], quadrilateral)
    own = np.arange(square.topology.index_map(2).size_local, dtype=np.int32)
    x = mesh.compute_midpoints(square, 2, own)
    return mesh.create_submesh(square, 2, own[(x[:, 0] < 1.0) | (x[:, 1] < 1.0)])[0]


def pulled(n, V=None, degree=1, adapt=None):
    free = None if adapt is None else []
    body = mpm.Particles(bracket(n), V, degree=degree, quadrature_degree=2 * degree, free=free)
    tags = mpm.facet_tags(body.mesh, {1: mpm.region(y=2.0), 2: mpm.region(x=2.0)})
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, law, tractions=[(traction, 2)], facet_tags=tags),
        supports=[mpm.boundary.fixed(body, tags, 1)],
    )
    problem.solve(1, adapt=adapt)
    power = ufl.inner(fem.Constant(body.mesh, traction), body.displacement)
    done = fem.form(power * ufl.ds(subdomain_data=tags, subdomain_id=2))
    work = comm.allreduce(fem.assemble_scalar(done))
    return problem, problem.history.statistics["free_dofs"], problem.error(), work


# The exact work, extrapolated from finite elements of degree 2.

coarse, middle, fine = (pulled(n, degree=2)[3] for n in (8, 16, 32))
exact = fine + (fine - middle) / ((middle - coarse) / (fine - middle) - 1.0)

# Carried by a background whose lines are not the bracket's, with nodes freed, and all free.

n, h = 32, 1.0 / 16  # m
ends = [[-0.63 * h] * 2, [2.0 + 2.37 * h] * 2]
grid = mesh.create_rectangle(comm, ends, [35, 35], quadrilateral)
V = fem.functionspace(grid, ("Lagrange", 1, (2,)))
runs = {
    "carried": pulled(n, V),
    "adapt=0.1": pulled(n, V, adapt=0.1),
    "adapt=0.08": pulled(n, V, adapt=0.08),
    "finite elements": pulled(n),
}

# ## Result

found = {}
for name, (_, unknowns, estimate, work) in runs.items():
    found[name] = np.sqrt(1.0 - work / exact)
    if comm.rank == 0:
        print(
            f"{name:15s} {unknowns} unknowns,", f"estimate {estimate:.3f}, error {found[name]:.3f}"
        )

fig, axes = None, {"carried": None, "adapt=0.08": None}
if comm.rank == 0:
    panels = [["carried", "adapt=0.08", "cost"]]
    fig, axes = plt.subplot_mosaic(panels, figsize=(16, 4.6), layout="compressed")
for name in ("carried", "adapt=0.08"):
    problem, body = runs[name][0], runs[name][0].particles
    mpm.plot.scene(problem, problem.error_of_particles(), ax=axes[name], limits=(0.0, 0.02))
    free = body.free[: body.W.dofmap.index_map.size_local]
    x = comm.gather(body.node_positions[: len(free)][free, :2])
    if comm.rank == 0:
        axes[name].plot(*np.concatenate(x).T, "o", ms=4, mfc="none", color="#d62728")
        axes[name].set(xlim=(0.5, 1.5), ylim=(0.5, 1.5), title=f"{name}: {runs[name][2]:.1%}")
if comm.rank == 0:
    names = [f"{name}\n{run[1]} unknowns" for name, run in runs.items()]
    axes["cost"].barh(names, list(found.values()), color="C0", label="error")
    axes["cost"].plot([run[2] for run in runs.values()], names, "kd", label="estimate")
    axes["cost"].set(xlabel="error in energy, relative", ylim=(3.5, -0.5))
    axes["cost"].legend()
    fig.savefig("bracket.png", dpi=130)

assert runs["adapt=0.08"][2] <= 0.08 and found["adapt=0.08"] < 0.65 * found["carried"]
assert all(0.75 < estimate / found[name] < 1.2 for name, (_, _, estimate, _) in runs.items())

# ## Exercises
#
# 1. Put the background's lines on those of the bracket. How many nodes have to be freed now?
# 2. Ask for an error of 0.05. What does the run say, and what does it want of you?
# 3. Take degree 2 for background and body. How many nodes are freed for 0.06?
