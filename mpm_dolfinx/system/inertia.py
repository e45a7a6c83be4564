# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Inertia of bodies: velocities at their nodes, and the balance of momentum over a step.

Velocities live on W, where a body has its displacement; no acceleration is kept. A step can follow
what is in the range of T: let P be the projector on it that is orthogonal in M, the consistent
mass. With ``w = T u``, ``"midpoint"`` and ``"conserving"`` solve

    T^T [ (2/dt) M (w/dt - v_n) + (f_n + f_1)/2 ] = 0,    v_1 = 2 w/dt - P v_n

or ``- v_n`` (reflect), f being the forces of all other terms at the step's ends, besides those that
some terms have for the step as a whole (:meth:`Term.pace`), which ``"conserving"`` asks of stress;
``"euler"`` solves ``T^T [ M (w/dt - v_n)/dt + f_1 ] = 0`` and has ``v_1 = w/dt``. Whatever T is,
with ``q = (I - P) v_n`` and L the loss

    1/2 |v_1|^2 - 1/2 |v_n|^2 = - f . w - L,    L = 1/2 |q|^2 - q . v_1,  0  or  1/2 |v_1 - v_n|^2,

f being the force of the step, norms and products those of M. ``q . v_1`` is round-off but where
Dirichlet values move.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..assembly.fused import Masses
from ..assembly.petsc import blocked
from ..errors import ConvergenceError, MPMError
from ..history import Energy
from ..io.snapshot import Kept, Taken, fill, of_cells, spaces_of
from ..meshes.remesh import Column
from ..particles.particles import Particles
from ..reals import is_one_of
from .term import Motion, Term, Transfer

__all__ = ["OUT_OF_RANGE", "SCHEMES", "Inertia"]

SCHEMES = ("midpoint", "conserving", "euler")
OUT_OF_RANGE = ("project", "reflect")
#: What the residual of a projection falls to, and the most iterations and refinements of it.
PROJECTED, MOST_ITERATIONS, REFINEMENTS = 1e-13, 100, 6
#: What iterations go on to beyond it, so that momentum does not wander in thousands of steps.
BEYOND = 0.01
#: The same for one that has come to the end of what round-off lets it do.
AT_ROUND_OFF = 1e-10
#: How often what the shift holds back is let go.
RELEASES = 3
#: Diagonal shift in a projection, relative to the diagonal.
SHIFT = 1e-13
#: What is added to it in turn where the factor is at round-off.
RAISES = (0.0, 1e-12, 1e-11, 1e-10)

#: What is summed over steps: attributes of Energy.
TOTALS = (
    "internal", "external", "lost", "damping", "stabilisation", "prescribed", "residual",
)  # fmt: skip

#: Those among them that are given to the bodies.
GIVEN = ("external", "prescribed")

type DomainMasses = Callable[[int], NDArray[np.float64]]
"""Returns the consistent mass of each owned domain of a body, ``(n, k, k)``, by its number."""
type ReducedMasses = Callable[[Masses], tuple[list[PETSc.Mat], list[Particles]]]
"""Reduces masses of domains by compiled loops; see :meth:`ReducedSystem.masses`."""
type Works = Callable[[], NDArray[np.float64]]
"""Returns the works of the last increment on the backgrounds; see :meth:`Field.works`."""
type Changes = Callable[[], list[NDArray[np.float64]]]
"""Returns the changes of Dirichlet values in the step, on own dofs of each background."""
type Driven = Callable[[Particles, Sequence[NDArray[np.float64]]], PETSc.Vec]
"""Returns how such values move a body."""
type Stored = Callable[[], tuple[float, float]]
"""Returns the elastic energy of all bodies, and the work done against stress in the last step."""


class Followed(NamedTuple):
    """What inertia must know of the rest of a problem, on the present meshes.

    Attributes:
        terms: All other terms.
        mass: Returns the mass of domains.
        reduced: Reduces it by compiled loops.
        weigh: Says how often tangents have what these have reduced.
        works: Returns the works of the last increment on the backgrounds.
        stored: Returns the elastic energy at the last converged step, and the work done against
            stress in the last step.
        changes: Returns the changes of Dirichlet values in the step.
        driven: Returns how such values move a body.
    """

    terms: Sequence[Term]
    mass: DomainMasses
    reduced: ReducedMasses
    weigh: Callable[[float], None]
    works: Works
    stored: Stored
    changes: Changes
    driven: Driven


class Inertia(Term):
    """The inertia of all bodies of a problem. See the module for the formulas.

    The residual is scaled so that forces at the step's end have the factor 1, as in equilibrium;
    :attr:`share` of it is the force.

    Args:
        bodies: The bodies.
        velocities: At the beginning, on W of each body.
        scheme: One of :data:`SCHEMES`.
        out_of_range: ``"project"`` or ``"reflect"``; of no meaning to ``"euler"``.
        rayleigh: Damping in proportion to mass, one over a time, and to stiffness, a time, of which
            the second is in the stress of bodies.
        energies: Where the account is kept, one entry for each step.
        static: Bodies among these that have no inertia: they are in equilibrium at each step's end,
            and their velocity is the mean of the step.

    Attributes:
        static: As given.
        velocities: At the last converged step, on W of each body.
        dt: Duration of the step.
        time: Time of the last converged step.
    """

    from_outside = True

    def __init__(
        self,
        bodies: Sequence[Particles],
        velocities: Sequence[fem.Function],
        scheme: str,
        out_of_range: str,
        rayleigh: tuple[float, float],
        energies: list[Energy],
        static: Sequence[Particles] = (),
    ) -> None:
        if not is_one_of(scheme, SCHEMES):
            raise MPMError(f"Unknown scheme={scheme!r}; choose one of {', '.join(SCHEMES)}.")
        if not is_one_of(out_of_range, OUT_OF_RANGE):
            raise MPMError(
                f"Unknown out_of_range={out_of_range!r}; choose one of {', '.join(OUT_OF_RANGE)}."
            )
        super().__init__(bodies)
        self.scheme, self.out_of_range = scheme, out_of_range
        self._rayleigh = rayleigh
        self._damping = rayleigh[0]
        self.static = tuple(static)
        self.velocities = list(velocities)
        self.dt, self.time = 1.0, 0.0
        self._end = 1.0
        self._energies = energies
        self._kinetic = 0.0
        self._totals = np.zeros(len(TOTALS))
        self._stress_work = 0.0
        self._strain = math.nan  # at the beginning
        self._forces = [fem.Function(body.W) for body in bodies]
        self._external = [fem.Function(body.W) for body in bodies]
        self._others: list[Term] = []
        self._deleted: list[int] | None = None
        self._transferred: list[PETSc.Mat] = []
        self._rates: list[NDArray[np.float64]] = []  # of Dirichlet values, in the last step
        self._rates_dt = 0.0

    @property
    def one_sided(self) -> bool:
        """Whether it may let its bodies go: see :attr:`Term.one_sided`."""
        return False

    @property
    def share(self) -> float:
        """What of the residual is the force: the mean over the step, but with ``"euler"``."""
        return 1.0 if self.scheme == "euler" else 0.5

    @property
    def _factors(self) -> tuple[float, float, float]:
        """Factors of M w, of M v_n and of the forces at the step's beginning."""
        damping = self._damping / self.dt
        if self.scheme == "euler":
            return 1.0 / self.dt**2 + damping, 1.0 / self.dt, 0.0
        return 4.0 / self.dt**2 + 2.0 * damping, 4.0 / self.dt, 1.0

    @property
    def symmetric(self) -> bool:
        """See :attr:`Term.symmetric`."""
        return True

    def follow(self, followed: Followed) -> None:
        """Take over the rest of the problem on the present meshes."""
        self._followed, self._others = followed, list(followed.terms)
        self._deleted = None

    def join(self, bodies: Sequence[Particles]) -> None:
        """Act on some more bodies, which are at rest, or on fewer of the last (collective).

        Args:
            bodies: All bodies, in the problem's order.
        """
        self.bodies = tuple(bodies)
        for functions in (self.velocities, self._forces, self._external):
            del functions[len(bodies) :]
            for body in bodies[len(functions) :]:
                functions.append(fem.Function(body.W, name="velocity"))

    # -- Mass and velocity ----------------------------------------------------------------

    def settle(self) -> None:
        """Assemble the mass for the present meshes and domains, unless that is done (collective).

        What kinetic energy changes by that is lost, or won.
        """
        deleted = self._present_deleted()
        if deleted == self._deleted:
            return
        self._deleted = deleted
        self._transferred = []
        self._domain_masses = [
            np.zeros((body.num_local, *2 * body.domain_nodes.shape[1:]))
            if self.is_static(body)
            else self._followed.mass(number)
            for number, body in enumerate(self.bodies)
        ]
        self.masses = [
            _on_nodes(body, own) for body, own in zip(self.bodies, self._domain_masses, strict=True)
        ]
        for body, M in zip(self.bodies, self.masses, strict=True):
            if not self.is_static(body):
                _require_mass(body, M)
        owned = [own.sum(axis=(1, 2)) for own in self._domain_masses]
        for term in self._others:
            term.weigh([owned[self._number(body)] for body in term.bodies])
        kinetic = self.kinetic()
        if self._energies:
            self._totals[TOTALS.index("lost")] += self._kinetic - kinetic
        self._kinetic = kinetic

    def is_static(self, body: Particles) -> bool:
        """Return whether a body has no inertia."""
        return any(body is one for one in self.static)

    def _present_deleted(self) -> list[int]:
        """Return how many particles of each body are deleted (collective)."""
        return [
            0 if body.deletion is None else body.mesh.comm.allreduce(int(body.deletion.mask.sum()))
            for body in self.bodies
        ]

    def _vectors(self, functions: Sequence[fem.Function]) -> list[PETSc.Vec]:
        """Return values of Functions on W of each body as vectors."""
        vectors = []
        for M, function in zip(self.masses, functions, strict=True):
            vector = M.createVecLeft()
            vector.array_w[:] = function.x.array[: vector.getLocalSize()]
            vectors.append(vector)
        return vectors

    def _times_mass(self, vectors: Sequence[PETSc.Vec]) -> list[PETSc.Vec]:
        """Return M times vectors on W of each body."""
        products = [vector.duplicate() for vector in vectors]
        for M, vector, product in zip(self.masses, vectors, products, strict=True):
            M.mult(vector, product)
        return products

    def kinetic(self) -> float:
        """Return the kinetic energy at the last converged step (collective)."""
        self.settle()
        v = self._vectors(self.velocities)
        return 0.5 * _dot(v, self._times_mass(v))

    def momentum(self) -> NDArray[np.float64]:
        """Return the momentum at the last converged step, shape ``(gdim,)`` (collective)."""
        self.settle()
        p = self._times_mass(self._vectors(self.velocities))
        gdim = self.bodies[0].mesh.geometry.dim
        own = sum(part.array_r.reshape(-1, gdim).sum(axis=0) for part in p)
        return np.asarray(self.bodies[0].V.mesh.comm.allreduce(own))

    def angular_momentum(self) -> NDArray[np.float64]:
        """Return the angular momentum about the origin (collective).

        Returns:
            Shape ``(1,)`` in the plane, about the axis normal to it, or ``(3,)``.
        """
        self.settle()
        gdim = self.bodies[0].mesh.geometry.dim
        total: NDArray[np.float64] = np.zeros(1 if gdim == 2 else 3)
        for body, p in zip(
            self.bodies, self._times_mass(self._vectors(self.velocities)), strict=True
        ):
            part = p.array_r.reshape(-1, gdim)
            x = body.node_positions[: len(part)]
            if gdim == 2:
                total += np.sum(x[:, 0] * part[:, 1] - x[:, 1] * part[:, 0])
            else:
                total += np.cross(x, part).sum(axis=0)
        return np.asarray(self.bodies[0].V.mesh.comm.allreduce(total))

    def begin_run(self, time: float) -> None:
        """Take the forces as they are now for those at the beginning of the next step (collective).

        Loads are those that are set; stress is that of the last converged step.

        Args:
            time: Time of the last converged step.
        """
        self.time = time
        self.settle()
        for term in self._others:
            term.roll_back()
        self._note_forces()
        if not self._energies:
            self._kinetic = self.kinetic()
            self._strain, _ = self._followed.stored()
            self._note_energy()

    def resume(self) -> None:
        """Let forces of whole steps take note of where a restored run is (collective)."""
        for term in self._others:
            term.end_forces()

    def _note_energy(self) -> None:
        """Add an entry to the account, of the last converged step."""
        strain, _ = self._followed.stored()
        sums = {name: float(total) for name, total in zip(TOTALS, self._totals, strict=True)}
        dissipated = self._stress_work - (strain - self._strain)
        self._energies.append(
            Energy(self.time, self._kinetic, strain=strain, dissipated=dissipated, **sums)
        )

    def _note_forces(self, balanced: bool = False) -> None:
        """Keep the forces of all other terms, as they are now.

        Args:
            balanced: Whether they are those of a step that has converged, which a term that begins
                anew may find otherwise, as where points of contact have stayed with their facets.
        """
        for functions in (self._forces, self._external):
            for function in functions:
                function.x.array[:] = 0.0
        for term in self._others:
            if balanced:
                self._gather(term, term.end_forces(), self._forces)
            self._gather(term, term.begin(), self._external)
            if not balanced:
                self._gather(term, term.end_forces(), self._forces)
        for function in (*self._forces, *self._external):
            function.x.scatter_forward()

    def _gather(self, term: Term, vectors: Sequence[PETSc.Vec], to: Sequence[fem.Function]) -> None:
        for body, vector in zip(term.bodies if vectors else (), vectors, strict=True):
            target = to[self._number(body)].x.array
            target[: vector.getLocalSize()] += vector.array_r

    def _number(self, particles: Particles) -> int:
        return next(i for i, body in enumerate(self.bodies) if body is particles)

    def aim(self, time: float) -> None:
        """Take a time for the end of the step to try."""
        self.dt, self._end = time - self.time, time

    # -- A step ---------------------------------------------------------------------------

    def begin(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.begin`."""
        self.settle()
        for term in self._others:
            term.pace(self.dt, self.share)
        _, b, share = self._factors
        self._v = self._vectors(self.velocities)
        self._staying = self._times_mass(self._v)
        self._sizes = []
        for force, before in zip(self._staying, self._vectors(self._forces), strict=True):
            force.scale(-b)
            size = force.copy()
            size.abs()
            force.axpy(share, before)
            before.abs()
            size.axpy(share, before)
            self._sizes.append(size)
        return self._staying

    def start(self, transfer: Transfer, prescribed: Motion) -> PETSc.Vec | None:
        """See :meth:`Term.start`: the M-projection of ``dt v_n``, unless all is at rest.

        From zero the solver's proximal term takes energy, if any; from elsewhere it may give some.
        Where velocities out of range are reflected, and nothing is lost, steps therefore start from
        zero. With ``"euler"``, which loses energy, they do not: at zero all points look elastic,
        and those that flow would have to find out again.
        """
        Ts = self._follow(transfer)
        if self.scheme != "euler" and self.out_of_range != "project":
            return None
        driven = self._driven()
        v = [v.copy() for v in self._v]
        for part, own in zip(v, driven or (), strict=False):
            part.axpy(-1.0, own)
        right = self._A.createVecLeft()
        right.set(0.0)
        for T, force in zip(Ts, self._times_mass(v), strict=True):
            T.multTransposeAdd(force, right, right)
        if self.scheme == "euler" and right.norm() == 0.0:
            return None
        y = right.duplicate()
        if y.getSize() > 0:
            self._solve(right, y)
        if self.scheme != "euler":
            self._projected = [v.duplicate() for v in self._v] if driven is None else driven
            for T, part in zip(Ts, self._projected, strict=True):
                T.multAdd(y, part, part) if driven else T.mult(y, part)
        y.scale(self.dt)
        return y

    def _driven(self) -> list[PETSc.Vec] | None:
        """Return velocities by Dirichlet values that move, ``None`` where none does (collective).

        Their rates at the step's beginning are those of a parabola through their last three values.
        """
        comm = self.bodies[0].V.mesh.comm
        rates = [change / self.dt for change in self._followed.changes()]
        if self._rates_dt > 0.0 and len(self._rates) == len(rates):
            part = self.dt / (self.dt + self._rates_dt)
            before = zip(self._rates, rates, strict=True)
            rates = [part * last + (1.0 - part) * now for last, now in before]
        if not comm.allreduce(any(bool(np.any(rate)) for rate in rates), MPI.LOR):
            return None
        return [self._followed.driven(body, rates) for body in self.bodies]

    def _follow(self, transfer: Transfer) -> list[PETSc.Mat]:
        """Return T of all bodies, by which the mass is reduced, anew where they are others."""
        Ts = [transfer(body) for body in self.bodies]
        if not all(T is known for T, known in zip(Ts, self._transferred, strict=False)) or not (
            self._transferred
        ):
            self._transferred = Ts
            self._reduce(Ts)
        return Ts

    def _reduce(self, Ts: Sequence[PETSc.Mat]) -> None:
        """Reduce the mass by T, and prepare to solve with it."""
        given = list(zip(self.bodies, self._domain_masses, strict=True))
        known, bodies = self._followed.reduced(given)
        self._apart = [all(body is not one for one in bodies) for body in self.bodies]
        others = [
            M.ptap(T) for M, T, apart in zip(self.masses, Ts, self._apart, strict=True) if apart
        ]
        self._others_A = _sum(others) if others else None
        self._A = _sum([*known, *([] if self._others_A is None else [self._others_A])])
        self._scaled = None if self._others_A is None else self._others_A.copy()
        self._unit = scale = self._A.getDiagonal()
        values = scale.array_w
        values[:] = np.where(values > 0.0, values, 1.0) ** -0.5
        shifted = self._A.copy()
        shifted.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        shifted.diagonalScale(scale, scale)
        diagonal = shifted.getDiagonal()
        values = diagonal.array_w
        values[:] = np.where(values > 0.0, SHIFT, 1.0)
        shifted.setDiagonal(diagonal, addv=PETSc.InsertMode.ADD_VALUES)
        self._shifted, self._held = shifted, diagonal
        self._incomplete: PETSc.KSP | None = None
        self._factor: PETSc.KSP | None = None
        self._iterates = True

    def _solve(self, right: PETSc.Vec, result: PETSc.Vec) -> None:
        """Solve for the unknowns of a projection (collective).

        Combinations of unknowns that hardly move the bodies' nodes are held by a shift, and let go
        as far as they can be, as in Newton's method, for which this is the start.

        Raises:
            ConvergenceError: That failed.
        """
        scaled, y = right.duplicate(), right.duplicate()
        scaled.pointwiseMult(right, self._unit)
        size = scaled.norm()
        if size > 0.0:
            self._solve_scaled(scaled, y, size)
            rest = self._rest(scaled, y)
            for _ in range(RELEASES):
                if rest.norm() <= 2.0 * BEYOND * PROJECTED * size:
                    break
                part = y.duplicate()
                self._solve_scaled(rest, part, size)
                part.axpy(1.0, y)
                left = self._rest(scaled, part)
                if not left.norm() <= 0.5 * rest.norm():
                    break
                y, rest = part, left
            result.pointwiseMult(y, self._unit)

    def _rest(self, right: PETSc.Vec, y: PETSc.Vec) -> PETSc.Vec:
        """Return what y leaves of the right-hand side, without the shift."""
        rest, held = right.duplicate(), right.duplicate()
        self._shifted.mult(y, rest)
        held.pointwiseMult(self._held, y)
        rest.axpby(1.0, -1.0, right)
        rest.axpy(1.0, held)
        return rest

    def _solve_scaled(self, right: PETSc.Vec, y: PETSc.Vec, size: float) -> None:
        """Solve with the matrix of unit diagonal: by iterations, or where they fail by a factor.

        What is left is judged by a size.
        """
        if self._iterates:
            if self._incomplete is None:
                self._incomplete = _incomplete(self._shifted)
            ksp = self._incomplete
            ksp.setTolerances(rtol=0.0, atol=BEYOND * PROJECTED * size, max_it=MOST_ITERATIONS)
            ksp.solve(right, y)
            if ksp.getConvergedReason() > 0:
                return
            self._iterates = False
        for more in RAISES:
            if self._factor is None:
                self._shifted.shift(more)
                self._held.shift(more)
                self._factor = _solver(self._shifted, "preonly", "cholesky")
                self._factor.getPC().setFactorSolverType("mumps")
            y.set(0.0)
            rest, part = right.copy(), y.duplicate()
            for _ in range(REFINEMENTS):
                self._factor.solve(rest, part)
                y.axpy(1.0, part)
                self._shifted.mult(y, rest)
                rest.aypx(-1.0, right)
                if rest.norm() <= PROJECTED * size:
                    return
            if rest.norm() <= AT_ROUND_OFF * size:
                return
            self._factor = None
        raise ConvergenceError("The projection of the velocities on the range of T failed")

    def _increments(self) -> list[PETSc.Vec]:
        """Return the present change of displacement, on W of each body."""
        found = []
        for body, M in zip(self.bodies, self.masses, strict=True):
            w = M.createVecLeft()
            own = slice(0, w.getLocalSize())
            w.array_w[:] = body.displacement.x.array[own] - body.converged_displacement[own]
            found.append(w)
        return found

    def residuals(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.residuals`."""
        self._w = self._increments()
        forces = self._times_mass(self._w)
        a, _, _ = self._factors
        for force, staying in zip(forces, self._staying, strict=True):
            force.scale(a)
            force.axpy(1.0, staying)
        return forces

    def absolute_contributions(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.absolute_contributions`."""
        forces = self._times_mass(self._w)
        for force, size in zip(forces, self._sizes, strict=True):
            force.scale(self._factors[0])
            force.abs()
            force.axpy(1.0, size)
        return forces

    def reduced_tangents(self, transfer: Transfer) -> Sequence[PETSc.Mat]:
        """See :meth:`Term.reduced_tangents`: the mass of bodies that fused forms do not have."""
        self._follow(transfer)
        self._followed.weigh(self._factors[0])
        if self._others_A is None or self._scaled is None:
            return []
        self._others_A.copy(self._scaled, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._scaled.scale(self._factors[0])
        return [self._scaled]

    def reduced_product(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.reduced_product`."""
        forces = self.stiffness_force(motions)
        for force, apart in zip(forces, self._apart, strict=True):
            if not apart:
                force.set(0.0)
        return forces

    def stiffness_force(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.stiffness_force`."""
        forces = self._times_mass(motions)
        for force in forces:
            force.scale(self._factors[0])
        return forces

    def commit(self) -> Callable[[], None]:
        """See :meth:`Term.commit`: take the new velocities, forces and energies."""
        undo = self._undo()
        new, lost = self._new_velocities()
        kinetic = 0.5 * _dot(new, self._times_mass(new))
        works = self._works_of_step(self._kinetic_loss(new, lost))
        if self._present_deleted() != self._deleted:
            # Forces of particles that the step's end has deleted are in its balance, but gone now.
            used = sum(work for name, work in works.items() if name not in GIVEN)
            given = sum(works[name] for name in GIVEN)
            works["lost"] += given - used - (kinetic - self._kinetic)
        self._totals += [works[name] for name in TOTALS]
        for function, v in zip(self.velocities, new, strict=True):
            function.x.array[: v.getLocalSize()] = v.array_r
            function.x.scatter_forward()
        self.time, self._kinetic = self._end, kinetic
        self._rates = [change / self.dt for change in self._followed.changes()]
        self._rates_dt = self.dt
        self._transferred = []
        self._stress_work += self._followed.stored()[1]
        self.settle()
        self._note_energy()
        return undo

    def _new_velocities(self) -> tuple[list[PETSc.Vec], list[PETSc.Vec]]:
        """Return the velocities at the step's end, and what of those before it they have lost."""
        if self.scheme == "euler":
            taken = [v.duplicate() for v in self._v]
            factor = 1.0
            for v in taken:
                v.set(0.0)
        else:
            taken = self._projected if self.out_of_range == "project" else self._v
            factor = 2.0
        lost = [v.copy() for v in self._v]
        new = [w.copy() for w in self._w]
        for body, v, before, out in zip(self.bodies, new, taken, lost, strict=True):
            still = self.is_static(body)
            v.scale((1.0 if still else factor) / self.dt)
            if not still:
                v.axpy(-1.0, before)
            out.axpy(-1.0, v if self.scheme == "euler" else before)
        return new, lost

    def _kinetic_loss(self, new: list[PETSc.Vec], lost: list[PETSc.Vec]) -> float:
        """Return the kinetic energy that the step's velocities have lost.

        Args:
            new: Velocities at the step's end.
            lost: What of those before it they have lost.
        """
        out_of_range = self._times_mass(lost)
        loss = 0.5 * _dot(lost, out_of_range)
        return loss if self.scheme == "euler" else loss - _dot(new, out_of_range)

    def _works_of_step(self, loss: float) -> dict[str, float]:
        """Return the works of the step by name, and note the forces at its end.

        Args:
            loss: Kinetic energy that its velocities have lost.
        """
        damped = self._damping / self.dt * _dot(self._w, self._times_mass(self._w))
        on_background, prescribed, left = self.share * self._followed.works()
        whole, resisted = np.sum([term.step_work() for term in self._others], axis=0)
        parts = [self._forces, self._external]
        before = [self._vectors(functions) for functions in parts]
        self._note_forces(balanced=True)
        begin, end = (0.0, 1.0) if self.scheme == "euler" else (0.5, 0.5)
        ends, loads = (
            begin * _dot(self._w, old) + end * _dot(self._w, self._vectors(functions))
            for old, functions in zip(before, parts, strict=True)
        )
        return {
            "internal": ends - loads + whole,
            "external": -loads,
            "lost": loss,
            "damping": damped + resisted,
            "stabilisation": on_background,
            "prescribed": prescribed,
            "residual": -left,
        }

    def _undo(self) -> Callable[[], None]:
        """Return what takes a commit back."""
        functions = [*self.velocities, *self._forces, *self._external]
        values = [function.x.array.copy() for function in functions]
        account = self.time, self._kinetic, self._stress_work, self._totals.copy()
        rates, entries = (self._rates, self._rates_dt), len(self._energies)

        def undo() -> None:
            for function, before in zip(functions, values, strict=True):
                function.x.array[:] = before
            self.time, self._kinetic, self._stress_work, self._totals = account
            self._rates, self._rates_dt = rates
            del self._energies[entries:]

        return undo

    # -- What goes with the problem -------------------------------------------------------

    def kept(self) -> Sequence[Kept]:
        """See :meth:`Term.kept`."""
        return [_Velocities(self)]

    def require_movable(self, consequence: str) -> None:
        """Raise nothing: velocities move with their bodies."""

    def require_remeshable(self, consequence: str) -> None:
        """Raise nothing: velocities are those of the same nodes."""

    def numbers(self) -> dict[str, Any]:
        """Return scheme, damping, time and account, for a checkpoint."""
        return {
            "scheme": [self.scheme, self.out_of_range],
            "rayleigh": list(self._rayleigh),
            "static": [number for number, body in enumerate(self.bodies) if self.is_static(body)],
            "time": self.time,
            "energies": [list(vars(energy).values()) for energy in self._energies],
            "totals": self._totals.tolist(),
            "stress": [self._kinetic, self._stress_work, self._strain],
            "rates": self._rates_dt,
        }

    def columns(self, body: int) -> dict[str, Column]:
        """Return velocity and forces at the nodes of a body."""
        return {
            "velocity": Column(of_cells(self.velocities[body]), "nodes"),
            "force": Column(of_cells(self._forces[body]), "forces"),
            "external": Column(of_cells(self._external[body]), "forces"),
        }

    def rates(self, number: int) -> dict[str, Column]:
        """Return the rates of Dirichlet values on a background in the last step."""
        spaces = spaces_of(self.bodies)
        if number >= len(spaces):  # that of a pressure, which has no rates
            return {}
        function = fem.Function(spaces[number])
        if self._rates_dt > 0.0 and number < len(self._rates):
            function.x.array[: len(self._rates[number])] = self._rates[number]
            function.x.scatter_forward()
        return {"rates": Column(of_cells(function), "nodes")}

    def take(self, taken: Taken) -> None:
        """Take over what :meth:`numbers` and :meth:`columns` returned (collective)."""
        for number, body in enumerate(self.bodies):
            columns = taken.columns[number]
            for functions, name in (
                (self.velocities, "velocity"),
                (self._forces, "force"),
                (self._external, "external"),
            ):
                if functions[number].function_space is not body.W:
                    functions[number] = fem.Function(body.W, name=functions[number].name)
                fill(functions[number], columns[name])
        self.time = taken.numbers["time"]
        self._energies[:] = [Energy(*entries) for entries in taken.numbers["energies"]]
        self._totals = np.array(taken.numbers["totals"], dtype=np.float64)
        self._kinetic, self._stress_work, self._strain = taken.numbers["stress"]
        self._rates_dt, self._rates = taken.numbers["rates"], []
        for V, columns in zip(spaces_of(self.bodies), taken.backgrounds, strict=False):
            function = fem.Function(V)
            fill(function, columns["rates"])
            owned = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
            self._rates.append(np.array(function.x.array[:owned]))
        self._transferred = []


class _Velocities(Kept):
    """Velocities, the forces that were there with them, and the account of energies.

    Args:
        inertia: Has them.
    """

    key = "inertia"

    def __init__(self, inertia: Inertia) -> None:
        self._inertia = inertia

    def numbers(self) -> dict[str, Any]:
        """See :class:`Kept`."""
        return self._inertia.numbers()

    def columns(self, body: int | None) -> dict[str, Column]:
        """See :class:`Kept`."""
        return self._inertia.rates(0) if body is None else self._inertia.columns(body)

    def on_background(self, number: int) -> dict[str, Column]:
        """See :class:`Kept`."""
        return self._inertia.rates(number)

    def require(self, source: str, taken: Taken) -> None:
        """See :class:`Kept`."""
        if "scheme" not in taken.numbers:
            raise MPMError(f"{source} holds no velocities; it is not that of a DynamicProblem.")
        present = self._inertia.numbers()
        mine, its = present["scheme"], taken.numbers["scheme"]
        if list(its) != mine:
            raise MPMError(
                f"{source} was made with scheme={its[0]!r}, out_of_range={its[1]!r}, and this "
                f"problem with {mine[0]!r}, {mine[1]!r}."
            )
        damping = taken.numbers.get("rayleigh")  # which older files do not tell
        if damping is not None and damping != present["rayleigh"]:
            raise MPMError(
                f"{source} was made with rayleigh={tuple(damping)}, and this problem with "
                f"{tuple(present['rayleigh'])}."
            )
        if taken.numbers.get("static", []) != present["static"]:
            raise MPMError(f"{source} has other bodies without inertia than quasi_static= says.")
        super().require(source, taken)

    def restore(self, taken: Taken) -> None:
        """See :class:`Kept`."""
        self._inertia.take(taken)


def _on_nodes(body: Particles, masses: NDArray[np.float64]) -> PETSc.Mat:
    """Return masses of domains summed up on W (collective)."""
    nodes = body.W.dofmap.index_map.local_to_global(body.domain_nodes.ravel())
    nodes = nodes.reshape(body.domain_nodes.shape)
    rows = np.broadcast_to(nodes[:, :, None], masses.shape).ravel()
    columns = np.broadcast_to(nodes[:, None, :], masses.shape).ravel()
    return blocked(body.W, rows, columns, masses.ravel(), body.W.dofmap.index_map_bs)


def _sum(parts: Sequence[PETSc.Mat]) -> PETSc.Mat:
    """Return the sum of matrices, in the first (collective)."""
    total = parts[0]
    for part in parts[1:]:
        total.axpy(1.0, part, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    return total


def _solver(A: PETSc.Mat, kind: str, preconditioner: str) -> PETSc.KSP:
    """Return a solver with a matrix (collective)."""
    ksp = PETSc.KSP().create(A.comm)
    ksp.setType(kind)
    ksp.setOperators(A)
    ksp.getPC().setType(preconditioner)
    return ksp


def _incomplete(A: PETSc.Mat) -> PETSc.KSP:
    """Return conjugate gradients with an incomplete factor on each rank (collective)."""
    ksp = _solver(A, "cg", "icc" if A.comm.size == 1 else "asm")
    if A.comm.size > 1:
        pc = ksp.getPC()
        pc.setASMOverlap(0)
        ksp.setUp()
        for part in pc.getASMSubKSP():
            part.setType("preonly")
            part.getPC().setType("icc")
    return ksp


def _dot(some: Sequence[PETSc.Vec], others: Sequence[PETSc.Vec]) -> float:
    """Return the scalar product of vectors on W of all bodies (collective)."""
    return float(sum(a.dot(b) for a, b in zip(some, others, strict=True)))


def _require_mass(body: Particles, M: PETSc.Mat) -> None:
    """Raise an error unless all nodes of domains that are present have mass (collective)."""
    gdim = body.mesh.geometry.dim
    light = M.getDiagonal().array_r.reshape(-1, gdim).min(axis=1) <= 0.0
    if body.deletion is not None:
        light &= ~body.deletion.dead[: len(light)]
    if body.mesh.comm.allreduce(bool(light.any())):
        raise MPMError(
            "A DynamicProblem needs a positive density at all nodes of bodies that move; one that "
            "shall have no inertia belongs into quasi_static=."
        )
