# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which problems derivatives follow, and whether nothing else has changed them since."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import MPMError, agree
from ..problems.motion import MovingProblem
from ..problems.problem import Problem
from ..problems.quasistatic import QuasiStaticProblem
from ..stepping.trial import Trial
from .parameters import Parameter

__all__ = ["Followed", "require_followed"]


class Followed:
    """A problem from its first step on, and by what it is differentiated.

    Args:
        problem: The problem.
        parameters: By what.
        who: Follows it, with an article.
    """

    def __init__(self, problem: Problem, parameters: Sequence[Parameter], who: str) -> None:
        self._problem, self._parameters, self._who = problem, parameters, who
        self._reduced = problem.reduced
        self.note()

    def note(self) -> None:
        """Take note of where the bodies are."""
        self._places = [body.converged_displacement.copy() for body in self._problem.bodies]

    def require_present(self) -> None:
        """Raise an error unless all is as it was noted (collective).

        Raises:
            MPMError: The problem is in another state, or a parameter has another value.
        """
        bodies = self._problem.bodies
        with agree(bodies[0].mesh.comm):
            same = self._reduced is self._problem.reduced and all(
                np.array_equal(body.converged_displacement, place)
                for body, place in zip(bodies, self._places, strict=True)
            )
            if not same:
                article, name = self._who.split()
                raise MPMError(
                    f"The problem has come to another state than by the steps that "
                    f"{article.lower()} {name} follows (a stage, a checkpoint, other meshes); make "
                    f"a new problem and a new {name}."
                )
            for parameter in self._parameters:
                parameter.require_unchanged()

    def require_step(self, trial: Trial) -> None:
        """Raise an error where a step is not one that follows the last (collective).

        Raises:
            MPMError: As :meth:`require_present`, or its load is no load that is given.
        """
        self.require_present()
        if trial.run is not None and trial.run.goal is not None:
            raise MPMError(
                f"{self._who} does not follow displacement control, whose load factor depends on "
                "the parameters too; apply a load."
            )


def require_followed(problem: Problem, who: str) -> None:
    """Raise an error unless the derivative of a problem's steps has all that acts in them.

    Args:
        problem: The problem.
        who: Follows it.

    Raises:
        MPMError: Something acts that has no part in it yet.
    """
    if not isinstance(problem, Problem):
        raise MPMError(f"{who} follows a problem, not a {type(problem).__name__}.")
    what = next(iter(_not_in(problem)), None)
    if what is not None:
        raise MPMError(f"{who} does not follow {what} yet.")
    if problem.history.steps or any(np.any(b.converged_displacement) for b in problem.bodies):
        raise MPMError(f"{who} follows a problem from its first step on; make it before.")


def _not_in(problem: Problem) -> list[str]:
    """Return the parts of a problem that have none in the derivative, in words."""
    bodies, kind = problem.bodies, type(problem)
    hooks = ("evaluate", "commit", "roll_back")
    setup = problem.setup if isinstance(problem, QuasiStaticProblem) else None
    own = problem.inertia if isinstance(problem, MovingProblem) else None
    missing = {
        "a pressure in place of the mean stress (mixed=)": setup and setup.mixed is not None,
        "a law of fracture (materials.Fracture)": setup and any(b.may_crack for b in setup.given),
        "bodies with a length=": any(points.softening is not None for points in problem.points),
        "fields that are solved in turn with the displacements": problem.reduced.terms.alternates,
        "terms= (contact, ties)": any(term is not own for term in problem.terms),
        "particles of other methods than 'cpdi2'": any(
            not (b.method == "cpdi2" or b.is_free) for b in bodies
        ),
        "bodies with free nodes (free=)": any(b.free_nodes is not None for b in bodies),
        "bodies whose particles may be deleted": any(b.deletion is not None for b in bodies),
        "bodies whose domains are split": any(b.on_distortion == "split" for b in bodies),
        "rebased bodies": any(b.undeformed.differs for b in bodies),
        "hooks of a subclass (evaluate, commit, roll_back)": any(
            getattr(kind, name) is not getattr(Problem, name) for name in hooks
        ),
        "Functions at quadrature points in a residual": bool(problem.built.data)
        and not problem.keeps_data,
    }
    return [name for name, present in missing.items() if present]
