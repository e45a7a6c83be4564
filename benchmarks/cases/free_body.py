# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Finite element bodies beside stock DOLFINx: the same mesh, law, rule and load steps.

Three neo-Hookean bodies in UFL: a cantilever that its weight bends far, a ring that is sheared in
its middle (the generalised vortex of Kamojjala, Brannon, Sadeghirad & Guilkey 2015, at rest), and a
block in space that is squeezed between rough plates. Both are solved with Newton's method to a
relative residual of 1e-12 and MUMPS' Cholesky factors; the ratio is that of CPU seconds from the
meshes to the end, compilation apart.
"""

import time
from collections.abc import Callable

from mpi4py import MPI

import kit
import numpy as np

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Finite element bodies beside stock DOLFINx.")
parser.add_argument("--scene", choices=("cantilever", "vortex", "block"), default="cantilever")
parser.add_argument("--degree", type=int, choices=(1, 2, 3), default=1, help="of the elements")
parser.add_argument("--size", type=kit.whole, default=4, help="elements across")
parser.add_argument("--steps", type=kit.whole, default=5, help="load steps")
args = parser.parse()

comm = MPI.COMM_WORLD
QUADRILATERAL, HEXAHEDRON = mesh.CellType.quadrilateral, mesh.CellType.hexahedron
dim = 3 if args.scene == "block" else 2
MU, LAME = 1e4 / 2.6, 1e4 * 0.3 / 1.3 / 0.4


def energy(d: fem.Function) -> ufl.core.expr.Expr:
    """The neo-Hookean energy per undeformed volume."""
    F = ufl.Identity(dim) + ufl.grad(d)
    J = ufl.det(F)
    return MU / 2 * (ufl.tr(F.T * F) - dim) - MU * ufl.ln(J) + LAME / 2 * ufl.ln(J) ** 2


def ring(n: int) -> mesh.Mesh:
    """The ring 0.75 < R < 1.25 in n by about 12 n quadrilaterals."""
    around = round(4.0 * np.pi * n)
    angle, radius = np.meshgrid(
        2.0 * np.pi * np.arange(around) / around, np.linspace(0.75, 1.25, n + 1)
    )
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    number = np.arange(len(points)).reshape(n + 1, around)
    after = np.roll(number, -1, axis=1)
    cells = np.stack([number[:-1], number[1:], after[:-1], after[1:]], axis=-1).reshape(-1, 4)
    if comm.rank > 0:
        cells, points = cells[:0], points[:0]
    element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    return mesh.create_mesh(comm, cells.astype(np.int64), element, points)


def turned(domain: mesh.Mesh, load: fem.Constant) -> ufl.core.expr.Expr:
    """The body force of the vortex: that of a turn by `load h(R)`."""
    X = ufl.SpatialCoordinate(domain)
    R = ufl.sqrt(ufl.dot(X, X))
    s = 16.0 * (R - 1.0) ** 2
    first = -64.0 * (R - 1.0) * (1.0 - s)
    second = -64.0 * (1.0 - s) + 2.0 * 32.0**2 * (R - 1.0) ** 2
    angle = load * (1.0 - s) ** 2
    radial, around = MU * R * (load * first) ** 2, -MU * load * (3.0 * first + R * second)
    c, s = ufl.cos(angle), ufl.sin(angle)
    e = ufl.as_vector((c * X[0] - s * X[1], s * X[0] + c * X[1])) / R
    return radial * e + around * ufl.as_vector((-e[1], e[0]))


def body_mesh() -> mesh.Mesh:
    n = args.size
    if args.scene == "vortex":
        return ring(n)
    sides = [4 * n, n] if dim == 2 else [n, n, n]
    return kit.box(
        [4.0, 1.0] if dim == 2 else [1.0] * 3, sides, HEXAHEDRON if dim == 3 else QUADRILATERAL
    )


def held(W: fem.FunctionSpace) -> tuple[list[fem.DirichletBC], Callable[[float], None]]:
    """Dirichlet conditions, and what sets their values at a load."""
    if args.scene == "cantilever":
        return [mpm.held(W, x=0.0)], lambda load: None
    if args.scene == "vortex":
        W.mesh.topology.create_connectivity(1, 2)
        facets = mesh.exterior_facet_indices(W.mesh.topology)
        dofs = fem.locate_dofs_topological(W, 1, facets)
        return [fem.dirichletbc(np.zeros(2), dofs, W)], lambda load: None
    plate = fem.Constant(W.mesh, np.zeros(3))
    dofs = fem.locate_dofs_geometrical(W, lambda x: np.isclose(x[2], 1.0))

    def move(load: float) -> None:
        plate.value[2] = -0.3 * load

    return [mpm.held(W, z=0.0), fem.dirichletbc(plate, dofs, W)], move


def residual(d: fem.Function, load: fem.Constant, dx: ufl.Measure) -> ufl.Form:
    """The virtual work of stress and body force."""
    W = d.function_space
    v = ufl.TestFunction(W)
    R = ufl.derivative(energy(d) * dx, d, v)
    if args.scene == "vortex":
        R -= ufl.inner(turned(W.mesh, load), v) * dx
    elif args.scene == "cantilever":
        R -= load * ufl.inner(ufl.as_vector((0.0, -40.0)), v) * dx
    return R


def ours() -> tuple[fem.Function, float, mpm.History]:
    """The body as `mpm.Particles` without a background."""
    start = time.process_time()
    body = mpm.Particles(body_mesh(), degree=args.degree)
    bcs, move = held(body.W)
    load = fem.Constant(body.mesh, 0.0)
    how = mpm.Solver(petsc_options={"snes_rtol": 1e-12}, linear="direct", predictor=False)
    R = residual(body.displacement, load, body.dx)
    problem = mpm.ParticleProblem(R, body, bcs=bcs, solver=how)

    def update(t: float) -> None:
        load.value = t
        move(t)

    problem.solve(args.steps, update=update)
    return body.displacement, time.process_time() - start, problem.history


def stock() -> tuple[fem.Function, float]:
    """The body in stock DOLFINx."""
    start = time.process_time()
    rule = mpm.Particles(body_mesh(), degree=args.degree).geometry.quadrature_degree
    domain = body_mesh()
    W = fem.functionspace(domain, ("Lagrange", args.degree, (dim,)))
    d, load = fem.Function(W), fem.Constant(domain, 0.0)
    bcs, move = held(W)
    dx = ufl.dx(domain, metadata={"quadrature_degree": rule, "quadrature_rule": "default"})
    factors = {"ksp_type": "preonly", "pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"}
    newton = {
        "snes_linesearch_type": "basic",
        "snes_rtol": 1e-12,
        "snes_error_if_not_converged": True,
    }
    problem = kit.NonlinearProblem(
        residual(d, load, dx),
        d,
        bcs=bcs,
        petsc_options_prefix="stock_",
        petsc_options=factors | newton,
    )
    for k in range(1, args.steps + 1):
        load.value = k / args.steps
        move(k / args.steps)
        problem.solve()
    return d, time.process_time() - start


failure, rows, history = None, [], mpm.History()
numbers: dict = {"difference": None, "seconds_ratio": None, "unknowns": None}
try:
    # Forms are compiled by the first run of each.
    _ = ours(), stock()
    mine, seconds, history = ours()
    other, least = stock()
    size = kit.largest(np.abs(other.x.array))
    numbers = {
        "difference": kit.largest(np.abs(mine.x.array - other.x.array)) / size,
        "seconds_ratio": kit.total(seconds) / kit.total(least),
        "unknowns": int(history.statistics["free_dofs"]),
    }
    rows = [
        ("unknowns", str(numbers["unknowns"])),
        ("difference of displacements", f"{numbers['difference']:.1e}"),
        ("CPU seconds", f"{kit.total(seconds):.2f}, stock {kit.total(least):.2f}"),
    ]
    if args.plot and comm.rank == 0:
        fig, axes = kit.figure(7.0, 5.0)
        place = mine.function_space.tabulate_dof_coordinates()[:, :dim]
        x = place + mine.x.array.reshape(-1, dim)
        axes["main"].plot(x[:, 0], x[:, dim - 1], ".", color=kit.COLOURS["blue"], ms=3)
        axes["main"].set(aspect="equal", title="Nodes of the deformed body")
        kit.save(fig, args)
except mpm.MPMError as told:
    failure = told

kit.report(args, kit.outcome(history, failure) | numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert numbers["difference"] < 1e-9
