# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.8: A hanging bar by MPM, GIMP, CPDI and CPDI2

# # When particles cross cells
#
# It illustrates how to:
# - run one problem with each of the four methods,
# - follow one particle through a run, on any number of ranks,
# - see the cell crossing error of the material point method, and what it comes from.
#
# ## Problem
#
# A bar, 8 m long and 1 m wide, hangs (to the right) under its weight $g_0$ per volume. With
# $\nu = 0$ it keeps its width, and the stress is the pull on all that is beyond a point:
#
# $$
# \sigma_{xx} = g_0 t\, (L - X), \qquad g_0 L = E\, \frac{\ln \lambda}{\lambda}, \tag{1}
# $$
#
# $\lambda = 1.5$ being the stretch at the held end; so a particle's grows in a straight line.
#
# ## What happens at a crossing
#
# The inner force at a node of the background is a sum over particles,
#
# $$
# f_i = \sum_p \sigma_p \cdot g_{ip}\, V_p, \qquad
# \sum_p g_{ip} V_p \approx \int \nabla N_i\, \mathrm{d}x, \tag{2}
# $$
#
# where $g_{ip}$ is what particle $p$ sees of the gradient of the basis function $N_i$. A point sees
# $\nabla N_i(x_p)$, which jumps where it crosses, so the second of (2) is wrong except when a cell
# holds just its share of the particles; the stress then leaps, however small the cells. GIMP, CPDI
# and CPDI2 take the mean of $\nabla N_i$ over a domain: as long as the domains fill the bar, (2)
# holds. GIMP's boxes of fixed size leave gaps in the longer bar, and do not.

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
length, young, stretch = 8.0, 1e6, 1.5  # m, Pa, -
g0 = young * np.log(stretch) / stretch / length  # N/m3
MARKED = (4.25, 0.25)  # where the particle that is followed begins, m
RUNS = {
    "mpm": {"method": "mpm"},
    "gimp, fixed boxes": {"method": "ugimp"},
    "gimp": {"method": "gimp"},
    "cpdi": {"method": "cpdi"},
    "cpdi2": {"method": "cpdi2"},
}


def bar(**options):
    background = mesh.create_rectangle(comm, [[0, 0], [14, 1]], [14, 1], quadrilateral)
    body = mesh.create_rectangle(comm, [[0, 0], [length, 1]], [16, 2], quadrilateral)
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 1, y=0.0), mpm.held(V, 1, y=1.0)]
    particles = mpm.Particles(body, V, **options)
    law = mpm.materials.Hencky(young, 0.0)
    return mpm.QuasiStaticProblem(mpm.Body(particles, law, body_force=(g0, 0.0)), bcs=bcs)


def total(values):
    return comm.allreduce(float(np.sum(values)), MPI.SUM)


# The rank that owns the marked particle knows it by its initial place. The scatter is the root mean
# square error over all particles and steps. That a method fails is a result, too.


def run(**options):
    problem = bar(**options)
    particles = problem.particles
    X = particles.initial_centroid
    mine = np.isclose(X, MARKED).all(axis=1)
    path, off, size, end = [(0.0, 0.0)], 0.0, 0.0, ""
    try:
        for step in problem.steps(80):
            exact = g0 * step.load * (length - X[:, 0])
            off += total((particles.stress[:, 0, 0] - exact) ** 2)
            size += total(exact**2)
            path.append((step.load, total(particles.stress[mine, 0, 0])))
    except mpm.MPMError as error:
        end = f" ({type(error).__name__})"
    return np.array(path), np.sqrt(off / size), end


results = {name: run(**options) for name, options in RUNS.items()}
if comm.rank == 0:
    fig, ax = plt.subplots(figsize=(9, 4.5), layout="constrained")
    ax.plot([0.0, 1.0], [0.0, g0 * (length - MARKED[0]) / 1e3], color="0.2", label="exact")
    for name, (path, scatter, end) in results.items():
        carried = f"load {path[-1, 0]:.3f}{end}"
        print(f"{name:18s} scatter {100 * scatter:6.2f} %, {carried}")
        ax.plot(path[:, 0], path[:, 1] / 1e3, label=f"{name} (scatter {100 * scatter:.1f} %)")
    ax.set(xlabel="load", ylabel="stress of one particle, kPa")
    ax.set_title("Points that cross cells upset the stress; domains do not")
    ax.legend()
    fig.savefig("cell_crossing.png", dpi=130)

assert max(results[name][1] for name in ("gimp", "cpdi", "cpdi2")) < 0.02
assert results["mpm"][1] > 0.1

# ## Exercises
#
# Use twice as many cells and particles each way, or four by four in a cell; then a domain has its
# middle at `MARKED = (4.125, 0.125)`. Which scatters fall?
