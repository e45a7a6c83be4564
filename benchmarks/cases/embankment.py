# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An embankment that is built in lifts on soft clay, and how safe it is then.

Half of a bank 2 m high, 4 m wide from its axis to its shoulder and with slopes of 1:2, on 6 m of
clay with an undrained strength of 15 kPa that carries its own weight. The fill is placed in lifts,
each in three steps, and after the last one the strength of all soil is reduced until no equilibrium
is found. `built` says whether all lifts stand, `factor` is the factor of safety, `reason` why the
reduction ended, and `curve` has factors, displacements and rates. All by defaults, with averages
over patches, or `--recommended`, the way to limit loads that docs/limit-loads.md describes, with
lines of the grid that are bent along the slope.

Bishop's method has 2.03 for a cohesion of 2 kPa, of the slope as it is built. Weak ground lets the
bank settle by as much as makes its slope 4 % flatter, so compare with soil that is stiff,
`--stiffness 100`.
"""

from itertools import pairwise

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("An embankment in lifts on soft clay, and its factor of safety.")
parser.add_argument("--cohesion", type=kit.positive, default=2.0, help="of the fill, kPa")
parser.add_argument("--dilation-angle", type=float, default=0.0, help="of the fill, degrees")
parser.add_argument("--lifts", type=kit.whole, default=4, help="number of lifts")
parser.add_argument(
    "--line", type=kit.positive, help="distance of grid lines, m; 1, recommended 0.5"
)
parser.add_argument("--cell", type=kit.positive, help="size of domains, m; half that distance")
parser.add_argument("--steps", type=kit.whole, default=3, help="steps of each lift")
parser.add_argument("--tolerance", type=kit.positive, default=0.02, help="of the factor of safety")
parser.add_argument("--stiffness", type=kit.positive, default=1.0, help="of all soils, times this")
parser.add_argument(
    "--recommended",
    action="store_true",
    help="degree 2, one domain of four points in a cell of a grid along the slope, no averages",
)
args = parser.parse()
if args.recommended and args.cell:
    parser.error("argument --cell: not where --recommended, whose cells are those of the grid")

comm, quadrilateral = MPI.COMM_WORLD, mesh.CellType.quadrilateral
width, depth, height, crest, run, gravity = 26.0, 6.0, 2.0, 4.0, 2.0, (0.0, -10.0)  # m, m/s^2
line = args.line or (0.5 if args.recommended else 1.0)
cell = args.cell or 0.5 * line
levels = depth + height * np.arange(args.lifts + 1) / args.lifts


def reach(level: float) -> float:
    """From the axis to the slope."""
    return crest + run * (depth + height - level)


def block(low: float, high: float, right: float) -> mesh.Mesh:
    """A rectangle from the axis of the bank."""
    cells = [max(1, round(length / cell)) for length in (right, high - low)]
    return mesh.create_rectangle(comm, [[0.0, low], [right, high]], cells, quadrilateral)


def lift(low: float, high: float) -> mesh.Mesh:
    """A lift between two levels, as wide as the slope leaves it."""
    domain = block(low, high, reach(low))
    x = domain.geometry.x
    x[:, 0] *= reach(x[:, 1]) / reach(low)
    return domain


def along(lines: list[np.ndarray], over: float = 0.0) -> mesh.Mesh:
    """A grid whose upright lines lean with the slope above the ground, and reach beyond it."""
    domain, toe = mpm.grid(comm, lines), reach(depth)
    x, y = domain.geometry.x[:, :2].T
    slope = reach(np.clip(y, depth, depth + height)) + over
    beside = slope + (x - toe) * (width - slope) / (width - toe)
    domain.geometry.x[:, 0] = np.where(x < toe + 1e-9, x * slope / toe, beside)
    domain.geometry.x[:, 1] += over * np.clip(y / depth, 0.0, 1.0)
    return domain


if args.recommended:
    # Columns are as wide as two rows at the toe, as they lean together. What bulges must not come
    # beyond its cells, where next to nothing would hold it: they are a twentieth larger.
    toe = reach(depth)
    left = mpm.grid_lines(0.0, toe, 2.0 * line)
    right = mpm.grid_lines(toe, width, 2.0 * line, equal=(toe, toe + 4.0 * line))
    below = mpm.grid_lines(0.0, depth, line, equal=(depth - 2.0, depth))
    layers = [mpm.grid_lines(float(low), float(high), line) for low, high in pairwise(levels)]
    rows = np.unique(np.round(np.concatenate([below, *layers]), 12))
    rows = np.append(rows, rows[-1] + line * np.arange(1, 3))
    columns = np.append(left, right[1:])
    V = fem.functionspace(along([columns, rows], 0.05 * line), ("Lagrange", 2, (2,)))
    ground = mpm.Particles(along([columns, below]), V, degree=2, quadrature_degree=3)
    sides = {"bcs": [mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=width), mpm.held(V, y=0.0)]}
    f_bar, stabilisation = "none", None
else:
    # The grid reaches a line beyond the ground's side, which is held on the ground's own boundary.
    counts = [int(np.ceil(length / line - 1e-9)) + 1 for length in (width, depth + height)]
    grid = mesh.create_rectangle(
        comm, [[0.0, 0.0], [line * count for count in counts]], counts, quadrilateral
    )
    V = fem.functionspace(grid, ("Lagrange", 1, (2,)))
    ground = mpm.Particles(block(0.0, depth, width), V)
    tags = mpm.facet_tags(ground.mesh, {1: mpm.region(x=width)})
    sides = {
        "bcs": [mpm.held(V, 0, x=0.0), mpm.held(V, y=0.0)],
        "supports": [mpm.boundary.roller(ground, tags, 1, normal=(1.0, 0.0))],
    }
    f_bar, stabilisation = "patch", "auto"
fill = mpm.materials.MohrCoulomb(
    2e4 * args.stiffness, 0.3, args.cohesion, 32.0, args.dilation_angle
)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        ground,
        mpm.materials.Tresca(4500.0 * args.stiffness, 0.49, cohesion=15.0),
        density=1.6,
        body_force=gravity,
        f_bar=f_bar,
        initial_stress=mpm.geostatic(depth, 1.6, 0.8, gravity),
    ),
    **sides,
    solver=mpm.Solver(petsc_options_prefix="embankment_", stabilisation=stabilisation),
)

failure, factor, reason, standing, most, curve = None, np.nan, None, 0, 0, []
try:
    problem.solve()
    for number, (low, high) in enumerate(pairwise(levels), 1):
        if args.recommended:
            own = along([left, layers[number - 1]])
            placed = mpm.Particles(own, V, degree=2, quadrature_degree=3)
        else:
            placed = mpm.Particles(lift(float(low), float(high)), V)
        body = mpm.Body(placed, fill, density=1.9, body_force=gravity, f_bar=f_bar)
        problem.add(body, f"lift {number}")
        for step in kit.progress(problem.steps(args.steps), args.steps, args):
            most = max(most, step.iterations)
        standing = number
    found = mpm.strength_reduction(problem, tolerance=args.tolerance)
    factor, reason, curve = found.factor, found.reason, found.curve.tolist()
except mpm.MPMError as error:
    failure = error

numbers = {
    **kit.outcome(problem.history, failure),
    "built": int(standing == args.lifts),
    "factor": factor,
    "reason": reason,
    "most_solves": most,
    "curve": curve,
}
rows = [
    ("lifts that stand", f"{standing} of {args.lifts}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("most in a step of building", f"{most}"),
    ("factor of safety", f"{factor:.3f}, ended by {reason}"),
]
if args.plot:
    fig, axes = kit.figure(11.0, 4.0)
    for body in problem.bodies:
        mpm.plot.domains(body, body.plastic_strain, ax=axes["main"], cmap="YlGnBu", vmin=0.0)
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)
