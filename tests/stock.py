# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Mixed problems solved with DOLFINx alone, to compare with."""

from inspect import signature

from petsc4py import PETSc

import numpy as np
import scenes
from scenes import WORLD

import basix.ufl
import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc as fem_petsc


class _NonlinearProblem:
    """``dolfinx.fem.petsc.NonlinearProblem`` as it is since 0.10, by Newton's method of 0.9.

    Takes ``snes_rtol`` alone of the PETSc options, as a bound of the increment.
    """

    def __init__(
        self,
        F,
        u,
        bcs=(),
        J=None,
        petsc_options_prefix="",
        petsc_options=None,
    ):
        from dolfinx.nls.petsc import NewtonSolver

        old = fem_petsc.NonlinearProblem
        self._u = u
        self._newton = NewtonSolver(u.function_space.mesh.comm, old(F, u, list(bcs), J))
        self._newton.convergence_criterion = "incremental"
        self._newton.rtol = self._newton.atol = (petsc_options or {}).get("snes_rtol", 1e-9)
        self._newton.error_on_nonconvergence = False
        self._reason = 0

    @property
    def solver(self):
        """The object that tells whether the last solve converged."""
        return self

    def getConvergedReason(self):
        """Return a positive number where the last solve converged."""
        return self._reason

    def solve(self):
        """Solve from the present values on."""
        converged = self._newton.solve(self._u)[1]
        self._reason = 1 if converged else -1
        return self._u


#: DOLFINx's nonlinear problem, for comparisons with finite elements.
NonlinearProblem = (
    fem_petsc.NonlinearProblem
    if "petsc_options_prefix" in signature(fem_petsc.NonlinearProblem).parameters
    else _NonlinearProblem
)


def values_at(function, x):
    """Return the values of a Function at points with the coordinates of x, from all ranks."""
    V, dim = function.function_space, x.shape[1]
    bs = V.dofmap.index_map_bs
    own = V.dofmap.index_map.size_local
    places = np.concatenate(WORLD.allgather(V.tabulate_dof_coordinates()[:own, :dim]))
    values = np.concatenate(WORLD.allgather(function.x.array[: own * bs].reshape(-1, bs)))
    found = np.linalg.norm(places[:, None] - x[None], axis=2).argmin(axis=0)
    return values[found]


def same_values(one, other, tolerance=1e-10):
    """Compare two Functions on Lagrange spaces of meshes with the same nodes."""
    dim = one.function_space.mesh.geometry.dim
    x = one.function_space.tabulate_dof_coordinates()[:, :dim]
    expected = values_at(other, x)
    mine = one.x.array.reshape(expected.shape)
    size = scenes.largest(expected)
    assert size > 0.0
    assert scenes.largest(mine - expected) <= tolerance * size


def newton(F, w, bcs):
    """Solve with DOLFINx alone."""
    J = fem.form(ufl.derivative(F, w))
    F = fem.form(F)
    for bc in bcs:
        bc.set(w.x.array)
    for _ in range(20):
        A = fem_petsc.assemble_matrix(J, bcs=bcs)
        A.assemble()
        b = fem_petsc.assemble_vector(F)
        b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        for bc in bcs:
            own = np.asarray(bc.dof_indices()[0])
            own = own[own < b.getLocalSize()]
            b.array_w[own] = 0.0
        ksp = PETSc.KSP().create(WORLD)
        ksp.setType("preonly")
        ksp.getPC().setType("lu")
        ksp.getPC().setFactorSolverType("mumps")
        ksp.setOperators(A)
        step = b.duplicate()
        ksp.solve(b, step)
        w.x.array[: step.getLocalSize()] -= step.array_r
        w.x.scatter_forward()
        if step.norm() <= 1e-13 * max(w.x.petsc_vec.norm(), 1e-300):
            return
    raise AssertionError("stock Newton does not converge")


def mixed_space(domain, *degrees):
    """Return a space of vectors and scalars of these degrees."""
    cell = domain.basix_cell()
    vector = basix.ufl.element("Lagrange", cell, degrees[0], shape=(domain.geometry.dim,))
    return fem.functionspace(
        domain, basix.ufl.mixed_element([vector, basix.ufl.element("Lagrange", cell, degrees[1])])
    )


def held(W, sub, where, value=None):
    """Return a condition on a part of a mixed space, on facets."""
    domain = W.mesh
    space, _ = W.sub(sub).collapse()
    function = fem.Function(space)
    if value is not None:
        function.x.array[:] = value
    facets = mesh.locate_entities_boundary(domain, domain.topology.dim - 1, where)
    dofs = fem.locate_dofs_topological((W.sub(sub), space), domain.topology.dim - 1, facets)
    return fem.dirichletbc(function, dofs, W.sub(sub))
