# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""All terms of a problem together: whether they can be evaluated, and their histories."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import ConvergenceError, MPMError, agree, agreed, as_ours, gravest
from ..parallel.interruption import Interrupted, note
from ..parallel.magnitudes import joint_norm
from ..parallel.totals import over_ranks
from ..particles.field import CarriedField
from ..particles.particles import Particles
from .body import BodyTerm
from .field import Field
from .term import Term

__all__ = ["Terms"]


class Terms:
    """All that acts on bodies. All calls are collective.

    Args:
        terms: The terms.
        bodies: All bodies, in the problem's order, then their other fields.
    """

    def __init__(self, terms: Sequence[Term], bodies: Sequence[Particles | CarriedField]) -> None:
        self._terms, self._bodies = list(terms), list(bodies)
        self._comm: MPI.Comm = bodies[0].V.mesh.comm

    def __iter__(self) -> Iterator[Term]:
        return iter(self._terms)

    @property
    def follow_load(self) -> bool:
        """Whether what the load factor does depends on the displacement."""
        return any(term.follows_load for term in self._terms)

    @property
    def one_sided(self) -> bool:
        """Whether a term may let bodies go and hold them again."""
        return any(term.one_sided for term in self._terms)

    @property
    def take_stress(self) -> bool:
        """Whether a term's forces are the stress of a body, as in Nitsche's method."""
        return any(term.takes_stress for term in self._terms)

    @property
    def alternates(self) -> bool:
        """Whether a term has equations that are solved in turn with the displacements."""
        return any(term.equation is not None for term in self._terms)

    def take_turns(self) -> int:
        """Let such terms solve their equations; return the linear solves that it took."""
        equations = [term.equation for term in self._terms]
        return sum(equation.alternate() for equation in equations if equation is not None)

    # -- Histories --------------------------------------------------------------------------------

    def update(self) -> BaseException | None:
        """Update all at the present displacement; return the gravest failure, on all ranks."""
        return agreed(self._comm, gravest([_updated(term) for term in self._terms]))

    def commit(self) -> None:
        """Make the last evaluation the converged one: of all terms, or where one fails of none."""
        done: list[Callable[[], None]] = []
        try:
            for term in self._terms:
                undo = None
                with agree(self._comm, "commit()"):
                    undo = term.commit()
                if undo is not None:
                    done.append(undo)
        except BaseException:
            for undo in reversed(done):
                undo()
            raise

    def roll_back(self) -> None:
        """Return to the last converged evaluation."""
        for term in self._terms:
            term.roll_back()

    def smooth(self) -> bool:
        """Return whether no history changes in the last residual, nor contact."""
        smooth = [term.smooth() for term in self._terms]
        return over_ranks(self._comm, all(smooth), MPI.LAND)

    def yielding(self) -> list[NDArray[np.bool_]]:
        """Return whether each particle yields in the last residual, for each body (not collective).

        In the order of those among the bodies that are displaced.
        """
        displaced = [body for body in self._bodies if isinstance(body, Particles)]
        found = {id(body): np.zeros(body.num_local, dtype=bool) for body in displaced}
        for term in self._terms:
            yields = term.yielding() if isinstance(term, BodyTerm) else None
            if yields is not None:
                found[id(term.bodies[0])] |= yields
        return list(found.values())

    def is_driven(self) -> bool:
        """Return whether something moves on its own path against bodies whose history changes."""
        drives = [term.drives() for term in self._terms]
        if not over_ranks(self._comm, any(drives), MPI.LOR):
            return False
        smooth = [term.smooth() for term in self._terms if not term.one_sided]
        return not over_ranks(self._comm, all(smooth), MPI.LAND)

    # -- Forces -----------------------------------------------------------------------------------

    def renew_external(self) -> None:
        """Let terms take over what their forces depend on besides displacements."""
        for term in self._terms:
            term.begin()

    def shear_moduli(self, field: Field) -> list[float]:
        """Return the shear modulus of each body of a field."""
        return [
            sum(
                term.shear_modulus()
                for term in self._terms
                if isinstance(term, BodyTerm) and term.particles is body
            )
            for body in field.bodies
        ]

    def nodal_forces(self) -> list[NDArray[np.float64]]:
        """Return the forces of all terms in the last converged state.

        Returns:
            For each body, on this rank's own dofs of W.
        """

        def force(term: Term) -> Sequence[PETSc.Vec]:
            term.roll_back()
            term.begin()
            if term.own is not None:
                term.own.values[:] = 0.0
            return term.residuals()

        return self._on_nodes(force)

    def size_of_forces(self) -> float:
        """Return the size of the forces of the last evaluation, but for contact between bodies.

        Where its points would change facets again and again they stay with some to the end of the
        step; the next evaluation finds others, which share its forces in another way.
        """

        def force(term: Term) -> Sequence[PETSc.Vec]:
            return () if term.one_sided and len(term.bodies) > 1 else term.residuals()

        return joint_norm(np.concatenate([*self._on_nodes(force), np.zeros(0)]), self._comm)

    def size_of_contributions(self) -> float:
        """Return the size of what the forces on nodes are sums of, in absolute values."""
        parts = [part.norm() for term in self._terms for part in term.absolute_contributions()]
        return joint_norm(parts)

    def last_nodal_forces(self) -> list[NDArray[np.float64]]:
        """Return the forces of all terms in the last evaluation, as :meth:`nodal_forces`."""
        return self._on_nodes(lambda term: term.residuals())

    def _on_nodes(
        self, force_of: Callable[[Term], Sequence[PETSc.Vec]]
    ) -> list[NDArray[np.float64]]:
        """Return sums of forces of all terms on this rank's own dofs of W of each body."""
        maps = [body.W.dofmap for body in self._bodies]
        totals = [np.zeros(m.index_map.size_local * m.index_map_bs) for m in maps]
        for term in self._terms:
            forces = force_of(term)
            for body, force in zip(term.bodies if forces else (), forces, strict=True):
                number = next(i for i, known in enumerate(self._bodies) if known is body)
                totals[number] += force.array_r
        return totals


def _updated(term: Term) -> BaseException | None:
    """Update a term; return why that cannot be, also where a user's code fails or wants to end."""
    try:
        return term.update()
    except MPMError as error:
        return error
    except KeyboardInterrupt:
        note()
        return Interrupted()
    except np.linalg.LinAlgError as error:  # as of numbers that an x far off has made too large
        return ConvergenceError(f"{term.evaluation} broke down ({error})")
    except Exception as error:
        return as_ours(error, term.evaluation)
    except BaseException as error:
        return error
