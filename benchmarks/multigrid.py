# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Multigrid beside MUMPS on a column that slumps in space, and beside stock finite elements.

The column is a quarter of an elastoplastic block of 8 x 8 x 4 on hexahedra, whose weight grows to
20 kN/m3 in four steps: elastic, two thirds plastic, nine tenths plastic. ``--fem`` solves linear
elasticity of stock DOLFINx on a mesh of about as many unknowns with GAMG, as DOLFINx's demo of
elasticity does, in the same process, and compares it with multigrid on the column's last tangent.
``--saddle`` runs scenes with a pressure or water beside the displacements instead. The solver
``full`` is ``direct`` without blocks of low rank. Seconds are this process's CPU time. ``--bytes``
lists what the problem keeps after the last step, in bytes an unknown.
"""

from __future__ import annotations

import argparse
import gc
import json
import resource
import time
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from solvers import HEXAHEDRON, QUADRILATERAL, box, rollers

import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc as fem_petsc

import mpm_dolfinx as mpm
from mpm_dolfinx.solvers.multigrid import Multigrid
from mpm_dolfinx.solvers.products import acting

PLANES = [(axis, 0.0) for axis in range(3)]
COMM = MPI.COMM_WORLD


def column(n: int, solver: str, spread: bool = False) -> mpm.QuasiStaticProblem:
    """Return the column, n background cells wide; spread over ranks as its background is."""
    background = box([8.0, 8.0, 4.5], [2 * n, 2 * n, round(4.5 * n / 4)], HEXAHEDRON)
    V = fem.functionspace(background, ("Lagrange", 1, (3,)))
    particles = mpm.Particles(box([4.0] * 3, [2 * n] * 3, HEXAHEDRON), V)
    if spread:
        particles.repartition()
    return mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.VonMises(1e6, 0.3, rho_y=20e3),
            density=2000.0,
            body_force=(0.0, 0.0, -10.0),
        ),
        bcs=rollers(V, *PLANES),
        solver=mpm.Solver(
            petsc_options={"mat_mumps_icntl_35": 0} if solver == "full" else None,
            stabilisation="ghost",
            linear="direct" if solver == "full" else solver,
        ),
    )


def run(n: int, solver: str, steps: int) -> tuple[mpm.QuasiStaticProblem, dict[str, Any]]:
    """Make the first steps; return the problem and what they took."""
    problem = column(n, solver)
    rows, before, counted = [], time.process_time(), 0.0
    path = problem.steps(4)
    for _ in range(steps):
        step = next(path)
        count = problem.history.statistics["krylov_iterations"]
        now = time.process_time()
        rows.append({"seconds": now - before, "newton": step.iterations, "krylov": count - counted})
        before, counted = now, count
    moved = problem.particles.displacement.x.array.reshape(-1, 3)[:, 2]
    return problem, {
        "solver": solver,
        "unknowns": problem.history.statistics["free_dofs"],
        "steps": rows,
        "seconds": sum(row["seconds"] for row in rows),
        "sink": COMM.allreduce(float(moved.min()), MPI.MIN),
        "megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def kept(problem: mpm.QuasiStaticProblem, least: float = 0.05) -> dict[str, float]:
    """Return the bytes an unknown of what a problem holds: arrays of numbers, and matrices.

    What DOLFINx and PETSc hold besides is not among them.

    Args:
        problem: The problem.
        least: Bytes an unknown over 1000 below which nothing is listed.

    Returns:
        By the classes on the way to it, the largest first.
    """
    unknowns = problem.history.statistics["free_dofs"]
    found: dict[str, float] = {}
    seen, left = {id(problem), problem.A.handle}, [(problem, "problem")]  # (of A the arrays)
    while left:
        one, name = left.pop()
        for other in gc.get_referents(one):
            while isinstance(other, np.ndarray) and isinstance(other.base, np.ndarray):
                other = other.base
            shared = isinstance(other, type | str) or type(other).__module__.startswith("ufl")
            key = other.handle if isinstance(other, PETSc.Mat) else id(other)
            if shared or key in seen:
                continue
            seen.add(key)
            if isinstance(other, PETSc.Mat | np.ndarray):
                matrix = isinstance(other, PETSc.Mat)
                size = 12.0 * other.getInfo()["nz_used"] if matrix else float(other.nbytes)
                kind = "matrix" if matrix else f"{other.dtype} {other.shape[1:]}"
                key = f"{name} {kind}"
                found[key] = found.get(key, 0.0) + size / unknowns
            elif not callable(other) or hasattr(other, "__dict__"):
                plain = isinstance(other, dict | list | tuple)
                left.append((other, name if plain else f"{name[-60:]}.{type(other).__name__}"))
    large = sorted(found.items(), key=lambda pair: -pair[1])
    return {name: size for name, size in large if size > 1e3 * least}


def timed(ksp: PETSc.KSP, K: PETSc.Mat, b: PETSc.Vec, make: Any) -> dict[str, Any]:
    """Return seconds of the first set-up, of one more for new values, and of a solve to 1e-6."""
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=1e-6, atol=0.0, max_it=1000)
    seconds = []
    for _ in range(2):
        K.setValue(K.getOwnershipRange()[0], K.getOwnershipRange()[0], 0.0, addv=True)
        K.assemble()
        start = time.process_time()
        make()
        ksp.setUp()
        seconds.append(time.process_time() - start)
    x = b.duplicate()
    start = time.process_time()
    ksp.solve(b, x)
    solved = time.process_time() - start
    left = (b - K * x).norm() / b.norm()
    return {
        "first": seconds[0],
        "again": seconds[1],
        "solve": solved,
        "iterations": ksp.getIterationNumber(),
        "residual": left,
    }


def tangent(problem: mpm.QuasiStaticProblem) -> dict[str, Any]:
    """Return what multigrid takes for a tangent of the body where it is."""
    change = [np.zeros_like(problem.particles.increment.x.array)]
    problem.reduced.begin(change, 1.0)
    x = PETSc.Vec().createMPI(problem.reduced.unknowns.sizes, comm=COMM)
    F = x.duplicate()
    problem.particles.load.value = float(problem.particles.load.value) + 0.25
    problem.reduced.residual(x, F)
    K = problem.reduced.tangent()
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    ksp = PETSc.KSP().create(COMM)
    made: list[Multigrid] = []

    def make() -> None:
        if not made:
            levels = problem.reduced.levels.interpolations(600)
            made.append(Multigrid(ksp.getPC(), levels, True))
        ksp.setOperators(acting(K), K)
        made[0].set(K)

    entries = K.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]
    return {"unknowns": K.getSize()[0], "row": entries / K.getSize()[0], **timed(ksp, K, F, make)}


def elasticity(unknowns: float) -> dict[str, Any]:
    """Return what GAMG takes for stock finite elements of a cube with about as many unknowns."""
    n = round((unknowns / 3) ** (1 / 3)) - 1
    domain = box([4.0] * 3, [n] * 3, HEXAHEDRON)
    V = fem.functionspace(domain, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    mu, lmbda = 1e6 / 2.6, 0.3e6 / (1.3 * 0.4)

    def strain(w: Any) -> Any:
        return ufl.sym(ufl.grad(w))

    stress = 2.0 * mu * strain(u) + lmbda * ufl.tr(strain(u)) * ufl.Identity(3)
    bcs = rollers(V, *PLANES)
    measure = ufl.dx(metadata={"quadrature_degree": 2})
    A = fem_petsc.assemble_matrix(fem.form(ufl.inner(stress, strain(v)) * measure), bcs=bcs)
    A.assemble()
    b = fem_petsc.assemble_vector(fem.form(-2e4 * v[2] * ufl.dx))
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    for bc in bcs:
        bc.set(b.array_w)
    modes = [fem.Function(V) for _ in range(6)]
    for axis in range(3):
        modes[axis].interpolate(lambda x, a=axis: np.eye(3)[a][:, None] * np.ones(x.shape[1]))
    for number, (i, j) in enumerate(((0, 1), (1, 2), (2, 0))):

        def turn(x: Any, i: int = i, j: int = j) -> Any:
            values = np.zeros_like(x)
            values[i], values[j] = -x[j], x[i]
            return values

        modes[3 + number].interpolate(turn)
    vectors = [A.createVecRight() for _ in modes]
    for vector, mode in zip(vectors, modes, strict=True):
        vector.array_w[:] = mode.x.array[: vector.getLocalSize()]
    kept: list[PETSc.Vec] = []
    for vector in vectors:
        for other in kept * 2:
            vector.axpy(-vector.dot(other), other)
        vector.normalize()
        kept.append(vector)
    A.setNearNullSpace(PETSc.NullSpace().create(vectors=kept, comm=COMM))
    A.setOption(PETSc.Mat.Option.SPD, True)
    ksp = PETSc.KSP().create(COMM)
    ksp.setOptionsPrefix("stock_")
    options = PETSc.Options()
    for key, value in {
        "mg_levels_ksp_type": "chebyshev",
        "mg_levels_pc_type": "jacobi",
        "mg_levels_ksp_chebyshev_esteig_steps": 20,
    }.items():
        options[f"stock_{key}"] = value
    ksp.getPC().setType("gamg")
    ksp.setFromOptions()

    def make() -> None:
        ksp.setOperators(A, A)

    entries = A.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]
    return {"unknowns": A.getSize()[0], "row": entries / A.getSize()[0], **timed(ksp, A, b, make)}


def squeezed(dim: int, n: int, law: mpm.materials.Material, solver: str) -> mpm.QuasiStaticProblem:
    """Return a heavy body of degree 2 with a pressure, half as wide as its background."""
    cell, domain = (QUADRILATERAL, mesh.CellType.triangle) if dim == 2 else (HEXAHEDRON, HEXAHEDRON)
    V = fem.functionspace(box([8.0] * dim, [2 * n] * dim, cell), ("Lagrange", 2, (dim,)))
    rule = None if dim == 2 else 4
    body = box([4.0] * dim, [n] * dim, domain)
    return mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V, degree=2, quadrature_degree=rule),
            law,
            density=1.0,
            body_force=(*[0.0] * (dim - 1), -8e3),
        ),
        bcs=rollers(V, *PLANES[:dim]),
        mixed="pressure",
        solver=mpm.Solver(linear=solver),
    )


def drained(n: int, solver: str) -> mpm.PorousProblem:
    """Return a block with water under a load, drained on its top."""
    V = fem.functionspace(box([1.5] * 2, [3 * n // 2] * 2, QUADRILATERAL), ("Lagrange", 2, (2,)))
    body = box([1.0] * 2, [2 * n] * 2, QUADRILATERAL)
    body.geometry.x[:, 1] += 0.01
    top = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[1], 1.01))
    base = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[1], 0.01))
    facets = np.concatenate([top, base])
    order = np.argsort(facets)
    tags = np.repeat([1, 2], [len(top), len(base)]).astype(np.int32)
    markers = mesh.meshtags(body, 1, facets[order], tags[order])
    particles = mpm.Particles(body, V, degree=2, quadrature_degree=4)
    return mpm.PorousProblem(
        mpm.Body(
            particles,
            mpm.materials.LinearElastic(1e3, 0.25),
            tractions=[((0.0, -1.0), 1)],
            facet_tags=markers,
            pore_fluid=mpm.PoreFluid(1e-3, drained=[(0.0, 1)]),
        ),
        bcs=rollers(V, (0, 0.0)),
        supports=[mpm.boundary.roller(particles, markers, 2, (0.0, -1.0))],
        solver=mpm.Solver(linear=solver),
    )


def saddles(small: bool) -> list[dict[str, Any]]:
    """Run the scenes with a pressure or water by either solver; return what they took."""
    laws = mpm.materials
    plastic, elastic = laws.VonMises(1e6, 0.4999, rho_y=20e3), laws.Hencky(1e6, 0.4999)
    scenes: list[tuple[str, Any, int]] = [
        ("plane column, pressure", lambda s: squeezed(2, 9 if small else 18, plastic, s), 2),
        ("elastic block, pressure", lambda s: squeezed(3, 3 if small else 7, elastic, s), 1),
        ("plane block, water", lambda s: drained(8 if small else 32, s), 2),
    ]
    if not small:
        scenes.append(("column in space, pressure", lambda s: squeezed(3, 6, plastic, s), 3))
    rows = []
    for name, make, steps in scenes:
        for solver in ("direct", "multigrid"):
            problem = make(solver)
            before = time.process_time()
            if isinstance(problem, mpm.PorousProblem):
                problem.solve(time=0.2, dt=0.2 / steps)
            else:
                problem.solve(steps=steps)
            counts = problem.history.statistics
            rows.append(
                {
                    "scene": name,
                    "solver": solver,
                    "unknowns": counts["free_dofs"],
                    "seconds": time.process_time() - before,
                    "solves": problem.history.total_iterations,
                    "its": counts["krylov_iterations"] / counts["factorisations"],
                    "failures": counts["multigrid_failures"],
                }
            )
    return rows


def show(name: str, row: dict[str, Any]) -> None:
    """Print what one linear system takes."""
    print(
        f"  {name:22s} {row['unknowns']:8d} unknowns, {row['row']:4.0f} a row: first "
        f"{row['first']:.2f} s, again {row['again']:.2f} s, solve {row['solve']:.2f} s "
        f"({row['iterations']} iterations)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, a few seconds")
    parser.add_argument("--size", type=int, action="append", help="background cells of the width")
    parser.add_argument("--steps", type=int, default=3, help="load steps of four")
    parser.add_argument("--solver", choices=["direct", "multigrid", "full"], action="append")
    parser.add_argument("--fem", action="store_true", help="stock finite elements beside it")
    parser.add_argument("--bytes", action="store_true", help="what the problem keeps, listed")
    parser.add_argument("--saddle", action="store_true", help="scenes with a pressure or water")
    args = parser.parse_args()
    quiet = args.json or COMM.rank > 0
    results: dict[str, Any] = {"runs": [], "tangents": []}
    if args.saddle:
        results["saddles"] = saddles(args.smoke)
        for row in results["saddles"] if not quiet else ():
            print("{scene:26s} {solver:10s} {unknowns:7.0f} unknowns".format(**row), end=" ")
            print("{seconds:6.2f} s, {solves} solves, {its:.1f} its each".format(**row))
    for n in () if args.saddle else args.size or ([5] if args.smoke else [8, 16]):
        for solver in args.solver or ["direct", "multigrid"]:
            problem, row = run(n, solver, 2 if args.smoke else args.steps)
            results["runs"].append(row)
            row["bytes"] = kept(problem) if args.bytes else {}
            if not quiet:
                steps = ", ".join(
                    f"{s['seconds']:.2f} s ({s['newton']}/{s['krylov']:.0f})" for s in row["steps"]
                )
                print(
                    f"{solver:10s} {row['unknowns']:8.0f} unknowns: {steps}; whole "
                    f"{row['seconds']:.2f} s, {row['megabytes']:.0f} MB, sink {row['sink']!r}",
                    flush=True,
                )
                for name, size in row["bytes"].items():
                    print(f"  {size:7.0f}  {name}")
            if args.fem and solver == "multigrid":
                pair = {"multigrid": tangent(problem), "GAMG": elasticity(row["unknowns"])}
                results["tangents"].append(pair)
                if not quiet:
                    show("multigrid, column", pair["multigrid"])
                    show("GAMG, finite elements", pair["GAMG"])
    if COMM.rank == 0 and args.json:
        print(json.dumps(results))


if __name__ == "__main__":
    main()
