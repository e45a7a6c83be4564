# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Evaluations of what acts where points of one body meet facets of another."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.petsc import create_vector
from .approach import Approach, OverStep
from .behind import At
from .facets import Closest
from .law import Friction
from .memory import FacetMemory, no_memory, spread
from .nitsche import Spread
from .outcome import Outcome, untouched
from .pair_matrices import Met, Places
from .stencil import Acting, Stencil, add_tangents, by_stress, remembered
from .surface import global_nodes

__all__ = ["Meeting"]


@dataclass(frozen=True)
class Meeting:
    """An evaluation of a pass.

    Attributes:
        law: Friction.
        approach: The points and facets.
        found: Which meet which.
        within: Which points are behind their facets.
        step: How they meet in a whole step of a motion; ``None``: forces are of its end.
        stencil: The points where something acts.
        facet: The facets that these meet.
        anchor: Those of their anchors.
        acting: What acts there.
        frozen: Whether points have stayed with facets of earlier evaluations.
    """

    law: Friction
    approach: Approach
    found: Closest
    within: NDArray[np.bool_]
    step: OverStep | None
    stencil: Stencil
    facet: NDArray[np.int64]
    anchor: NDArray[np.int64]
    acting: Acting
    frozen: bool

    @cached_property
    def outcome(self) -> Outcome:
        """Tractions on all points that were looked at."""
        x, which, acts = self.approach.x, self.stencil.which, self.acting.acts
        inside = self.within if self.step is None else self.step.inside
        if self.stencil.behind is not None:
            inside = inside.copy()
            inside[which] = acts.inside
        force, pressure, slips = np.zeros_like(x), np.zeros(len(x)), np.zeros(len(x), dtype=bool)
        force[which] = acts.normal + acts.shear
        pressure[which], slips[which] = acts.pressure, acts.slips
        gap = np.where(self.found.near, self.found.gap, np.inf)
        nq = self.approach.around.sides.source.nq
        parts: list[Any] = [x, gap, pressure, force, inside, slips]
        return Outcome(*(part.reshape(-1, nq, *part.shape[1:]) for part in parts))

    @property
    def works(self) -> tuple[float, float]:
        """Work against pressure and against friction in a step of a motion."""
        if (start := self.stencil.start) is None:
            return 0.0, 0.0
        change = self.stencil.x[:, : start.x.shape[1]] - start.x
        w = self.approach.around.weights[self.stencil.which]
        push, rub = ((p * change).sum(axis=(1, 2)) for p in (self.acting.pushes, self.acting.rubs))
        return -float(w @ push), -float(w @ rub)

    def forces(self, factor: float) -> list[PETSc.Vec]:
        """Return the forces on the nodes of both bodies, times a factor (collective)."""
        around = self.approach.around
        sides = around.sides
        first = sides.source.force(self.outcome.traction, factor * sides.share, around.facets)
        second = create_vector(sides.target.particles.W)
        reaction = (self.acting.pushes + self.acting.rubs)[:, 1:]
        values = factor * around.weights[self.stencil.which][:, None, None] * reaction
        dofs = around.near.dofs[self.facet].astype(PETSc.IntType)
        second.setValues(dofs.ravel(), values.ravel(), addv=PETSc.InsertMode.ADD_VALUES)
        second.assemble()
        return [first, second]

    def met(self) -> Met:
        """Return the facets that meet at the points where something acts."""
        around, near = self.approach.around, self.approach.around.near
        source = around.sides.source
        own = around.facets[self.stencil.which // source.nq]
        bs = source.particles.W.dofmap.index_map_bs
        others = [self.facet] if self.law.smooth else [self.facet, self.anchor]
        nodes = [near.dofs[facet][:, ::bs] // bs for facet in others]
        mine = global_nodes(source.particles.W, source.layout.nodes[own])
        return Met(np.stack([own, *others], axis=1), (mine, *nodes))

    def add_tangents(self, factor: float, into: Places) -> None:
        """Add the forces' derivatives, times a factor, to blocks."""
        which, around = self.stencil.which, self.approach.around
        shapes = around.sides.source.shapes
        weights, spread = factor * around.weights[which], shapes[which % len(shapes)]
        add_tangents(self.law, self.stencil, around.sides.touch, weights, spread, into)

    def by_stress(self, factor: float) -> tuple[At, list[Spread]]:
        """Return points with normals, and how forces on both bodies grow with the stress behind.

        Args:
            factor: As for :meth:`add_tangents`.
        """
        around, near = self.approach.around, self.approach.around.near
        source, which = around.sides.source, self.stencil.which
        normals, forces = by_stress(self.law, self.stencil, around.sides.touch)
        forces = factor * around.weights[which][:, None, None] * forces
        at = At(around.facets[which // source.nq], which % source.nq, normals)
        numbers, dofs = near.number[self.facet], near.dofs[self.facet]
        others = Spread.over_met(at, numbers, dofs, forces[:, 1:], len(source.layout.cells))
        return at, [Spread.over_facets(source, at, forces[:, 0]), others]

    def state(self, friction: NDArray[np.float64]) -> tuple[FacetMemory, Outcome]:
        """Return the memory of all points, and their outcome, if a step ends with this.

        Args:
            friction: What the law of friction has remembered of all points.
        """
        approach, around, last = self.approach, self.approach.around, self.approach.last
        near, nodes, sides = around.near, approach.nodes, around.sides
        trial, found, offset = self.outcome, self.found, np.zeros(len(approach.x))
        if self.step is not None:
            found, offset = approach.returned(found, self.within, self.step.offset, self.frozen)
        inside = trial.inside.ravel()
        place, numbers = found.place.copy(), near.numbers(found.facet)
        which = self.stencil.which
        if not self.law.smooth and len(which):
            slips = trial.slips.ravel()[which]
            k = self.stencil.points.tangential
            stays = inside[which] & ~slips & self.stencil.points.touched
            stays &= near.find(last.facet[which]) >= 0
            moves = inside[which] & ~stays
            # anchors that moved are beside the foot, and belong to the facet that is there
            X = nodes[self.facet[moves]]
            N, _, _ = near.tabulate(self.stencil.place[moves])
            lag = self.acting.acts.shear[moves] / np.where(k[moves] > 0.0, k[moves], 1.0)[:, None]
            foot = np.einsum("nk,nki->ni", N, X) + lag
            at, s = approach.located(foot, self.facet[moves])
            numbers[which[stays]] = last.facet[which[stays]]
            place[which[stays]] = last.place[which[stays]]
            numbers[which[moves]] = near.number[at]
            place[which[moves]] = s
        anchors = approach.x.copy()
        at = near.find(numbers)
        N, _, _ = near.tabulate(place[at >= 0])
        anchors[at >= 0] = np.einsum("nk,nki->ni", N, nodes[at[at >= 0]])
        rubbed = last.friction.copy()
        if self.law.memory:
            rubbed[which] = remembered(self.law, self.stencil, sides.touch)
        own = last._replace(
            touched=inside,
            facet=numbers,
            place=place,
            closest=near.numbers(found.facet),
            gap=found.gap,
            within=self.within,
            offset=offset,
            points=approach.x,
            anchors=anchors,
            friction=rubbed,
        )
        x = sides.source.positions()
        rest = no_memory(self.law, x.reshape(-1, x.shape[2]))._replace(friction=friction)
        base = untouched(x)
        parts = (spread(one, around.facets, whole) for one, whole in zip(trial, base, strict=True))
        return rest.with_some(around.which, own), Outcome(*parts)
