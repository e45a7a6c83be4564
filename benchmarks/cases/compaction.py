# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Compaction of an elastic column under its own weight.

demos/demo_compaction.py is its simplest form and has the equations.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Elastic column that shortens to half under its own weight.")
parser.add_argument("--elements", type=kit.whole, default=16, help="background cells, height")
parser.add_argument("--domain", choices=tuple(kit.DOMAINS), default="quad", help="domains")
parser.add_argument("--method", choices=kit.METHODS, default="cpdi2", help="rows of T")
parser.add_argument("--young", type=kit.positive, default=1e4, help="Young's modulus")
parser.add_steps(40)
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
    grid = kit.DOMAINS["hex" if dim == 3 else "quad"]
    background = kit.box(upper, [1] * up + [elements], grid)
    V = fem.functionspace(background, ("Lagrange", args.degree, (dim,)))
    body = kit.box(upper, [2] * up + [2 * elements], kit.DOMAINS[args.domain])

    bcs = []
    for axis in range(dim):
        ends = (0.0,) if axis == up else (0.0, width)
        facets = mesh.locate_entities_boundary(
            background, up, lambda x, i=axis, ends=ends: np.isclose(x[i][:, None], ends).any(axis=1)
        )
        dofs = fem.locate_dofs_topological(V.sub(axis), up, facets)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))

    particles = mpm.Particles(body, V, method=args.method, **kit.order(args))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.Hencky(young, poisson),
            density=density,
            body_force=(0.0,) * up + (-gravity,),
        ),
        bcs=bcs,
        solver=mpm.Solver(
            petsc_options_prefix="compaction_", stabilisation=kit.stabilisation(args)
        ),
    )
    return particles, problem


# The exact solution (5), (6) as functions of the initial height.

modulus = young * (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
k = weight / modulus


def exact_stress(Y):
    return -weight * (height - Y)


def exact_position(Y):
    w, bottom = kit.lambert_w(k * (height - Y)), kit.lambert_w(k * height)
    return ((bottom + bottom**2 / 2.0) - (w + w**2 / 2.0)) / k


# The errors (7). `particles` hands out arrays of the particles that this rank owns; `kit.mean`
# sums over ranks.


def errors(particles: mpm.Particles) -> tuple[float, float]:
    Y, volume = particles.initial_centroid[:, up], particles.initial_volume
    of_stress = np.abs(particles.stress[:, up, up] - exact_stress(Y)) / (weight * height)
    of_position = np.abs(particles.centroid[:, up] - exact_position(Y)) / height
    return kit.mean(of_stress, volume), kit.mean(of_position, volume)


# A run that cannot go on raises an `mpm.MPMError` and leaves the particles at the last converged
# step.

particles, problem = column(args.elements)
failure = None
try:
    problem.solve(**kit.chosen(args), progress=not args.json)
except mpm.MPMError as error:
    failure = error

# The residuals of the first step show Newton's method at work: once it is near, each of them is
# about the square of the one before.

error, error_position = errors(particles)
top = kit.largest(kit.nodes(particles)[:, up])
numbers = {
    **kit.outcome(problem.history, failure),
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
    fig, axes = kit.figure(14, 6.2, [["column", "stress", "error"]], width_ratios=[0.55, 2.6, 2.6])
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
    y, s = kit.gathered(particles.centroid[:, up]), kit.gathered(values)
    sizes, found = [8, 16, 32, 64], []
    for elements in sizes:
        other, again = column(elements)
        again.solve(**kit.chosen(args))
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
        ax.plot(exact_stress(Y) / 1e3, exact_position(Y), color=kit.COLOURS["grey"], label="exact")
        ax.plot(s, y, "o", ms=5, mew=0, color=kit.COLOURS["blue"], label="particles")
        ax.set(xlabel="vertical Cauchy stress, kPa", ylabel="height now, m", ylim=(0.0, None))
        ax.set_title(f"Stress: off by {100 * error:.2g} % of its range")
        ax.legend(loc="upper left")

        ax = axes["error"]
        sizes, found = np.array(sizes), np.array(found)
        ax.loglog(sizes, found[:, 0], "o-", color=kit.COLOURS["blue"], label="stress, (7)")
        ax.loglog(sizes, found[:, 1], "s-", color=kit.COLOURS["orange"], label="position, (7)")
        slope = found[0, 0] * 1.5 * (sizes / sizes[0]) ** -1.0
        ax.loglog(sizes, slope, "--", color=kit.COLOURS["grey"], lw=1.2, label="first order")
        ax.set_xticks(sizes, [str(n) for n in sizes])
        ax.minorticks_off()
        ax.set(xlabel="background cells over the height", ylabel="relative error")
        ax.set_title("Finer background, smaller error")
        ax.legend(loc="lower left")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert error < 2.7e-3 and error_position < 1e-3
    assert numbers["iterations"] <= 130
    assert abs(top - exact_position(height)) < 1e-2
