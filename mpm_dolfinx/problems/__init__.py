# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The problems that users make, and what they are made of.

:class:`~mpm_dolfinx.problems.problem.Problem` is what all have in common.
:class:`~mpm_dolfinx.problems.particle_problem.ParticleProblem` is written in UFL,
:class:`~mpm_dolfinx.problems.quasistatic.QuasiStaticProblem` in materials and loads,
:class:`~mpm_dolfinx.problems.dynamic.DynamicParticleProblem` and
:class:`~mpm_dolfinx.problems.dynamic.DynamicProblem` are the same with inertia. Bodies with
materials are made ready for the system in :mod:`~mpm_dolfinx.problems.physics`, to which motion and
water add their laws.

A problem holds bodies, a system, a solver and a stepper, and lets them go by when these change. How
that is done is in one place, :meth:`.ProblemState.renew`: the state is captured, something changes,
the problem is built again and takes the state back (:mod:`~mpm_dolfinx.problems.state`, with all
that has a state in :mod:`~mpm_dolfinx.problems.kept`). What changes are meshes
(:mod:`~mpm_dolfinx.problems.remeshing`) or what the problem is made of, by stages
(:mod:`~mpm_dolfinx.problems.staging`, :mod:`~mpm_dolfinx.problems.stages`).
"""
