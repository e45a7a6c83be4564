# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later

# # Collapse of an elasto-plastic block
#
# It illustrates how to:
# - follow the collapse of a slope of 45 degrees and more from a body that is a square,
# - read the displacement of single nodes of the body, step by step,
# - see that more particles per cell make low-order domains stiffer, and what cures it.
#
# The example is the elasto-plastic demonstration of AMPLE (Coombs & Augarde 2020, *AMPLE: A
# Material Point Learning Environment*, Adv. Eng. Softw. 139), where the same scene is run with
# generalised interpolation.
#
# ## Problem
#
# The right half of a block 16 m wide and 8 m high stands on a smooth base, with a roller at the
# plane of symmetry. Its weight $\rho_0\, g$ = 10 kN/m3 is applied in 40 steps. The material is von
# Mises', perfectly plastic, on Hencky elasticity,
#
# $$
# f = \frac{\sqrt{2 J_2}}{\rho_y} - 1 \le 0, \qquad E = 1\ \mathrm{MPa}, \quad \nu = 0.3, \quad
# \rho_y = 20\ \mathrm{kPa}. \tag{1}
# $$
#
# The undrained strength is $c = \rho_y/\sqrt2$. A free vertical cut of height $H$ fails where
# $\rho_0 g H / c$ exceeds about 3.8; here it is 5.7. So the block must collapse, and comes to rest
# by spreading.
#
# ## Method
#
# With $F$ the deformation gradient of a domain's quadrature point and $\psi$ the material's energy
# (or its update), a step finds the increment $u$ of the background at which
#
# $$
# T_n^T R(d_n + T_n u) = 0, \qquad
# R(d; v) = \int P(\bar F) : \delta \bar F\, \mathrm{d}X
# - \int \rho_0\, b \cdot v\, \mathrm{d}X, \tag{2}
# $$
#
# $$
# \bar F = (\bar J / J)^{1/2} F. \tag{3}
# $$
#
# Plastic flow keeps the volume. Each quadrature point thus asks the background for one condition,
# $\det F \approx 1$, and a background cell has two unknowns to meet them with. With 2 by 2
# particles it has four conditions, with 6 by 6 thirty-six: the body *locks*, and becomes stiffer
# the better its geometry is resolved. With `--f-bar none` $\bar J$ is $J$. With `--f-bar patch` it
# is (nearly) the mean of $J$ over a fixed patch of domains as large as a background cell, so there
# is one condition for a cell however many particles it has.
#
# ## Implementation

from math import ceil

from mpi4py import MPI

import demo_tools as tools
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = tools.Parser("Collapse of an elasto-plastic block under its own weight.")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument("--cell", type=tools.positive, default=1.0, help="background cell size, m")
parser.add_argument(
    "--particles-per-cell", type=tools.whole, default=3, help="quadrilaterals, each way"
)
parser.add_f_bar()
parser.add_order()
parser.add_argument("--steps", type=tools.whole, default=40, help="load steps")
args = parser.parse()

comm = MPI.COMM_WORLD
size = 8.0  # m
young, poisson, rho_y = 1e6, 0.3, 20e3  # Pa, -, Pa
density, gravity = 1000.0, 10.0  # kg/m3, m/s2

# The background is 16 m wide, which leaves the toe room to move by 8 m, and a cell higher than the
# block.

h = args.cell
cells = [ceil(16.0 / h), ceil(9.0 / h)]
background = tools.box([cells[0] * h, cells[1] * h], cells, mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
along = max(1, round(size / h * args.particles_per_cell))
body = tools.box([size, size], [along, along], tools.DOMAINS[args.domain])

bcs = []
for axis in (0, 1):
    facets = mesh.locate_entities_boundary(background, 1, lambda x, i=axis: np.isclose(x[i], 0.0))
    dofs = fem.locate_dofs_topological(V.sub(axis), 1, facets)
    bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))

particles = mpm.Particles(body, V, **tools.order(args))
problem = mpm.QuasiStaticProblem(
    particles,
    mpm.materials.VonMises(young, poisson, rho_y=rho_y),
    density=density,
    body_force=(0.0, -gravity),
    bcs=bcs,
    f_bar=args.f_bar,
    petsc_options_prefix="collapse_",
    stabilisation=tools.stabilisation(args),
)

# What is watched is the top of the plane of symmetry and the toe, two nodes of the body.

X = particles.W.tabulate_dof_coordinates()


def displacement(corner, component: int) -> float:
    """A component of the displacement of the body's node at an undeformed position."""
    at = np.isclose(X[:, :2], corner).all(axis=1)
    return tools.largest(particles.displacement.x.array.reshape(-1, 2)[at, component])


path = [(0.0, 0.0, 0.0)]
failure = None
try:
    for step in tools.progress(problem.steps(args.steps), args.steps, args):
        path.append((step.load, displacement((0.0, size), 1), displacement((size, 0.0), 0)))
except mpm.MPMError as error:
    failure = error

# ## Result

_, u_top, u_toe = path[-1]
numbers = {
    **tools.outcome(problem.history, failure),
    "u_top": u_top,
    "u_toe": u_toe,
    "particles": particles.num_global,
    "worst_domain": tools.smallest(particles.domain_distortion()),
}
rows = [
    ("particles", f"{particles.num_global} ({args.domain}), cells of {h:g} m, F-bar: {args.f_bar}"),
    ("load steps", f"{len(path) - 1}, load {numbers['load']:g}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("top of the symmetry plane", f"{u_top:.3f} m"),
    ("toe", f"{u_toe:.3f} m"),
    ("worst domain", f"{numbers['worst_domain']:.3f}"),
]

# The picture: the body before and after, coloured by plastic strain, and the way there. The
# crosses are AMPLE's particles next to the corner, with cells of 1 m and 3 by 3 particles.

if args.plot:
    fig, axes = tools.figure(13.0, 5.0, [["body", "path"]], width_ratios=[2.0, 1.0])
    mpm.plot.background(V, ax=axes["body"], color="0.9")
    mpm.plot.domains(particles, ax=axes["body"], warp=0.0, facecolor="0.97", edgecolor="0.85")
    colours = mpm.plot.domains(
        particles, particles.plastic_strain, ax=axes["body"], cmap="YlGnBu", vmin=0.0
    )
    if comm.rank == 0:
        ax = axes["body"]
        ax.set(xlim=(0.0, 16.0), ylim=(0.0, 8.6), xlabel="x, m", ylabel="y, m")
        ax.set_title(f"The toe moves {u_toe:.2f} m, the top {-u_top:.2f} m")
        fig.colorbar(colours, ax=ax, label="plastic strain", shrink=0.7)
        ax = axes["path"]
        load, top, toe = np.array(path).T
        ax.plot(100 * load, toe, color=tools.COLOURS["orange"], label="toe, sideways")
        ax.plot(100 * load, -top, color=tools.COLOURS["blue"], label="top, down")
        known = (
            (0.25, 0.0756),
            (0.5, 0.231),
            (0.625, 1.055),
            (0.75, 1.802),
            (0.875, 2.329),
            (1, 2.656),
        )
        ax.plot(*(100 * np.array(known) * (1.0, 0.01)).T, "x", color="0.2", label="top, AMPLE")
        ax.set(xlabel="weight, %", ylabel="displacement, m", xlim=(0.0, 102.0), ylim=(0.0, None))
        ax.set_title("It gives way past half its weight")
        ax.legend(loc="upper left")
    tools.save(fig, args)

tools.report(args, numbers, rows, failure)

# With the default arguments the numbers are known: AMPLE's particles, which are half a domain away
# from these nodes, move by -2.656 m and 5.800 m.

if args.default:
    assert numbers["completed"] and numbers["cutbacks"] == 0
    assert abs(u_top / -2.70 - 1.0) < 0.01
    assert abs(u_toe / 5.79 - 1.0) < 0.01
