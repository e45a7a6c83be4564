# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A UFL residual on particles, solved in load steps."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

import ufl
from dolfinx import fem

from . import _compat
from .assembly import BackgroundForms, BodyForms, ReducedSpace
from .errors import (
    ConvergenceError,
    DomainDistortionError,
    MPMError,
    ParticleOutsideError,
    agreed,
)
from .history import History, Step
from .io import TimeSeries
from .particles import Particles
from .solver import NewtonSolver
from .stepping import StepControl

__all__ = ["ParticleProblem"]


class ParticleProblem:
    """Find the displacement of particles at which a UFL residual vanishes.

    The residual is written on the body mesh as for finite elements. Each step's increment
    lives in the background space: ``d = d_n + T u``, residual ``T^T R`` and tangent
    ``T^T J T``.

    Args:
        R: Residual in ``particles.displacement`` and a test function of ``particles.W``.
        particles: The body.
        J: Tangent; ``None`` is ``ufl.derivative(R, particles.displacement)``.
        bcs: Dirichlet conditions on V; their values are totals at full load.
        background: Form in ``particles.increment`` and a test function of V, added to R.
        petsc_options_prefix: Prefix of the PETSc options.
        petsc_options: PETSc options for SNES, KSP and PC, without prefix.
        form_compiler_options: Options of FFCx.
        jit_options: Options of the compilation at run time.
        symmetric: Whether J is symmetric (an LDL^T factorisation instead of LU).
        shift: Diagonal shift in the factorisation, relative to the diagonal. Combinations of
            background dofs that move no node of the body make the reduced tangent singular;
            without a shift the factor of such a matrix is noise.
        line_search: Whether Newton steps are halved where they invert domains or do not
            reduce the residual.

    Attributes:
        particles: The body.
        history: Steps, counters and seconds; filled as a run goes on.
        bcs: The Dirichlet conditions.

    Raises:
        MPMError: Forms, spaces or conditions that do not go together.
    """

    def __init__(
        self,
        R: ufl.Form,
        particles: Particles,
        J: ufl.Form | None = None,
        bcs: Sequence[fem.DirichletBC] = (),
        background: ufl.Form | None = None,
        petsc_options_prefix: str = "mpm_",
        petsc_options: dict[str, Any] | None = None,
        form_compiler_options: dict[str, Any] | None = None,
        jit_options: dict[str, Any] | None = None,
        *,
        symmetric: bool = False,
        shift: float = 1e-13,
        line_search: bool = True,
    ) -> None:
        if not isinstance(particles, Particles):
            raise MPMError(f"particles must be mpm.Particles, not {type(particles).__name__}.")
        if not (np.isfinite(shift) and 0.0 <= shift < 1.0):
            raise MPMError(f"shift must be at least 0 and below 1, not {shift!r}.")
        options = {"form_compiler_options": form_compiler_options, "jit_options": jit_options}
        self.particles = particles
        self.bcs = list(bcs)
        for bc in self.bcs:
            if not _compat.is_condition_on(bc, particles.V):
                raise MPMError(
                    "A Dirichlet condition is not on the background space V of the particles "
                    "or on a component of it (V.sub(i))."
                )
        self.history = History()
        self._comm: MPI.Comm = particles.mesh.comm
        self._forms = BodyForms(R, J, particles, **options)
        self._background = (
            BackgroundForms(background, particles, **options) if background is not None else None
        )
        self._newton = NewtonSolver(
            self._comm,
            petsc_options_prefix,
            petsc_options or {},
            symmetric,
            shift,
            line_search,
            self.history.statistics,
        )
        self._prescribed: NDArray[np.float64] = np.zeros(len(particles.increment.x.array))
        self._loaded = float(particles.load.value)
        self._reactions: NDArray[np.float64] | None = None
        self._space: ReducedSpace | None = None
        self._series: dict[Path, TimeSeries] = {}

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
    ) -> History:
        """Apply the whole load.

        Args:
            steps: Number of equal load steps; a step that fails is halved, none is larger.
            update: The user's path: ``update(t)`` sets values of Dirichlet conditions,
                Constants and Functions to their totals at t in (0, 1]. It may be called again
                with a smaller t after a failure. The load factor is t unless it sets another.
            progress: Whether rank 0 shows a progress bar.

        Returns:
            The history of the run.

        Raises:
            MPMError: The run cannot go on; the state is that of the last converged step.
        """
        with tqdm(
            total=steps,
            disable=not progress or self._comm.rank > 0,
            unit="step",
            bar_format="{l_bar}{bar}| {n:.3g}/{total} [{elapsed}<{remaining}{postfix}]",
        ) as bar:
            for step in self.steps(steps, update):
                bar.set_postfix_str(f"{step.iterations} solves")
                bar.update(step.load * steps - bar.n)
        return self.history

    def steps(self, steps: int, update: Callable[[float], None] | None = None) -> Iterator[Step]:
        """Apply the whole load, one converged step at a time.

        Args:
            steps: As in :meth:`solve`.
            update: As in :meth:`solve`.

        Yields:
            Each converged step.

        Raises:
            MPMError: As in :meth:`solve`.
        """
        if not isinstance(steps, int | np.integer) or steps < 1:
            raise MPMError(f"The number of steps must be a whole number from 1 on, not {steps!r}.")
        if update is None and self._loaded >= 1.0:
            raise MPMError(
                "The whole load is applied already; go on with problem.step() or with a path "
                "(update=...)."
            )
        control = StepControl(int(steps))
        start, base = (self._loaded, self._prescribed.copy())
        while not control.finished:
            t = control.target
            load = t if update is not None else start + (1.0 - start) * t
            try:
                np.copyto(self.particles.load.value, load)
                if update is not None:
                    update(t)
                    values = self._dirichlet_values()
                else:
                    values = base + (self._dirichlet_values() - base) * t
                step = self._advance(t if update is not None else load, values)
            except ParticleOutsideError as error:
                self._restore(update)
                raise self._placed(error) from None
            except (ConvergenceError, DomainDistortionError) as error:
                self._restore()
                self.history.failed_iterations += self._newton.iterations
                if not control.cut_back():
                    self._restore(update)
                    raise self._placed(error) from None
                self.history.cutbacks += 1
                continue
            control.accept(step.iterations)
            yield step
        self._warn_of_outside()

    def step(self) -> Step:
        """Make one increment to the present values of loads and conditions.

        Returns:
            The converged step.

        Raises:
            MPMError: It does not converge; the state is that of the last converged step.
        """
        try:
            return self._advance(float(self.particles.load.value), self._dirichlet_values())
        except MPMError as error:
            self._restore()
            self.history.failed_iterations += self._newton.iterations
            raise self._placed(error) from None

    # -- Results --------------------------------------------------------------------------

    def reaction(self, bc: fem.DirichletBC) -> NDArray[np.float64]:
        """Return the force of a support on the body at the last converged load.

        Args:
            bc: One of the problem's Dirichlet conditions.

        Returns:
            Force, shape ``(gdim,)``, the same on all ranks.

        Raises:
            MPMError: The condition is not one of the problem's.
        """
        if not any(bc is known for known in self.bcs):
            raise MPMError("reaction(bc) needs one of the Dirichlet conditions of this problem.")
        gdim = self.particles.V.dofmap.index_map_bs
        force = np.zeros(gdim)
        if self._reactions is not None:
            dofs, first_ghost = bc.dof_indices()
            own = dofs[:first_ghost]
            np.add.at(force, own % gdim, self._reactions[own])
        return np.asarray(self._comm.allreduce(force))

    def write(self, path: str | Path) -> None:
        """Add the present state to a time series for ParaView.

        The domains are written at their current positions, with displacement, volume ratio
        and, where there is a material, Cauchy stress, pressure and plastic strain.

        Args:
            path: A ``.pvd`` file; the first call of a run replaces it.

        Raises:
            MPMError: The name does not end in ``.pvd``.
        """
        path = Path(path)
        if path not in self._series:
            self._series[path] = TimeSeries(path, self.particles)
        last = self.history.steps[-1].load if self.history.steps else 0.0
        self._series[path].write(last)

    def _warn_of_outside(self) -> None:
        """Say so where the last step, which is converged, took particles off the background."""
        try:
            with self.history.statistics.phase("locate"):
                self.particles.locate()
        except ParticleOutsideError as error:
            if self._comm.rank == 0:
                warnings.warn(f"The run is complete, but {error!s}", stacklevel=3)

    # -- One step -------------------------------------------------------------------------

    def _advance(self, parameter: float, values: NDArray[np.float64]) -> Step:
        """Solve one step to Dirichlet totals, and commit it."""
        statistics = self.history.statistics
        self._values = values
        self._change = values - self._prescribed
        self._lifted = False
        with statistics.phase("locate"):
            self.particles.locate()
        with statistics.phase("transfer"):
            self._reduce()
        with statistics.phase("assemble"):
            self._forms.assemble_external()
        assert self._space is not None
        self._external = float(self._to_background(self._forms.external).norm())
        self._newton.solve(self, self._space.sizes)
        crossed = self.particles.crossed()
        if (failure := agreed(self._comm, _distorted("cross themselves", crossed))) is not None:
            raise failure
        with statistics.phase("commit"):
            self.particles._commit()
            self.commit()
            self._prescribed = values.copy()
            self._loaded = float(self.particles.load.value)
            self._reactions = self._work_V.array_r.copy()
            self._space = None
        step = Step(parameter, self._newton.iterations, list(self._newton.residuals))
        self.history.steps.append(step)
        return step

    def _reduce(self) -> None:
        """Find the free dofs and the transfer to them, unless they are those of the last try."""
        if self._space is not None:
            return
        particles = self.particles
        T = particles.T
        bs = particles.V.dofmap.index_map_bs
        owned = particles.V.dofmap.index_map.size_local * bs
        free = np.zeros(owned, dtype=bool)
        free.reshape(-1, bs)[particles._active_nodes] = True
        if self._background is not None:
            free[self._background.support()] = True
        self._fixed = np.zeros(owned, dtype=bool)
        for bc in self.bcs:
            dofs, first_ghost = bc.dof_indices()
            self._fixed[dofs[:first_ghost]] = True
        self._space = ReducedSpace(T, np.flatnonzero(free & ~self._fixed).astype(np.int32))
        self._work_V, self._work_W = T.createVecs()
        self.history.statistics.count("transfers")
        self.history.statistics["free_dofs"] = self._space.sizes[1]

    def _dirichlet_values(self) -> NDArray[np.float64]:
        """Return the present totals of all Dirichlet conditions, on the local dofs of V."""
        values: NDArray[np.float64] = np.zeros_like(self._prescribed)
        for bc in self.bcs:
            bc.set(values, None, 1.0)
        return values

    def _restore(self, update: Callable[[float], None] | None = None) -> None:
        """Return to the last converged step."""
        self.particles._roll_back()
        np.copyto(self.particles.load.value, self._loaded)
        self.roll_back()
        if update is not None and self.history.steps:
            update(self.history.steps[-1].load)

    def _placed(self, error: MPMError) -> MPMError:
        """Say at what load an error happened, and what to do."""
        advice = {
            ParticleOutsideError: "",
            DomainDistortionError: "; take more steps, smaller loads or finer domains",
            ConvergenceError: "; take more steps, or look whether a limit load is reached",
        }[type(error)]
        particles, text = error.particles, error.message.rstrip(".")
        if isinstance(error, ConvergenceError) and not particles:
            particles = self._worst_particles()
            if particles:
                text += "; the residual is largest at {particles}"
        return type(error)(
            f"{text}, in the step after load {self._loaded:.6g}{advice}.",
            particles,
            self._loaded,
        )

    def _worst_particles(self) -> list[int]:
        """Return the particles at the node with the largest residual (collective)."""
        particles = self.particles
        particles.T.mult(self._work_V, self._work_W)
        force = np.linalg.norm(
            self._work_W.array_r.reshape(-1, particles.V.mesh.geometry.dim), axis=1
        )
        largest = float(np.nanmax(force, initial=0.0))
        if not self._comm.allreduce(largest, MPI.MAX) == largest > 0.0:
            mine: list[int] = []
        else:
            touches = (particles._domain_nodes == int(np.nanargmax(force))).any(axis=1)
            mine = [int(p) for p in particles.global_index[touches]]
        return sorted({p for found in self._comm.allgather(mine) for p in found})

    # -- What a problem with a material adds -----------------------------------------------

    def evaluate(self) -> MPMError | None:
        """Update what the forms hold besides the displacement; return why that cannot be.

        Called before each assembly with ``particles.displacement`` set. Must not change the
        history. It may differ between ranks.
        """
        return None

    def commit(self) -> None:
        """Make the last evaluation the converged one."""

    def roll_back(self) -> None:
        """Return to the last converged evaluation."""

    # -- The reduced problem, as the solver sees it ----------------------------------------

    def residual(self, x: PETSc.Vec, F: PETSc.Vec) -> MPMError | None:
        """Evaluate the reduced residual (for the solver)."""
        assert self._space is not None
        particles, statistics = self.particles, self.history.statistics
        u = particles.increment.x
        owned = len(self._fixed)
        u.array[:owned] = self._lifts() if self._lifted else 0.0
        u.array[self._space.free] = x.array_r
        u.scatter_forward()
        self._work_V.array_w[:] = u.array[:owned]
        particles.T.mult(self._work_V, self._work_W)
        d = particles.displacement.x
        rows = self._work_W.getLocalSize()
        d.array[:rows] = particles._converged.ravel()[:rows] + self._work_W.array_r
        d.scatter_forward()
        with statistics.phase("constitutive"):
            failure = agreed(
                self._comm,
                _distorted("turn inside out", particles.inverted()) or self.evaluate(),
            )
        if failure is not None:
            return failure
        with statistics.phase("assemble"):
            total = self._to_background(self._forms.assemble_residual())
            if self._background is not None:
                total.axpy(1.0, self._background.assemble_residual())
        F.array_w[:] = self._space.restrict(total)
        return None

    def _to_background(self, vector: PETSc.Vec) -> PETSc.Vec:
        """Return ``T^T`` times a vector of W, in the problem's work vector of V."""
        self.particles.T.multTranspose(vector, self._work_V)
        return self._work_V

    def tangent(self) -> PETSc.Mat:
        """Return the reduced tangent (for the solver)."""
        assert self._space is not None
        with self.history.statistics.phase("assemble"):
            background = (
                self._background.assemble_tangent() if self._background is not None else None
            )
            return self._space.reduce(self._forms.assemble_tangent(), background)

    def impose(self) -> bool:
        """Impose the step's Dirichlet values; return whether there are any (for the solver)."""
        self._lifted = True
        return bool(self._comm.allreduce(bool(np.any(self._lifts())), MPI.LOR))

    def _lifts(self) -> NDArray[np.float64]:
        return np.where(self._fixed, self._change[: len(self._fixed)], 0.0)

    def lift(self) -> PETSc.Vec:
        """Return the linearised forces of the step's Dirichlet values (for the solver)."""
        assert self._space is not None
        self._work_V.array_w[:] = self._lifts()
        self.particles.T.mult(self._work_V, self._work_W)
        forces = self._forms.K.createVecLeft()
        self._forms.K.mult(self._work_W, forces)
        total = self._work_V.duplicate()
        if self._background is not None:
            self._background.assemble_tangent().mult(self._work_V, total)
        self.particles.T.multTransposeAdd(forces, total, total)
        reduced = self._space.T.createVecRight()
        reduced.array_w[:] = self._space.restrict(total)
        return reduced

    def scale(self) -> float:
        """Return the larger of external forces and reactions (for the solver)."""
        reactions = np.where(self._fixed, self._work_V.array_r, 0.0)
        return max(self._external, self._size(reactions))

    def internal_scale(self) -> float:
        """Return the size of the absolute internal contributions (for the solver)."""
        with self.history.statistics.phase("assemble"):
            total = self._forms.absolute_contributions(self.particles._domain_nodes)
            result = self.particles.T.createVecRight()
            self.particles.T.multTranspose(total, result)
            return float(result.norm())

    def motion(self, x: PETSc.Vec) -> float:
        """Return the norm of ``T x`` (for the solver)."""
        assert self._space is not None
        self._space.T.mult(x, self._work_W)
        return float(self._work_W.norm())

    def _size(self, values: NDArray[np.float64]) -> float:
        return float(np.sqrt(self._comm.allreduce(values @ values)))


def _distorted(how: str, which: NDArray[np.int64]) -> DomainDistortionError | None:
    return (
        DomainDistortionError(f"The domains of {{particles}} {how}", which) if len(which) else None
    )
