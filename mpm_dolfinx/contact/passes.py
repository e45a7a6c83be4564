# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The passes of a contact, through steps, other meshes, and changes of contacts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.petsc import MatrixSum
from ..errors import MPMError, agree, agreed
from ..meshes.remesh import Column
from ..system.term import PointMaterial
from .nitsche import Nitsche
from .one_pass import Pass
from .outcome import require_apart
from .pair_matrices import PairMatrices
from .surface import Surface

__all__ = ["Kept", "Maker", "Passes"]

type Array = NDArray[np.float64]
#: What is kept of the points on a body.
type Kept = dict[str, NDArray[Any]]
#: Makes passes by the stiffnesses of the facets of each surface.
type Maker = Callable[[Sequence[Array]], Sequence[Pass[Any, Any]]]

#: What is kept of facets; the rest is of points that touch.
OF_FACETS = ("area", "thickness", "stretch")


class Passes:
    """The passes of a contact: points of its first body, and, in a second one, of the other.

    All calls are collective.

    Args:
        surfaces: Facets of the bodies.
        modulus: Modulus of these; ``None``: those of their materials.
        make: Makes the passes on the present meshes.
        what: The contact, in a sentence.
        stressed: Whether the stress behind the points presses.

    Attributes:
        surfaces: As given.
        every: The passes; none before the contact belongs to a problem.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        modulus: float | None,
        make: Maker,
        what: str,
        stressed: bool,
    ) -> None:
        self.surfaces, self._modulus, self._make, self._what = surfaces, modulus, make, what
        self._stressed = stressed
        self._comm = surfaces[0].particles.mesh.comm
        self.every: Sequence[Pass[Any, Any]] = ()
        self._stiffnesses: list[Array] = []
        self._begins = True
        self._new_pattern()

    # -- Meshes and materials -------------------------------------------------------------------

    def settle(self, materials: Sequence[PointMaterial | None], anew: bool = False) -> None:
        """Take the present meshes of the bodies.

        Args:
            materials: Those of the bodies.
            anew: Whether to begin anew on the same meshes too.
        """
        new = [surface.settle() for surface in self.surfaces]
        if not any(new) and not anew:
            return
        of_step = bool(self.every) and self.every[0].of_step
        self._stiffnesses = [
            stiffness(surface, self._modulus, material, self._what)
            for surface, material in zip(self.surfaces, materials, strict=True)
        ]
        self.every = self._make(self._stiffnesses)
        self.of_step(of_step)
        self.take_stress(materials)

    def take_stress(self, materials: Sequence[PointMaterial | None]) -> None:
        """Take the stress behind the points of each pass, where that presses."""
        spaces = [surface.particles.W for surface in self.surfaces]
        for each, material in zip(self.every, materials, strict=False):
            if self._stressed and material is not None:
                each.stress = Nitsche(each.source, material, spaces)
            spaces = spaces[::-1]
        self._begins = True
        self._new_pattern()

    def of_step(self, whole: bool) -> None:
        """Take whether forces are those of whole steps of a motion."""
        for each in self.every:
            each.of_step = whole

    def add_stiffness(self, more: Sequence[Array]) -> None:
        """Take stiffnesses on top of those of the facets, ``(m,)``, in a step of a motion."""
        k = [own + on_top for own, on_top in zip(self._stiffnesses, more, strict=True)]
        for each in self.every:
            each.stiffen(*k)
            k = k[::-1]

    def _new_pattern(self) -> None:
        self._matrices = PairMatrices([surface.particles.W for surface in self.surfaces])
        self._sums: dict[tuple[int, int], MatrixSum] = {}
        self._learned = [each.learned for each in self.every]
        for each in self.every:
            if each.stress is not None:
                each.stress.new_pattern()

    # -- A step ---------------------------------------------------------------------------------

    def begin(self) -> None:
        """Begin a step; the last evaluation stays until the next, and may still be committed."""
        for surface in self.surfaces:
            surface.look_at_deleted()
        for each in self.every:
            each.prepare()
        self._begins = True

    def start(self) -> None:
        """Note how wide facets are, once in each try of a step."""
        for surface in self.surfaces:
            surface.begin_step()

    def _look(self) -> None:
        """Learn where points and targets are now."""
        if self._begins:
            self._begins = False
            for each in self.every:
                each.begin()
            self._new_pattern()
        for each in self.every:
            each.look()

    def evaluate(self) -> None:
        """Evaluate what acts at the present positions.

        Raises:
            MPMError: That cannot be, on some ranks.
        """
        self._look()
        for each in self.every:
            each.evaluate()

    def touch(self) -> bool:
        """Return whether any point of this rank touches, or has at the last converged step."""
        return any(each.touches() for each in self.every)

    def forces(self, factor: float) -> list[PETSc.Vec]:
        """Return forces on the nodes of the bodies, times a factor."""
        if self._begins or any(each.evaluation is None for each in self.every):
            self._look()
        found: dict[int, PETSc.Vec] = {}
        for own, each in enumerate(self.every):
            for side, force in enumerate(each.forces(factor)):
                if own ^ side in found:
                    found[own ^ side].axpy(1.0, force)
                else:
                    found[own ^ side] = force
        return [found[body] for body in sorted(found)]

    def tangents(self, factor: float, secants: bool) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return derivatives of the forces on bodies by displacements of bodies.

        Args:
            factor: As for :meth:`forces`.
            secants: Whether points that have changed their slip may take secants instead.
        """
        if self._learned != [each.learned for each in self.every]:
            self._new_pattern()
        if any(each.evaluation is None for each in self.every):
            self.evaluate()
        found_by = [each.evaluation for each in self.every if each.evaluation is not None]
        places = self._matrices.begin([evaluation.met() for evaluation in found_by])
        with agree(self._comm):  # of the slopes of a user's shape
            for each, into in zip(self.every, places, strict=True):
                each.add_tangents(factor, secants, into)
        found = {place: [K] for place, K in self._matrices.assembled().items()}
        for own, (each, evaluation) in enumerate(zip(self.every, found_by, strict=True)):
            if each.stress is not None:
                parts = each.stress.tangents(*evaluation.by_stress(factor))
                for side, K in enumerate(parts):
                    if K is not None:
                        found.setdefault((own ^ side, own), []).append(K)
        return {
            place: self._sums.setdefault(place, MatrixSum()).of(parts)
            for place, parts in found.items()
        }

    def works(self) -> tuple[float, float]:
        """Return this rank's work against pressure and against friction in the last step."""
        done = [each.evaluation.works for each in self.every if each.evaluation is not None]
        normal, shear = np.sum([(0.0, 0.0), *done], axis=0)
        return float(normal), float(shear)

    def commit(self) -> Callable[[], None]:
        """Commit the step; return what takes that back.

        Raises:
            ConvergenceError: Points have gone through what they touch.
        """
        passes, failure, after = self.every, None, list[Any]()
        try:
            after = [each.after() for each in passes]
        except MPMError as error:
            failure = error
        if (failure := agreed(self._comm, failure)) is not None:
            raise failure
        before = [each.state for each in passes]
        for each, state in zip(passes, after, strict=True):
            each.state = state
        narrow = [surface.end_step() for surface in self.surfaces]

        def undo() -> None:
            for each, state in zip(passes, before, strict=True):
                each.state = state
            for back in narrow:
                back()

        return undo

    def roll_back(self) -> None:
        """Return to the last converged step."""
        for each in self.every:
            each.roll_back()
        for surface in self.surfaces:
            surface.roll_back()

    # -- What is kept ---------------------------------------------------------------------------

    def columns(self, number: int) -> dict[str, Column]:
        """Return the columns kept on a body, the first or the second."""
        surface = self.surfaces[number]
        kept = self.every[number].columns() if number < len(self.every) else {}
        return surface.columns() | {name: surface.column(v) for name, v in kept.items()}

    def restore(self, kept: Sequence[Kept], materials: Sequence[PointMaterial | None]) -> None:
        """Begin anew with what was kept.

        Args:
            kept: What :meth:`columns` has of each body.
            materials: Those of the bodies.
        """
        for surface in self.surfaces:
            surface.settle()
        for surface, columns in zip(self.surfaces, kept, strict=True):
            surface.restore(columns)
        self.settle(materials, anew=True)
        for each, columns in zip(self.every, kept, strict=False):
            at_points = {name: each.source.of_column(values) for name, values in columns.items()}
            each.source.take_stretch(at_points["stretch"])
            each.restore({name: v for name, v in at_points.items() if name not in OF_FACETS})

    def kept(self) -> list[Kept] | None:
        """Return the kept columns of each body; ``None``: the contact belongs to no problem."""
        if not self.every:
            return None
        every = [self.columns(number) for number in range(len(self.surfaces))]
        return [{name: column.values for name, column in one.items()} for one in every]

    def fits(self, kept: Sequence[Kept]) -> bool:
        """Return whether what is kept of other passes is of points in the same places."""
        sizes = [one["area"].shape[2] for one in kept] == [s.nq for s in self.surfaces]
        return sizes and all("anchor" in one for one in kept[: len(self.every)])

    def require_apart(self) -> None:
        """Raise an error where points are deep in what they do not touch yet."""
        for each in self.every:
            require_apart(each.source, each.told, each.WITHIN)


def both(one: Kept, other: Kept) -> Kept:
    """Return the values of two contacts as one: the second's where it alone has any or touches."""
    found: Kept = {}
    for name, values in one.items():
        if name in OF_FACETS:
            new = one["area"] == 0.0
        else:
            new = other["touches"] & ~one["touches"]
        found[name] = values
        if name in other and other[name].shape == values.shape:
            more = (1,) * (values.ndim - new.ndim)
            found[name] = np.where(new.reshape(*new.shape, *more), other[name], values)
    return found


def stiffness(
    surface: Surface, modulus: float | None, material: PointMaterial | None, what: str
) -> Array:
    """Return modulus over height of the domain behind each facet, shape ``(m,)`` (collective).

    The height is over the square of the degree of the shape functions: so much stiffer is a
    domain against what acts on its surface.

    Args:
        surface: The facets.
        modulus: The modulus, if it is given.
        material: The material otherwise.
        what: What needs it.

    Raises:
        MPMError: It is not known, or not positive.
    """
    if modulus is None and material is None:
        raise MPMError(
            f"{what} needs materials that say how stiff bodies are; a Rigid takes a modulus= in "
            "their place, the confined one (lambda + 2 mu) or its like."
        )
    if modulus is not None:
        moduli = np.full(len(surface.layout.cells), modulus)
    else:
        assert material is not None
        moduli = material.initial_modulus()[surface.layout.cells]
    with agree(surface.particles.mesh.comm):
        if not (np.isfinite(moduli).all() and (moduli > 0.0).all()):
            raise MPMError(f"{what} needs a positive modulus of the material at all its facets.")
    degree = surface.particles.W.ufl_element().degree
    return np.asarray(degree**2 * moduli / surface.thickness)
