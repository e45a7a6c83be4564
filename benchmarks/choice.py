# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What ``Solver(linear="auto")`` chooses, and how long the other choice takes.

Scenes of all kinds, in space with few unknowns more than those from which on multigrid is chosen,
where it gains least: bodies that weigh on rollers, slump, touch and move. Kinds of which it takes
many iterations, and for which it is chosen later, are there below that, and some above it. Each
runs with MUMPS, with what is chosen and with multigrid; its are those of conjugate gradients, or of
FGMRES, over all linear solves. Seconds are this process's CPU time.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from solvers import HEXAHEDRON, QUADRILATERAL, box, rollers

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

COMM = MPI.COMM_WORLD
TETRAHEDRON, TRIANGLE = mesh.CellType.tetrahedron, mesh.CellType.triangle
PLASTIC, ELASTIC = mpm.materials.VonMises(1e6, 0.3, rho_y=20e3), mpm.materials.Hencky(1e6, 0.3)

type Made = tuple[Any, Callable[[], None]]


def bent(domain: mesh.Mesh, length: float) -> mesh.Mesh:
    """Move the vertices inside, so that no lines of a grid are left."""
    dim = domain.geometry.dim
    x = domain.geometry.x[:, :dim]
    bubble = np.prod(x * (length - x) * 4.0 / length**2, axis=1)[:, None]
    x += 0.05 * bubble * np.sin(np.outer(x @ [3.0, 5.0, 7.0][:dim], [1.0, 1.7, 2.3][:dim]))
    return domain


def graded(domain: mesh.Mesh, length: float) -> mesh.Mesh:
    """Make the cells near the corner half as large as those far from it."""
    x = domain.geometry.x
    x[:] = x * (2.0 + x / length) / 3.0
    return domain


def unstructured(length: float, size: float) -> mesh.Mesh:
    """Return a mesh of tetrahedra by gmsh."""
    import gmsh

    from dolfinx.io import gmsh as gmshio

    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    if COMM.rank == 0:
        gmsh.model.add("background")
        whole = gmsh.model.occ.addBox(0.0, 0.0, 0.0, length, length, length)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(3, [whole], 1, name="background")
        for option in ("Mesh.MeshSizeMin", "Mesh.MeshSizeMax"):
            gmsh.option.setNumber(option, size)
        gmsh.model.mesh.generate(3)
    domain = gmshio.model_to_mesh(gmsh.model, COMM, 0, gdim=3).mesh
    gmsh.finalize()
    return domain


def heavy(
    solver: str,
    n: int,
    dim: int = 3,
    cell: mesh.CellType = HEXAHEDRON,
    body: mesh.CellType = HEXAHEDRON,
    degree: int = 1,
    law: mpm.materials.Material = PLASTIC,
    weight: float = 8e3,
    steps: int = 2,
    change: Callable[[mesh.Mesh, float], mesh.Mesh] | None = None,
    background: Callable[[], mesh.Mesh] | None = None,
    method: str = "cpdi2",
    rule: int | None = None,
    f_bar: str = "none",
    stabilisation: str = "auto",
) -> Made:
    """A heavy cube of 4 m between rollers, n cells wide in a background twice as wide."""
    if background is not None:
        grid = background()
    else:
        grid = box([8.0] * dim, [2 * n] * dim, cell)
    if change is not None:
        grid = change(grid, 8.0)
    V = fem.functionspace(grid, ("Lagrange", degree, (dim,)))
    shape = box([4.0] * dim, [(2 if degree == 1 else 1) * n] * dim, body)
    if degree > 1 and body in (HEXAHEDRON, QUADRILATERAL):
        rule = 2 * degree
    particles = mpm.Particles(shape, V, method=method, degree=degree, quadrature_degree=rule)
    force = (*[0.0] * (dim - 1), -weight)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, law, density=1.0, body_force=force, f_bar=f_bar),
        bcs=rollers(V, *[(axis, 0.0) for axis in range(dim)]),
        solver=mpm.Solver(linear=solver, stabilisation=stabilisation),
    )
    return problem, lambda: problem.solve(steps=steps)


def tagged(body: mesh.Mesh, axis: int, *places: float) -> mesh.MeshTags:
    """Return tags 1, 2, ... of the facets on planes."""
    found = [
        mesh.locate_entities_boundary(body, 2, lambda x, p=p: np.isclose(x[axis], p))
        for p in places
    ]
    facets = np.concatenate(found)
    order = np.argsort(facets)
    tags = np.repeat(np.arange(1, len(found) + 1), [len(f) for f in found])[order]
    return mesh.meshtags(body, 2, facets[order], tags.astype(np.int32))


def pressed(solver: str, n: int, friction: float) -> Made:
    """A block into which a rigid sphere is pressed, that drags along a surface then."""
    grid = box([6.0, 6.0, 4.0], [n, n, 2 * n // 3], HEXAHEDRON)
    V = fem.functionspace(grid, ("Lagrange", 1, (3,)))
    body = box([5.0, 5.0, 3.0], [5 * n // 3, 5 * n // 3, n], HEXAHEDRON)
    body.geometry.x[:, :2] += 0.5
    particles = mpm.Particles(body, V)
    ball = mpm.contact.Rigid(
        particles,
        mpm.contact.sphere((3.0, 3.0, 5.0), 2.0),
        friction,
        facets=(tagged(body, 2, 3.0), 1),
    )
    base = mesh.locate_entities_boundary(V.mesh, 2, lambda x: np.isclose(x[2], 0.0))
    floor = fem.dirichletbc(np.zeros(3), fem.locate_dofs_topological(V, 2, base), V)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, ELASTIC), bcs=[floor], terms=[ball], solver=mpm.Solver(linear=solver)
    )

    def path(t: float) -> None:
        ball.move((0.3 * max(t - 0.5, 0.0), 0.0, -0.3 * min(2.0 * t, 1.0)))

    return problem, lambda: problem.solve(4, update=path)


def stacked(solver: str, n: int, friction: float) -> Made:
    """A quarter of a block on a larger one, pressed down so that it spreads along it."""
    grid = box([4.0] * 3, [n] * 3, HEXAHEDRON)
    lower, upper = (fem.functionspace(grid, ("Lagrange", 1, (3,))) for _ in range(2))
    base = box([3.0, 3.0, 2.0], [3 * n // 2, 3 * n // 2, n], HEXAHEDRON)
    top = box([2.0] * 3, [n] * 3, HEXAHEDRON)
    top.geometry.x[:, 2] += 2.0
    bodies = [mpm.Particles(base, lower), mpm.Particles(top, upper)]
    tags = [tagged(base, 2, 2.0), tagged(top, 2, 2.0, 4.0)]
    touch = mpm.contact.Pair(bodies[1], bodies[0], friction, facets=[(tags[1], 1), (tags[0], 1)])
    walls = [(0, 0.0), (1, 0.0)]
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(bodies[0], ELASTIC),
            mpm.Body(bodies[1], ELASTIC, tractions=[((0.0, 0.0, -5e4), 2)], facet_tags=tags[1]),
        ],
        bcs=[*rollers(lower, *walls, (2, 0.0)), *rollers(upper, *walls)],
        terms=[touch],
        solver=mpm.Solver(linear=solver),
    )
    return problem, lambda: problem.solve(2)


def squeezed(solver: str, n: int) -> Made:
    """A block that follows a pressure on its top, which stays normal to it."""
    grid = box([6.0, 6.0, 4.0], [n, n, 2 * n // 3], HEXAHEDRON)
    V = fem.functionspace(grid, ("Lagrange", 1, (3,)))
    body = box([4.0, 4.0, 3.0], [4 * n // 3, 4 * n // 3, n], HEXAHEDRON)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V), ELASTIC, pressures=[(2e5, 1)], facet_tags=tagged(body, 2, 3.0)
        ),
        bcs=rollers(V, (0, 0.0), (1, 0.0), (2, 0.0)),
        solver=mpm.Solver(linear=solver),
    )
    return problem, lambda: problem.solve(2)


def held(solver: str, n: int) -> Made:
    """A heavy cube on rollers on its own boundary, between the lines of the grid."""
    V = fem.functionspace(box([6.0] * 3, [2 * n] * 3, HEXAHEDRON), ("Lagrange", 1, (3,)))
    body = box([3.0] * 3, [2 * n] * 3, HEXAHEDRON)
    body.geometry.x[:] += 0.37
    particles = mpm.Particles(body, V)
    supports = []
    for axis in range(3):
        tags = tagged(body, axis, 0.37)
        supports.append(mpm.boundary.roller(particles, tags, 1, -np.eye(3)[axis]))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, PLASTIC, density=1.0, body_force=(0.0, 0.0, -8e3)),
        supports=supports,
        solver=mpm.Solver(linear=solver),
    )
    return problem, lambda: problem.solve(2)


def falling(solver: str, n: int) -> Made:
    """A block that hits a floor."""
    V = fem.functionspace(box([8.0] * 3, [2 * n] * 3, HEXAHEDRON), ("Lagrange", 1, (3,)))
    problem = mpm.DynamicProblem(
        mpm.Body(
            mpm.Particles(box([4.0] * 3, [2 * n] * 3, HEXAHEDRON), V),
            PLASTIC,
            density=2000.0,
            body_force=(0.0, 0.0, -10.0),
            velocity=lambda x: (0.0 * x[0], 0.0 * x[0], -2.0 * x[2] / 4.0),
        ),
        bcs=rollers(V, (0, 0.0), (1, 0.0), (2, 0.0)),
        solver=mpm.Solver(linear=solver),
    )
    return problem, lambda: problem.solve(time=0.08, dt=0.02)


class Scene(NamedTuple):
    """A scene, how to make it, and how large."""

    name: str
    make: Callable[..., Made]
    n: int
    small: int = 4


GMSH_IS_THERE = find_spec("gmsh") is not None
TET = {"cell": TETRAHEDRON, "body": TETRAHEDRON}
QUAD = {"dim": 2, "cell": QUADRILATERAL, "body": QUADRILATERAL}
TRI = {"dim": 2, "cell": TRIANGLE, "body": TRIANGLE}
NEARLY = mpm.materials.VonMises(1e6, 0.49, rho_y=20e3)
SMALL = mpm.materials.LinearElastic(1e6, 0.3)
SAND = mpm.materials.MohrCoulomb(1e6, 0.3, 2e4, 30.0, 5.0)
GMSH = {"background": partial(unstructured, 8.0, 0.4), "body": TETRAHEDRON}
GMSH_FINE = {"background": partial(unstructured, 8.0, 0.28), "body": TETRAHEDRON}
GMSH_2 = {"background": partial(unstructured, 8.0, 0.8), "body": TETRAHEDRON, "degree": 2}
GMSH_2_FINE = {**GMSH_2, "background": partial(unstructured, 8.0, 0.58)}
SCENES = [
    Scene("hexahedra", heavy, 9),
    Scene("ghost penalty", partial(heavy, stabilisation="ghost"), 9),
    Scene("elastic", partial(heavy, law=ELASTIC), 9),
    Scene("small strain", partial(heavy, law=SMALL), 9),
    Scene("Poisson's ratio 0.49", partial(heavy, law=NEARLY), 9),
    Scene("the same, F-bar", partial(heavy, law=NEARLY, f_bar="domain", rule=2), 9),
    Scene("GIMP", partial(heavy, method="gimp"), 9),
    Scene("graded grid", partial(heavy, change=graded), 9),
    Scene("bent hexahedra", partial(heavy, change=bent), 9),
    Scene("bent hexahedra, finer", partial(heavy, change=bent), 13),
    Scene("rollers on the body", held, 9),
    Scene("tetrahedra", partial(heavy, **TET), 9),
    Scene("tetrahedra on hexahedra", partial(heavy, body=TETRAHEDRON), 9),
    Scene("tetrahedra by gmsh", partial(heavy, **GMSH), 9),
    Scene("tetrahedra by gmsh, finer", partial(heavy, **GMSH_FINE), 13),
    Scene("degree 2", partial(heavy, degree=2), 5, 2),
    Scene("degree 2, ghost penalty", partial(heavy, degree=2, stabilisation="ghost"), 5, 2),
    Scene("degree 2, Poisson's ratio 0.49", partial(heavy, degree=2, law=NEARLY), 5, 2),
    Scene("degree 2, tetrahedra", partial(heavy, degree=2, **TET), 5, 2),
    Scene("degree 2, gmsh", partial(heavy, **GMSH_2), 5, 2),
    Scene("degree 2, tetrahedra, finer", partial(heavy, degree=2, **TET), 7, 2),
    Scene("degree 2, gmsh, finer", partial(heavy, **GMSH_2_FINE), 7, 2),
    Scene("degree 3", partial(heavy, degree=3, law=ELASTIC), 3, 1),
    Scene("degree 3, finer", partial(heavy, degree=3, law=ELASTIC), 4, 1),
    Scene("rigid sphere", partial(pressed, friction=0.0), 15, 6),
    Scene("rigid sphere, friction 0.3", partial(pressed, friction=0.3), 15, 6),
    Scene("rigid sphere, friction, finer", partial(pressed, friction=0.3), 19, 6),
    Scene("two bodies", partial(stacked, friction=0.0), 12, 4),
    Scene("two bodies, finer", partial(stacked, friction=0.0), 18, 4),
    Scene("two bodies, friction 0.3", partial(stacked, friction=0.3), 12, 4),
    Scene("two bodies, friction, finer", partial(stacked, friction=0.3), 18, 4),
    Scene("sand, not associated", partial(heavy, law=SAND, weight=4e3), 9),
    Scene("sand, finer", partial(heavy, law=SAND, weight=4e3), 13),
    Scene("pressure that follows", squeezed, 15, 6),
    Scene("pressure that follows, finer", squeezed, 22, 6),
    Scene("motion", falling, 11),
    Scene("plane", partial(heavy, **QUAD), 142, 10),
    Scene("plane, triangles", partial(heavy, **TRI), 142, 10),
    Scene("plane, degree 2", partial(heavy, degree=2, **QUAD), 71, 5),
]


def run(scene: Scene, solver: str, n: int) -> dict[str, Any]:
    """Run a scene; return what it took."""
    problem, solve = scene.make(solver, n)
    before = time.process_time()
    solve()
    seconds = time.process_time() - before
    counts = problem.history.statistics
    return {
        "seconds": seconds,
        "unknowns": counts["free_dofs"],
        "solves": problem.history.total_iterations,
        "cutbacks": problem.history.cutbacks,
        "krylov": counts["krylov_iterations"],
        "its": counts["krylov_iterations"] / max(1, counts["factorisations"]),
        "failures": counts["multigrid_failures"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, a few seconds")
    parser.add_argument("--only", default="", help="scenes that begin so")
    args = parser.parse_args()
    rows = []
    for scene in SCENES:
        if not scene.name.startswith(args.only) or ("gmsh" in scene.name and not GMSH_IS_THERE):
            continue
        n = scene.small if args.smoke else scene.n
        runs = {solver: run(scene, solver, n) for solver in ("direct", "auto", "multigrid")}
        ratio = runs["auto"]["seconds"] / runs["direct"]["seconds"]
        rows.append({"scene": scene.name, "ratio": ratio, **runs})
        if COMM.rank == 0 and not args.json:
            print(f"{scene.name:32s} {runs['direct']['unknowns']:6.0f} unknowns", end="")
            for solver, found in runs.items():
                told = "{seconds:6.2f} s, {solves} solves, {its:.1f} its".format(**found)
                print(f" | {solver} {told}", end="")
            print(f" | {ratio:.2f}", flush=True)
    chosen = [row["ratio"] for row in rows if row["auto"]["krylov"]]
    if COMM.rank == 0 and args.json:
        print(json.dumps({"scenes": rows, "slowest": max(chosen, default=1.0)}))
    elif COMM.rank == 0 and chosen:
        print(f"{len(chosen)} scenes with multigrid, at most {max(chosen):.2f} of MUMPS's seconds")


if __name__ == "__main__":
    main()
