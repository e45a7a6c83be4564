# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bearing capacity of a strip footing.

demos/demo_footing.py is its simplest form and has the equations.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Bearing capacity of a smooth strip footing on undrained soil.")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument(
    "--cell", type=kit.positive, default=0.125, help="background cell size at the footing, m"
)
parser.add_argument(
    "--particles-per-cell", type=kit.whole, default=2, help="quadrilaterals, each way"
)
parser.add_f_bar("patch")
parser.add_mixed()
parser.add_order()
parser.add_argument(
    "--strip",
    choices=("body", "background"),
    default="body",
    help="what the strip holds: facets of the soil, or nodes of the background",
)
parser.add_argument(
    "--finer", type=kit.count, default=0, help="how often cells are halved towards the strip's edge"
)
parser.add_argument("--small-strain", action="store_true", help="material of small strain")
parser.add_steps(40)
args = parser.parse()

comm = MPI.COMM_WORLD
half_width, size, settlement = 0.5, 5.0, 0.002  # m
young, poisson, cohesion = 1e7, 0.48, 490.0  # kPa, -, kPa
limit = (2.0 + np.pi) * cohesion
h = half_width / max(1, round(half_width / args.cell))

# The lines of the body: cells of `--cell` where the soil flows, 1.75 m to the side and 1 m deep,
# and from there on each a fifth longer than the one before. (The cell is rounded so that the strip
# ends at a line.)

across, up = kit.lines(h, 1.75, size), size - kit.lines(h, 1.0, size)[::-1]
across, up = kit.finer_at(half_width, across, args.finer), kit.finer_at(size, up, args.finer)
edge = h / 2**args.finer  # the cells at the strip's edge

# The background has the same lines but for two shifts, and two more rows of cells above the ground
# as room for the heave. The strip's edge is a singular point, and two things about it are decided
# by the lines around it (docs/supports.md has the numbers). The soil under the strip is held as
# one piece as far as the background's cells under its facets reach: if its last corner passes a
# line, as it is pressed outwards by up to 1 mm, the next cell is held too. So a line is 0.04 cells
# beyond the edge. And the soil beside the strip can only leave it behind where the two lie on
# different sides of a horizontal line; if that happens late, the pressure falls. So the ground
# starts 0.1 mm above a line, which the strip passes at once. A strip on nodes of the background has
# lines at its edge and at the ground.

on_body = args.strip == "body"
beyond, over = (0.04 * edge, 1e-4) if on_body else (0.0, 0.0)  # m
taper = np.clip((size - across) / 2.0, 0.0, 1.0) * (across > 0.0)
heights = np.append(up - over * np.clip(up, 0.0, 1.0), size - over + h * np.arange(1, 3))
background = kit.grid([across + beyond * taper, heights], mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
each = args.particles_per_cell
body = kit.grid([kit.divided(across, each), kit.divided(up, each)], kit.DOMAINS[args.domain])

# Quadrilaterals of degree 1 have 2 by 2 points here.

if args.quadrature_degree is None and args.domain == "quad" and args.degree == 1:
    args.quadrature_degree = 2
particles = mpm.Particles(body, V, **kit.order(args))

# Rollers on grid lines, and the strip: it presses on the facets of the body that lie under it, or
# moves the nodes of the background that lie there at first.

background.topology.create_connectivity(1, 2)


def held(component: int, where, value: float = 0.0) -> fem.DirichletBC:
    facets = mesh.locate_entities(background, 1, where)
    dofs = fem.locate_dofs_topological(V.sub(component), 1, facets)
    return fem.dirichletbc(value, dofs, V.sub(component))


def strip(x: np.ndarray) -> np.ndarray:
    """The strip's points on the ground."""
    return np.isclose(x[1], size) & (x[0] < half_width * (1.0 + 1e-9))


under = mesh.locate_entities_boundary(body, 1, strip)
tags = mesh.meshtags(body, 1, np.sort(under), np.full(len(under), 1, np.int32))
footing = (
    mpm.boundary.roller(particles, tags, 1, normal=(0.0, -1.0), value=settlement)
    if on_body
    else held(1, strip, -settlement)
)
law = mpm.materials.SmallStrainVonMises if args.small_strain else mpm.materials.VonMises

problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        law(young, poisson, rho_y=np.sqrt(2.0) * cohesion),
        f_bar=args.f_bar if args.mixed == "none" else "none",
    ),
    bcs=[
        held(0, lambda x: np.isclose(x[0], 0.0) | np.isclose(x[0], size)),
        held(1, lambda x: np.isclose(x[1], 0.0)),
        *([] if on_body else [footing]),
    ],
    supports=[footing] if on_body else [],
    mixed=None if args.mixed == "none" else args.mixed,
    solver=mpm.Solver(petsc_options_prefix="footing_", stabilisation=kit.stabilisation(args)),
)

# The Dirichlet values are totals at full load, so the load factor is the share of the settlement.

path = [(0.0, 0.0)]
failure = None
try:
    for step in kit.progress(problem.steps(**kit.chosen(args)), args.steps, args):
        path.append((step.load, -problem.reaction(footing)[1] / half_width))
except mpm.MPMError as error:
    failure = error

# The mean pressure at the end over the limit (2); by how much the pressure rose over the last
# tenth of the settlement: a limit load has been reached if that is nothing; and the largest fall
# below an earlier pressure, over the limit.

load, pressure = np.array(path).T
drop = float(np.max(np.maximum.accumulate(pressure) - pressure)) / limit
numbers = {
    **kit.outcome(problem.history, failure),
    "pressure": pressure[-1],
    "limit": limit,
    "ratio": pressure[-1] / limit,
    "plateau": kit.rise(load, pressure),
    "drop": drop,
    "peak": pressure.max() / limit,
    "most_solves": max((step.iterations for step in problem.history.steps), default=0),
    "particles": particles.num_global,
}
remedy = f"F-bar: {args.f_bar}" if args.mixed == "none" else f"mixed: {args.mixed}"
rows = [
    ("particles", f"{particles.num_global} ({args.domain}), {remedy}"),
    ("cells at the footing", f"{h:g} m, {each} particles each way"),
    ("steps", f"{len(path) - 1}, settlement {1e3 * settlement * load[-1]:g} mm"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("pressure", f"{pressure[-1]:.0f} kPa, limit {limit:.0f} kPa, ratio {numbers['ratio']:.3f}"),
    ("rise over the last tenth", f"{100.0 * numbers['plateau']:.2f} %"),
    ("largest fall", f"{100.0 * drop:.2f} % of the limit"),
]

# The picture: where the soil flows, with the displacement magnified, and the pressure.

if args.plot:
    fig, axes = kit.figure(13.0, 5.0, [["soil", "path"]], width_ratios=[1.7, 1.0])
    warp = 60.0
    colours = mpm.plot.domains(
        particles,
        100.0 * particles.plastic_strain,
        ax=axes["soil"],
        warp=warp,
        cmap="YlGnBu",
        vmin=0.0,
        linewidth=0.15,
    )
    if comm.rank == 0:
        ax = axes["soil"]
        sunk = size - warp * settlement * load[-1]
        ax.fill_between([0.0, half_width], sunk, sunk + 0.12, color=kit.COLOURS["grey"])
        ax.set(xlim=(0.0, 2.0), ylim=(size - 1.15, size + 0.18), xlabel="x, m", ylabel="y, m")
        ax.set_title(f"Soil under the strip, displacement times {warp:g}")
        fig.colorbar(colours, ax=ax, label="plastic strain, %", shrink=0.7)
        ax = axes["path"]
        ax.axhline(limit, color="0.2", lw=1.2, ls="--")
        ax.text(2.0, 0.985 * limit, "Prandtl", va="top", ha="right", color="0.2")
        ax.plot(1e3 * settlement * load, pressure, color=kit.COLOURS["blue"])
        ax.set(xlabel="settlement, mm", ylabel="mean pressure, kPa")
        ax.set(xlim=(0.0, None), ylim=(0.0, None))
        ax.set_title(f"{numbers['ratio']:.3f} of the limit ({remedy})")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the limit is met from above, and kept.

if args.default:
    assert 0.98 < numbers["ratio"] < 1.03
    assert abs(numbers["plateau"]) < 0.005
    assert numbers["drop"] < 0.003
