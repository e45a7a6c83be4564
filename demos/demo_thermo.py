# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 3.6: Heat and large bending in UFL, coupled both ways

# # A strip of two metals curls as it warms up
#
# It illustrates how to:
# - write thermo-mechanics in UFL: a residual for the displacement, one for the temperature,
# - let heat flow in a body that moves through the cells of its background,
# - couple both ways: heat expands the strip, and straining takes heat.
#
# ## Problem
#
# A strip of length $L$ = 6 and thickness $h$ = 0.2 is bonded of two layers of equal stiffness. The
# lower one expands by $\alpha\theta$, the upper one does not. Its left end is held by a wall that
# is suddenly hot, $\theta = 1$; all else is insulated. With the energy $\psi$, a neo-Hookean one of
# $F / (1 + \alpha\theta)$,
#
# $$
# \mathrm{Div}\, \frac{\partial \psi}{\partial F} = 0, \qquad
# \dot\theta - \kappa\, \frac{\partial}{\partial t} \frac{\partial \psi}{\partial \theta}
#     = \mathrm{Div}\,(J F^{-1} F^{-T} \nabla \theta). \tag{1}
# $$
#
# Young's modulus and the diffusivity are 1, and by $\kappa$ = 0.5 straining takes heat. With
# $\alpha$ = 0.08, far more than metals have, the strip crosses many cells.
#
# Heat travels as along a straight bar, by a series $\theta(X, t)$. A bonded strip bends by
# $3 \varepsilon / 2 h$ per length (Timoshenko 1925), $\varepsilon = (1 + \nu)\, \alpha\theta$ in
# plane strain. It also gets thicker, by $\varepsilon / 2$ in the mean. So its end has turned by
#
# $$
# \varphi(t) = \int_0^L \frac{3\, \varepsilon}{2 h\, (1 + \varepsilon / 2)}\, \mathrm{d}X. \tag{2}
# $$
#
# Where a stress $\sigma$ pulls, what expands cools by $\kappa (1 + \nu)\, \alpha\sigma$ (Kelvin
# 1853), but for terms in $\kappa \alpha^2$.

from mpi4py import MPI

import matplotlib.pyplot as plt
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
L, h, nu, expansion, kappa = 6.0, 0.2, 0.3, 0.08, 0.5
mu, lmbda = 0.5 / (1 + nu), nu / (1 + nu) / (1 - 2 * nu)
grid = mesh.create_rectangle(comm, [[-2.0, -0.5], [6.5, 5.5]], [34, 24], quadrilateral)
V, Q = (fem.functionspace(grid, ("Lagrange", 2, shape)) for shape in ((2,), ()))


def strip(hot):
    """A strip at a hot wall, or insulated, and what a step is given."""
    body = mesh.create_rectangle(comm, [[0.0, 0.0], [L, h]], [48, 2], quadrilateral)
    particles = mpm.Particles(body, V, degree=2)
    theta = mpm.ParticleField(particles, Q, at="nodes", name="temperature")
    d, v, q = particles.displacement, ufl.TestFunction(particles.W), ufl.TestFunction(theta.W)
    before, dt, pull = fem.Function(particles.W), fem.Constant(body, 0.0), fem.Constant(body, 0.0)
    X, dx, G = ufl.SpatialCoordinate(body), particles.dx, ufl.inv(ufl.Identity(2) + ufl.grad(d)).T
    alpha, end = (ufl.conditional(where, 1.0, 0.0) for where in (X[1] < h / 2, X[0] > L - 1e-9))

    def energy(d, theta):
        F, s = ufl.Identity(2) + ufl.grad(d), 1 + expansion * alpha * theta
        ln_J = ufl.ln(ufl.det(F) / s**3)
        return mu / 2 * ((ufl.inner(F, F) + 1) / s**2 - 3) - mu * ln_J + lmbda / 2 * ln_J**2

    def heat(d, theta):
        theta = ufl.variable(theta)
        return theta - kappa * ufl.diff(energy(d, theta), theta)

    R_d = ufl.derivative(energy(d, theta) * dx, d, v) - pull * end * v[0] * ufl.ds(body)
    flow = ufl.dot(G * ufl.grad(theta), G * ufl.grad(q)) / ufl.det(G)
    R_q = (heat(d, theta) - heat(before, theta.previous)) * q * dx + dt * flow * dx
    wall, F = {"x": 0.0, "y": (-0.5, 0.5)}, ufl.Identity(2) + ufl.grad(d)
    bcs = [mpm.held(V, **wall)]
    if hot:
        bcs.append(mpm.held(Q, value=1.0, **wall))
    problem = mpm.ParticleProblem([R_d, R_q], particles, bcs=bcs, fields=[theta])
    means = [F[i, 1] * end / h * ufl.ds(body) for i in (0, 1)] + [theta / (L * h) * dx]
    return problem, particles, theta, before, dt, pull, fem.form(means)


# ## Run
#
# In steps that grow; `before` is the displacement at the beginning of a step.


def exact(X, t):
    """Temperature of a straight bar."""
    k = (np.arange(200) + 0.5) * np.pi / L
    return 1.0 - np.sin(np.outer(X, k)) @ (2.0 / (k * L) * np.exp(-(k**2) * t))


problem, particles, theta, before, dt, _, means = strip(True)
along = theta.W.tabulate_dof_coordinates()[:, 0]
line, shown = np.linspace(0.0, L, 601), [0.5, 3.0, 10.0, 44.0]
mosaic = [["strip", "heat"], ["strip", "turn"]]
fig, axes = plt.subplot_mosaic(mosaic, figsize=(12, 6.3), layout="constrained")
mpm.plot.background(V, ax=axes["strip"])
rows, turned = [], np.zeros(1)
for length in np.repeat([0.05, 0.1, 0.5, 2.0], [10, 25, 14, 17]):
    dt.value, before.x.array[:] = length, particles.displacement.x.array
    problem.step()
    t = length + (rows[-1][0] if rows else 0.0)
    x, y = (comm.allreduce(fem.assemble_scalar(part)) for part in means[:2])
    turned = np.unwrap(np.append(turned, np.arctan2(-x, y)))
    off = np.abs(theta.x.array - exact(along, t)).max(initial=0.0)
    strain = (1 + nu) * expansion * exact(line, t)
    steep = np.trapezoid(1.5 * strain / (h + h * strain / 2), line)
    rows.append((t, turned[-1], steep, comm.allreduce(off, MPI.MAX)))
    if np.isclose(shown, t).any():
        warmth = theta.x.array[theta.W.dofmap.list[: particles.num_local]].mean(axis=1)
        look = {"cmap": "inferno", "vmin": 0.0, "vmax": 1.0, "linewidth": 0.1}
        drawn = mpm.plot.domains(particles, warmth, ax=axes["strip"], **look)
        found = np.concatenate(comm.allgather(np.stack([along, theta.x.array])), axis=1)
        axes["heat"].plot(*found, ".", color=f"C{shown.index(round(t, 6))}", ms=2)
        axes["heat"].plot(line, exact(line, t), "k-", lw=0.7)

insulated, _, _, _, dt, pull, means = strip(False)
dt.value, pull.value = 1e-6, 1e-3
insulated.step()
cooled = -comm.allreduce(fem.assemble_scalar(means[2]))
kelvin = kappa * (1 + nu) * expansion * 1e-3 / 2

# ## Result

times, turned, timoshenko, off = np.array(rows).T
if comm.rank == 0:
    print("time  turned by, rad  Timoshenko  error of temperature")
    for i in np.flatnonzero(np.isclose(times[:, None], shown).any(axis=1)):
        bent = f"{turned[i]:16.3f}{timoshenko[i]:12.3f}"
        print(f"{times[i]:4.1f}{bent}{off[i]:22.3f}")
    print(f"pulled, it cools by {cooled:.3e} in the mean, Kelvin {kelvin:.3e}")
    axes["strip"].set(xlim=(-2.0, 6.5), ylim=(-0.5, 5.5), xticks=[], yticks=[], aspect="equal")
    fig.colorbar(drawn, ax=axes["strip"], label="temperature", shrink=0.7, location="left")
    axes["heat"].set(xlabel="place in the straight strip", ylabel="temperature")
    axes["turn"].plot(times, np.degrees(turned), "C3", label="strip")
    axes["turn"].plot(times, np.degrees(timoshenko), "k--", lw=1, label="Timoshenko")
    axes["turn"].set(xlabel="time", ylabel="end turned by, degrees")
    axes["turn"].legend()
    fig.savefig("thermo.png", dpi=130)

later = times > 0.4
assert np.abs(turned / timoshenko - 1.0)[later].max() < 0.02 and off[later].max() < 0.02
assert abs(cooled / kelvin - 1.0) < 0.01

# ## Exercises
#
# 1. Shift the background down by a third of a cell. What changes?
# 2. Make the lower layer twice as stiff. What is Timoshenko's factor then?
# 3. Let the strip lose heat to the air: add `dt * beta * theta * q * ufl.ds(body)` to its residual.
