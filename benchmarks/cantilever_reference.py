# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The cantilever of the demo by finite elements of stock DOLFINx, in two ways.

    python benchmarks/cantilever_reference.py [--json] [--smoke] [--graded] [--poisson 0.4999]

A bar of 10 m by 1 m in plane strain, clamped at its left end, of Hencky's law with E = 12 MPa,
under a dead traction of 100 kPa downwards on its right end. With the principal logarithmic
strains e_1 and e_2, l = e_1 + e_2 = ln J and d = e_1 - e_2 its energy is

    psi = (lambda + mu) / 2 l^2 + mu / 2 d^2.

*Displacements*: elements of degree 3 and 4. For Newton's method the pressure (lambda + mu) l has a
value of its own at each quadrature point, which follows l to first order in each iteration; where
it has converged, the two are the same. *Mixed*: the pressure p is an unknown,

    psi = p l - p^2 / (2 (lambda + mu - a)) + a / 2 l^2 + mu / 2 d^2,

displacements of degree k, continuous pressures of degree k - 1. In the continuum a does not matter;
it is 3 mu. Without it (``--share 0``) a tension p adds - p (dl)^2 to the stiffness, which nothing
opposes within an element: on 40 by 4 cells of degree 2 J varies between 0.46 and 1.84 and the tip
moves too far, by 7e-3 of the length. Nothing of this package is used.
Tip: shortening and deflection at half depth of the right end, over the length.
The corners of the root are singular: in equal cells both ways come to about the same 4e-4 below
what they come to in cells that shrink at the root (``--graded``).
"""

from __future__ import annotations

import argparse
import json
from math import comb

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

import basix.ufl
import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc

LENGTH, DEPTH, YOUNG, LOAD = 10.0, 1.0, 12e6, 100e3
#: Ways, degrees of the displacements, and cells over the depth.
RUNS = [
    ("displacement", 3, (4, 8)),
    ("mixed", 2, (4, 8, 16)),
    ("displacement", 4, (2, 4, 8)),
    ("mixed", 3, (4, 8)),
    ("displacement", 3, (16,)),
]
#: The same in cells that shrink to nothing at the root and at its corners.
GRADED = [("mixed", 2, (8, 16, 24)), ("mixed", 3, (8, 12, 16)), ("displacement", 3, (8, 12, 16))]
SMOKE = [("displacement", 3, (1,)), ("mixed", 2, (1,))]
#: Newton iterations of a step that fails.
MOST = 25


def squared_difference(C: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
    """Return (e_1 - e_2)^2 of a right Cauchy-Green tensor, smooth where the two are equal.

    cosh(e_1 - e_2) = 1 + x with x = tr C / (2 sqrt(det C)) - 1, and arccosh(1 + x)^2 has a power
    series in x.
    """
    x = ufl.tr(C) / (2.0 * ufl.sqrt(ufl.det(C))) - 1.0
    small = ufl.lt(x, 0.05)
    far = 1.0 + ufl.conditional(small, 0.05, x)
    series = 0.0
    for n in range(10, 0, -1):
        series = x * (2.0 * (-1.0) ** (n - 1) * 2.0**n / (n**2 * comb(2 * n, n)) + series)
    return ufl.conditional(small, series, ufl.ln(far + ufl.sqrt(far**2 - 1.0)) ** 2)


class Beam:
    """The beam in elements of one degree, displacements alone or with the pressure as an unknown.

    Args:
        degree: Degree of the displacements; pressures are of one degree less.
        n: Cells over the depth.
        poisson: Poisson's ratio.
        mixed: Whether the pressure is an unknown.
        share: a over the shear modulus.
        graded: Whether sizes of cells go to zero with the distance from the root and from its
            corners, as its square root, in a quarter of the cells along.
    """

    def __init__(
        self, degree: int, n: int, poisson: float, mixed: bool, share: float, graded: bool = False
    ) -> None:
        along = (5 * n) // 2 if graded else 10 * n
        beam = mesh.create_rectangle(
            MPI.COMM_SELF, [[0.0, -0.5], [LENGTH, 0.5]], [along, n], mesh.CellType.quadrilateral
        )
        if graded:
            x, y = beam.geometry.x[:, 0], beam.geometry.x[:, 1]
            x[:] = LENGTH * (x / LENGTH) ** 2
            y[:] = 0.5 * np.sign(y) * (1.0 - (1.0 - 2.0 * np.abs(y)) ** 2)
        element = basix.ufl.element("Lagrange", beam.basix_cell(), degree, shape=(2,))
        if mixed:
            pressure = basix.ufl.element("Lagrange", beam.basix_cell(), degree - 1)
            element = basix.ufl.mixed_element([element, pressure])
        V = fem.functionspace(beam, element)
        self.mixed, self.w = mixed, fem.Function(V)
        u, p = ufl.split(self.w) if mixed else (self.w, None)
        mu = YOUNG / (2.0 * (1.0 + poisson))
        first = YOUNG * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)) + mu
        F = ufl.Identity(2) + ufl.grad(u)
        volume = ufl.ln(ufl.det(F))
        rule = 2 * degree + 2
        if not mixed:
            points = basix.ufl.quadrature_element(beam.basix_cell(), degree=rule)
            p = self.p = fem.Function(fem.functionspace(beam, points))
        psi = mu / 2.0 * squared_difference(F.T * F)
        psi += p * volume
        if mixed:
            kept = share * mu
            psi += kept / 2.0 * volume**2 - p**2 / (2.0 * (first - kept))
        end = mesh.locate_entities_boundary(beam, 1, lambda x: np.isclose(x[0], LENGTH))
        tags = mesh.meshtags(beam, 1, np.sort(end), np.full(len(end), 1, np.int32))
        dx = ufl.Measure("dx", domain=beam, metadata={"quadrature_degree": rule})
        ds = ufl.Measure("ds", domain=beam, subdomain_data=tags, subdomain_id=1)
        self.load = fem.Constant(beam, 0.0)
        test = ufl.TestFunction(V)
        residual = ufl.derivative(psi * dx + self.load * LOAD * u[1] * ds, self.w, test)
        tangent = ufl.derivative(residual, self.w)
        if not mixed:
            self.move, trial = fem.Function(V), ufl.TrialFunction(V)
            growth = [ufl.derivative(volume, self.w, v) for v in (test, trial, self.move)]
            residual += (first * volume - p) * growth[0] * dx
            tangent += first * growth[0] * growth[1] * dx
            at = points.custom_quadrature()[0]
            self.pressure = fem.Expression(first * (volume + growth[2]), at)
        self.R, self.K = fem.form(residual), fem.form(tangent)
        root = mesh.locate_entities_boundary(beam, 1, lambda x: np.isclose(x[0], 0.0))
        if mixed:
            space, _ = V.sub(0).collapse()
            dofs = fem.locate_dofs_topological((V.sub(0), space), 1, root)
            self.held = fem.dirichletbc(fem.Function(space), dofs, V.sub(0))
        else:
            dofs = fem.locate_dofs_topological(V, 1, root)
            self.held = fem.dirichletbc(np.zeros(2), dofs, V)
        self.solver = PETSc.KSP().create(MPI.COMM_SELF)
        self.solver.setType("preonly")
        self.solver.getPC().setType("lu")
        self.solver.getPC().setFactorSolverType("mumps")

    def solve(self, load: float) -> int:
        """Solve at a load from the present state; returns iterations, 0 where Newton fails."""
        self.load.value = load
        before = self.w.x.array.copy(), None if self.mixed else self.p.x.array.copy()
        held = self.held.dof_indices()[0]
        for iteration in range(1, MOST + 1):
            force = fem.assemble_vector(self.R)
            force.array[held] = 0.0
            A = petsc.assemble_matrix(self.K, bcs=[self.held])
            A.assemble()
            self.solver.setOperators(A)
            right, move = A.createVecs()
            right.setArray(-force.array)
            self.solver.solve(right, move)
            if not self.mixed:
                self.move.x.array[:] = move.array
                self.p.interpolate(self.pressure)
            self.w.x.array[:] += move.array
            change = float(np.abs(self.displacements(move.array)).max())
            for thing in (A, right, move):
                thing.destroy()
            if not np.isfinite(change) or change > LENGTH:
                break
            if change < 1e-9 * LENGTH:
                return iteration
        self.w.x.array[:] = before[0]
        if not self.mixed:
            self.p.x.array[:] = before[1]
        return 0

    def displacements(self, values: np.ndarray) -> np.ndarray:
        """The part of values of dofs that are displacements."""
        if not self.mixed:
            return values
        return values[self.w.function_space.sub(0).collapse()[1]]

    def tip(self) -> tuple[float, float]:
        """Shortening and deflection of the tip over the length."""
        u = self.w.sub(0).collapse() if self.mixed else self.w
        X = u.function_space.tabulate_dof_coordinates()
        at = int(np.argmin(np.abs(X[:, 0] - LENGTH) + np.abs(X[:, 1])))
        shortening, deflection = -u.x.array.reshape(-1, 2)[at] / LENGTH
        return float(shortening), float(deflection)


def tip(beam: Beam, steps: int) -> tuple[float, float, int]:
    """Return shortening and deflection of the tip, and Newton iterations: equal steps, cut back."""
    load, size, total = 0.0, 1.0 / steps, 0
    while load < 1.0 - 1e-12:
        iterations = beam.solve(min(load + size, 1.0))
        total += iterations or MOST
        if iterations:
            load = min(load + size, 1.0)
        else:
            size /= 2.0
            if size < 1e-4 / steps:
                raise RuntimeError(f"Newton's method stops at {load} of the load.")
    return *beam.tip(), total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes")
    parser.add_argument("--poisson", type=float, default=0.4999, help="Poisson's ratio")
    parser.add_argument("--share", type=float, default=3.0, help="a over mu, mixed")
    parser.add_argument("--steps", type=int, default=20, help="load steps")
    parser.add_argument("--graded", action="store_true", help="cells that shrink at the root")
    args = parser.parse_args()
    rows = []
    for way, degree, numbers in SMOKE if args.smoke else GRADED if args.graded else RUNS:
        for n in numbers:
            beam = Beam(degree, n, args.poisson, way == "mixed", args.share, args.graded)
            result = tip(beam, args.steps)
            names = ("shortening", "deflection", "iterations")
            along = (5 * n) // 2 if args.graded else 10 * n
            row = {"way": way, "degree": degree, "cells": [along, n]}
            rows.append({**row, **dict(zip(names, result, strict=True))})
            if not args.json:
                print(
                    f"{way:12} degree {degree}, {along:3} x {n:2}: {result[0]:.6f} "
                    f"{result[1]:.6f} ({result[2]} iterations)",
                    flush=True,
                )
    if args.json:
        print(
            json.dumps(
                {"poisson": args.poisson, "share": args.share, "steps": args.steps, "runs": rows}
            )
        )


if __name__ == "__main__":
    main()
