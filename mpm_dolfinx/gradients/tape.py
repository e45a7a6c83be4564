# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs on the tape of pyadjoint, beside what dolfinx-adjoint puts there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from dolfinx import fem

from ..errors import MPMError
from ..problems.quasistatic import QuasiStaticProblem

__all__ = ["taped"]


def taped(
    made: Callable[[], QuasiStaticProblem],
    controls: Sequence[Any],
    run: Callable[[QuasiStaticProblem], Any],
    steps: Sequence[int] = (-1,),
) -> list[fem.Function]:
    """Run a problem, as a block on the tape of pyadjoint (collective).

    What follows on the tape, such as ``dolfinx_adjoint.assemble_scalar`` of a misfit, and what
    pyadjoint makes of it (``ReducedFunctional``, ``taylor_test``, ``minimize``) is as in any script
    with dolfinx-adjoint. Derivatives are those of an :class:`Adjoint`; a tangent-linear model
    (``reduced.tlm``) takes a run of its own, with a :class:`Sensitivity`. Where the tape is played
    again, the problem is made and run again::

        young = dolfinx_adjoint.Function(fem.functionspace(body, ("DG", 0)))
        young.x.array[:] = 5e4

        def made():
            law = mpm.materials.Hencky(young, 0.3)
            soil = mpm.Body(mpm.Particles(body, V), law, ...)
            return mpm.QuasiStaticProblem(soil, bcs)

        (d,) = mpm.taped(made, [young], lambda problem: problem.solve(steps=10))
        gap = d - measured
        misfit = dolfinx_adjoint.assemble_scalar(ufl.inner(gap, gap) * ds(1))
        reduced = pyadjoint.ReducedFunctional(misfit, pyadjoint.Control(young))
        slope = reduced.derivative()

    Args:
        made: Returns a new problem that an :class:`Adjoint` can follow, made of the controls.
        controls: What the run depends on: Functions of dolfinx_adjoint, of which a law or a load is
            made (see the parameters of :class:`Adjoint`), and pairs of an ``AdjFloat`` and the
            Constant that has its value.
        run: Runs the problem, in steps that are the same each time: not ``steps="auto"``, whose
            sizes change with the controls, which no derivative sees (a warning tells it).
        steps: Numbers of the steps, from 0 or back from -1, whose displacements are returned.

    Returns:
        Functions of dolfinx_adjoint: the displacements of all bodies at the end of the first of
        ``steps``, then those of the others.

    Raises:
        MPMError: dolfinx-adjoint is missing, or controls or steps that make no sense.
    """
    try:
        pyadjoint, _ = import_module("pyadjoint"), import_module("dolfinx_adjoint")
    except ImportError as error:
        raise MPMError(
            f"A tape needs pyadjoint and dolfinx-adjoint, of which {error.name} is missing; see "
            "'Gradients and calibration' for how to install them."
        ) from None
    block = import_module(".run_block", __package__).RunBlock(made, controls, run, steps)
    with pyadjoint.stop_annotating():
        displacements: list[fem.Function] = block.first()
    if pyadjoint.annotate_tape():
        for displacement in displacements:
            block.add_output(displacement.create_block_variable())  # type: ignore[attr-defined]
        pyadjoint.get_working_tape().add_block(block)
    return displacements
