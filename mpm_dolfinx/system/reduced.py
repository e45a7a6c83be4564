# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The reduced system of a step: residual and tangent in the free dofs of the backgrounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..history import Statistics
from ..parallel.balance import imbalance
from ..particles.field import CarriedField
from ..particles.particles import Particles
from .balance import Balance
from .field import Field
from .levels import Levels
from .predictor import Predictor
from .resistance import Resistance
from .tangent import Tangent
from .term import Term
from .terms import Terms
from .unknowns import Unknowns
from .value_field import ValueField

__all__ = ["ReducedSystem"]


class _Begun(NamedTuple):
    """A step that has begun.

    Attributes:
        size: Its size, in load factor or parameter of the path.
        start: The unknowns from which a term lets Newton's method start, if one does.
    """

    size: float
    start: PETSc.Vec | None


class ReducedSystem:
    """``sum_b T_b^T r_b(d_n + T u) = 0`` in the unknowns of all fields, as the solver sees it.

    All calls are collective.

    Args:
        bodies: All bodies, in the problem's order, then their other fields.
        fields: The background spaces that move them, each before those of free nodes of its bodies.
        terms: What acts on them.
        statistics: Where to count.
        predictor: Says what increment to expect.

    Attributes:
        bodies: As given.
        fields: As given.
        predictor: As given.
        unknowns: The unknowns, and how they move bodies.
        terms: The terms, with their histories.
        tangent: Returns the tangent at the last residual, one object within a step.
        balance: Forces and their sizes.
        levels: The unknowns as a linear solver must know them.
        resistance: How bodies resist motions.
        softens: Whether tangents may be indefinite in a direction that :meth:`constrain` forbids.
    """

    softens = False

    def __init__(
        self,
        bodies: Sequence[Particles | CarriedField],
        fields: Sequence[Field],
        terms: Sequence[Term],
        statistics: Statistics,
        predictor: Predictor,
    ) -> None:
        own = [term.own for term in terms if term.own is not None]
        unknowns = self.unknowns = Unknowns(bodies, fields, own)
        self.bodies, self.fields, self.predictor = unknowns.bodies, unknowns.fields, predictor
        self.terms = Terms(terms, bodies)
        self.tangent = Tangent(unknowns, self.terms, statistics)
        self.balance = Balance(unknowns, self.terms, self.tangent, statistics)
        self.levels = Levels(unknowns, self.terms)
        self.resistance = Resistance(unknowns, self.terms)
        self._statistics = statistics
        self._step = _Begun(0.0, None)

    # -- A step -----------------------------------------------------------------------------------

    def begin(
        self,
        changes: Sequence[NDArray[np.float64]],
        size: float,
        before: Sequence[NDArray[np.float64] | None] | None = None,
        release: Callable[[], None] | None = None,
    ) -> None:
        """Prepare a step, or another try of the same.

        Args:
            changes: Change of the Dirichlet values, on the local dofs of V, for each field.
            size: Size of the step, in load factor or parameter of the path.
            before: Totals of the Dirichlet values at its beginning, for each field; ``None``: zero.
            release: Called where the last tangent is needed no more.

        Raises:
            ParticleOutsideError: Where the last step left a domain outside the background.
        """
        unknowns = self.unknowns
        totals = [None] * len(self.fields) if before is None else before
        for field, change, total in zip(self.fields, changes, totals, strict=True):
            field.begin(change, total)
        with self._statistics.phase("locate"):
            for _, motion in unknowns.places:
                motion.particles.locate()
        unknowns.follow()
        if unknowns.numbering is None:
            with self._statistics.phase("transfer"):
                self._find_unknowns(release)
        with self._statistics.phase("assemble"):
            self.balance.begin()
            for field in self.fields:
                field.acting.scale(partial(self.terms.shear_moduli, field))
            if any(field.unit is None for field in unknowns.values):
                self._find_units()
            starts = [term.start(unknowns.transfer, unknowns.prescribed) for term in self.terms]
            self._step = _Begun(size, next((x for x in starts if x is not None), None))

    def _find_units(self) -> None:
        """Choose units of unknowns, powers of two, in which all have tangents of the same size."""
        comm = self.unknowns.comm
        x = self.unknowns.vector()
        if self.residual(x, x.duplicate()) is not None:
            return
        diagonal = self.levels.diagonal(self.tangent()).array_r
        sizes = [
            comm.allreduce(float(np.abs(diagonal[field.part]).max(initial=0.0)), MPI.MAX)
            for field in self.fields
        ]
        given = [
            s for s, f in zip(sizes, self.fields, strict=True) if not isinstance(f, ValueField)
        ]
        whole = max(given, default=sizes[0])
        for field, size in zip(self.fields, sizes, strict=True):
            if isinstance(field, ValueField) and size > 0.0 and whole > 0.0:
                field.unit = float(2.0 ** np.round(0.5 * np.log2(whole / size)))
        self._find_unknowns()

    def _find_unknowns(self, release: Callable[[], None] | None = None) -> None:
        unknowns, statistics = self.unknowns, self._statistics
        numbering = unknowns.find()
        self.tangent.renew(numbering, release)
        counts: dict[str, int] = {}
        for field in self.fields:
            for name, count in field.counts.items():
                counts[name] = counts.get(name, 0) + count
        for name, count in counts.items():
            statistics[name] = count
        statistics.count("transfers")
        statistics["free_dofs"] = numbering.sizes[1]
        rows, off, columns = (int(count) for count in numbering.off_rank)
        statistics["off_rank_rows"] = off / max(rows, 1)
        statistics["off_rank_columns"] = columns
        statistics["dof_imbalance"] = imbalance(unknowns.comm, numbering.sizes[0])
        particles = sum(motion.particles.num_local for _, motion in unknowns.places)
        statistics["particle_imbalance"] = imbalance(unknowns.comm, particles)

    def end(self, again: bool = False) -> None:
        """Take note of the increments; forget the unknowns, since the bodies have moved.

        Args:
            again: Whether it was the step before that was solved on, with more unknowns.
        """
        self.unknowns.forget()
        for field in self.fields:
            field.end()
        self.predictor.record(self._step.size, self.unknowns.increments(), again)
        for own in self.unknowns.own:
            own.record(self._step.size, again)

    # -- As the solver asks -----------------------------------------------------------------------

    def residual(self, x: PETSc.Vec, F: PETSc.Vec) -> MPMError | None:
        """Evaluate the residual at x, or say why that cannot be: see :meth:`.Balance.evaluate`."""
        for block in self.unknowns.blocks:
            block.spread(x)
        failure = self.balance.evaluate()
        if failure is None:
            for field in self.fields:
                field.collect(field.force, F)
            for own in self.unknowns.own:
                own.collect(F)
        return failure

    def constrain(
        self, y: PETSc.Vec, x: PETSc.Vec | None, solve: Callable[[PETSc.Vec, PETSc.Vec], None]
    ) -> int:
        """Leave a Newton step as it is: all steps are permitted."""
        return 0

    def prediction(self) -> PETSc.Vec | None:
        """Return the unknowns to expect at the step's end, if a term or the past says any."""
        size, start = self._step
        unknowns = self.unknowns
        if start is not None:
            x = start.copy()
        else:
            increments = self.predictor.increments(size)
            if increments is None:
                return None
            x = unknowns.vector()
            bodies = [motion.particles for _, motion in unknowns.places]
            for field in self.fields:
                its = [
                    increment
                    for motion in field.motions
                    for increment, body in zip(increments, bodies, strict=True)
                    if body is motion.particles
                ]
                field.predict(its, x, fit=not self.terms.one_sided)
        for own in unknowns.own:
            own.predict(x, size)
        return x

    def impose(self) -> bool:
        """Impose the step's Dirichlet values from now on; return whether there are any."""
        return any([field.impose() for field in self.fields])

    def lift(self) -> PETSc.Vec:
        """Return the linearised forces of the step's Dirichlet values, by the last tangent."""
        return self.tangent.lift()

    def scale(self, F: PETSc.Vec | None = None) -> float:
        """Return the size by which a residual is judged: see :meth:`.Balance.scale`."""
        return self.balance.scale(F)

    def work_tells(self) -> bool:
        """Return whether a residual's work on a Newton step tells if that is stable.

        It is the second-order work of what resists the step, and where the tangent is symmetric
        equilibrium makes a potential least. With fields besides displacements it is a saddle's,
        and Nitsche's method adds the stress's own change.
        """
        displaced = all(isinstance(body, Particles) for body in self.bodies)
        return displaced and not self.terms.take_stress
