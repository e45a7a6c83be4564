# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A UFL residual on particles, solved in load steps."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from . import checkpoint, state
from .assembly import BackgroundForms, BodyForms, PointStress, is_fast
from .bodies import (
    as_bodies,
    as_conditions,
    force_at,
    one_for_each,
)
from .boundary import Support
from .cleanup import Cleaner, weakly
from .displacement_control import DisplacementControl
from .errors import (
    MPMError,
)
from .history import History, Step
from .io import Output, read_series
from .loading import Converged, load_steps, single_step
from .particles import Particles
from .predictor import Predictor
from .progress import with_bar
from .quadrature import data_at_points
from .reduced import ReducedSystem
from .share import Body
from .solver import NewtonSolver
from .stabilisation import stabilisation_of
from .stepping import Run

__all__ = ["ParticleProblem"]

type Law = tuple[str, dict[str, Any]]
"""Name of a material, and its parameters: numbers, or indices and values of points."""


class ParticleProblem:
    """Find the displacement of particles at which a UFL residual vanishes.

    The residual is written on the body mesh as for finite elements. Each step's increment
    lives in the background space: ``d = d_n + T u``, residual ``T^T R`` and tangent
    ``T^T J T``.

    Args:
        R: Residual in ``particles.displacement`` and a test function of ``particles.W``; for
            several bodies one for each.
        particles: The body, or a list of bodies on one V: they do not slip where they touch.
        J: Tangent; ``None`` is ``ufl.derivative(R, particles.displacement)``.
        bcs: Dirichlet conditions on V; their values are totals at full load.
        background: Form in ``particles.increment`` (of the first body) and a test function of
            V, added to R.
        petsc_options_prefix: Prefix of the PETSc options.
        petsc_options: PETSc options for SNES, KSP and PC, without prefix.
        form_compiler_options: Options of FFCx.
        jit_options: Options of the compilation at run time.
        assembly: ``"fast"``: the compiled loops assemble the reduced tangent domain by domain;
            ``"reference"``: DOLFINx assembles on the body mesh and PETSc multiplies by T;
            ``"auto"``: fast where the package was built with the loops, unless the environment
            variable ``MPM_DOLFINX_ASSEMBLY`` says ``reference``.
        symmetric: Whether J is symmetric (an LDL^T factorisation instead of LU).
        shift: Diagonal shift in the factorisation, relative to the diagonal. Combinations of
            background dofs that move no node of the body make the reduced tangent singular;
            without a shift the factor of such a matrix is noise.
        line_search: Whether Newton steps are halved where they invert domains or do not
            reduce the residual, and where nothing yields taken on trust.
        dependent_dofs: What becomes of dofs that others can stand for, as no node of the body
            tells them apart: ``"shift"`` leaves them to the shift, ``"remove"`` looks for them in
            each step and takes them from the unknowns (then ``shift=0.0`` is possible, and
            ``statistics["dependent_dofs"]`` is the largest number of them).
        predictor: Whether Newton's method starts from the last increments extrapolated, where
            the residual there is not above twice that of a start from zero.
        stabilisation: What is done about background dofs that the body supports badly:
            ``"ghost"`` penalty, ``"aggregate"``, ``None``, or ``"auto"``, a ghost penalty where a
            cut is small, on backgrounds of degree 2 or more and, on those of degree 1, while
            the bodies have hardly more nodes than the background (not beside ``background=``
            or ``dependent_dofs="remove"``).

    Attributes:
        particles: The body or bodies, as given.
        bodies: The bodies, as a list.
        reduced: Residual and tangent in the free dofs of V.
        history: Steps, counters and seconds; filled as a run goes on.
        bcs: The Dirichlet conditions.

    Raises:
        MPMError: Forms, spaces or conditions that do not go together.
    """

    def __init__(
        self,
        R: ufl.Form | Sequence[ufl.Form | None],
        particles: Particles | Sequence[Particles],
        J: ufl.Form | Sequence[ufl.Form | None] | None = None,
        bcs: Sequence[fem.DirichletBC] = (),
        background: ufl.Form | None = None,
        petsc_options_prefix: str = "mpm_",
        petsc_options: dict[str, Any] | None = None,
        form_compiler_options: dict[str, Any] | None = None,
        jit_options: dict[str, Any] | None = None,
        *,
        assembly: str = "auto",
        symmetric: bool = False,
        shift: float = 1e-13,
        line_search: bool = True,
        dependent_dofs: str = "shift",
        predictor: bool = True,
        stabilisation: str | None = "auto",
    ) -> None:
        if dependent_dofs not in ("shift", "remove"):
            raise MPMError(
                f"Unknown dependent_dofs={dependent_dofs!r}; choose 'shift' or 'remove'."
            )
        if not isinstance(shift, float | int) or not 0.0 <= shift < 1.0:
            raise MPMError(f"shift must be at least 0 and below 1, not {shift!r}.")
        options = {"form_compiler_options": form_compiler_options, "jit_options": jit_options}
        self.particles = particles
        self.bodies = as_bodies(particles)
        V = self.bodies[0].V
        residuals = one_for_each(R, self.bodies, "residual R")
        tangents = [None] * len(self.bodies) if J is None else one_for_each(J, self.bodies, "J")
        self.bcs = as_conditions(bcs, V)
        if type(self).mend is ParticleProblem.mend and any(
            body.on_distortion == "split" for body in self.bodies
        ):
            raise MPMError(
                "The residual is written on the present body mesh, so domains cannot be split; "
                "on_distortion='split' is for mpm.QuasiStaticProblem."
            )
        if "history" not in self.__dict__:  # made anew on another mesh
            self.history = History()
            self.identity: dict[str, Any] | None = None
        self._comm: MPI.Comm = V.mesh.comm
        self._clean_up = Cleaner(self._comm, [V.mesh, *(body.mesh for body in self.bodies)])
        stresses = [self._internal_stress(number) for number in range(len(self.bodies))]
        fast = is_fast(assembly)
        self.shares = [
            Body(body, BodyForms(r, j, body, stress, fast, **options))
            for body, r, j, stress in zip(self.bodies, residuals, tangents, stresses, strict=True)
        ]
        terms = None
        if background is not None:
            terms = BackgroundForms(background, self.bodies[0], **options)
        statistics = self.history.statistics
        past = Predictor() if predictor else None
        remove, simple = dependent_dofs == "remove", V.ufl_element().degree == 1
        left_alone = simple and stabilisation == "auto" and (remove or background is not None)
        cure = stabilisation_of(None if left_alone else stabilisation, self.bodies)
        if remove and (cure is not None or not simple):
            raise MPMError(
                "dependent_dofs='remove' is for a background of degree 1 without stabilisation; "
                "use dependent_dofs='shift'."
            )
        self.reduced = ReducedSystem(
            self.shares,
            terms,
            self.bcs,
            weakly(self.evaluate),
            weakly(self.smooth),
            statistics,
            past,
            cure,
            remove,
        )
        self._newton = NewtonSolver(
            self._comm,
            petsc_options_prefix,
            petsc_options or {},
            symmetric,
            shift,
            line_search,
            statistics,
            V.mesh.geometry.dim,
        )
        load = float(self.bodies[0].load.value)
        self._converged = Converged(load, load, np.zeros(len(self.bodies[0].increment.x.array)))
        self._output = Output()
        forms = [form for form in (*residuals, *tangents) if form is not None]
        self._data = set().union(*map(data_at_points, forms))
        self._run: Run | None = None
        self._resume = False

    def __del__(self) -> None:
        """Drop what PETSc holds; at the program's end PETSc does it."""
        if "_newton" in self.__dict__ and not sys.is_finalizing():
            self._release()

    def _release(self) -> None:
        for body in self.bodies:
            body.__dict__.pop("T", None)
        self.shares.clear()
        for part in (self.reduced, self._newton):
            part.__dict__.clear()
        self._clean_up.end()

    # -- PETSc objects --------------------------------------------------------------------

    @property
    def solver(self) -> PETSc.SNES:
        """The nonlinear solver."""
        return self._newton.snes

    @property
    def A(self) -> PETSc.Mat | None:
        """The reduced tangent of the last Newton iteration."""
        return self._newton.K

    @property
    def b(self) -> PETSc.Vec | None:
        """The reduced residual that was evaluated last."""
        return self._newton.F

    @property
    def x(self) -> PETSc.Vec | None:
        """The free dofs of the last step's increment."""
        return self._newton.x

    # -- Loading --------------------------------------------------------------------------

    def solve(
        self,
        steps: int = 1,
        update: Callable[[float], None] | None = None,
        progress: bool = False,
        repartition: float | None = None,
        control: DisplacementControl | None = None,
    ) -> History:
        """Apply the whole load.

        Args:
            steps: Number of equal load steps; a step that fails is halved, none is larger.
            update: The user's path: ``update(t)`` sets values of Dirichlet conditions,
                Constants and Functions to their totals at t in (0, 1]. It may be called again
                with a smaller t after a failure. The load factor is t unless it sets another.
            progress: Whether rank 0 shows a progress bar.
            repartition: Share of the particles that makes them move to other ranks after a
                step (:meth:`QuasiStaticProblem.repartition`); ``None`` leaves them.
            control: A displacement of a body that goes to a value in equal steps; the load
                factor is found for each, which may fall again. Dirichlet values stay.

        Returns:
            The history of the run.

        Raises:
            MPMError: The run cannot go on; the state is that of the last converged step. With
                ``outside="stop"`` a particle that leaves the background is no error: the run
                ends, ``history.stopped`` and a warning say why.
        """
        path = self.steps(steps, update, repartition, control)
        for _ in with_bar(path, steps, self._share) if progress and self._comm.rank == 0 else path:
            pass
        return self.history

    def steps(
        self,
        steps: int,
        update: Callable[[float], None] | None = None,
        repartition: float | None = None,
        control: DisplacementControl | None = None,
    ) -> Iterator[Step]:
        """Apply the whole load, one converged step at a time.

        After :meth:`restore` it goes on with the run that was interrupted.

        Args:
            steps: As in :meth:`solve`.
            update: As in :meth:`solve`.
            repartition: As in :meth:`solve`.
            control: As in :meth:`solve`.

        Yields:
            Each converged step.

        Raises:
            MPMError: As in :meth:`solve`.
        """
        return load_steps(self, steps, update, repartition, control)

    def _share(self, _: Step) -> float:
        """Return how much of the run is done."""
        return 1.0 if self._run is None else self._run.control.share

    def step(self) -> Step:
        """Make one increment to the present values of loads and conditions.

        Returns:
            The converged step.

        Raises:
            MPMError: It does not converge; the state is that of the last converged step.
        """
        return single_step(self)

    # -- Results --------------------------------------------------------------------------

    def reaction(self, bc: fem.DirichletBC | Support) -> NDArray[np.float64]:
        """Return the force of a support on the body at the last converged load.

        Args:
            bc: One of the problem's Dirichlet conditions, or a support of
                :mod:`mpm_dolfinx.boundary` on one of its bodies.

        Returns:
            Force, shape ``(gdim,)``, the same on all ranks.

        Raises:
            MPMError: The condition is not one of the problem's.
        """
        if isinstance(bc, Support):
            if all(bc.particles is not body for body in self.bodies):
                raise MPMError("reaction() needs a support on one of the bodies of this problem.")
            return bc.reaction
        if not any(bc is known for known in self.bcs):
            raise MPMError("reaction(bc) needs one of the Dirichlet conditions of this problem.")
        return force_at(bc, self._converged.reactions, self.bodies[0].V)

    def write(self, path: str | Path) -> None:
        """Add the present state to a time series for ParaView.

        The domains are written at their current positions, with displacement, volume ratio
        and, where there is a material, Cauchy stress, pressure and plastic strain.

        Args:
            path: A ``.pvd`` file; the first call replaces it, unless the problem was restored
                from a checkpoint of the run that wrote it: then the series goes on, without
                what is later than the checkpoint. With several bodies each has its own, numbered
                from 0: ``name_0.pvd``.

        Raises:
            MPMError: The name does not end in ``.pvd``, or the file cannot be written.
        """
        self._output.write(Path(path), self.bodies, self.history.time)

    def keep_identity(self) -> None:
        """Note what this problem is known by, before its body meshes change (collective)."""
        self.identity = state.identity(self)

    def warn(self, sentence: str) -> None:
        """Warn the user, on one rank."""
        if self._comm.rank == 0:
            warnings.warn(sentence, stacklevel=4)

    def repartition(self, threshold: float = 0.1) -> bool:
        """Move particles with their history to where they are best now (collective).

        Args:
            threshold: Share of the particles that must be better elsewhere.

        Returns:
            Whether particles have moved.

        Raises:
            MPMError: The problem holds what cannot move: a residual in UFL.
        """
        raise MPMError(
            "The residual is written on the present body mesh, so its particles cannot move; "
            "place them at the start with Particles(..., partition='background')."
        )

    def save(self, path: str | Path, functions: Sequence[fem.Function] = ()) -> None:
        """Write a checkpoint of the last converged step (collective).

        Call it wherever one likes, also between the steps of :meth:`steps`. The file replaces
        the one before when it is whole and on the disk; whatever interrupts that leaves the one
        before.

        Args:
            path: Name of the file.
            functions: Functions on the bodies' meshes that are part of the state, known by
                their names: data at quadrature points that the residual holds, and whatever
                else the run depends on.

        Raises:
            MPMError: The file cannot be written, or functions that cannot be kept.
        """
        checkpoint.write(self._comm, Path(path), state.capture(self, functions))

    def restore(
        self, path: str | Path, functions: Sequence[fem.Function] = (), resume: bool = True
    ) -> None:
        """Return to the state of a checkpoint, on any number of ranks (collective).

        The problem must be made as the one that was saved: same meshes, space, method and
        materials. Loads and Dirichlet conditions are not compared, so that a run may go on with
        others.

        Args:
            path: A file that :meth:`save` wrote.
            functions: As they were given to :meth:`save`; their values are restored.
            resume: Whether :meth:`solve` or :meth:`steps`, with the same number of steps as
                before, goes on with the run that was interrupted; else they begin a new one
                from the present load.

        Raises:
            MPMError: The file is missing, no checkpoint, newer than this package, truncated,
                damaged, or that of another problem, or a time series that it was writing cannot
                be read; the state is what it was.
        """
        snapshot, source = checkpoint.read(self._comm, Path(path)), f"The checkpoint '{path}'"
        state.require_same(self, snapshot, source)
        written = snapshot.numbers.get("series", {})
        series = read_series(self._comm, written)
        self.cut_as(snapshot, bool(functions), source)
        state.adopt(self, snapshot, functions, resume, source)
        self._output.go_back(series, written, self.history.time)

    def cut_as(self, snapshot: checkpoint.Snapshot, functions: bool, source: str) -> None:
        """Split the domains that were split in a state (collective).

        Args:
            snapshot: The state, one of this problem.
            functions: Whether it is to be restored with Functions on the present mesh.
            source: What to call it in an error.

        Raises:
            MPMError: Domains were split that are not, or the other way round.
        """

    # -- What a problem with a material adds -----------------------------------------------

    def smooth(self) -> bool:
        """Return whether no history changes in the last residual, nor contact (collective).

        Newton steps that let the residual grow are taken on trust then. A problem that overrides
        :meth:`evaluate` or :meth:`commit` has a history, unless it says otherwise here.
        """
        own = type(self)
        return own.evaluate is ParticleProblem.evaluate and own.commit is ParticleProblem.commit

    def evaluate(self) -> MPMError | None:
        """Update what the forms hold besides the displacement; return why that cannot be.

        Called before each assembly with ``particles.displacement`` set. Must not change the
        history. It may differ between ranks.
        """
        return None

    def _internal_stress(self, number: int) -> PointStress | None:
        """Return the stress of a body whose virtual work is not in the residual form, if any."""
        return None

    def _masses(self, number: int) -> NDArray[np.float64] | None:
        """Return the mass of each particle of a body that this rank owns, if it is known."""
        return None

    def commit(self) -> None:
        """Make the last evaluation the converged one."""

    def end_step(self) -> None:
        """Do what is to be done between two steps."""

    def mend(self, error: MPMError) -> bool:
        """Change what made the smallest step fail; return whether to go on (collective)."""
        return False

    def roll_back(self) -> None:
        """Return to the last converged evaluation."""

    def converged_state(self) -> list[dict[str, NDArray[Any]]]:
        """Return the history at the last converged step, for a checkpoint.

        Returns:
            One dictionary for each body: arrays ``(n, ...)`` of its owned particles by name.
        """
        return [{} for _ in self.bodies]

    def set_converged_state(self, states: list[dict[str, NDArray[Any]]]) -> None:
        """Make what :meth:`converged_state` once returned the history.

        :meth:`roll_back` is called after it.

        Args:
            states: As returned there.
        """

    def laws(self) -> list[list[Law]]:
        """Return the materials of each body, for a checkpoint to know them by."""
        return [[] for _ in self.bodies]

    def data_at_points(self) -> set[fem.Function]:
        """Return Functions at quadrature points that the forms hold and no history keeps."""
        keeps = type(self).converged_state is not ParticleProblem.converged_state
        return set() if keeps else self._data
