# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Record of a run: steps, counters and seconds per phase."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

from .errors import ParticleOutsideError

__all__ = ["Attempt", "Energy", "History", "Loss", "Stage", "Statistics", "Step"]

PHASES = ("locate", "transfer", "constitutive", "assemble", "factorise", "solve", "commit")
COUNTERS = (
    "transfers",
    "patterns",
    "free_dofs",
    "off_rank_rows",
    "off_rank_columns",
    "particle_imbalance",
    "dof_imbalance",
    "repartitions",
    "residuals",
    "predictions",
    "rejected_predictions",
    "second_attempts",
    "alternations",
    "field_solves",
    "rejected_steps",
    "factorisations",
    "krylov_iterations",
    "multigrid_failures",
    "halvings",
    "trusted_steps",
    "withdrawn_steps",
    "redirections",
    "converged_at_round_off",
    "workspace_retries",
    "frozen_residual",
    "ghost_facets",
    "joint_nodes",
    "folded_domains",
    "split_domains",
    "lost_particles",
    "lost_volume",
    "lost_mass",
)


class Statistics(dict[str, float]):
    """Counters of a run, and this rank's seconds in each phase.

    The phases, which do not overlap, are ``locate``, ``transfer``, ``constitutive``,
    ``assemble``, ``factorise``, ``solve`` and ``commit``. Counters are ``transfers`` (how often
    the transfer was rebuilt), ``patterns`` (how often the sparsity of the reduced tangent was),
    ``free_dofs`` (unknowns of the last step), ``off_rank_rows``
    (share of the bodies' nodes that move with an unknown of another rank, in the last step) and
    ``off_rank_columns`` (unknowns that ranks need of others for a product with T, 8 bytes each),
    ``particle_imbalance`` and ``dof_imbalance`` (largest number on a rank over the mean),
    ``repartitions`` (how often particles moved to other ranks),
    ``residuals`` and
    ``factorisations`` (or levels of multigrid made for a tangent), ``krylov_iterations`` (of solves
    with multigrid), ``multigrid_failures`` (how often a factorisation took over),
    ``predictions`` (steps that began at the extrapolated increment) and ``rejected_predictions``,
    ``second_attempts`` (at steps whose first one failed, from their beginning), ``alternations``
    (how often equations of fields were solved in turn with the displacements) and ``field_solves``
    (linear solves for these), ``rejected_steps`` (which converged, and were taken back for their
    error), ``halvings`` (of Newton steps by the line search), ``trusted_steps`` (series of them
    taken although the residual grew) and ``withdrawn_steps`` (where that came to nothing),
    ``redirections`` (of Newton steps that a tangent which is not positive definite led uphill),
    ``converged_at_round_off`` (steps that ended at the floor of round-off),
    ``workspace_retries`` (factorisations that MUMPS repeated with more workspace),
    ``frozen_residual`` (the largest relative residual that a step left, nearly all in unknowns
    that move next to nothing),
    ``ghost_facets`` (with a ghost penalty, in the last step), ``joint_nodes`` (nodes of bodies
    that bear on another one and follow the cell beside theirs, in the last step),
    ``folded_domains`` (the most after any step; curved ones only), ``split_domains``
    (quadrilaterals cut in two) and ``lost_particles``, ``lost_volume`` (undeformed) and
    ``lost_mass`` (0 where no density is known), the sums over ``history.losses``.
    """

    def __init__(self) -> None:
        super().__init__(dict.fromkeys((*PHASES, *COUNTERS), 0))
        self._running: list[str] = []
        self._since = 0.0

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of each phase."""
        return {name: self[name] for name in PHASES}

    def count(self, name: str) -> None:
        """Add one to a counter."""
        self[name] += 1

    def phase(self, name: str) -> AbstractContextManager[None]:
        """Account the block's seconds to a phase, and not to the phase around it."""
        return _Phase(name, self._enter, self._leave)

    def _enter(self, name: str) -> None:
        self._switch()
        self._running.append(name)

    def _leave(self) -> None:
        self._switch()
        self._running.pop()

    def _switch(self) -> None:
        now = time.perf_counter()
        if self._running:
            self[self._running[-1]] += now - self._since
        self._since = now


class _Phase:
    """A block whose seconds belong to a phase; a class, as a step of few cells enters thirty."""

    __slots__ = ("_enter", "_leave", "_name")

    def __init__(self, name: str, enter: Callable[[str], None], leave: Callable[[], None]) -> None:
        self._name, self._enter, self._leave = name, enter, leave

    def __enter__(self) -> None:
        self._enter(self._name)

    def __exit__(self, *_: object) -> None:
        self._leave()


@dataclass(frozen=True)
class Step:
    """One converged step.

    Attributes:
        load: Load factor (or the parameter t of a path) at its end.
        iterations: Linear solves it took.
        residuals: Relative residual before each of Newton's iterations and at the end.
        displacement: The controlled displacement at its end, under displacement control.
        time: Time at its end: the number of stages before it, and how much of its own is done.
        output: Whether it ends at one of the levels that were asked for (``output_at``), or at the
            end of the run.
        error: What :meth:`Problem.error` found at its end, ``None`` where it was not asked.
        alternations: How often equations of fields were solved in turn with the displacements.
        freed: How many nodes were freed at its end (``adapt=``), after which it was solved on.
        time_error: Of a motion, the estimated error of its displacements by its duration, the root
            mean square over the nodes; ``None`` in the first steps, which have too few before them.
        motion: Of a motion, how far the nodes have come at its end, likewise.
    """

    load: float
    iterations: int
    residuals: list[float]
    displacement: float | None = None
    time: float = 0.0
    output: bool = False
    error: float | None = None
    alternations: int = 0
    freed: int = 0
    time_error: float | None = None
    motion: float | None = None


@dataclass(frozen=True)
class Attempt:
    """A step that was taken back.

    Attributes:
        load: Load factor (parameter of a path, controlled displacement) at which it was to end.
        size: How much of that it was.
        iterations: Linear solves it took.
        reason: Why it was taken back.
    """

    load: float
    size: float
    iterations: int
    reason: str


@dataclass(frozen=True)
class Stage:
    """The beginning of a stage that changed the problem: ``stage``, ``remove`` or ``add``.

    Attributes:
        name: Its name.
        time: The time at which it begins.
    """

    name: str
    time: float


@dataclass(frozen=True)
class Loss:
    """Particles of one body that a step took out of the background, and that are deleted.

    Attributes:
        load: Load factor (or the parameter t of a path) at the end of the step.
        body: Number of the body, from 0.
        particles: Their global indices, sorted; the same on all ranks.
        volume: Their undeformed volume.
        mass: Their mass, ``None`` in a problem without a density.
    """

    load: float
    body: int
    particles: list[int]
    volume: float
    mass: float | None


@dataclass(frozen=True)
class Energy:
    """Energies of a motion at one time, of all bodies; sums are over the steps up to it.

    :attr:`balance` stays what it was at the beginning, to round-off.

    Attributes:
        time: The time.
        kinetic: Kinetic energy.
        internal: Work done against stress, pressures, supports and terms, stored or not.
        external: Work of body forces and tractions.
        lost: Kinetic energy that was lost as no motion of the background could follow it, to
            backward Euler, with deleted particles, and to other meshes of a body.
        strain: Elastic energy stored in the bodies at the time (not in supports); not a number
            where a material does not know its own.
        dissipated: Work done against stress that is not stored in it: plastic work, what deleted
            particles took away, and what the scheme makes of elastic bodies, which is nothing with
            ``scheme="conserving"`` and positive or negative with others; not a number where
            :attr:`strain` is none.
        damping: Work done against Rayleigh damping, dashpots and, in steps whose force is a mean,
            friction of contacts.
        stabilisation: Work done against a ghost penalty.
        prescribed: Work of Dirichlet values that move.
        residual: Work done against what Newton's method left: its tolerance, and the proximal term
            in motions that hardly move a node.
    """

    time: float
    kinetic: float
    internal: float
    external: float
    lost: float
    strain: float = math.nan
    dissipated: float = math.nan
    damping: float = 0.0
    stabilisation: float = 0.0
    prescribed: float = 0.0
    residual: float = 0.0

    @property
    def balance(self) -> float:
        """Conserved sum: kinetic energy, less work of loads, plus energy stored and lost."""
        used = self.internal + self.damping + self.stabilisation + self.residual + self.lost
        return self.kinetic + used - self.external - self.prescribed


@dataclass(repr=False)
class History:
    """The steps of a run; it grows as the run goes on and stays after an error.

    Attributes:
        steps: The converged steps.
        cutbacks: How often a step was halved.
        failed_iterations: Linear solves of attempts that did not converge, or were rejected.
        taken_back: These attempts, and why.
        losses: What ``outside="delete"`` has deleted.
        stopped: Why a run with ``outside="stop"`` ended before its whole load, else ``None``.
        statistics: Counters and seconds per phase.
        energies: Of a :class:`DynamicProblem`, at the beginning and after each step.
        stages: Beginnings of stages that changed the problem.
        in_time: Whether steps have a duration, as in a motion.
    """

    steps: list[Step] = field(default_factory=list)
    cutbacks: int = 0
    failed_iterations: int = 0
    losses: list[Loss] = field(default_factory=list)
    stopped: ParticleOutsideError | None = None
    statistics: Statistics = field(default_factory=Statistics)
    energies: list[Energy] = field(default_factory=list)
    stages: list[Stage] = field(default_factory=list)
    taken_back: list[Attempt] = field(default_factory=list)
    in_time: bool = False

    def __repr__(self) -> str:
        return f"<History: {self.in_words()}>"

    def in_words(self) -> str:
        """Return how far the run is and what it took, in a few words."""
        if not self.steps:
            words = "no step yet"
        else:
            steps = f"{len(self.steps)} step{'s' if len(self.steps) > 1 else ''}"
            end = f"time {self.time:g}" if self.in_time else f"load {self.steps[-1].load:g}"
            words = f"{steps} to {end}, {self.total_iterations} linear solves"
        if self.cutbacks:
            words += f", {self.cutbacks} cutback{'s' if self.cutbacks > 1 else ''}"
        return words

    @property
    def iterations(self) -> list[int]:
        """Linear solves of each converged step."""
        return [step.iterations for step in self.steps]

    @property
    def load(self) -> list[float]:
        """Load factor at the end of each converged step."""
        return [step.load for step in self.steps]

    @property
    def time(self) -> float:
        """Time of the last converged step, which increases from step to step; 0 before the first.

        It is the number of stages before it, and how much of its own is done, from 0 to 1. Each
        call of ``solve``, ``steps`` or ``step`` is a stage, but where it goes on with a run from a
        checkpoint. Of a :class:`DynamicProblem` it is the physical time.
        """
        return self.steps[-1].time if self.steps else 0.0

    @property
    def stage(self) -> float:
        """Number of the stages so far, those that ended early too: the time when one begins."""
        return float(math.ceil(self.time))

    @property
    def time_error(self) -> float | None:
        """Estimated error of a motion by the duration of its steps, over how far it has gone.

        The sum of what is known of the steps; those before the first of which an error is known
        count like it. ``None`` where none is, or nothing has moved.
        """
        known = [step.time_error for step in self.steps if step.time_error is not None]
        moved = max((step.motion or 0.0 for step in self.steps), default=0.0)
        if not known or moved == 0.0:
            return None
        return (sum(known) + (len(self.steps) - len(known)) * known[0]) / moved

    @property
    def total_iterations(self) -> int:
        """All linear solves, those of failed attempts too."""
        return sum(self.iterations) + self.failed_iterations
