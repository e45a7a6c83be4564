# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2

# # A cylinder under inner pressure
#
# It illustrates how to:
# - solve a problem of revolution, `axisymmetric=True`,
# - apply a pressure that follows the surface as it turns and grows, `pressures=`,
# - tag facets of the body, which ride on it,
# - make a body whose mesh is bent to polar coordinates, on a background that is not,
# - measure a rate of convergence.
#
# ## Problem
#
# A long thick tube of inner radius $a = 1$ m and outer radius $b = 2$ m is blown up by a pressure
# $p = 80$ kPa inside; it cannot lengthen. The material is Hencky's, $E = 1$ MPa and $\nu = 0.3$,
#
# $$
# \tau = K\, \mathrm{tr}(\varepsilon)\, I + 2 G\, \mathrm{dev}\, \varepsilon, \qquad
# \varepsilon = \ln V. \tag{1}
# $$
#
# The pressure acts on the inner surface as it is at each moment. On the undeformed one, with
# normal $N$, that is the traction
#
# $$
# t = -p\, J F^{-T} N, \qquad J = \det F, \tag{2}
# $$
#
# which depends on the displacement; its derivative is part of the tangent, which is not symmetric.
#
# The tube is computed twice. *Axisymmetric*: the body is a strip in the $(r, z)$ plane, one
# background cell high, $x_0$ is the radius, and the deformation gradient has the hoop stretch
#
# $$
# F_{\theta\theta} = 1 + d_r / R. \tag{3}
# $$
#
# *Plane strain*: the body is a quarter of the ring in the $(x, y)$ plane, a mesh in polar
# coordinates. The background is a grid of squares that knows nothing of circles: its nodes
# on $x = 0$ and on $y = 0$ are rollers, and that is all.
#
# ## Reference
#
# With $r(R)$ the present radius, $\lambda_r = r'$ and $\lambda_\theta = r / R$, equilibrium is a
# boundary value problem for $r$ and the first Piola stress $P_r = \tau_r / \lambda_r$:
#
# $$
# r' = \lambda_r(P_r, r / R), \qquad
# P_r' = -\frac{1}{R} \Bigl( P_r - \frac{\tau_\theta}{\lambda_\theta} \Bigr), \qquad
# P_r(a) = -p\, \frac{r(a)}{a}, \quad P_r(b) = 0. \tag{4}
# $$
#
# $\lambda_r$ follows from $P_r$ by Newton's method on (1). SciPy integrates (4) to a relative
# tolerance of $10^{-10}$.
#
# The error of a run is the larger of the relative errors of the two radii,
#
# $$
# e = \max_{R \in \{a, b\}} \frac{|\bar r(R) - r(R)|}{r(R)}, \tag{5}
# $$
#
# $\bar r$ being the mean over the body's nodes on that surface. These are better than the elements
# promise, in an erratic way. A rate is defined by the stress, whose error is
#
# $$
# e_\sigma = \frac{\sum_p (|\sigma_r - \sigma_r(R_p)| + |\sigma_\theta - \sigma_\theta(R_p)|)\,
#   V_p^0}{2 p \sum_p V_p^0}, \tag{6}
# $$
#
# on three grids, with a quarter and a half as many elements and with all of them; `rate` is the
# smaller one of the two runs' last rates. (The coarsest of the axisymmetric grids is better than
# its rank: no particle leaves its first cell there.)
#
# ## Implementation

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_bvp

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm = MPI.COMM_WORLD
a, b, pressure = 1.0, 2.0, 80e3  # m, m, Pa
young, poisson = 1e6, 0.3  # Pa, -
K, G = young / (3.0 * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
INNER = 1

# ### Reference
#
# Newton's method for the radial stretch, vectorised over the points, then (4).


def kirchhoff(radial, hoop):
    """Principal stresses (radial, hoop, axial) of the stretches."""
    strain = np.log([radial, hoop, np.ones_like(hoop)])
    return K * strain.sum(axis=0) + 2.0 * G * (strain - strain.mean(axis=0))


def radial_stretch(P, hoop):
    stretch = np.ones_like(hoop)
    for _ in range(30):
        tau = kirchhoff(stretch, hoop)[0]
        slope = (K + 4.0 * G / 3.0 - tau) / stretch**2
        stretch = stretch - (tau / stretch - P) / slope
    return stretch


def equations(R, y):
    hoop = y[0] / R
    radial = radial_stretch(y[1], hoop)
    return np.vstack([radial, -(y[1] - kirchhoff(radial, hoop)[1] / hoop) / R])


def ends(at_a, at_b):
    return np.array([at_a[1] / pressure + at_a[0] / a, at_b[1] / pressure])


R = np.linspace(a, b, 101)
guess = np.vstack([R + 0.1, -pressure * (b - R) / (b - a)])
reference = solve_bvp(equations, ends, R, guess, tol=1e-10, max_nodes=100000)
assert reference.status == 0, reference.message


def exact_stress(R):
    """Cauchy stress (radial, hoop, axial) at initial radii."""
    r, P = reference.sol(R)
    hoop = r / R
    radial = radial_stretch(P, hoop)
    return kirchhoff(radial, hoop) / (radial * hoop)


# ### The tube in two ways
#
# Both are a body, a background, its rollers, and a problem with a pressure on the tagged inner
# facets; they differ in the meshes and in one argument. Two by two particles share a cell.


def rollers(V, component, where):
    facets = mesh.locate_entities_boundary(V.mesh, 1, where)
    dofs = fem.locate_dofs_topological(V.sub(component), 1, facets)
    return fem.dirichletbc(0.0, dofs, V.sub(component))


def inner_facets(body, radius):
    facets = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(radius(x), a))
    return mesh.meshtags(body, 1, facets, np.full(len(facets), INNER, dtype=np.int32))


def strip(n):
    """Strip of the wall in the (r, z) plane, n cells wide and one high."""
    h = (b - a) / n
    background = mesh.create_rectangle(
        comm, [[0.5, 0.0], [3.0, h]], [round(2.5 / h), 1], mesh.CellType.quadrilateral
    )
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    body = mesh.create_rectangle(comm, [[a, 0.0], [b, h]], [2 * n, 2], mesh.CellType.quadrilateral)
    bcs = [rollers(V, 1, lambda x: np.isclose(x[1], 0.0) | np.isclose(x[1], h))]
    return mpm.Particles(body, V), bcs, inner_facets(body, lambda x: x[0])


def quarter_ring(n):
    """Quarter of the ring; particles are about as long round it as across it."""
    h = (b - a) / n
    background = mesh.create_rectangle(
        comm, [[0.0, 0.0], [2.5, 2.5]], [round(2.5 / h)] * 2, mesh.CellType.quadrilateral
    )
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))

    # A rectangle of radii and angles, then its geometry mapped. Rounding must not push the two
    # straight edges out of the background.

    body = mesh.create_rectangle(
        comm, [[a, 0.0], [b, np.pi / 2.0]], [2 * n, 4 * n], mesh.CellType.quadrilateral
    )
    radius, angle = body.geometry.x[:, 0].copy(), body.geometry.x[:, 1].copy()
    body.geometry.x[:, 0] = np.maximum(radius * np.cos(angle), 0.0)
    body.geometry.x[:, 1] = np.maximum(radius * np.sin(angle), 0.0)

    bcs = [
        rollers(V, 0, lambda x: np.isclose(x[0], 0.0)),
        rollers(V, 1, lambda x: np.isclose(x[1], 0.0)),
    ]
    # The middle of a facet lies on a chord, its ends, which are what is looked at, on the circle.
    return (
        mpm.Particles(body, V),
        bcs,
        inner_facets(body, lambda x: np.hypot(x[0], x[1])),
    )


def solve(scene, n, axisymmetric):
    particles, bcs, tags = scene(n)
    problem = mpm.QuasiStaticProblem(
        particles,
        mpm.materials.Hencky(young, poisson),
        bcs=bcs,
        pressures=[(pressure, INNER)],
        facet_tags=tags,
        axisymmetric=axisymmetric,
    )
    problem.solve(steps=10)
    return particles


# Sums and extremes over all ranks, each a collective call.


def total(values):
    return comm.allreduce(float(np.sum(values)), MPI.SUM)


def mean(values, weights):
    return total(values * weights) / total(weights)


def nodes(particles):
    """Present positions of the nodes that this rank owns."""
    own, gdim = particles.W.dofmap.index_map.size_local, particles.mesh.geometry.dim
    d = particles.displacement.x.array.reshape(-1, gdim)[:own]
    return particles.W.tabulate_dof_coordinates()[:own, :gdim] + d


# The error (5).


def radii(points, axisymmetric):
    return points[:, 0] if axisymmetric else np.hypot(points[:, 0], points[:, 1])


def error(particles, axisymmetric):
    own = particles.W.dofmap.index_map.size_local
    first = radii(particles.W.tabulate_dof_coordinates()[:own], axisymmetric)
    now = radii(nodes(particles), axisymmetric)
    return max(abs(mean(now, np.isclose(first, at)) / reference.sol(at)[0] - 1.0) for at in (a, b))


# The error (6): a particle of the ring is turned by its polar angle.


def stress(particles, axisymmetric):
    """Return the initial radius, radial and hoop stress of the particles."""
    sigma, X, x = particles.stress, particles.initial_centroid, particles.centroid
    if axisymmetric:
        return X[:, 0], sigma[:, 0, 0], sigma[:, 2, 2]
    e_r = x / np.linalg.norm(x, axis=1, keepdims=True)
    e_t = np.column_stack([-e_r[:, 1], e_r[:, 0]])
    s_r, s_t = (np.einsum("ni,nij,nj->n", e, sigma[:, :2, :2], e) for e in (e_r, e_t))
    return np.hypot(X[:, 0], X[:, 1]), s_r, s_t


def error_stress(particles, axisymmetric):
    R_p, s_r, s_t = stress(particles, axisymmetric)
    exact = exact_stress(R_p)
    volume = particles.initial_volume * (R_p if axisymmetric else 1.0)
    difference = np.abs(s_r - exact[0]) + np.abs(s_t - exact[1])
    return mean(difference, volume) / (2.0 * pressure)


# ## Result

runs, errors, errors_stress, rates = {}, {}, {}, {}
for name, scene in (("axisymmetric", strip), ("plane strain", quarter_ring)):
    series = []
    for n in (4, 8, 16):
        runs[name] = solve(scene, n, scene is strip)
        series.append(error_stress(runs[name], scene is strip))
    errors[name] = error(runs[name], scene is strip)
    errors_stress[name] = series[-1]
    rates[name] = np.log2(series[1] / series[2])
    if comm.rank == 0:
        print(f"{name}: error of the radii {errors[name]:.1e}", end=", ")
        print("of the stress", *(f"{e:.2e}" for e in series), f"(rate {rates[name]:.2f})")

# The picture: the ring, coloured by hoop stress, before what it was; and radial and hoop stress of
# the particles of both runs on the exact lines.

ring = runs["plane strain"]
shown = {name: comm.gather(stress(run, run is not ring)) for name, run in runs.items()}
hoop_stress = stress(ring, False)[2] / 1e3
fig, axes = None, {"ring": None}
if comm.rank == 0:
    fig, axes = plt.subplot_mosaic([["ring", "stress"]], figsize=(12.5, 5.8), layout="constrained")
mpm.plot.background(ring.V, ax=axes["ring"], color="0.9")
mpm.plot.domains(ring, ax=axes["ring"], warp=0.0, facecolor="0.96", edgecolor="0.88")
colours = mpm.plot.domains(ring, hoop_stress, ax=axes["ring"], cmap="YlGnBu", linewidth=0.25)
if comm.rank == 0:
    axes["ring"].set(xlim=(0.0, 2.5), ylim=(0.0, 2.5), xlabel="x, m", ylabel="y, m")
    fig.colorbar(colours, ax=axes["ring"], label="hoop stress, kPa", shrink=0.8)
    for i, direction in enumerate(("radial", "hoop")):
        (line,) = axes["stress"].plot(R, exact_stress(R)[i] / 1e3, label=f"{direction}, exact")
        for (name, parts), marker in zip(shown.items(), "o+", strict=True):
            at, *found = np.hstack([np.array(part) for part in parts])
            label = f"{direction}, {name}"
            axes["stress"].plot(at, found[i] / 1e3, marker, color=line.get_color(), label=label)
    axes["stress"].set(xlabel="initial radius, m", ylabel="Cauchy stress, kPa")
    axes["stress"].legend(loc="upper right")
    fig.savefig("pressurised_cylinder.png", dpi=160)

# The numbers are known.

assert max(errors.values()) < 1e-5
assert max(errors_stress.values()) < 1.3e-3
assert min(rates.values()) > 1.8
