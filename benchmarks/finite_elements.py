# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Finite elements of stock DOLFINx on the bodies of the scenes.

    python benchmarks/finite_elements.py --reference

Each scene of `scenes.py` has its twin here: the same mesh of the body, law, loads and load steps,
and the same measure of the error, but no background. Functions on the mesh are the unknowns,
DOLFINx assembles, and its `NonlinearProblem` solves: SNES, Newton's method with full steps, which
is faster here than with any of PETSc's line searches, and MUMPS; in space, from 6 000 unknowns on,
conjugate gradients with GAMG. Laws that take more than a line of UFL are evaluated at quadrature
points as external operators, by the same compiled updates that the package has. A step in which
Newton's method fails is halved.

``--reference`` prints the force on the plate of the block in space (case P) on finer and finer
meshes, which `scenes.BLOCK_FORCE` is extrapolated from.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI  # noqa: F401 (before PETSc)
from petsc4py import PETSc

import numpy as np
import scenes
from scenes import kit

import basix.ufl
import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc

import mpm_dolfinx as mpm

DIRECT = {"ksp_type": "preonly", "pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"}
#: As DOLFINx's demo of elasticity.
GAMG = {
    "ksp_rtol": 1e-6,
    "ksp_type": "cg",
    "pc_type": "gamg",
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_pc_type": "jacobi",
    "mg_levels_ksp_chebyshev_esteig_steps": 20,
}
#: Unknowns in space from which GAMG is faster than MUMPS.
MANY = 6000
NEWTON = {"snes_linesearch_type": "basic", "snes_rtol": 1e-8, "snes_atol": 1e-10, "snes_max_it": 20}


class Failed(mpm.MPMError):
    """Newton's method fails however small the step."""


class Solid:
    """A solid in finite elements, with unknown displacements.

    Args:
        body: Its mesh.
        degree: Of the elements.
        bcs: Makes conditions for the space of displacements.

    Attributes:
        cells: Numbers of its elements.
        displacement: The displacement.
        iterations: Linear solves, those of failed steps too.
        cutbacks: Steps that failed.
        load: Share of the load, or the time, that was reached.
    """

    smallest = 1 / 64  # step over the first one

    def __init__(
        self,
        body: mesh.Mesh,
        degree: int,
        bcs: Callable[[fem.FunctionSpace], list[fem.DirichletBC]],
    ) -> None:
        self.mesh, self.degree, self.dim = body, degree, body.geometry.dim
        self.W = fem.functionspace(body, ("Lagrange", degree, (self.dim,)))
        self.displacement = fem.Function(self.W)
        self.bcs = bcs(self.W)
        self.cells = np.arange(body.topology.index_map(self.dim).size_local, dtype=np.int32)
        self.factor = fem.Constant(body, 0.0)
        self.iterations, self.cutbacks, self.load = 0, 0, 0.0

    @property
    def test(self) -> Any:
        """The test function."""
        return ufl.TestFunction(self.W)

    def pose(self, residual: Any, tangent: Any = None) -> None:
        """Make the problem of a residual in the displacement, and of its derivative."""
        count = self.W.dofmap.index_map.size_global * self.dim
        many = self.dim == 3 and count > MANY
        self.problem = petsc.NonlinearProblem(
            residual,
            self.displacement,
            bcs=self.bcs,
            J=tangent,
            petsc_options_prefix="stock_",
            petsc_options={**NEWTON, **(GAMG if many else DIRECT)},
        )
        A = self.problem.A
        A.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        if many:
            A.setNearNullSpace(rigid_motions(self.W))

    def begin(self) -> None:
        """Take the last converged state for the start of a step."""

    def commit(self) -> None:
        """Keep the state of a step that has converged."""

    def solve(self, steps: int, update: Callable[[float], None] | None = None) -> None:
        """Go from load 0 to 1 in steps, halved where Newton's method fails.

        Raises:
            Failed: It fails in the smallest step.
        """
        size = first = 1.0 / steps
        while self.load < 1.0 - 1e-9:
            target = min(self.load + size, 1.0)
            self.factor.value = target
            if update is not None:
                update(target)
            before = self.displacement.x.array.copy()
            self.begin()
            if self.converges():
                self.load, size = target, min(2.0 * size, first)
                self.commit()
                continue
            self.displacement.x.array[:] = before
            self.cutbacks += 1
            size /= 2.0
            if size < self.smallest * first:
                raise Failed(f"Newton's method fails at {self.load:g} of the load.")

    def converges(self) -> bool:
        """Run Newton's method."""
        try:
            self.problem.solve()
            good = self.problem.solver.getConvergedReason() > 0
        except PETSc.Error:
            good = False
        self.iterations += self.problem.solver.getIterationNumber()
        return good


class PlasticSolid(Solid):
    """A solid of a law of the package, which is evaluated at the quadrature points.

    Args:
        body: Its mesh.
        degree: Of the elements.
        bcs: Makes conditions for the space of displacements.
        law: The law.
        loads: Returns the power of the loads on a test function, by that and the load factor.
        rule: Degree of the quadrature rule; by default all of a cube's k + 1 points each way.

    Attributes:
        initial_centroid: Of the elements.
        initial_volume: Of the elements.
    """

    def __init__(
        self,
        body: mesh.Mesh,
        degree: int,
        bcs: Callable[[fem.FunctionSpace], list[fem.DirichletBC]],
        law: mpm.materials.Material,
        loads: Callable[[Any, Any], Any] | None = None,
        rule: int | None = None,
    ) -> None:
        super().__init__(body, degree, bcs)
        dim, cell = self.dim, body.basix_cell()
        rule = 2 * degree if rule is None else rule
        self.rule = {"quadrature_degree": rule, "quadrature_rule": "default"}

        def at_points(*shape: int) -> fem.Function:
            element = basix.ufl.quadrature_element(cell, value_shape=shape, degree=rule)
            return fem.Function(fem.functionspace(body, element))

        self.piola, self.tangent = at_points(dim, dim), at_points(dim * dim, dim * dim)
        points = self.piola.function_space.element.interpolation_points
        self.gradient = fem.Expression(ufl.grad(self.displacement), points)
        self.law, self.each = law, len(points)
        self.state = self.trial = law.initial_state(len(self.cells) * self.each, dim)
        # means over elements, as particles report them
        place = fem.Expression(ufl.SpatialCoordinate(body), points)
        where = place.eval(body, self.cells).reshape(len(self.cells), self.each, dim)
        dx = ufl.dx(domain=body, metadata=self.rule)
        constant = ufl.TestFunction(fem.functionspace(body, ("DG", 0)))
        self.initial_volume = fem.assemble_vector(fem.form(constant * dx)).array
        # all elements of a scene are parallelograms
        self.initial_centroid = where.mean(axis=1)

        v, u = self.test, ufl.TrialFunction(self.W)
        residual = ufl.inner(self.piola, ufl.grad(v)) * dx
        flat = [ufl.as_vector(list(_entries(ufl.grad(w), dim))) for w in (u, v)]
        tangent = ufl.inner(ufl.dot(self.tangent, flat[0]), flat[1]) * dx
        if loads is not None:
            residual -= loads(v, self.factor)
        self.pose(residual, tangent)
        R, K = self.problem.F, self.problem.J

        def residual_of(snes: PETSc.SNES, x: PETSc.Vec, b: PETSc.Vec) -> None:
            petsc.assign(x, self.displacement)
            self.evaluate()
            petsc.assemble_residual(snes, x, b, self.displacement, R, K, self.bcs)

        self.problem.solver.setFunction(residual_of, self.problem.b)

    def evaluate(self) -> None:
        """Update the law at all points; a deformation that is none gives no number."""
        dim = self.dim
        H = self.gradient.eval(self.mesh, self.cells).reshape(-1, dim, dim)
        try:
            answer = self.law.update(np.ascontiguousarray(H), self.state)
        except mpm.MPMError:
            self.piola.x.array[:] = np.nan
            return
        self.trial = answer.state
        self.piola.x.array[:] = answer.first_piola.ravel()
        self.tangent.x.array[:] = answer.tangent.ravel()

    def begin(self) -> None:
        """Bring stress and tangent to the last converged state."""
        self.evaluate()

    def commit(self) -> None:
        """Keep the trial state."""
        self.state = self.trial

    @property
    def stress(self) -> np.ndarray:
        """Means of the Cauchy stress over elements, shape ``(n, 3, 3)``."""
        H = self.gradient.eval(self.mesh, self.cells).reshape(-1, self.dim, self.dim)
        stress = self.law.cauchy_stress(H, self.state)
        return np.asarray(stress.reshape(len(self.cells), self.each, 3, 3).mean(axis=1))


def _entries(A: Any, dim: int) -> Any:
    """The entries of a tensor, row by row."""
    return (A[i, j] for i in range(dim) for j in range(dim))


def rigid_motions(W: fem.FunctionSpace) -> PETSc.NullSpace:
    """Return the six rigid motions in space."""
    basis = [fem.Function(W) for _ in range(6)]
    x = W.tabulate_dof_coordinates()
    for axis in range(3):
        basis[axis].x.array.reshape(-1, 3)[:, axis] = 1.0
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = basis[3 + axis].x.array.reshape(-1, 3)
        turn[:, i], turn[:, j] = -x[:, j], x[:, i]
    Q, _ = np.linalg.qr(np.stack([b.x.array for b in basis], axis=1))
    vectors = []
    for column in Q.T:
        vector = PETSc.Vec().createWithArray(column.copy(), comm=W.mesh.comm)
        vectors.append(vector)
    return PETSc.NullSpace().create(vectors=vectors, comm=W.mesh.comm)


# ## The scenes


class Twin:
    """A scene in finite elements, as `scenes.Scene`."""

    def __init__(
        self,
        solid: Solid,
        steps: int,
        measure: Callable[[], dict[str, Any]],
        update: Callable[[float], None] | None = None,
    ) -> None:
        self.solid, self.steps, self.measure, self.update = solid, steps, measure, update

    def solve(self) -> None:
        """Make the load steps."""
        self.solid.solve(self.steps, self.update)

    def account(self) -> dict[str, Any]:
        """Return how large it is, how far it came, and the linear solves of all attempts."""
        return {
            "particles": len(self.solid.cells),
            "load": self.solid.load,
            "iterations": self.solid.iterations,
            "cutbacks": self.solid.cutbacks,
        }


def weight(value: float) -> Callable[[Any, Any], Any]:
    """Return the load of a weight per volume."""

    def load(v: Any, factor: fem.Constant) -> Any:
        return -factor * value * v[len(v) - 1] * ufl.dx

    return load


def _column(
    size: float, degree: int, law: mpm.materials.Material, height: float, value: float
) -> PlasticSolid:
    """The columns in the plane, two by two elements where a cell would be."""
    n = round(size)
    width = height / n
    return PlasticSolid(
        kit.box([width, height], [2, 2 * n], kit.DOMAINS["quad"]),
        degree,
        lambda W: scenes.rollers(W, (0, 0.0), (0, width), (1, 0.0)),
        law,
        weight(value),
    )


def compaction(size: float, degree: int, steps: int = 40) -> Twin:
    """Case A."""
    case = scenes.COMPACTION
    law = mpm.materials.Hencky(case["young"], case["poisson"])
    solid = _column(size, degree, law, case["height"], case["weight"])
    return Twin(solid, steps, lambda: scenes.column_error(solid, **case))


def column_roller(size: float, degree: int, steps: int = 40) -> Twin:
    """Case B."""
    case = scenes.ROLLER
    solid = _column(size, degree, scenes.roller_law(), case["height"], case["weight"])
    return Twin(solid, steps, lambda: scenes.roller_error(solid))


def column_free(size: float, degree: int, steps: int = 40, value: float = 20e3) -> Twin:
    """Case C."""
    solid = PlasticSolid(
        kit.box([4.0, 8.0], [round(8.0 / size), round(16.0 / size)], kit.DOMAINS["quad"]),
        degree,
        lambda W: scenes.rollers(W, (0, 0.0), (1, 0.0)),
        scenes.free_law(),
        weight(value),
    )
    height = fem.form(
        (ufl.SpatialCoordinate(solid.mesh)[1] + solid.displacement[1]) / 32.0 * ufl.dx
    )
    return Twin(solid, steps, lambda: {"y_mean": fem.assemble_scalar(height)})


def compaction_in_space(size: float, degree: int, steps: int = 20) -> Twin:
    """Case D."""
    case, n = scenes.COMPACTION_IN_SPACE, round(size)
    width = case["height"] / 4
    sides = [(axis, place) for axis in (0, 1) for place in (0.0, width)]
    solid = PlasticSolid(
        kit.box([width, width, case["height"]], [2 * n, 2 * n, 8 * n], kit.DOMAINS["hex"]),
        degree,
        lambda W: scenes.rollers(W, *sides, (2, 0.0)),
        mpm.materials.Hencky(case["young"], case["poisson"]),
        weight(case["weight"]),
    )
    return Twin(solid, steps, lambda: scenes.position_error(solid.displacement))


def cantilever(size: float, degree: int, steps: int = 50) -> Twin:
    """Case E."""
    body = scenes.beam(size, "quad")
    tags = scenes.beam_end(body)

    def loads(v: Any, factor: fem.Constant) -> Any:
        return -factor * 100e3 * v[1] * ufl.ds(domain=body, subdomain_data=tags, subdomain_id=1)

    solid = PlasticSolid(
        body,
        degree,
        lambda W: scenes.rollers(W, (0, 0.0)) + scenes.clamp(W),
        mpm.materials.Hencky(12e6, 0.2),
        loads,
    )
    return Twin(solid, steps, lambda: scenes.tip_error(solid.displacement))


def block(size: float, degree: int, steps: int = 10, parts: int = 2) -> Twin:
    """Case P, with ``parts`` elements where a cell would be."""
    n = parts * round(size)
    body = kit.box([1.0] * 3, [n] * 3, kit.DOMAINS["hex"])
    down = fem.Constant(body, 0.0)

    def bcs(W: fem.FunctionSpace) -> list[fem.DirichletBC]:
        def held(place: float, i: int, value: Any) -> fem.DirichletBC:
            side = mesh.locate_entities_boundary(body, 2, lambda x: np.isclose(x[2], place))
            return fem.dirichletbc(value, fem.locate_dofs_topological(W.sub(i), 2, side), W.sub(i))

        return [
            *scenes.rollers(W, (0, 0.0), (1, 0.0)),
            *(held(0.0, i, 0.0) for i in range(3)),
            held(1.0, 2, down),
        ]

    solid = PlasticSolid(body, degree, bcs, scenes.block_law())
    v = solid.test
    forces = fem.form(ufl.inner(solid.piola, ufl.grad(v)) * ufl.dx(metadata=solid.rule))
    base = solid.bcs[4].dof_indices()[0]

    def update(t: float) -> None:
        down.value = -scenes.BLOCK["squeeze"] * t

    def measure() -> dict[str, float]:
        solid.evaluate()
        force = float(fem.assemble_vector(forces).array[base].sum())
        return {"force": force, "error": abs(force / scenes.BLOCK_FORCE - 1.0)}

    return Twin(solid, steps, measure, update)


def hertz(size: float, degree: int, steps: int = 8) -> Twin:
    """Case H: the penalty of the package, of the modulus over the thickness of the elements."""
    x, y = scenes.hertz_lines(size)
    body = scenes.graded(x, y, 2)
    tags = scenes.hertz_top(body)
    young, poisson, radius, depth = (
        scenes.HERTZ[name] for name in ("young", "poisson", "radius", "depth")
    )

    def bcs(W: fem.FunctionSpace) -> list[fem.DirichletBC]:
        base = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[1], y[0]))
        floor = fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(W, 1, base), W)
        return [*scenes.rollers(W, (0, 0.0)), floor]

    solid = Solid(body, degree, bcs)
    d, v = solid.displacement, solid.test
    mu = young / (2.0 * (1.0 + poisson))
    lame = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    sunk = fem.Constant(body, 0.0)
    away = ufl.SpatialCoordinate(body) + d - ufl.as_vector([0.0, radius - sunk])
    distance = ufl.sqrt(ufl.dot(away, away))
    inside = ufl.conditional(ufl.lt(distance, radius), radius - distance, 0.0)
    # outside of a disc that is above: its normal at a point is - away / distance
    stiffness = (lame + 2.0 * mu) / (scenes.HERTZ["half"] / size / 2.0) * degree**2
    touching = {"quadrature_degree": 2 * degree + 1}
    ds = ufl.ds(domain=body, subdomain_data=tags, subdomain_id=1, metadata=touching)
    push = stiffness * inside * away / distance
    strain, virtual = ufl.sym(ufl.grad(d)), ufl.sym(ufl.grad(v))
    stress = 2.0 * mu * strain + lame * ufl.tr(strain) * ufl.Identity(2)
    solid.pose(ufl.inner(stress, virtual) * ufl.dx - ufl.inner(push, v) * ds)

    of = ufl.TestFunction(fem.functionspace(body, ("DG", 0)))
    forms = [fem.form(part * of * ds) for part in (-push[1], 1.0, ufl.SpatialCoordinate(body)[0])]

    def update(t: float) -> None:
        sunk.value = depth * t

    def measure() -> dict[str, float]:
        force, length, place = (fem.assemble_vector(form).array for form in forms)
        top = length > 0.0
        return scenes.hertz_error(place[top] / length[top], force[top], length[top])

    return Twin(solid, steps, measure, update)


class MovingSolid(Solid):
    """The vortex by the implicit midpoint rule with a consistent mass.

    Args:
        motion: The motion.
        degree: Of the elements.
        dt: Time step, which is not halved.
    """

    smallest = 1.0

    def __init__(self, motion: scenes.Vortex, degree: int, dt: float) -> None:
        super().__init__(motion.mesh, degree, lambda W: [])
        d, v = self.displacement, self.test
        self.before, self.velocity = fem.Function(self.W), fem.Function(self.W)
        self.dt = dt
        points = self.W.element.interpolation_points
        self.velocity.interpolate(fem.Expression(motion.velocity, points))
        middle = 0.5 * (d + self.before)
        gain = 2.0 / dt**2 * (d - self.before - dt * self.velocity)
        dx = ufl.dx(metadata={"quadrature_degree": 2 * degree + 1})
        self.pose(
            motion.rho * ufl.inner(gain, v) * dx
            + ufl.inner(motion.stress(middle), ufl.grad(v)) * dx
            - motion.loads(v, degree)
        )

    def commit(self) -> None:
        """Keep displacement and velocity."""
        now, before = self.displacement.x.array, self.before.x.array
        self.velocity.x.array[:] = 2.0 / self.dt * (now - before) - self.velocity.x.array
        before[:] = now


def vortex(size: float, degree: int, steps: int = 0) -> Twin:
    """Case V up to t = 1/2."""
    motion = scenes.Vortex(1.0 / size)
    count = steps or scenes.vortex_steps(size, degree)
    solid = MovingSolid(motion, degree, 0.5 / count)
    error = motion.measured(solid.displacement, degree)

    def measure() -> dict[str, float]:
        motion.at(0.5)
        return {"error": error()}

    return Twin(solid, count, measure, lambda t: motion.at(0.5 * (t - 0.5 / count)))


CASES: dict[str, Callable[..., Twin]] = {
    "A": compaction,
    "B": column_roller,
    "C": column_free,
    "D": compaction_in_space,
    "E": cantilever,
    "H": hertz,
    "P": block,
    "V": vortex,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reference", action="store_true", help="of the block in space")
    parser.add_argument("--steps", type=int, default=10, help="load steps")
    args = parser.parse_args()
    if not args.reference:
        parser.error("nothing to do: give --reference")
    sizes, forces = (4, 6, 8), []
    for n in sizes:
        twin = block(n, 2, args.steps, 1)
        twin.solve()
        forces.append(twin.measure()["force"])
        print(f"{n:3d} elements: {forces[-1]:.6e} N", flush=True)
    order, limit = extrapolated(sizes, forces)
    print(f"extrapolated, order {order:.2f}: {limit:.6e} N")


def extrapolated(sizes: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Return order and limit of three values on finer and finer meshes, by bisection."""
    lower, upper = 0.1, 8.0
    target = (values[0] - values[1]) / (values[1] - values[2])
    for _ in range(60):
        order = 0.5 * (lower + upper)
        a, b, c = (n**-order for n in sizes)
        lower, upper = (order, upper) if (a - b) / (b - c) < target else (lower, order)
    return order, values[2] - (values[1] - values[2]) / (b - c) * c


if __name__ == "__main__":
    main()
