# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The forces of all terms on the backgrounds, and sizes that tell when they balance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import TRIAL_ERRORS, DomainDistortionError, MPMError, agreed
from ..history import Statistics
from ..parallel.interruption import Interrupted, noted
from ..parallel.magnitudes import joint_norm, norm
from .field import Field
from .free_field import FreeField
from .release import Release
from .tangent import Tangent
from .terms import Terms
from .unknowns import Unknowns
from .value_field import ValueField

__all__ = ["Balance"]


@dataclass(frozen=True, slots=True)
class _External:
    """Sizes of forces by which each field's residual is judged.

    Attributes:
        staying: Of what stays through the step.
        outer: Of what came from outside of the bodies in the last residual.
    """

    staying: list[float]
    outer: list[float]


class Balance:
    """Forces on the backgrounds, and their sizes. All calls are collective.

    Args:
        unknowns: The unknowns.
        terms: The terms.
        tangent: Their tangent.
        statistics: Where to count.
    """

    def __init__(
        self, unknowns: Unknowns, terms: Terms, tangent: Tangent, statistics: Statistics
    ) -> None:
        self._unknowns, self._terms, self._tangent = unknowns, terms, tangent
        self._statistics = statistics
        none = [0.0] * len(unknowns.fields)
        self._external = _External(none, none)

    # -- Forces -----------------------------------------------------------------------------------

    def begin(self) -> None:
        """Begin a step: the forces are those that stay through it."""
        forces = self._unknowns.forces
        for force in forces:
            force.set(0.0)
        for term in self._terms:
            self._unknowns.add(term.bodies, term.begin(), forces)
        staying = [norm(force) for force in forces]
        self._external = _External(staying, [0.0] * len(forces))

    def evaluate(self) -> MPMError | None:
        """Evaluate the forces at the present displacements, or say why that cannot be.

        Returns:
            One of the ``TRIAL_ERRORS``.

        Raises:
            MPMError: What any rank has met that no other x mends, as an error of a user's code.
            BaseException: What a user's code has raised on any rank to end the program.
        """
        unknowns = self._unknowns
        with self._statistics.phase("constitutive"):
            failure: BaseException | None = Interrupted() if noted() else None
            for _, motion in unknowns.places:
                inverted = motion.particles.inverted()
                failure = failure or DomainDistortionError.of("turn inside out", inverted)
            failure = agreed(unknowns.comm, failure)
        return _told(failure) or self.evaluate_beside()

    def evaluate_beside(self) -> MPMError | None:
        """Do :meth:`evaluate` next to displacements that turn no domain inside out."""
        unknowns = self._unknowns
        with self._statistics.phase("constitutive"):
            failure = _told(self._terms.update())
        if failure is not None:
            return failure
        with self._statistics.phase("assemble"):
            forces, outer = unknowns.forces, [0.0] * len(unknowns.fields)
            for force in forces:
                force.set(0.0)
            for term in self._terms:
                parts = term.residuals()
                to = unknowns.zeros() if parts and term.from_outside else forces
                unknowns.add(term.bodies, parts, to)
                for number, (force, part) in enumerate(zip(forces, to, strict=True)):
                    if part is not force:
                        outer[number] += norm(part)
                        force.axpy(1.0, part)
            for number, field in enumerate(unknowns.fields):
                outer[number] += self._add_on_background(field)
            self._external = _External(self._external.staying, outer)
            for field in unknowns.fields:
                field.acting.add_residual(field.u, field.force)
        return None

    def _add_on_background(self, field: Field) -> float:
        """Add forces that are held back on dofs of a background, and return their size."""
        size = 0.0
        for term in self._terms:
            forces = term.background_forces(field.V) if isinstance(term, Release) else None
            if forces is not None:
                field.force.array_w[:] += forces
                size += joint_norm(forces, self._unknowns.comm)
        return size

    def followed(self) -> list[NDArray[np.float64] | None]:
        """Return the forces on free nodes that follow held dofs, as forces on these.

        The last forces on the fields leave them out.

        Returns:
            For each field on own dofs of V; ``None`` where nothing follows its held dofs.
        """
        found: list[NDArray[np.float64] | None] = []
        fields = self._unknowns.fields
        for field, total in zip(fields, self._unknowns.zeros(), strict=True):
            free = [one for one in fields if isinstance(one, FreeField) and one.host is field]
            follows = [one.add_followed(total) for one in free]
            found.append(total.array_r.copy() if any(follows) else None)
        return found

    def load_derivative(self, order: int = 1) -> tuple[list[PETSc.Vec], float]:
        """Return :meth:`BodyForms.load_derivative` on all dofs of each V."""
        with self._statistics.phase("assemble"):
            totals, whole = self._unknowns.zeros(), 0.0
            for term in self._terms:
                parts, size = term.load_derivative(order)
                self._unknowns.add(term.bodies, parts, totals)
                whole += size
            return totals, whole

    def works(self) -> NDArray[np.float64]:
        """Return the work of forces on the backgrounds of displacements over the last increment.

        Returns:
            Work done against what acts on the background itself, work of the residual at Dirichlet
            conditions, and work of the residual at the unknowns.
        """
        found = np.zeros(3)
        for field in self._unknowns.fields:
            if isinstance(field, ValueField):
                continue
            own = field.u.duplicate()
            own.set(0.0)
            if self._unknowns.sizes[1] > 0 and norm(field.u) > 0.0:
                field.acting.add_product(field.u, own)
            u, work = field.u.array_r, field.u.array_r * field.force.array_r
            found += u @ own.array_r, work[field.fixed].sum(), work[field.dofs].sum()
        return np.asarray(self._unknowns.comm.allreduce(found))

    # -- Sizes ------------------------------------------------------------------------------------

    def scale(self, F: PETSc.Vec | None = None) -> float:
        """Return the size of external forces and reactions, by which a residual is judged.

        The residual of a constraint has no forces to be compared with: what is to vanish, as the
        change of volume at each point, is a sum of terms that do not, of which the size counts.

        Args:
            F: The residual. Where there are several fields, its norm over what is returned is the
                largest of the fields' own ratios, so that each has to converge by itself.
        """
        unknowns, external = self._unknowns, self._external
        fields, own, comm = unknowns.fields, unknowns.own, unknowns.comm
        scales = self._by_subspace(
            [
                field.factor * np.array([staying, _reactions(field), outer, self._changed(field)])
                for field, staying, outer in zip(
                    fields, external.staying, external.outer, strict=True
                )
            ]
        )
        scales += [one.size for one in own]
        if len(scales) == 1:
            return scales[0]
        if F is None:
            return joint_norm(scales)
        sizes = self._by_subspace([joint_norm(F.array_r[field.part], comm) for field in fields])
        sizes += [joint_norm(F.array_r[one.part], comm) for one in own]
        if any(scale == 0.0 < size for size, scale in zip(sizes, scales, strict=True)):
            inner = self._internal_scales()
            scales = [scale or other for scale, other in zip(scales, inner, strict=True)]
        ratios = [
            size / scale for size, scale in zip(sizes, scales, strict=True) if size > 0.0 < scale
        ]
        return norm(F) / max(ratios) if ratios else joint_norm(scales)

    def _changed(self, field: Field) -> float:
        return self._tangent.size_of_changes(field) if isinstance(field, ValueField) else 0.0

    def _by_subspace(self, sizes: Sequence[NDArray[np.float64] | float]) -> list[float]:
        """Return the largest joint size of each subspace.

        Args:
            sizes: Sizes of each field, a number or one of each kind.
        """
        subspaces = self._unknowns.subspaces
        ends = np.cumsum([len(one.fields) for one in subspaces])[:-1]
        parts = np.split(np.array(sizes).reshape(len(self._unknowns.fields), -1), ends)
        return [float(np.linalg.norm(part, axis=0).max()) for part in parts]

    def internal_scale(self) -> float:
        """Return the size of what all domains add to the residual, in absolute values."""
        return joint_norm(self._internal_scales())

    def _internal_scales(self) -> list[float]:
        unknowns = self._unknowns
        with self._statistics.phase("assemble"):
            totals = unknowns.zeros()
            for term in self._terms:
                unknowns.add(term.bodies, term.absolute_contributions(), totals)
            sizes = [f.factor * norm(t) for f, t in zip(unknowns.fields, totals, strict=True)]
            return self._by_subspace(sizes) + [own.size for own in unknowns.own]

    def resultant(self) -> float:
        """Return the size of the sum of the last residual over the unknowns.

        It is what loads and supports, as computed, differ by: the stress of a domain adds
        nothing to it, nor does round-off of the stress.
        """
        sums = [sum(map(_resultant, one.fields)) for one in self._unknowns.subspaces]
        return joint_norm([float(np.linalg.norm(each)) for each in sums])


def _reactions(field: Field) -> float:
    """Return the norm of the last residual at Dirichlet conditions (collective)."""
    return joint_norm(np.where(field.fixed, field.force.array_r, 0.0), field.V.mesh.comm)


def _resultant(field: Field) -> NDArray[np.float64]:
    """Return the sum of the last residual over free dofs, by component, as values (collective)."""
    bs = field.V.dofmap.index_map_bs
    free = field.force.array_r[field.dofs]
    sums = np.bincount(field.dofs % bs, weights=free, minlength=bs)
    return np.asarray(field.factor * field.V.mesh.comm.allreduce(sums))


def _told(failure: BaseException | None) -> MPMError | None:
    """Return a failure that another x may mend, or raise it."""
    if failure is None or isinstance(failure, TRIAL_ERRORS):
        return failure
    raise failure
