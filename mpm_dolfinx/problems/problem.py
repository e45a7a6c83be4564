# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A problem: bodies, steps, results, and a state that goes with them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, NoReturn

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from ..boundary.supports import Support
from ..constitutive.points import MaterialPoints
from ..errors import MPMError, agree, warn
from ..history import History, Step
from ..io.files import as_path
from ..io.series import Output
from ..io.snapshot import Kept, spaces_of
from ..parallel.boundary import collective
from ..parallel.garbage import Cleaner
from ..parallel.given import is_number, is_ours, require_same
from ..particles.field import ParticleField
from ..particles.particles import Particles
from ..solvers.newton import NewtonSolver
from ..stepping.automatic import ErrorControl
from ..stepping.displacement_control import DisplacementControl
from ..stepping.loading import Mender, Stepper
from ..stepping.progress import with_bar
from ..stepping.solving import System
from ..stepping.trial import Trial
from ..structures.structure import Structure
from ..system.conditions import force_at
from ..system.field_equation import FieldEquation
from ..system.hooks import Hooks
from ..system.predictor import Predictor
from ..system.reduced import ReducedSystem
from ..system.release import Release
from ..system.term import Term, UserTerm
from ..system.value_field import ValueField
from .accuracy import adaptivity_of, errors_of
from .arguments import (
    as_bodies,
    as_conditions,
    as_terms,
    by_space,
    require_joined,
)
from .names import OwnNames
from .parts import Built, Contribution, Parts
from .reign import Reign
from .solver import Solver
from .staging import Staging
from .state import ProblemState
from .summary import in_one_line, on_a_screen

__all__ = ["Law", "Problem"]

#: What goes with automatic steps, and is of no meaning to others.
AUTOMATIC = {"tolerance": None, "output_at": (), "length": None}
#: What is there of a problem that is not built.
NOTHING = Built([], [], [], [], [], set(), {})


type Law = tuple[str, dict[str, Any]]
"""Name of a material, and its parameters: numbers, or indices and values of points."""


class Problem(Hooks, OwnNames):
    """Find the displacement of particles at which forces balance, in load steps.

    What all problems have is here. Of what their bodies are made is told by
    :class:`ParticleProblem` in UFL, by :class:`QuasiStaticProblem` with materials, and by those
    through time. Each step's increment lives in the background space: ``d = d_n + T u``, residual
    ``T^T R`` and tangent ``T^T J T``. A subclass that takes a name of these for its own is refused,
    but for what heirs are to write.

    Args:
        particles: The body or bodies.
        bcs: Dirichlet conditions.
        background: Form on the background.
        solver: How it is solved.
        terms: What else acts on the bodies.
        fields: Unknowns besides displacements, with residuals of their own.
        mender: What changes meshes between steps, if anything.
        spaces: Background spaces of fields.

    Attributes:
        particles: The body or bodies, as given.
        bodies: The bodies, as a list.
        reduced: Residual and tangent in the free dofs of V.
        history: Steps, counters and seconds; filled as a run goes on.
        bcs: The Dirichlet conditions.
        terms: As given.
        fields: As given.
        trial: Tries load steps, and knows the last that has converged.
        state: All that goes with it to other meshes, to other ranks, into files and back.
        staging: Takes it from one stage to the next.
        built: What it is on the present meshes.
        reign: Whether it governs the bodies.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuse what a user derives from what all problems have alone."""
        super().__init_subclass__(**options)
        cls.keeps_data = cls.converged_state is not Problem.converged_state
        if Problem in cls.__bases__ and not is_ours(cls.__module__):
            raise MPMError(
                f"{cls.__name__} is of mpm.Problem, which is what all problems have and can be "
                "none; derive it from mpm.ParticleProblem, mpm.QuasiStaticProblem or one of those "
                "through time."
            )

    def __init__(
        self,
        particles: Particles | Sequence[Particles],
        bcs: Sequence[fem.DirichletBC],
        background: ufl.Form | Sequence[ufl.Form] | None,
        solver: Solver,
        terms: Sequence[Term],
        fields: Sequence[ParticleField] = (),
        mender: Mender | None = None,
        spaces: Sequence[fem.FunctionSpace] = (),
    ) -> None:
        self.particles, self.fields = particles, fields
        self.bodies = as_bodies(particles)
        self.bcs = as_conditions(bcs, [*spaces_of(self.bodies), *spaces])
        self.terms = as_terms(terms, self.bodies)
        self.history = History(in_time=not self.at_rest)
        self._comm: MPI.Comm = self.bodies[0].V.mesh.comm
        self._background, self._how = background, solver
        self._output = Output()
        self._held = Release()
        self.trial = Trial(self)
        self._stepper = Stepper(self.trial, self._held, mender)
        self.state = ProblemState(self, self._stepper, self._held, self._output, mender)
        self.staging = Staging(self.state, self._stepper, self._held)
        self.built = NOTHING
        self.build()
        self.state.keep_terms()

    def build(self) -> None:
        """Make the system and its solver for the present meshes of the bodies (collective).

        It is called again whenever these are other ones.
        """
        meshes = [group[0].V.mesh for group in by_space(self.bodies)]
        clean_up = Cleaner(self._comm, [*meshes, *(body.mesh for body in self.bodies)])
        try:
            self.trial.follow(self._system(clean_up))
        except BaseException:
            clean_up.end()  # what is half built is freed by the next problem
            raise
        self.reign = Reign(self.bodies)

    def _system(self, clean_up: Cleaner) -> System:
        """Return the system on the present meshes (collective).

        Args:
            clean_up: Frees what is out of use.
        """
        how = self._how
        parts = Parts(
            self.bodies,
            self._contributions(),
            self.fields,
            self._of_fields,
            self._background,
            how,
            self._entity_maps,
            [term.field for term in self.terms if isinstance(term, FieldEquation)],
        )
        built = self.built = parts.built()
        require_joined(self.bodies, self.terms)
        for term in self.terms:
            materials = [given.stress for given in built.contributions]
            term.take_part(self.state.number(term), self.bodies, materials)
        for term in self.terms if self._pace else ():
            term.pace(*self._pace)
        carried = built.carried
        fields = [
            *parts.displacement_fields(self.bcs, self.keeps_joints),
            *(ValueField(group, self.bcs) for group in by_space(carried)),
        ]
        statistics = self.history.statistics
        self._held.follow([*self.bodies, *carried], [field.V for field in fields])
        reduced = ReducedSystem(
            [*parts.moving, *carried],
            fields,
            [*built.body_terms, *built.field_terms, *self.terms, UserTerm(self), self._held],
            statistics,
            Predictor(how.predictor and self.predicts),
        )
        newton = NewtonSolver(
            self._comm,
            how.petsc_options_prefix,
            how.petsc_options or {},
            all(given.symmetric for given in built.contributions)
            and all(term.symmetric for term in (*built.field_terms, *self.terms)),
            how.shift,
            how.line_search,
            statistics,
            self.bodies[0].V.mesh.geometry.dim,
            how.linear,
        )
        for body in self.bodies:
            known = [*self.fields, *parts.alternating]
            body.attach_unknowns([one for one in known if one.particles is body])
        return System(
            self.bodies,
            built.body_terms,
            reduced,
            newton,
            clean_up,
            built.points,
            built.supports,
            built.loads,
            built.masses,
        )

    def _contributions(self) -> list[Contribution]:
        """Return the contribution of each body to the system, on its present mesh (collective)."""
        raise NotImplementedError

    #: How body meshes are related to others that forms have Functions on.
    _entity_maps: Any = None
    #: Whether bodies that bear on each other are kept together where the background would let go.
    keeps_joints: ClassVar[bool] = True
    #: Whether steps may start from an extrapolation of those before.
    predicts: ClassVar[bool] = True
    #: Whether a step ends in equilibrium.
    at_rest: ClassVar[bool] = True
    #: Duration of a step of a motion, and the share of force in its last residual.
    _pace: tuple[float, ...] = ()
    #: Residuals of the fields.
    _of_fields: Sequence[ufl.Form] = ()

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Raise an error: a copy would have the bodies and their state in common."""
        raise MPMError("A problem cannot be copied; make another one, of particles of its own.")

    def __del__(self) -> None:
        """Leave PETSc's objects to the next clean-up; at the program's end PETSc drops them.

        The meshes are let go of here too: see :meth:`Particles.__del__`.
        """
        if sys.is_finalizing():
            return
        if isinstance(vars(self).get("built"), Built):
            self.release()
        vars(self).clear()

    __repr__ = in_one_line

    @collective()
    def summary(self) -> str:
        """Return a summary of the problem and of its run, a screen of text (collective).

        Bodies with their materials, how far they have moved and yielded, background, solver, steps,
        linear solves and seconds (mean of the ranks): ``print(problem.summary())``.
        """
        return on_a_screen(self, self._comm, self._how.in_words(), self.built.words)

    def release(self) -> None:
        """Let go of what was built for the present meshes."""
        for body in self.bodies:
            body.forget_transfer()
        for field in self.built.carried:
            field.forget_transfer()
        self.built = NOTHING
        self.trial.release()

    # -- PETSc objects --------------------------------------------------------------------

    @property
    def reduced(self) -> ReducedSystem:
        """Residual and tangent in the free dofs of V."""
        return self.trial.reduced

    @property
    def solver(self) -> PETSc.SNES:
        """The nonlinear solver."""
        return self.trial.newton.snes

    @property
    def A(self) -> PETSc.Mat | None:
        """The reduced tangent of the last Newton iteration."""
        return self.trial.newton.K

    @property
    def b(self) -> PETSc.Vec | None:
        """The reduced residual that was evaluated last."""
        return self.trial.newton.F

    @property
    def x(self) -> PETSc.Vec | None:
        """The free dofs of the last step's increment."""
        return self.trial.newton.x

    # -- Loading --------------------------------------------------------------------------

    @collective()
    def solve(
        self,
        steps: int | str = 1,
        *,
        update: Callable[[float], None] | None = None,
        progress: bool = False,
        repartition: float | None = None,
        control: DisplacementControl | None = None,
        tolerance: float | None = None,
        output_at: Sequence[float] = (),
        length: float | None = None,
        adapt: float | None = None,
    ) -> History:
        """Apply the whole load.

        Args:
            steps: Number of equal load steps; a step that fails is halved, none is larger. With
                ``"auto"`` their sizes are chosen by an estimate of their error, and steps
                with too large a one are taken back.
            update: The user's path: ``update(t)`` sets values of Dirichlet conditions,
                Constants and Functions to their totals at t in (0, 1]. It may be called again
                with a smaller t after a failure. The load factor goes from its present value
                to 1 in proportion to t unless it sets another.
            progress: Whether rank 0 shows a progress bar.
            repartition: Share of the particles that makes them move to other ranks after a
                step (:meth:`QuasiStaticProblem.repartition`); ``None`` leaves them.
            control: A displacement of a body that goes to a value in these steps; the load
                factor is found for each, which may fall again. Dirichlet values stay.
            tolerance: With ``"auto"``: error of the displacement at the end that is aimed at,
                relative to the motion of the run, as root mean squares over the nodes. ``None`` is
                0.01, or with ``adapt=`` its square: the error in energy is the root of the one in
                displacements that belongs to it.
            output_at: With ``"auto"``: shares t of the run in (0, 1] at which a step is to end, to
                the last bit; ``step.output`` says so.
            length: With ``"auto"``: a motion to be expected, by which the error is measured instead
                of the motion so far.
            adapt: What :meth:`error` may be. Where it is more at the end of a step, nodes of bodies
                made with ``free=`` are freed and the step is solved on, until it is not, or until
                next to all of it is the error of the bodies' own elements. Nodes are carried again
                where the domains around them distort.

        Returns:
            The history of the run.

        Raises:
            MPMError: The run cannot go on; the state is that of the last converged step. With
                ``outside="stop"`` a particle that leaves the background is no error: the run
                ends, ``history.stopped`` and a warning say why.
        """
        path = self.steps(
            steps,
            update=update,
            repartition=repartition,
            control=control,
            tolerance=tolerance,
            output_at=output_at,
            length=length,
            adapt=adapt,
        )
        number = 1 if isinstance(steps, str) else steps
        if progress and self._comm.rank == 0:
            path = with_bar(path, number, lambda _: self._stepper.share)
        for _ in path:
            pass
        return self.history

    @collective()
    def steps(
        self,
        steps: int | str,
        *,
        update: Callable[[float], None] | None = None,
        repartition: float | None = None,
        control: DisplacementControl | None = None,
        tolerance: float | None = None,
        output_at: Sequence[float] = (),
        length: float | None = None,
        adapt: float | None = None,
    ) -> Iterator[Step]:
        """Apply the whole load, one converged step at a time.

        After :meth:`restore` it goes on with the run that was interrupted.

        Args:
            steps: As in :meth:`solve`.
            update: As in :meth:`solve`.
            repartition: As in :meth:`solve`.
            control: As in :meth:`solve`.
            tolerance: As in :meth:`solve`.
            output_at: As in :meth:`solve`.
            length: As in :meth:`solve`.
            adapt: As in :meth:`solve`.

        Yields:
            Each converged step.

        Raises:
            MPMError: As in :meth:`solve`.
        """
        self.reign.require()
        automatic = {
            "tolerance": tolerance,
            "output_at": output_at,
            "length": length,
        }
        adaptivity = None if adapt is None else adaptivity_of(self.trial, self.bcs, adapt)
        if isinstance(steps, str) and steps == "auto":
            if tolerance is None:
                tolerance = 1e-2 if adaptivity is None else adaptivity.tolerance**2
            chosen: Any = ErrorControl(tolerance, output_at, length)
        elif automatic != AUTOMATIC:
            raise MPMError(
                f"tolerance=, output_at= and length= are for steps='auto', not for steps={steps!r}."
            )
        else:
            chosen = steps
        return self._stepper.steps(
            self, chosen, update, repartition, control, adaptivity=adaptivity
        )

    @collective()
    def step(self) -> Step:
        """Make one increment to the present values of loads and conditions.

        Loads count times the load factor, which is that of the last step unless
        ``particles.load`` is set, and so do displacements of supports before the first path;
        Dirichlet values, and supports after a path, are taken as they are. A first step at the load
        factor 0 that moves nothing warns.

        Returns:
            The converged step.

        Raises:
            MPMError: It does not converge; the state is that of the last converged step.
        """
        self.reign.require()
        return self._stepper.step()

    # -- Results --------------------------------------------------------------------------

    @collective()
    def reaction(self, bc: fem.DirichletBC | Support | Term) -> NDArray[np.float64]:
        """Return the force of a support on the body at the last converged load.

        The force at each dof of the condition counts once, however often the condition names
        it; where two conditions share a dof, it is in the force of both. A support that stands in a
        residual in UFL has the force of what is set now.

        Args:
            bc: One of the problem's Dirichlet conditions, a support of
                :mod:`mpm_dolfinx.boundary` on one of its bodies, or one of its terms that tells its
                ``reaction``: a contact, a :class:`Tie` (the pull on its first body), a
                :class:`Truss` or :class:`Membrane` (the force that holds its nodes).

        Returns:
            Force, shape ``(gdim,)``, the same on all ranks.

        Raises:
            MPMError: The condition is not one of the problem's, or a term tells no reaction.
        """
        known: Sequence[Any]
        if isinstance(bc, Term):
            what, known = "terms", self.terms
        elif isinstance(bc, Support):
            what, known = "supports", [bc for body in self.bodies if bc.particles is body]
        else:
            what, known = "Dirichlet conditions", self.bcs
        place = next((number for number, one in enumerate(known) if one is bc), None)
        with agree(self._comm):
            if place is None:
                raise MPMError(
                    "reaction() takes a Dirichlet condition, a support or a term: one of the "
                    f"{what} of this problem."
                )
        require_same(self._comm, bc=f"number {place} of the {what}")
        if isinstance(bc, Support):
            own, known = self.built.supports, self.trial.converged.supports or ()
            number = next((i for i, one in enumerate(own) if one is bc), len(own))
            return known[number].copy() if number < len(known) == len(own) else bc.reaction
        if isinstance(bc, Term):
            if not hasattr(type(bc), "reaction"):
                raise MPMError(f"A {type(bc).__name__} tells no reaction.")
            told: Any = bc
            return np.asarray(told.reaction)
        number, field = next(
            (number, field)
            for number, field in enumerate(self.reduced.fields)
            if any(bc is known for known in field.prescribed)
        )
        return force_at(bc, self.trial.converged.reaction(number), field.V)

    @collective()
    def error(self) -> float:
        """Return an estimate of the error of the last converged step (collective).

        In equilibrium the background sees no force: ``T^T R = 0``. R itself, on the bodies' own
        nodes, is what it could not balance; its energy, node by node, tells how far the bodies'
        own finite elements are from here. It is kept as ``error`` of the last of
        ``history.steps``. Ask before loads, conditions and obstacles are changed for the next step;
        after :meth:`restore` set them as they were.

        Not seen is what these elements cannot do themselves (shear or volumetric locking, a mesh
        too coarse for the load), nor the error of load steps, for which ``steps="auto"`` has a
        tolerance. Where a body yields the error is that of its stress, of which much that strain
        errs by is no part; from a tenth of the distortion on a warning says so.

        Returns:
            Energy norm of the error over that of the deformation.

        Raises:
            MPMError: A motion, or a flow of water, which is in no equilibrium of its own, particles
                that do not hang together, or forces that are not those of that step.
        """
        errors = errors_of(self.trial)
        found = errors.total(self.bodies)
        if errors.doubt is not None:
            warn(self._comm, errors.doubt)
        steps = self.history.steps
        if steps:
            steps[-1] = replace(steps[-1], error=found)
        return found

    @collective()
    def error_of_particles(self, body: int = 0) -> NDArray[np.float64]:
        """Return where :meth:`error` comes from, for pictures (collective).

        Args:
            body: Number of the body.

        Returns:
            Share of each particle of this rank, shape ``(n,)``; the squares of all bodies' add
            up to the square of the error.

        Raises:
            MPMError: As for :meth:`error`, or there is no such body.
        """
        with agree(self._comm):
            if not isinstance(body, int | np.integer) or body not in range(len(self.bodies)):
                raise MPMError(f"There is no body {body!r}; there are {len(self.bodies)}.")
        return errors_of(self.trial).of_particles(body, self.bodies[body])

    @collective()
    def write(self, path: str | Path, time: float | None = None) -> None:
        """Add the present state to a time series for ParaView (collective).

        The domains are written at their current positions, with displacement, volume ratio
        and, where there is a material, Cauchy stress, pressure and plastic strain; of a body with
        water effective and total stress and the pore pressure; unknowns besides by their names.

        Args:
            path: A ``.pvd`` file; the first call replaces it, unless the problem was restored
                from a checkpoint of the run that wrote it: then the series goes on, without
                what is later than the checkpoint. With several bodies each has its own, numbered
                from 0: ``name_0.pvd``; a :class:`Truss` or :class:`Membrane` has one by its name or
                number: ``name_structure0.pvd``. Each state has one file besides,
                ``name_000000.vtu``.
            time: Time of the state, ``history.time`` by default. It replaces a state of the same
                time that was written last.

        Raises:
            MPMError: The name does not end in ``.pvd``, the time lies before that of the state
                that was written last, or a file cannot be written, or not all of it.
        """
        self.reign.require()
        moment = self.history.time if time is None else time
        with agree(self._comm):
            if not is_number(moment) or not abs(moment) < np.inf:
                raise MPMError(f"time must be a finite number, not {time!r}.")
        others = {term.label: term for term in self.terms if isinstance(term, Structure)}
        self._output.write(
            as_path(path), self.bodies, others, float(moment), len(self.history.steps)
        )

    @collective()
    def repartition(self, threshold: float = 0.1) -> bool:
        """Move particles with their history to where they are best now (collective).

        Args:
            threshold: Share of the particles that must be better elsewhere.

        Returns:
            Whether particles have moved.

        Raises:
            MPMError: The problem holds what cannot move: a residual in UFL.
        """
        raise NotImplementedError

    @collective()
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
        self.reign.require()
        self.state.save(as_path(path), functions)

    def begin_anew(self) -> None:
        """Let bodies that have not moved be what parameters make of them now (collective)."""

    def beginning(self) -> list[NDArray[np.float64]]:
        """Return the arrays that a step begins with besides displacements and history, to be set.

        They are values of fields, stiffness of supports, forces held back; of a motion velocities,
        forces, and what stresses of a whole step begin with.
        """
        return [np.asarray(field.previous.x.array) for field in self.fields]

    def at_end(self) -> list[NDArray[np.float64]]:
        """Return :meth:`beginning` as it will be after the last evaluation (collective)."""
        return [np.asarray(field.x.array) for field in self.fields]

    def renew_external(self) -> None:
        """Let forces take over what they depend on besides displacements (collective)."""
        self.reduced.terms.renew_external()

    @collective()
    def keep(self, thing: Kept) -> None:
        """Let something of the user's own go with the problem.

        It is split and rebased with the bodies, moves to other ranks, and is saved and restored.

        Args:
            thing: An heir of :class:`mpm_dolfinx.io.Kept` with a key of its own.

        Raises:
            MPMError: It is something else, or its key is taken.
        """
        self.state.keep(thing)

    @collective()
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
        self.reign.require()
        self.state.restore(as_path(path), functions, resume)

    # -- What a problem with a material adds -----------------------------------------------

    def time_error(self, size: float) -> tuple[float | None, float | None]:
        """Return the error of a solved step by its duration, and the motion so far (collective).

        Root mean squares over the nodes; ``None``: not known.

        Args:
            size: The duration.
        """
        return None, None

    def begin_step(self) -> None:
        """Look at what may have changed since the last step (collective).

        Raises:
            MPMError: The coordinates of a mesh have, other problems govern the bodies, or ranks
                have different loads.
        """
        self.reign.require()
        with agree(self._comm):
            for body in self.bodies:
                for coordinates in (body.geometry.coordinates, body.mover.coordinates):
                    coordinates.require_same()
        load = [float(body.load.value) for body in self.bodies]
        require_same(self._comm, load=load, bcs=self.bcs, constants=self.built.constants)

    @property
    def points(self) -> list[MaterialPoints]:
        """The materials at the points of each body; none where the residual is all."""
        return self.built.points

    #: Whether :meth:`converged_state` has all data at points that forms hold.
    keeps_data: ClassVar[bool] = False

    def laws(self) -> list[list[Law]]:
        """Return the materials of each body, for a checkpoint to know them by."""
        return [[] for _ in self.bodies]
