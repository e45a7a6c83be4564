# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Terms act on the nodes of bodies: forces, their tangents, and their histories."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Protocol, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.blocks import Coupling
from ..assembly.body_forms import BodyForms
from ..constitutive.averaging import VolumeAveraging
from ..constitutive.pressure import MeanStress
from ..constitutive.strain import Strain
from ..errors import MPMError
from ..io.snapshot import Kept
from ..parallel.boundary import Hooked, by_itself
from ..particles.particles import Particles
from .hooks import Hooks
from .own import OwnUnknowns

__all__ = ["Alternating", "Motion", "PointMaterial", "Term", "Transfer", "UserTerm"]


type Transfer = Callable[[Particles], PETSc.Mat]
type Motion = Callable[[Particles], PETSc.Vec | None]


class PointMaterial(Protocol):
    """Material at the points of a body, as a term may ask for it."""

    def initial_modulus(self) -> NDArray[np.float64]:
        """Return the modulus of each undeformed domain in one direction, ``(n,)`` (collective)."""

    @property
    def first_piola(self) -> NDArray[np.float64]:
        """First Piola stress of the last update, shape ``(n nq, dim, dim)``."""

    @property
    def tangent(self) -> NDArray[np.float64]:
        """Its derivative by F, ``(n nq, dim, dim, dim, dim)``; with F-bar the pointwise part."""

    @property
    def strain(self) -> Strain:
        """Strain of the points."""

    @property
    def averaging(self) -> VolumeAveraging | None:
        """F-bar, or ``None``."""

    @property
    def mean_stress(self) -> MeanStress | None:
        """A pressure of its own in place of the mean stress, or ``None``."""


class Alternating(Protocol):
    """Equations that are solved in turn with the displacements."""

    def alternate(self) -> int:
        """Solve them at the displacements of the last evaluation (collective).

        It is called in turn with Newton's method for the displacements until these are in
        equilibrium with what it has found: see :class:`mpm_dolfinx.FieldEquation`.

        Returns:
            The linear solves that it took.

        Raises:
            ConvergenceError: It does not converge, on all ranks; a smaller step is tried.
        """


class Term(Hooked, hooks=True):
    """Something that acts on the nodes of one body or of several.

    The residual of a step is ``sum_b T_b^T r_b`` and its tangent ``sum_ab T_a^T K_ab T_b``, where
    r_b and K_ab are sums over terms and live on the spaces W of the bodies, whatever
    backgrounds move these. A subclass has ``residuals`` and ``tangents``, ``update`` where these
    depend on more than the displacements, ``commit`` and ``roll_back`` where it has a history;
    whatever else is here adds nothing unless overridden. All calls
    are collective, and made with the displacements set. Nodes of deleted particles alone
    (``outside="delete"``) stay where they were, and forces on them are lost.

    Args:
        bodies: The bodies on which it acts.

    Attributes:
        bodies: As given.
        evaluation: What :meth:`update` is called where it fails.
        from_outside: Whether its forces come from outside of its bodies: then they count for the
            scale of forces, as loads and reactions do.
        movable: Whether it follows bodies whose particles move to other ranks.
        remeshable: Whether it follows bodies that are split or rebased.
        takes_stress: Whether it takes the material's stress for all that its bodies bear.
        follows_load: Whether what the load factor does depends on the displacement.
        axisymmetric: Whether its forces are those of a body of revolution, ``None`` where it does
            not say; a problem refuses one that differs.
        name: One word by which a checkpoint knows what it remembers, if it is given (before the
            term is); otherwise it is known by the order in which terms have come to the problem.
        own: Unknowns of its own, besides its bodies' displacements; ``None``: none. It sets their
            residual in :meth:`update`, and :meth:`tangents` has derivatives of and by them too, in
            the place that comes after the bodies.
        fused: Forms whose tangent the compiled loops reduce domain by domain, with their bodies.
        coupling: All of :meth:`tangents` by the compiled loops; ``None``: nothing.
    """

    evaluation: ClassVar[str] = "update()"
    from_outside: ClassVar[bool] = True
    movable: bool = False
    remeshable: bool = False
    takes_stress: bool = False
    follows_load: bool = False
    axisymmetric: bool | None = None
    name: str | None = None
    own: OwnUnknowns | None = None
    fused: Sequence[tuple[Particles, BodyForms]] = ()
    coupling: Coupling | None = None

    def __init__(self, bodies: Sequence[Particles] = ()) -> None:
        self.bodies: tuple[Particles, ...] = tuple(bodies)

    @property
    def symmetric(self) -> bool:
        """Whether its tangent is symmetric, all bodies taken together."""
        return False

    @property
    def one_sided(self) -> bool:
        """Whether it may let its bodies go and hold them again, as contact does; taken for granted.

        Only where no term does is a body with a free rigid motion beyond help by smaller steps.
        """
        return True

    @property
    def equation(self) -> Alternating | None:
        """Solver of equations of its own, in turn with the displacements, on all ranks."""
        return None

    def come_after(self, gone: Sequence[Term]) -> None:
        """Take note that it comes to a problem that goes on, before :meth:`take_part` (collective).

        What it remembers of the bodies from an earlier time is void, as they have moved since.

        Args:
            gone: The terms that act no longer, which it may stand in place of.
        """

    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        """Take note of the problem, each time that this is built on meshes of its bodies.

        Args:
            number: Number of the term among all that have come to the problem.
            bodies: All bodies of the problem.
            materials: The material at the points of each, where the problem knows it.
        """

    def begin(self) -> Sequence[PETSc.Vec]:
        """Prepare a step, or another try of it, from the last converged positions.

        Returns:
            The forces that stay through the step, on W of each body, for the scale of forces; they
            are part of :meth:`residuals`. Empty: none.
        """
        return ()

    def start(self, transfer: Transfer, prescribed: Motion) -> PETSc.Vec | None:
        """Return where Newton's method is to start, after :meth:`begin`; ``None``: no matter.

        Args:
            transfer: Returns T of a body in all unknowns, the same object through a step.
            prescribed: Returns how the step's Dirichlet values move a body, ``None``: not at all.

        Returns:
            The unknowns.
        """
        return None

    def pace(self, dt: float, share: float) -> None:
        """Take notice that a step of a motion begins, before its first residuals.

        It is also called when a problem of motion has been built, after :meth:`take_part`.

        The scheme of a DynamicProblem takes the mean of a step's end forces: its residual is the
        sum of :meth:`end_forces` at the beginning (if ``share`` is 0.5) and :meth:`residuals`, and
        ``share`` of that is force. A term whose force is one of the whole step, such as that of a
        damper, or of contact with an energy that is to be kept, returns nothing as its
        :meth:`end_forces`, ``1 / share`` times the force as its :meth:`residuals`, and the work
        done against it as its :meth:`step_work`.

        Args:
            dt: Duration of the step.
            share: 0.5, or 1 where the scheme takes forces at the step's end alone.
        """

    def weigh(self, masses: Sequence[NDArray[np.float64]]) -> None:
        """Take the masses of the domains of its bodies in a motion, before its first :meth:`pace`.

        They are told again where domains are deleted.

        Args:
            masses: Of the domains of each body that this rank owns, shape ``(n,)``; zero for a
                body without inertia.
        """

    def end_forces(self) -> Sequence[PETSc.Vec]:
        """Return the residuals at the last converged step, but for what is of a whole step.

        Called once when a motion begins and after each of its steps, with loads as they are then;
        forces of whole steps take note of where the next one begins.
        """
        return self.residuals()

    def step_work(self) -> tuple[float, float]:
        """Return the work done in the last step against its forces of the whole step (collective).

        Called before or after :meth:`commit`, with the displacements at the step's end.

        Returns:
            What counts as internal, and what as damping.
        """
        return 0.0, 0.0

    @by_itself
    def update(self) -> MPMError | None:
        """Update what the forces depend on; return why that cannot be. It must not be kept yet.

        A ``ConvergenceError`` or ``DomainDistortionError`` refuses these displacements, and smaller
        steps are tried; all else, returned or raised, ends the step. It may differ between ranks.
        """
        return None

    def smooth(self) -> bool:
        """Return whether no history changes in the last residual, nor contact."""
        return True

    def drives(self) -> bool:
        """Return whether it touches bodies and moves on its own path in this step, on this rank."""
        return False

    def residuals(self) -> Sequence[PETSc.Vec]:
        """Return the forces on W of each body, or nothing."""
        return ()

    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return the derivatives of the forces on a body by the displacement of a body.

        Returns:
            Matrices on W_a x W_b by the numbers (a, b) of these in :attr:`bodies`; the same object
            in each call as long as its sparsity is the same. Without what :attr:`fused` and
            :meth:`reduced_tangents` have; not asked for where :attr:`coupling` has it all.
        """
        return {}

    def reduced_tangents(self, transfer: Transfer) -> Sequence[PETSc.Mat]:
        """Return tangents that the term reduces by T itself, ``T_a^T K_ab T_b`` of all unknowns.

        Args:
            transfer: Returns T of a body in all unknowns, the same object through a step.
        """
        return ()

    def derivatives(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return the derivatives of the forces, where :meth:`tangents` are others to begin with."""
        return self.tangents()

    def stiffness_force(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        """Return the whole tangent times displacements on W of each body, or nothing.

        Args:
            motions: The displacements, and last the motion of its own unknowns, if it has any.

        Returns:
            Forces in the same places.
        """
        found = self.derivatives()
        forces = [motion.duplicate() for motion in motions if found]
        for force in forces:
            force.set(0.0)
        for (a, b), K in found.items():
            K.multAdd(motions[b], forces[a], forces[a])
        return forces

    def absolute_contributions(self) -> Sequence[PETSc.Vec]:
        """Return the sums of absolute values of what the residuals consist of, or nothing."""
        sizes = [force.copy() for force in self.residuals()]
        for size in sizes:
            size.abs()
        return sizes

    def load_derivative(self, order: int) -> tuple[Sequence[PETSc.Vec], float]:
        """Return a difference quotient of the residuals by the load factor.

        Args:
            order: 1 or 2: see :meth:`BodyForms.load_derivative`.

        Returns:
            The quotients, or nothing, and the size of what they are differences of.
        """
        return (), 0.0

    def commit(self) -> Callable[[], None] | None:
        """Make the last evaluation the converged one.

        Bodies commit first, then the terms of the user, then the hooks of a problem's subclass.

        Returns:
            A function that takes it back, which is called where another commit fails; ``None``
            where there is nothing to take back.
        """
        return None

    def roll_back(self) -> None:
        """Return to the last converged evaluation."""

    def kept(self) -> Sequence[Kept]:
        """Return the objects that are saved with the term and move with the bodies."""
        return ()


class UserTerm(Term):
    """Contribution of the hooks that a subclass of a problem class overrides.

    Args:
        hooks: The problem, which is not kept alive.
    """

    evaluation = "evaluate()"
    one_sided = False

    def __init__(self, hooks: Hooks) -> None:
        super().__init__()
        self._reference = weakref.ref(hooks)

    @property
    def _hooks(self) -> Hooks:
        hooks = self._reference()
        assert hooks is not None
        return hooks

    @override
    def update(self) -> MPMError | None:
        return self._hooks.evaluate()

    @override
    def smooth(self) -> bool:
        return self._hooks.smooth()

    @override
    def commit(self) -> None:
        self._hooks.commit()

    @override
    def roll_back(self) -> None:
        self._hooks.roll_back()
