# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later

# # Compaction of an elastic column under its own weight
#
# It illustrates how to:
# - make a body of particles from one mesh and a background from another,
# - solve for equilibrium at finite strain with `mpm.QuasiStaticProblem`,
# - read stress, volume and position of the particles, on any number of ranks,
# - compare with an exact solution, and see the error fall as the background is refined.
#
# ## Notation
#
# $X$ is a point of the undeformed body, $d(X)$ its displacement and $x = X + d$ its position;
# $F = I + \nabla d$. Stress is Kirchhoff's $\tau$ or Cauchy's $\sigma = \tau/\det F$; pressure
# is negative stress. $Y$ is the height of a point at first, $y$ its height now.
#
# ## Problem
#
# A column of height $L = 50$ m stands between smooth walls on a smooth base and is loaded by its
# own weight, $\rho_0 g$ per undeformed volume. The load grows in 40 steps. With the default
# stiffness the column shortens to 48 % of its height, so all that is measured here is measured
# at large strain, with every particle crossing many cells of the background.
#
# Equilibrium on the undeformed body reads: find $d$ such that for all $v$
#
# $$
# R(d; v) = \int P : \nabla v \,\mathrm{d}X - \int \rho_0\, b \cdot v \,\mathrm{d}X = 0,
# \qquad P = \tau F^{-T}. \tag{1}
# $$
#
# The material is Hencky's: stress is linear in the logarithmic strain,
#
# $$
# \tau = K\, \mathrm{tr}(\varepsilon)\, I + 2 G\, \mathrm{dev}\, \varepsilon, \qquad
# \varepsilon = \tfrac12 \ln (F F^T). \tag{2}
# $$
#
# ## Method
#
# The domains of the particles are the cells of the body's mesh. Let $W$ be the continuous
# Lagrange space on it, $V$ that on the background, and $d_n$ the displacement at the last
# converged step. The unknown of a step is an increment $u$ in $V$, which the nodes of the domains
# pick up where they are at the moment:
#
# $$
# d = d_n + T_n u, \qquad (T_n)_{ci} = N_i\bigl(X_c + d_n(X_c)\bigr), \tag{3}
# $$
#
# with $N_i$ the basis functions of the background and $c$ the nodes of the domains. Restricting
# (1) to such increments gives the equations of a step, which Newton's method solves:
#
# $$
# r(u) = T_n^T R_W(d_n + T_n u) = 0, \qquad K = T_n^T K_W T_n. \tag{4}
# $$
#
# With one quadrature point per domain this is CPDI2, the second-order convected particle domain
# interpolation. The background is reset after each step by doing nothing: it never moved. The
# older methods (`--method`) differ in the rows of $T_n$ alone; of them the point method `mpm`
# does not converge here, since the stress jumps whenever a particle crosses a cell.
#
# ## Exact solution
#
# Nothing moves sideways, so (1) is a balance over the height. Let $\delta = L - Y$ be the depth
# of a point at first, and $M = E (1-\nu) / ((1+\nu)(1-2\nu))$. The weight above a point does not
# change, and neither does the area that carries it:
#
# $$
# \sigma_{yy} = -g_0\, \delta, \qquad g_0 = \rho_0\, g. \tag{5}
# $$
#
# The stretch $\lambda = e^{-w}$ follows from $\sigma_{yy} = M \ln \lambda/\lambda = -M w e^w$,
# so that $w$ is Lambert's function, and integrating the stretch gives the position:
#
# $$
# w = W(k\, \delta), \quad k = \frac{g_0}{M}, \qquad
# y(Y) = \frac1k \left[ w + \tfrac12 w^2 \right]_{w(\delta)}^{w(L)}. \tag{6}
# $$
#
# Errors are means over the particles, weighted by their initial volumes $V_p^0$:
#
# $$
# e_\sigma = \frac{\sum_p |\sigma_{yy,p} - \sigma_{yy}(Y_p)|\, V_p^0}{g_0 L \sum_p V_p^0}, \qquad
# e_y = \frac{\sum_p |y_p - y(Y_p)|\, V_p^0}{L \sum_p V_p^0}. \tag{7}
# $$
#
# ## Implementation

from mpi4py import MPI

import demo_tools as tools
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = tools.Parser("Elastic column that shortens to half under its own weight.")
parser.add_argument("--elements", type=tools.whole, default=16, help="background cells, height")
parser.add_argument("--domain", choices=tuple(tools.DOMAINS), default="quad", help="domains")
parser.add_argument("--method", choices=tools.METHODS, default="cpdi2", help="rows of T")
parser.add_argument("--young", type=tools.positive, default=1e4, help="Young's modulus")
parser.add_argument("--steps", type=tools.whole, default=40, help="load steps")
parser.add_order()
args = parser.parse()

comm = MPI.COMM_WORLD
height, density, gravity = 50.0, 80.0, 10.0  # m, kg/m3, m/s2
young, poisson = args.young, 0.0
weight = density * gravity
dim = 3 if args.domain in ("hex", "tet") else 2
up = dim - 1  # the vertical axis

# The background is one cell wide, the body has two by two quadrilaterals in each of its cells
# (or those cut into triangles, diagonals alternating; in space, two by two by two hexahedra or
# those cut into tetrahedra). The walls and the base are conditions on the background, as the
# background is where the unknowns live.


def column(elements: int) -> tuple[mpm.Particles, mpm.QuasiStaticProblem]:
    width = height / elements
    upper = [width] * up + [height]
    grid = tools.DOMAINS["hex" if dim == 3 else "quad"]
    background = tools.box(upper, [1] * up + [elements], grid)
    V = fem.functionspace(background, ("Lagrange", args.degree, (dim,)))
    body = tools.box(upper, [2] * up + [2 * elements], tools.DOMAINS[args.domain])

    bcs = []
    for axis in range(dim):
        ends = (0.0,) if axis == up else (0.0, width)
        facets = mesh.locate_entities_boundary(
            background, up, lambda x, i=axis, ends=ends: np.isclose(x[i][:, None], ends).any(axis=1)
        )
        dofs = fem.locate_dofs_topological(V.sub(axis), up, facets)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))

    particles = mpm.Particles(body, V, method=args.method, **tools.order(args))
    problem = mpm.QuasiStaticProblem(
        particles,
        mpm.materials.Hencky(young, poisson),
        density=density,
        body_force=(0.0,) * up + (-gravity,),
        bcs=bcs,
        petsc_options_prefix="compaction_",
        stabilisation=tools.stabilisation(args),
    )
    return particles, problem


# The exact solution (5), (6) as functions of the initial height.

modulus = young * (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
k = weight / modulus


def exact_stress(Y):
    return -weight * (height - Y)


def exact_position(Y):
    w, bottom = tools.lambert_w(k * (height - Y)), tools.lambert_w(k * height)
    return ((bottom + bottom**2 / 2.0) - (w + w**2 / 2.0)) / k


# The errors (7). `particles` hands out arrays of the particles that this rank owns; `tools.mean`
# sums over ranks.


def errors(particles: mpm.Particles) -> tuple[float, float]:
    Y, volume = particles.initial_centroid[:, up], particles.initial_volume
    of_stress = np.abs(particles.stress[:, up, up] - exact_stress(Y)) / (weight * height)
    of_position = np.abs(particles.centroid[:, up] - exact_position(Y)) / height
    return tools.mean(of_stress, volume), tools.mean(of_position, volume)


# A run that cannot go on raises an `mpm.MPMError` and leaves the particles at the last converged
# step.

particles, problem = column(args.elements)
failure = None
try:
    problem.solve(steps=args.steps, progress=not args.json)
except mpm.MPMError as error:
    failure = error

# ## Result
#
# The residuals of the first step show Newton's method at work: once it is near, each of them is
# about the square of the one before.

error, error_position = errors(particles)
top = tools.largest(tools.nodes(particles)[:, up])
numbers = {
    **tools.outcome(problem.history, failure),
    "error": error,
    "error_position": error_position,
    "particles": particles.num_global,
}
first = problem.history.steps[0].residuals if problem.history.steps else []
rows = [
    ("particles", f"{particles.num_global} ({args.domain}, {args.method}), {args.elements} cells"),
    ("load steps", f"{len(problem.history.steps)}, load {numbers['load']:g}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("height", f"{top:.6f} (exact {exact_position(height):.6f}, at first {height:g})"),
    ("error of stress", f"{error:.3e}"),
    ("error of position", f"{error_position:.3e}"),
    ("first step", "  ".join(f"{r:.0e}" for r in first)),
]

# The picture shows the column before what it was at first, its stress over the height against
# (5), (6), and how the error falls: the run again on other backgrounds.

if args.plot:
    fig, axes = tools.figure(
        14, 6.2, [["column", "stress", "error"]], width_ratios=[0.55, 2.6, 2.6]
    )
    values = particles.stress[:, up, up] / 1e3
    if dim == 2:
        column_axes = axes["column"]
        mpm.plot.domains(particles, ax=column_axes, warp=0.0, facecolor="0.93", edgecolor="0.8")
        colours = mpm.plot.domains(
            particles,
            values,
            ax=column_axes,
            cmap="viridis_r",
            vmin=-weight * height / 1e3,
            vmax=0.0,
        )
    y, s = tools.gathered(particles.centroid[:, up]), tools.gathered(values)
    sizes, found = [8, 16, 32, 64], []
    for elements in sizes:
        other, again = column(elements)
        again.solve(steps=args.steps)
        found.append(errors(other))

    if comm.rank == 0:
        ax, width = axes["column"], height / args.elements
        ax.set_visible(dim == 2)
        ax.set(xlim=(-0.2 * width, 1.2 * width), ylim=(-0.5, height + 0.5), xticks=[])
        ax.set(ylabel="height, m")
        ax.spines["bottom"].set_visible(False)
        if dim == 2:
            label = "vertical Cauchy stress, kPa"
            fig.colorbar(colours, ax=ax, label=label, shrink=0.55, pad=0.15)

        ax, Y = axes["stress"], np.linspace(0.0, height, 400)
        ax.plot(
            exact_stress(Y) / 1e3, exact_position(Y), color=tools.COLOURS["grey"], label="exact"
        )
        ax.plot(s, y, "o", ms=5, mew=0, color=tools.COLOURS["blue"], label="particles")
        ax.set(xlabel="vertical Cauchy stress, kPa", ylabel="height now, m", ylim=(0.0, None))
        ax.set_title(f"Stress: off by {100 * error:.2g} % of its range")
        ax.legend(loc="upper left")

        ax = axes["error"]
        sizes, found = np.array(sizes), np.array(found)
        ax.loglog(sizes, found[:, 0], "o-", color=tools.COLOURS["blue"], label="stress, (7)")
        ax.loglog(sizes, found[:, 1], "s-", color=tools.COLOURS["orange"], label="position, (7)")
        slope = found[0, 0] * 1.5 * (sizes / sizes[0]) ** -1.0
        ax.loglog(sizes, slope, "--", color=tools.COLOURS["grey"], lw=1.2, label="first order")
        ax.set_xticks(sizes, [str(n) for n in sizes])
        ax.minorticks_off()
        ax.set(xlabel="background cells over the height", ylabel="relative error")
        ax.set_title("Finer background, smaller error")
        ax.legend(loc="lower left")
    tools.save(fig, args)

tools.report(args, numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert error < 2.7e-3 and error_position < 1e-3
    assert numbers["iterations"] <= 130
    assert abs(top - exact_position(height)) < 1e-2
