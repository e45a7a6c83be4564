# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The problems that users make, and what they are made of.

:class:`~mpm_dolfinx.problems.problem.Problem` is what all have in common.
:class:`~mpm_dolfinx.problems.particle_problem.ParticleProblem` is written in UFL,
:class:`~mpm_dolfinx.problems.quasistatic.QuasiStaticProblem` in materials and loads,
:class:`~mpm_dolfinx.problems.dynamic.DynamicParticleProblem` and
:class:`~mpm_dolfinx.problems.dynamic.DynamicProblem` are the same with inertia. A problem
holds bodies, a system, a solver and a stepper, and lets them go by when its bodies are split,
rebased or moved to other ranks (:mod:`~mpm_dolfinx.problems.remeshing`).
"""
