# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The state of a problem at its last converged step: captured, returned to, saved and restored."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from mpi4py import MPI

from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError, agree
from ..history import History
from ..io import checkpoint, identity
from ..io.series import Output, read_series
from ..io.snapshot import Kept, adopt, capture, require_key
from ..parallel.given import require_same
from ..particles.particles import Particles
from ..stepping.control import Run
from ..stepping.loading import Mender, Stepper
from ..system.reduced import ReducedSystem
from ..system.release import Release
from ..system.term import Term
from . import kept
from .parts import Built

__all__ = ["ProblemState", "Stateful"]


class Stateful(Protocol):
    """A problem that has a state; see :class:`Problem` for each.

    Attributes:
        particles: Its body or bodies, as given.
        bodies: The bodies.
        bcs: Dirichlet conditions.
        history: What was computed.
        terms: What else acts on the bodies.
        built: What it is on the present meshes.
    """

    particles: Particles | Sequence[Particles]
    bodies: list[Particles]
    bcs: list[fem.DirichletBC]
    history: History
    terms: list[Term]
    built: Built

    @property
    def reduced(self) -> ReducedSystem:
        """The system."""

    def build(self) -> None:
        """Make the system and its solver for the present meshes of the bodies."""

    def release(self) -> None:
        """Let go of what was built."""

    def laws(self) -> list[list[tuple[str, dict[str, Any]]]]:
        """Return name and parameters of each body's materials."""

    @property
    def history_at(self) -> str | None:
        """Where arrays of the history live that do not say it; ``None``: they must."""

    @property
    def keeps_data(self) -> bool:
        """Whether the history has all data at points that forms hold."""

    def converged_state(self) -> list[dict[str, Any]]:
        """Return the history at the points of each body."""

    def set_converged_state(self, states: list[dict[str, NDArray[Any]]]) -> None:
        """Take it again."""


class ProblemState:
    """All that goes with a problem: on other meshes, to other ranks, into files and back.

    It outlives the meshes of the bodies. What a state is known by is the problem as it was made at
    first, before domains were split and before the first stage.

    Args:
        problem: The problem, which is not kept alive.
        stepper: Knows how far it is.
        release: What stages hold back, a term that every problem has.
        output: The time series that it writes.
        mender: What changes meshes of its bodies, if anything.

    Attributes:
        kept: What goes with the problem besides what every problem has, and the term that it
            belongs to, if any.
        numbered: The terms in the order in which they came, ``None`` for those that are gone: what
            has no name is known by its place here, which no other term ever has.
    """

    def __init__(
        self,
        problem: Stateful,
        stepper: Stepper,
        release: Release,
        output: Output,
        mender: Mender | None,
    ) -> None:
        self._reference = weakref.ref(problem)
        self._stepper, self._release = stepper, release
        self._output, self._mender = output, mender
        self.kept: list[tuple[Term | None, Kept]] = []
        self.numbered: list[Term | None] = []
        self._stages: list[str] = []
        self._identity: dict[str, Any] | None = None

    @property
    def problem(self) -> Stateful:
        """The problem."""
        problem = self._reference()
        assert problem is not None
        return problem

    @property
    def _comm(self) -> MPI.Comm:
        comm: MPI.Comm = self.problem.bodies[0].V.mesh.comm
        return comm

    @property
    def spaces(self) -> list[fem.FunctionSpace]:
        """All background spaces."""
        return [field.V for field in self.problem.reduced.fields]

    # -- What goes with it ----------------------------------------------------------------

    def keep(self, thing: Kept, owner: Term | None = None) -> None:
        """Let something go with the problem.

        Args:
            thing: What to keep.
            owner: The term that it belongs to: it goes as long as that acts in the problem.

        Raises:
            MPMError: It is something else, or its key is taken.
        """
        comm = self.problem.bodies[0].mesh.comm
        with agree(comm):
            if not isinstance(thing, Kept):
                raise MPMError(f"keep() needs an heir of mpm_dolfinx.io.Kept, not {thing!r}.")
            if not isinstance(thing.key, str):
                raise MPMError(f"The key of what is kept must be a string, not {thing.key!r}.")
        require_same(comm, key=thing.key)
        things, _ = self._all((), whole=False)
        require_key(thing.key, things, len(self.problem.bodies))
        self.kept.append((owner, thing))

    def number(self, term: Term) -> int:
        """Return the number of a term among all that have come to the problem."""
        for number, known in enumerate(self.numbered):
            if known is term:
                return number
        self.numbered.append(term)
        return len(self.numbered) - 1

    def keep_terms(self) -> None:
        """Let go with the problem what its terms keep, and what other terms kept no longer."""
        terms = [*self.problem.terms, self._release]

        def acts(owner: Term | None) -> bool:
            return any(owner is term for term in terms)

        self.kept = [(owner, thing) for owner, thing in self.kept if owner is None or acts(owner)]
        self.numbered = [term if acts(term) else None for term in self.numbered]
        for term in terms:
            if all(owner is not term for owner, _ in self.kept):
                for thing in term.kept():
                    self.keep(thing, term)

    def _all(
        self, functions: Sequence[fem.Function], whole: bool = True
    ) -> tuple[list[Kept], kept.Standing]:
        """Return all that goes with the problem, and what knows how far it is.

        Args:
            functions: As in :meth:`Problem.save`.
            whole: Whether data at points must be among them.

        Raises:
            MPMError: Functions that cannot be kept, or that are missing.
        """
        problem = self.problem
        standing = kept.Standing(self._stepper.trial.progress(), self.spaces)
        carried = [
            [one for one in problem.built.carried if one.mesh is body.mesh]
            for body in problem.bodies
        ]
        needed = problem.built.data if whole and not problem.keeps_data else set()
        things = [
            kept.Bodies(problem.bodies),
            kept.Material(
                problem.converged_state,
                problem.set_converged_state,
                problem.history_at,
                problem.built.points,
            ),
            kept.Functions(functions, problem.bodies, needed),
            kept.Values(carried, problem.reduced),
            kept.Increments(problem.reduced, problem.bodies, carried),
            kept.Past(problem.history, problem.reduced, self._comm),
            *(thing for _, thing in self.kept),
            standing,
        ]
        return things, standing

    # -- What it is known by --------------------------------------------------------------

    def identity(self) -> dict[str, Any]:
        """Return the identity of the problem, as it was made at first (collective)."""
        return self._present() if self._identity is None else self._identity

    def _present(self) -> dict[str, Any]:
        problem = self.problem
        return identity.identity(problem.bodies, problem.built.carried, problem.laws())

    def before_remeshing(self) -> None:
        """Note what the problem is known by, before its body meshes change (collective)."""
        self._identity = self.identity()

    def after_stage(self, name: str, first: dict[str, Any]) -> None:
        """Note that the problem is another one now.

        Args:
            name: What was done, and the name of the stage.
            first: What the problem was known by before.
        """
        self._identity = first
        self._stages.append(name)

    # -- To a state and back --------------------------------------------------------------

    def capture(self, functions: Sequence[fem.Function] = ()) -> checkpoint.Snapshot:
        """Return the state at the last converged step (collective).

        Args:
            functions: As in :meth:`Problem.save`.

        Raises:
            MPMError: Functions that cannot be kept, or that are missing.
        """
        if functions and any(
            len(body.trail.cuts) or body.trail.rebases for body in self.problem.bodies
        ):
            raise MPMError(
                "Domains were split or the body rebased, so functions= on its new mesh could not "
                "be restored; save the state without them."
            )
        things, _ = self._all(functions)
        snapshot = capture(things, self.problem.bodies, self.spaces)
        snapshot.numbers["identity"] = self.identity() | {"the stages": list(self._stages)}
        snapshot.numbers["series"] = self._output.written()
        snapshot.numbers["keys"] = self._keys()
        return snapshot

    def _keys(self) -> list[str]:
        """Return the keys of what terms keep."""
        return [thing.key for owner, thing in self.kept if owner is not None]

    def adopt(
        self,
        snapshot: checkpoint.Snapshot,
        functions: Sequence[fem.Function] = (),
        source: str = "The state before",
    ) -> Run | None:
        """Go to a state, and return the run that was going on (collective).

        Args:
            snapshot: The state, one of this problem on its present meshes.
            functions: As in :meth:`Problem.restore`.
            source: What to call it in an error.

        Raises:
            MPMError: It is that of another problem; the state is what it was.
        """
        things, standing = self._all(functions)
        adopt(things, self.problem.bodies, snapshot, source, self.spaces)
        self._stepper.trial.take(standing.progress)
        return standing.progress.run

    def renew(
        self,
        change: Callable[[], None],
        carry: Callable[[checkpoint.Snapshot], checkpoint.Snapshot],
        undo: Callable[[], None] | None = None,
    ) -> None:
        """Make the problem again, in the same state: on other meshes, of other things (collective).

        Args:
            change: Changes what the problem is made of: gives the particles their meshes.
            carry: Makes of the state before the one of the problem as it is then.
            undo: Takes the change back where something fails, and all stays as it was.
        """
        problem, snapshot = self.problem, self.capture()
        seconds = problem.history.statistics.seconds
        problem.release()
        try:
            change()
            problem.build()
            known, run = self._stepper.trial.run, self.adopt(carry(snapshot))
            if known is not None and run is not None:
                known.base = run.base  # (on W where nodes are free, which is another one now)
        except BaseException:
            if undo is not None:
                undo()
                problem.release()
                problem.build()
                self.adopt(snapshot)
            raise
        problem.history.statistics.update(seconds)

    def save(self, path: Path, functions: Sequence[fem.Function]) -> None:
        """Write a checkpoint: see :meth:`Problem.save`."""
        checkpoint.write(self._comm, path, self.capture(functions))

    def restore(self, path: Path, functions: Sequence[fem.Function], resume: bool) -> None:
        """Return to the state of a checkpoint: see :meth:`Problem.restore`."""
        problem = self.problem
        snapshot, source = checkpoint.read(self._comm, path), f"The checkpoint '{path}'"
        with agree(self._comm):
            stages = snapshot.numbers["identity"]["the stages"]
            if stages != self._stages:
                raise MPMError(
                    f"{source} was made after the stages {stages}, and this problem has gone "
                    f"through {self._stages}; make it as at first and repeat the calls of stage, "
                    "remove and add."
                )
            self._require_keys(snapshot.numbers["keys"], source)
        identity.require_same(self.identity(), snapshot, source, self._comm)
        written = snapshot.numbers["series"]
        series = read_series(self._comm, written)
        if self._mender is not None:
            self._mender.repeat(snapshot, bool(functions), source)
        run = self.adopt(snapshot, functions, source)
        self._stepper.resume(run if resume else None)
        history = problem.history
        self._output.go_back(series, written, history.time, len(history.steps))

    def _require_keys(self, there: list[str], source: str) -> None:
        """Raise an error unless terms keep the same things as in a state, by name."""
        here = self._keys()
        if set(there) == set(here):
            return
        raise MPMError(
            f"{source} is of a problem in which terms keep {_listed(there)}, and here "
            f"they keep {_listed(here)}; give the same terms, in the order they came in, or by "
            "the same names (term.name)."
        )


def _listed(keys: Sequence[str]) -> str:
    """Return names in words."""
    return ", ".join(repr(key) for key in sorted(keys)) or "nothing"
