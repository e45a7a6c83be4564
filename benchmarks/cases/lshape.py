# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An L-shaped elastic body: the error beside its estimate.

The arms are 2 long and 1 wide. One end is clamped, the other is loaded; the re-entrant corner and
the ends of the clamped side are singular. The background's cells are `1 / cells`, those of the
body half as wide; `--offset` moves the background by so many of its cells.

The energy of the load tells the error, as nothing else does work: for linear elasticity the energy
norm of the error is `sqrt(W - W_h)`, where the limit W is extrapolated from finite elements of
degree 2 on three meshes.

With `--adapt TOLERANCE` nodes of the body are freed until the estimate is at most that, or as near
to the error of the body's own elements as it can come.
"""

from mpi4py import MPI

import kit
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("L-shaped elastic body: the error, and its estimate.")
parser.add_argument("--cells", type=kit.whole, default=8, help="background cells a unit length")
parser.add_argument("--offset", type=float, default=0.0, help="of the background, in cells")
parser.add_argument("--space", type=int, choices=(2, 3), default=2, help="dimensions")
parser.add_argument("--steps", type=kit.whole, default=1, help="load steps")
parser.add_argument("--adapt", type=kit.positive, help="error at which no more nodes are freed")
parser.add_order()
args = parser.parse()

comm = MPI.COMM_WORLD
dim, degree, h = args.space, args.degree, 1.0 / args.cells
kind = mesh.CellType.quadrilateral if dim == 2 else mesh.CellType.hexahedron
LOAD = 1e-6  # so small that geometry stays linear
law = mpm.materials.LinearElastic(2.5, 0.25)


def body_mesh(n: int) -> mesh.Mesh:
    """The body in cells of 1 / n: a square of 2 without its upper right quarter."""
    square = kit.box([2.0, 2.0, 1.0][:dim], [2 * n, 2 * n, n][:dim], kind)
    middle = mesh.compute_midpoints(
        square, dim, np.arange(square.topology.index_map(dim).size_local, dtype=np.int32)
    )
    kept = np.flatnonzero((middle[:, 0] < 1.0) | (middle[:, 1] < 1.0)).astype(np.int32)
    return mesh.create_submesh(square, dim, kept)[0]


def work(problem: mpm.QuasiStaticProblem, tags: mesh.MeshTags) -> float:
    """The work of the load, over its square: the square of the energy norm."""
    body = problem.particles
    ds = ufl.Measure("ds", domain=body.mesh, subdomain_data=tags)
    done = fem.assemble_scalar(fem.form(-body.displacement[1] * ds(2)))
    return kit.total(done) / LOAD


def solved(
    n: int, V: fem.FunctionSpace | None, order: dict
) -> tuple[mpm.QuasiStaticProblem, float]:
    """The problem on a body of cells 1 / n, and the work of the load."""
    body = mpm.Particles(body_mesh(n), V, **order)
    tags = mpm.facet_tags(body.mesh, {1: mpm.region(y=2.0), 2: mpm.region(x=2.0)})
    traction = (0.0, -LOAD, 0.0)[:dim]
    given = mpm.Body(body, law, tractions=[(traction, 2)], facet_tags=tags)
    how = mpm.Solver(stabilisation=kit.stabilisation(args))
    if V is None:
        clamped = [mpm.held(body.W, where=mpm.region(y=2.0))]
        problem = mpm.QuasiStaticProblem(given, bcs=clamped, solver=how)
    else:
        supports = [mpm.boundary.fixed(body, tags, 1)]
        problem = mpm.QuasiStaticProblem(given, supports=supports, solver=how)
    problem.solve(args.steps, adapt=None if body.free_nodes is None else args.adapt)
    return problem, work(problem, tags)


# The limit, by finite elements of degree 2.

sizes = (8, 16, 32) if dim == 2 else (2, 4, 8)
coarse, middle, fine = (solved(n, None, {"degree": 2})[1] for n in sizes)
limit = fine + (fine - middle) / ((middle - coarse) / (fine - middle) - 1.0)

# The body on its background, and as finite elements.

counts = np.array([2 * args.cells + 3, 2 * args.cells + 3, args.cells + 3][:dim])
lower = np.full(dim, -h + args.offset * h)
create = mesh.create_rectangle if dim == 2 else mesh.create_box
background = create(comm, [lower, lower + h * counts], counts, kind)
V = fem.functionspace(background, ("Lagrange", degree, (dim,)))
order = kit.order(args)
order["quadrature_degree"] = order["quadrature_degree"] or 2 * order["degree"]
failure = None
numbers: dict = {"unknowns": None, "error": None, "estimate": None, "error_all_free": None}
history = mpm.History()
try:
    problem, found = solved(2 * args.cells, V, order)
    history, carried = problem.history, problem
    if args.adapt is not None:
        problem, found = solved(2 * args.cells, V, {**order, "free": []})
        history = problem.history
    numbers |= {
        "unknowns": int(history.statistics["free_dofs"]),
        "unknowns_carried": int(carried.history.statistics["free_dofs"]),
        "error": float(np.sqrt(1.0 - found / limit)),
        "estimate": problem.error(),
        "error_all_free": float(np.sqrt(1.0 - solved(2 * args.cells, None, order)[1] / limit)),
    }
except mpm.MPMError as told:
    failure = told

rows = []
if failure is None:
    rows = [
        ("unknowns", f"{numbers['unknowns']}"),
        ("error, in energy", f"{numbers['error']:.4f}"),
        ("estimate", f"{numbers['estimate']:.4f}, {numbers['estimate'] / numbers['error']:.2f}"),
        ("body's finite elements", f"{numbers['error_all_free']:.4f}"),
    ]
    if args.plot and dim == 2:
        mpm.plot.scene(problem, problem.error_of_particles(), path=args.plot)

kit.report(args, kit.outcome(history, failure) | numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert 0.8 < numbers["estimate"] / numbers["error"] < 1.2
