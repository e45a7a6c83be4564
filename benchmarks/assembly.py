# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Reduced tangents and residuals against DOLFINx's finite elements on the background.

Both sides have as many quadrature points and are timed in turns in one process; the number is
the least CPU time of several. Finite elements have one cell of four (eight) points where the
body has four (eight) domains of one point. Ratios are given for domains that fill the cells of
the background and, `moved`, for domains that lie across them, which see half as many nodes again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

import basix.ufl
import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc

import mpm_dolfinx as mpm

CELL = {2: mesh.CellType.quadrilateral, 3: mesh.CellType.hexahedron}
MATERIAL = mpm.materials.VonMises(young=1e6, poisson=0.3, rho_y=20e3)


def seconds(*tasks: Callable[[], Any], repeats: int = 5) -> list[float]:
    """The least CPU time of each task, the tasks taking turns."""
    times = [[] for _ in tasks]
    for _ in range(repeats):
        for task, own in zip(tasks, times, strict=True):
            start = time.process_time()
            task()
            own.append(time.process_time() - start)
    return [min(own) for own in times]


def resident() -> int:
    """Resident memory of this process in bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def box(dim: int, lower: float, upper: float, n: int) -> mesh.Mesh:
    corners = [[lower] * dim, [upper] * dim]
    create = mesh.create_rectangle if dim == 2 else mesh.create_box
    return create(MPI.COMM_WORLD, corners, [n] * dim, CELL[dim])


class Scene:
    """A block of particles, 2 in each direction of a background cell."""

    def __init__(self, count: float, dim: int, offset: float) -> None:
        self.dim = dim
        self.cells = max(2, round((count / 2**dim) ** (1 / dim)))
        h = 1.0 / self.cells
        self.background = box(dim, 0.0, 1.0 + h, self.cells + 1)
        self.V = fem.functionspace(self.background, ("Lagrange", 1, (dim,)))
        body = box(dim, offset * h, 1.0 + offset * h, 2 * self.cells)
        self.particles = mpm.Particles(body, self.V)
        random = np.random.default_rng(0)
        d = self.particles.displacement.x.array
        d[:] = 1e-3 * h * random.standard_normal(d.size)

    def prepared(self, problem: mpm.ParticleProblem) -> mpm.ParticleProblem:
        assert all(body.update() is None for body in problem.built.body_terms)
        problem.reduced.begin([np.zeros_like(problem.bodies[0].increment.x.array)], 1.0)
        return problem

    def plastic(self) -> mpm.ParticleProblem:
        force = (*(0.0,) * (self.dim - 1), -1.0)
        body = mpm.Body(self.particles, MATERIAL, body_force=force)
        return self.prepared(mpm.QuasiStaticProblem(body))

    def ufl(self) -> mpm.ParticleProblem:
        d = self.particles.displacement
        R = ufl.derivative(energy(d) * self.particles.dx, d)
        return self.prepared(
            mpm.ParticleProblem(R, self.particles, solver=mpm.Solver(petsc_options_prefix="ufl_"))
        )

    def injected_fem(self) -> Callable[[], None]:
        """Finite elements with a tangent given at the quadrature points."""
        element = basix.ufl.quadrature_element(
            self.background.basix_cell().name,
            value_shape=(self.dim,) * 4,
            scheme="default",
            degree=3,
        )
        A = fem.Function(fem.functionspace(self.background, element))
        A.x.array[:] = 1.0
        u, v = ufl.TrialFunction(self.V), ufl.TestFunction(self.V)
        i, j, k, m = ufl.indices(4)
        return self._fem(A[i, j, k, m] * ufl.grad(u)[k, m] * ufl.grad(v)[i, j])

    def ufl_fem(self) -> Callable[[], None]:
        u = fem.Function(self.V)
        return self._fem(ufl.derivative(ufl.derivative(energy(u), u), u))

    def _fem(self, integrand: Any) -> Callable[[], None]:
        dx = ufl.Measure("dx", domain=self.background, metadata={"quadrature_degree": 3})
        form = fem.form(integrand * dx)
        matrix = petsc.create_matrix(form)

        def assemble() -> None:
            matrix.zeroEntries()
            petsc.assemble_matrix(matrix, form)
            matrix.assemble()

        return assemble


def energy(u: Any) -> Any:
    """A compressible neo-Hookean energy."""
    dim = u.function_space.mesh.geometry.dim
    F = ufl.Identity(dim) + ufl.grad(u)
    ln_J = ufl.ln(ufl.det(F))
    return 0.5 * (ufl.inner(F, F) - dim) - ln_J + 0.5 * ln_J**2


def ratios(count: float, dim: int, offset: float) -> dict[str, float]:
    scene = Scene(count, dim, offset)
    fast, general = scene.plastic(), scene.ufl()
    mine, mine_ufl, stock, stock_ufl = seconds(
        fast.reduced.tangent, general.reduced.tangent, scene.injected_fem(), scene.ufl_fem()
    )
    n = scene.particles.num_local
    return {
        "particles": n,
        "fem": mine / stock,
        "fem_ufl": mine_ufl / stock_ufl,
        "us_tangent": 1e6 * mine / n,
    }


def plastic_update(count: float, dim: int = 2) -> float:
    """Microseconds per particle of an update in which all particles flow."""
    scene = Scene(count, dim, 0.0)
    problem = scene.plastic()
    X = scene.particles.W.tabulate_dof_coordinates()[:, :dim]
    shear = np.zeros_like(X)
    shear[:, 0] = 0.1 * X[:, 1]
    scene.particles.displacement.x.array[:] = shear.ravel()
    (body,) = problem.built.body_terms
    assert body.update() is None
    assert problem.yield_function.max() < 0.0  # of the last converged step
    (time_of,) = seconds(body.update)
    body.commit()
    assert (scene.particles.plastic_strain > 0.0).all()
    return 1e6 * time_of / scene.particles.num_local


def whole(count: float) -> dict[str, float]:
    """Memory and time per particle of all that comes before the linear solver."""
    before = resident()
    scene = Scene(count, 2, 0.37)
    problem = scene.plastic()
    problem.reduced.tangent()
    n = scene.particles.num_local

    def step() -> None:
        scene.particles.restore(scene.particles.displacement.x.array.reshape(-1, 2).copy())
        problem.reduced.unknowns.forget()
        problem.reduced.begin([np.zeros_like(problem.bodies[0].increment.x.array)], 1.0)
        for _ in range(5):
            problem.built.body_terms[0].update()
            problem.built.body_terms[0].forms.assemble_residual()
            problem.reduced.tangent()

    (time_of,) = seconds(step, repeats=2)
    return {
        "particles": n,
        "bytes_per_particle": (resident() - before) / n,
        "us_per_particle": 1e6 * time_of / n,
    }


def in_process(task: str, count: float) -> dict[str, float]:
    """Run a task in a process of its own, whose memory nobody else has touched."""
    command = [sys.executable, __file__, "--task", task, "--sizes", str(count)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--sizes", default="1e4,1e5,1e6", help="particles of the growth in 2-D")
    parser.add_argument("--particles", type=float, default=160e3, help="of the ratios in 2-D")
    parser.add_argument("--particles-3d", type=float, default=100e3, help="of those in 3-D")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it run?")
    parser.add_argument("--task", choices=["whole"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.smoke:
        args.sizes, args.particles, args.particles_3d = "400,1600", 1600, 512
    sizes = [float(size) for size in args.sizes.split(",")]
    if args.task:
        print(json.dumps(whole(sizes[0])))
        return
    plane, moved = (ratios(args.particles, 2, offset) for offset in (0.0, 0.37))
    space = ratios(args.particles_3d, 3, 0.37)
    growth = [in_process("whole", size) for size in sizes]
    result = {
        "particles": plane["particles"],
        "ratio_fem": plane["fem"],
        "ratio_fem_ufl": plane["fem_ufl"],
        "ratio_fem_moved": moved["fem"],
        "ratio_fem_ufl_moved": moved["fem_ufl"],
        "ratio_fem_3d": space["fem"],
        "ratio_fem_ufl_3d": space["fem_ufl"],
        "us_per_particle_tangent": plane["us_tangent"],
        "us_per_particle_constitutive": plastic_update(args.particles),
        "growth": growth[-1]["us_per_particle"] / growth[0]["us_per_particle"],
        "us_per_particle_step": [g["us_per_particle"] for g in growth],
        "bytes_per_particle": growth[-1]["bytes_per_particle"],
        "sizes": [g["particles"] for g in growth],
    }
    if args.json:
        print(json.dumps(result))
        return
    for name, value in result.items():
        print(f"{name:32s} {value}")


if __name__ == "__main__":
    main()
