# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Long flights of a bar: does any speed, step or degree win energy? It takes an hour.

    nice python docs/studies/flights.py [degree ...] > flights.txt

An elastic bar of small strains vibrates and flies through the cells in 400 steps of 0.2 to 16 times
what a wave needs for a cell, at eight speeds (waves have the speed 1), in both ways to treat what
the background cannot follow. Each line is one speed: the largest energy of all its flights and
steps over the first one less 1, the smallest one at the end of a flight, and the largest change of
the account, over the first energy.
"""

import sys

from mpi4py import MPI

import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

H, STEPS = 0.125, 400
SPEEDS = (0.0, 0.1, 0.25, 0.37, 0.5, 0.8, 1.0, 1.25)
CELLS = (0.2, 0.8, 2.0, 5.0, 16.0)


def flight(speed: float, cells: float, degree: int, out: str) -> tuple[float, float, float]:
    """Return what a flight wins, what it has at its end, and what its account has changed by."""
    dt = cells * H
    count = int(np.ceil((2.3 + speed * dt * STEPS) / H))
    kind, comm = mesh.CellType.quadrilateral, MPI.COMM_SELF
    background = mesh.create_rectangle(comm, [[0.0, 0.0], [count * H, H]], [count, 1], kind)
    V = fem.functionspace(background, ("Lagrange", degree, (2,)))
    body = mesh.create_rectangle(comm, [[0.3, 0.0], [1.3, H]], [16, 2], kind)
    across = V.sub(1).collapse()[0]
    held = fem.locate_dofs_geometrical((V.sub(1), across), lambda x: x[0] > -1.0)
    problem = mpm.DynamicProblem(
        mpm.Body(
            mpm.Particles(body, V, degree=degree),
            mpm.materials.LinearElastic(1.0, 0.0),
            density=1.0,
            velocity=lambda x: np.stack([speed + 0.1 * np.cos(np.pi * (x[0] - 0.3)), 0.0 * x[0]]),
        ),
        bcs=[fem.dirichletbc(fem.Function(across), held, V.sub(1))],
        out_of_range=out,
        solver=mpm.Solver(stabilisation=None),
    )
    energies = problem.solve(time=STEPS * dt, dt=dt).energies
    whole = np.array([energy.kinetic + energy.strain for energy in energies]) / (
        energies[0].kinetic + energies[0].strain
    )
    balances = np.array([energy.balance for energy in energies])
    return whole.max() - 1.0, whole[-1], float(np.ptp(balances)) / energies[0].kinetic


if __name__ == "__main__":
    print("| degree, speed | project: gain, end, account | reflect: gain, end, account |")
    print("| --- | --- | --- |")
    for degree in map(int, sys.argv[1:] or "12"):
        for speed in SPEEDS:
            columns = []
            for out in ("project", "reflect"):
                found = np.array([flight(speed, cells, degree, out) for cells in CELLS])
                gain, end, account = found[:, 0].max(), found[:, 1].min(), found[:, 2].max()
                columns.append(f"{gain:.1e}, {end:.4f}, {account:.1e}")
            print(f"| {degree}, {speed:g} | {' | '.join(columns)} |", flush=True)
