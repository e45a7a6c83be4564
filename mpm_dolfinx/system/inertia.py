# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Inertia of bodies: velocities at their nodes, and the balance of momentum over a step.

Velocities live on W, where a body has its displacement; no acceleration is kept. A step can follow
what is in the range of T: let P be the projector on it that is orthogonal in M, the consistent
mass. With ``w = T u``, ``"midpoint"`` and ``"conserving"`` solve

    T^T [ (2/dt) M (w/dt - v_n) + (f_n + f_1)/2 ] = 0,    v_1 = 2 w/dt - P v_n

or ``- v_n`` (reflect), f being the forces of all other terms at the step's ends, besides those that
some terms have for the step as a whole (:meth:`Term.pace`), which ``"conserving"`` asks of stress;
``"euler"`` solves ``T^T [ M (w/dt - v_n)/dt + f_1 ] = 0`` and has ``v_1 = w/dt``. Other schemes are
other subclasses of :class:`~mpm_dolfinx.system.schemes.Scheme`. Whatever T is, with
``q = (I - P) v_n`` and L the loss

    1/2 |v_1|^2 - 1/2 |v_n|^2 = - f . w - L,    L = 1/2 |q|^2 - q . v_1,  0  or  1/2 |v_1 - v_n|^2,

f being the force of the step, norms and products those of M. ``q . v_1`` is round-off but where
Dirichlet values move.
"""

from __future__ import annotations

import operator
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, Protocol, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..assembly.blocks import Masses
from ..history import Energy
from ..io.snapshot import Kept
from ..particles.particles import Particles
from .account import Account
from .mass import NodalMass, deleted, dot, nodal_mass
from .motion_step import MotionStep, combined
from .projection import Projection
from .reduced import ReducedSystem
from .schemes import Kinematics, Scheme, rates_of
from .term import Motion, Term, Transfer
from .velocities import Velocities

__all__ = ["Inertia", "Moving", "Projected"]

type ReducedMasses = Callable[[Masses], tuple[PETSc.Mat | None, list[Particles]]]
"""Reduces masses of domains by compiled loops; see :meth:`.Tangent.masses`."""


class Moving(Protocol):
    """Problem with inertia, as inertia must know it."""

    @property
    def reduced(self) -> ReducedSystem:
        """The system."""

    def domain_masses(self, number: int) -> NDArray[np.float64]:
        """Return the consistent mass of each owned domain of a body, ``(n, k, k)``."""

    def stored_and_done(self) -> tuple[float, float]:
        """Return the elastic energy of all bodies, and the work against stress in the last step."""


class _Rest:
    """The rest of a problem on its present meshes.

    Args:
        problem: The problem, which is not kept alive.
        terms: All other terms.

    Attributes:
        terms: As given.
    """

    def __init__(self, problem: Moving, terms: Sequence[Term]) -> None:
        self._problem, self.terms = weakref.ref(problem), terms

    @property
    def problem(self) -> Moving:
        """The problem."""
        problem = self._problem()
        assert problem is not None
        return problem

    @property
    def reduced(self) -> ReducedSystem:
        """Its system."""
        return self.problem.reduced

    def domain_masses(self, state: Velocities) -> list[NDArray[np.float64] | None]:
        """Return the mass of each body's domains by what densities are now (collective)."""
        return [
            None if state.is_static(body) else self.problem.domain_masses(number)
            for number, body in enumerate(state.bodies)
        ]

    def changes(self) -> list[NDArray[np.float64]]:
        """Return the changes of Dirichlet values in the step, on own dofs of each background."""
        return [field.changes() for field in self.reduced.fields]


class _Reduced(NamedTuple):
    """The mass in all unknowns.

    It is another one where T is: whatever changes the mass, as particles that are gone and meshes,
    changes T, too.

    Attributes:
        transfers: T of each body, by which it is reduced.
        mass: That of bodies whose mass the compiled loops do not have, or ``None``.
        scaled: Room for a multiple of it.
        projection: Solves with the mass of all.
    """

    transfers: list[PETSc.Mat]
    mass: PETSc.Mat | None
    scaled: PETSc.Mat | None
    projection: Projection

    def is_by(self, transfers: list[PETSc.Mat]) -> bool:
        """Return whether it is reduced by some transfers."""
        return all(map(operator.is_, transfers, self.transfers))


class Projected(NamedTuple):
    """The part of the velocities at a step's beginning that its background can follow.

    Attributes:
        solve: Returns the unknowns y of ``T^T M (v - T y) = 0`` from ``T^T M v`` (collective).
        unknowns: Those of the velocities, but for what Dirichlet values drive.
        driven: Rates of these, on own dofs of each background.
        velocity: On W of each body.
    """

    solve: Callable[[PETSc.Vec], PETSc.Vec]
    unknowns: PETSc.Vec
    driven: list[NDArray[np.float64]]
    velocity: list[PETSc.Vec]


class Inertia(Term):
    """The inertia of all bodies of a problem. See the module for the formulas.

    The residual is scaled so that forces at the step's end have the factor 1, as in equilibrium;
    ``scheme.share`` of it is the force.

    Args:
        bodies: The bodies.
        velocities: At the beginning, on W of each body.
        scheme: The time scheme.
        rayleigh: Damping in proportion to mass, one over a time, and to stiffness, a time, of which
            the second is in the stress of bodies.
        energies: Where the account is kept, one entry for each step.
        static: Bodies among these that have no inertia: they are in equilibrium at each step's end,
            and their velocity is the mean of the step.

    Attributes:
        scheme: As given.
        state: Velocities and forces at the last converged step.
        velocities: These, on W of each body.
        dt: Duration of the step.
    """

    from_outside = True
    one_sided = False
    symmetric = True
    movable = remeshable = True  # velocities go with the nodes

    def __init__(
        self,
        bodies: Sequence[Particles],
        velocities: Sequence[fem.Function],
        scheme: Scheme,
        rayleigh: tuple[float, float],
        energies: list[Energy],
        static: Sequence[Particles] = (),
    ) -> None:
        super().__init__(bodies)
        self.scheme, self._damping = scheme, rayleigh[0]
        self._account = Account(energies)
        self.state = Velocities(bodies, velocities, scheme, rayleigh, static, self._account)
        self.velocities = self.state.velocities
        self.dt, self._end = 1.0, 1.0
        self._others: _Rest | None = None
        self._mass: NodalMass | None = None
        self._reduced: _Reduced | None = None
        self._beginning: MotionStep | None = None
        self._projected: Projected | None = None
        self._increments: list[PETSc.Vec] = []  # of displacement, in the last residuals
        self._is_held = False

    @property
    def _rest(self) -> _Rest:
        """The rest of the problem."""
        assert self._others is not None
        return self._others

    def follow(self, problem: Moving, terms: Sequence[Term]) -> None:
        """Take over the rest of a problem on its present meshes.

        Args:
            problem: The problem, which is not kept alive.
            terms: All other terms.
        """
        self._others, self._mass = _Rest(problem, terms), None
        problem.reduced.levels.massive = [
            one for one in self.bodies if not self.state.is_static(one)
        ]

    def join(self, bodies: Sequence[Particles]) -> None:
        """Act on some more bodies, which are at rest, or on fewer of the last (collective).

        Args:
            bodies: All bodies, in the problem's order.
        """
        self.bodies = tuple(bodies)
        self.state.join(bodies)

    def mass(self) -> NodalMass:
        """Return the mass for the present meshes and domains (collective).

        What kinetic energy changes by where these are others is lost, or gained.
        """
        if self._mass is None or not self._mass.is_of_present():
            domains = self._rest.domain_masses(self.state)
            self._mass = nodal_mass(self.bodies, domains, deleted(self.bodies))
            owned = [own.sum(axis=(1, 2)) for own in self._mass.domains]
            for term in self._rest.terms:
                term.weigh([owned[self.state.number(body)] for body in term.bodies])
            self._account.remesh(self._mass.kinetic(self.velocities))
        return self._mass

    # -- A run ------------------------------------------------------------------------------------

    def begin_run(self, time: float) -> None:
        """Take the forces as they are now for those at the beginning of the next step (collective).

        Loads are those that are set; stress is that of the last converged step.

        Args:
            time: Time of the last converged step.
        """
        self.state.time = time
        mass = self.mass()
        for term in self._rest.terms:
            term.roll_back()
        self.state.note_forces(self._rest.terms)
        self._account.begin(
            time, mass.kinetic(self.velocities), self._rest.problem.stored_and_done()[0]
        )

    def resume(self) -> None:
        """Let forces of whole steps take note of where a restored run is (collective)."""
        for term in self._rest.terms:
            term.end_forces()

    def aim(self, time: float) -> None:
        """Take a time for the end of the step to try."""
        self.dt, self._end = time - self.state.time, time

    # -- A step -----------------------------------------------------------------------------------

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        mass, share = self.mass(), self.scheme.share
        for term in self._rest.terms:
            term.pace(self.dt, share)
        state = self.state
        rates = rates_of(self.bodies[0].V.mesh.comm, self.scheme, self.dt, state.last)
        self._beginning = MotionStep.begun(mass, state, rates, self.dt, self._damping)
        if not self._is_held:
            self._projected = None
        return self.step.staying

    @property
    def step(self) -> MotionStep:
        """The step that has begun."""
        assert self._beginning is not None
        return self._beginning

    @override
    def start(self, transfer: Transfer, prescribed: Motion) -> PETSc.Vec | None:
        """Return the M-projection of ``dt v_n``, unless all is at rest.

        From zero the solver's proximal term takes energy, if any; from elsewhere it may give some.
        Where velocities out of range are reflected, and nothing is lost, steps therefore start from
        zero. With ``"euler"``, which loses energy, they do not: at zero all points look elastic,
        and those that flow would have to find out again.
        """
        reduced, step = self._reduce(transfer), self.step
        if self.scheme.reflects:
            return None
        rates = self.state.driven(self._rest.changes(), self.dt)
        driven = _driven(self.bodies, self._rest.reduced, rates)
        v = [v.copy() for v in step.fields[0]]
        for part, own in zip(v, driven or (), strict=False):
            part.axpy(-1.0, own)
        right = reduced.projection.zeros()
        for T, force in zip(reduced.transfers, step.mass.times(v), strict=True):
            T.multTransposeAdd(force, right, right)
        taken = bool(step.rates.velocity[1])
        if not taken and right.norm() == 0.0:
            return None
        y = right
        if right.getSize() > 0:
            known = self._rest.reduced.unknowns.at_nodes(self.bodies, v)
            y = reduced.projection.solve(right, known)
        moved = [v.duplicate() for v in v] if driven is None else driven
        for T, part in zip(reduced.transfers, moved, strict=True):
            T.multAdd(y, part, part) if driven else T.mult(y, part)
        self._projected = Projected(reduced.projection.solve, y.copy(), rates, moved)
        y.scale(self.dt)
        return y

    # -- Beside the state -----------------------------------------------------------------------

    @property
    def projected(self) -> Projected | None:
        """Velocities that the step's background can follow; ``None``: not asked for."""
        return self._projected

    def at_end(
        self,
        forces: Sequence[NDArray[np.float64]],
        changes: Sequence[NDArray[np.float64]],
        taken: Sequence[PETSc.Vec] | None,
    ) -> list[NDArray[np.float64]]:
        """Return :meth:`beginning` of the next step after the last residuals (collective).

        Args:
            forces: Of all other terms at its end, on the local dofs of W of each body.
            changes: Of Dirichlet values in it.
            taken: What it has of the velocities before, in place of :attr:`projected`.
        """
        step = self.step
        values = step.local(step.at_end(self._moved(taken)))
        return [*values, *forces, *(change / self.dt for change in changes)]

    def weighed(self) -> NodalMass:
        """Return the mass by what densities are now (collective)."""
        known = self.mass()
        return nodal_mass(self.bodies, self._rest.domain_masses(self.state), known.deleted)

    def assume(self, mass: NodalMass) -> None:
        """Let the mass be another one in :meth:`held`."""
        self._mass = mass

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the step as it is now, to which all comes back after the block."""
        known = self._mass, self._beginning, self._increments
        self._is_held = True
        try:
            yield
        finally:
            self._is_held = False
            self._mass, self._beginning, self._increments = known

    # -- A residual -----------------------------------------------------------------------------

    def _reduce(self, transfer: Transfer) -> _Reduced:
        """Return the mass reduced by T of all bodies, anew where they are others."""
        Ts = [transfer(body) for body in self.bodies]
        known = self._reduced
        if known is None or not known.is_by(Ts):
            masses = self._rest.reduced.tangent.masses
            self._reduced = known = _reduced(self.step.mass, Ts, masses)
        return known

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        self._increments = self.step.increments()
        forces = self.step.pull(self._increments)
        for force, staying in zip(forces, self.step.staying, strict=True):
            force.axpy(1.0, staying)
        return forces

    @override
    def absolute_contributions(self) -> Sequence[PETSc.Vec]:
        forces = self.step.pull(self._increments)
        for force, size in zip(forces, self.step.sizes, strict=True):
            force.abs()
            force.axpy(1.0, size)
        return forces

    @override
    def reduced_tangents(self, transfer: Transfer) -> Sequence[PETSc.Mat]:
        """Return the mass of bodies that fused forms do not have."""
        reduced, factor = self._reduce(transfer), self.step.factor
        self._rest.reduced.tangent.mass_factor = factor
        if reduced.mass is None or reduced.scaled is None:
            return []
        reduced.mass.copy(reduced.scaled, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        reduced.scaled.scale(factor)
        return [reduced.scaled]

    @override
    def stiffness_force(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        return self.step.pull(motions)

    @override
    def commit(self) -> Callable[[], None]:
        """Commit the new velocities, forces and energies."""
        undo, step, account = self.state.undo(), self.step, self._account
        moved = self._moved()
        kinetic = 0.5 * step.mass.product(moved.after, moved.after)
        works = self._works(moved)
        if not step.mass.is_of_present():
            # Forces of particles that the step's end has deleted are in its balance, but gone now.
            works["lost"] += account.missing(works, kinetic)
        account.book(works, kinetic, self._rest.problem.stored_and_done()[1])
        self.state.commit(step.at_end(moved), self._rest.changes(), self._end)
        self.mass()
        account.note(self._end, self._rest.problem.stored_and_done()[0])
        return undo

    def _moved(self, projected: Sequence[PETSc.Vec] | None = None) -> Kinematics:
        """Return the motion in the step that has converged (collective).

        Args:
            projected: See :attr:`projected`; ``None``: that.
        """
        if projected is None and self._projected is not None:
            projected = self._projected.velocity
        return self.step.moved(self._increments, self.state, projected)

    def _works(self, moved: Kinematics) -> dict[str, float]:
        """Return the works of the step by name, and note the forces at its end (collective)."""
        step, share, state, terms = self.step, self.scheme.share, self.state, self._rest.terms
        w, mass = moved.increment, step.mass
        drag = combined(self._damping * step.rates.damped, [w, *step.fields])
        on_background, prescribed, left = share * self._rest.reduced.balance.works()
        whole, resisted = np.sum([term.step_work() for term in terms], axis=0)
        parts = [state.forces, state.external]
        before = [mass.vectors(functions) for functions in parts]
        state.note_forces(terms, balanced=True)
        ends, loads = (
            (1.0 - share) * dot(w, old) + share * dot(w, mass.vectors(functions))
            for old, functions in zip(before, parts, strict=True)
        )
        return {
            "internal": ends - loads + whole,
            "external": -loads,
            "lost": self.scheme.lost(moved),
            "damping": mass.product(drag, w) + resisted,
            "stabilisation": on_background,
            "prescribed": prescribed,
            "residual": -left,
        }

    # -- What goes with the problem ---------------------------------------------------------------

    @override
    def kept(self) -> Sequence[Kept]:
        return [self.state]


def _driven(
    bodies: Sequence[Particles], reduced: ReducedSystem, rates: list[NDArray[np.float64]]
) -> list[PETSc.Vec] | None:
    """Return velocities by Dirichlet values that move, ``None`` where none does (collective)."""
    comm = bodies[0].V.mesh.comm
    if not comm.allreduce(any(bool(np.any(rate)) for rate in rates), MPI.LOR):
        return None
    return [reduced.unknowns.driven(body, rates) for body in bodies]


def _reduced(mass: NodalMass, transfers: list[PETSc.Mat], by_loops: ReducedMasses) -> _Reduced:
    """Return the mass in all unknowns (collective)."""
    known, bodies = by_loops(list(zip(mass.bodies, mass.domains, strict=True)))
    others = [
        M.ptap(T)
        for M, T, body in zip(mass.matrices, transfers, mass.bodies, strict=True)
        if all(body is not one for one in bodies)
    ]
    left = _sum(others) if others else None
    projection = Projection(_sum([one for one in (known, left) if one is not None]))
    return _Reduced(transfers, left, None if left is None else left.copy(), projection)


def _sum(parts: Sequence[PETSc.Mat]) -> PETSc.Mat:
    """Return the sum of matrices, in the first (collective)."""
    total = parts[0]
    for part in parts[1:]:
        total.axpy(1.0, part, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    return total
