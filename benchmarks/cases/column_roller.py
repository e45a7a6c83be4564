# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An elasto-plastic column between rollers.

demos/demo_column_roller.py is its simplest form and has the equations.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Elasto-plastic column with rollers on both sides, under its own weight.")
parser.add_argument("--elements", type=kit.whole, default=32, help="background cells, height")
parser.add_argument("--domain", choices=tuple(kit.DOMAINS), default="quad", help="domains")
parser.add_argument("--method", choices=kit.METHODS, default="cpdi2", help="rows of T")
parser.add_argument("--small-strain", action="store_true", help="material of small strain")
parser.add_argument("--young", type=kit.positive, default=2e5, help="Young's modulus, Pa")
parser.add_steps(40)
parser.add_argument(
    "--particles-per-cell", type=kit.whole, default=2, help="domains, each way in a cell"
)
parser.add_f_bar()
parser.add_order()
args = parser.parse()

comm = MPI.COMM_WORLD
height, density, gravity = 10.0, 800.0, 10.0  # m, kg/m3, m/s2
young, poisson, rho_y = args.young, 0.3, 20e3  # Pa, -, Pa
weight = density * gravity
width = height / args.elements

# Background and body, each a DOLFINx mesh; two domains each way in a cell unless asked otherwise.

dim = 3 if args.domain in ("hex", "tet") else 2
up = dim - 1  # the vertical axis
upper = [width] * up + [height]
background = kit.box(upper, [1] * up + [args.elements], kit.DOMAINS["hex" if dim == 3 else "quad"])
V = fem.functionspace(background, ("Lagrange", args.degree, (dim,)))
each = args.particles_per_cell
body = kit.box(upper, [each] * up + [each * args.elements], kit.DOMAINS[args.domain])

# The rollers are conditions on the background: on both ends of each horizontal axis, and at the
# base.

bcs = []
for axis in range(dim):
    ends = (0.0,) if axis == up else (0.0, width)
    facets = mesh.locate_entities_boundary(
        background, up, lambda x, i=axis, ends=ends: np.isclose(x[i][:, None], ends).any(axis=1)
    )
    dofs = fem.locate_dofs_topological(V.sub(axis), up, facets)
    bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))

particles = mpm.Particles(body, V, method=args.method, **kit.order(args))
law = mpm.materials.SmallStrainVonMises if args.small_strain else mpm.materials.VonMises
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        law(young, poisson, rho_y=rho_y),
        density=density,
        body_force=(0.0,) * up + (-gravity,),
        f_bar=args.f_bar,
    ),
    bcs=bcs,
    solver=mpm.Solver(petsc_options_prefix="roller_", stabilisation=kit.stabilisation(args)),
)

# `steps` hands out each converged step. After each, the yield function (1) is looked at: by how
# much does the worst particle violate it?

yield_violation = -np.inf
failure = None
try:
    for _ in kit.progress(problem.steps(**kit.chosen(args)), args.steps, args):
        yield_violation = max(yield_violation, kit.largest(problem.yield_function))
except mpm.MPMError as error:
    failure = error

# The exact solution at initial heights: the stresses and the vertical stretch.

K, G = young / (3.0 * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))
M = K + 4.0 * G / 3.0
c = np.sqrt(2.0 / 3.0) * rho_y


def exact(Y):
    depth = np.maximum(height - np.asarray(Y, dtype=float), 0.0)
    s_yy = -weight * depth
    if args.small_strain:
        s_xx = np.where(
            depth < yield_depth, poisson / (1.0 - poisson) * s_yy, s_yy + np.sqrt(1.5) * rho_y
        )
        stretch = 1.0 + np.where(depth < yield_depth, s_yy / M, (s_yy + c) / K)
    else:
        elastic = kit.lambert_w(-s_yy / M)
        plastic = kit.lambert_w(-s_yy / K * np.exp(c / K)) - c / K
        w = np.where(depth < yield_depth, elastic, plastic)
        s_xx = np.where(
            depth < yield_depth,
            -(K - 2.0 * G / 3.0) * w * np.exp(w),
            s_yy + np.sqrt(1.5) * rho_y * np.exp(w),
        )
        stretch = np.exp(-w)
    return s_yy, s_xx, stretch


w_y = np.sqrt(1.5) * rho_y / (2.0 * G)
yield_depth = M * w_y * (1.0 if args.small_strain else np.exp(w_y)) / weight

# The present height is the integral of the stretch; the midpoint rule on a fine grid will do for
# a picture and for the column's top.

edges = np.linspace(0.0, height, 20001)
stretch = exact((edges[1:] + edges[:-1]) / 2.0)[2]
heights = np.concatenate([[0.0], np.cumsum(stretch * np.diff(edges))])

# The errors (7).

Y, volume = particles.initial_centroid[:, up], particles.initial_volume
stress = particles.stress
s_yy, s_xx, _ = exact(Y)
error_syy = kit.mean(np.abs(stress[:, up, up] - s_yy), volume) / (weight * height)
error_sxx = kit.mean(np.abs(stress[:, 0, 0] - s_xx), volume) / (weight * height)
top = kit.largest(kit.nodes(particles)[:, up])

# The yield function is zero to round-off where the material yields: it is reported to 12 digits.

numbers = {
    **kit.outcome(problem.history, failure),
    "error_syy": error_syy,
    "error_sxx": error_sxx,
    "top": top,
    "particles": particles.num_global,
    "yield_violation": round(yield_violation, 12) + 0.0,
}

# Newton's method is quadratic in the elastic first step and in the plastic last one: the
# relative residuals are in the table.

steps = problem.history.steps
law_name = "small" if args.small_strain else "finite"
rows = [
    ("particles", f"{particles.num_global} ({args.domain}, {args.method}), {args.elements} cells"),
    ("strain", f"{law_name}, E = {young:g} Pa"),
    ("load steps", f"{len(steps)}, load {numbers['load']:g}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("top of the column", f"{top:.5f} m (exact {heights[-1]:.5f} m)"),
    ("error of s_yy", f"{error_syy:.2e}"),
    ("error of s_xx", f"{error_sxx:.2e}"),
    ("largest yield function", f"{yield_violation:.1e}"),
]
if steps:
    rows += [
        ("residuals, first step", "  ".join(f"{r:.0e}" for r in steps[0].residuals)),
        ("residuals, last step", "  ".join(f"{r:.0e}" for r in steps[-1].residuals)),
    ]

# Figure 3: markers are the particles, lines the exact solution. Beside it stands the column,
# coloured by plastic strain, before what it was at first.

if args.plot:
    fig, axes = kit.figure(12.0, 6.2, [["column", "stress"]], width_ratios=[0.5, 4.0])
    plastic = particles.plastic_strain
    if dim == 2:
        column = axes["column"]
        mpm.plot.domains(particles, ax=column, warp=0.0, facecolor="0.93", edgecolor="0.8")
        colours = mpm.plot.domains(particles, 100.0 * plastic, ax=column, cmap="cividis", vmin=0.0)
    now = kit.gathered(particles.centroid[:, up])
    shown_yy = kit.gathered(stress[:, up, up] / 1e3)
    shown_xx = kit.gathered(stress[:, 0, 0] / 1e3)
    if comm.rank == 0:
        ax = axes["column"]
        ax.set_visible(dim == 2)
        ax.set(xlim=(-0.4 * width, 1.4 * width), ylim=(-0.1, height + 0.1), xticks=[])
        ax.set(ylabel="vertical position, m")
        ax.spines["bottom"].set_visible(False)
        if dim == 2:
            fig.colorbar(colours, ax=ax, label="plastic strain, %", shrink=0.55, pad=0.15)

        ax = axes["stress"]
        line_yy, line_xx, _ = exact(edges)
        blue, orange, grey = (kit.COLOURS[name] for name in ("blue", "orange", "grey"))
        for line, shown, colour, marker, label in (
            (line_yy, shown_yy, blue, "o", r"$\sigma_{yy}$"),
            (line_xx, shown_xx, orange, "s", r"$\sigma_{xx}$"),
        ):
            ax.plot(heights, line / 1e3, color=colour, lw=1.8, label=f"{label} exact")
            ax.plot(
                now,
                shown,
                marker,
                color=colour,
                mfc="white",
                ms=6,
                mew=1.3,
                label=f"{label} particles",
            )
        if yield_depth < height:
            front = float(np.interp(height - yield_depth, edges, heights))
            ax.axvspan(0.0, front, color="0.93", zorder=0)
            ax.text(front / 2.0, -2.0, "yields", ha="center", va="top", color=grey)
            ax.text((front + heights[-1]) / 2.0, -2.0, "elastic", ha="center", va="top", color=grey)
        ax.set(xlim=(0.0, 1.01 * heights[-1]), xlabel="vertical position, m")
        ax.set(ylim=(-1.03 * weight * height / 1e3, 0.0), ylabel="Cauchy stress, kPa")
        ax.set_title(f"Stress of {particles.num_global} particles follows the exact solution")
        ax.legend(loc="lower right")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert error_syy < 1.2e-3 and error_sxx < 9.7e-4
    assert abs(top - heights[-1]) < 2e-3
    assert yield_violation < 1e-8
    assert numbers["iterations"] <= 135 and numbers["cutbacks"] == 0
