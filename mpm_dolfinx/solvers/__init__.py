# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Newton's method, its line search, and the linear solver; no particle is known here.

:mod:`~mpm_dolfinx.solvers.newton` solves a problem that is given by protocols
(:mod:`~mpm_dolfinx.solvers.problem`): it evaluates the residual with its proximal term
(:mod:`~mpm_dolfinx.solvers.residual`), finds steps (:mod:`~mpm_dolfinx.solvers.steps`), and asks a
judge when to end (:mod:`~mpm_dolfinx.solvers.judge`), until an attempt
(:mod:`~mpm_dolfinx.solvers.attempt`) is over. :mod:`~mpm_dolfinx.solvers.linear` factorises the
shifted tangent, or lets :mod:`~mpm_dolfinx.solvers.multigrid` stand for the factor, by a table of
how many unknowns are for which (:mod:`~mpm_dolfinx.solvers.strategies`),
:mod:`~mpm_dolfinx.solvers.line_search` shortens its steps, and
:mod:`~mpm_dolfinx.solvers.mechanism` finds motions that nothing holds.
"""
