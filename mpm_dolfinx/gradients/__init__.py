# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of runs by what problems are made of.

:class:`~mpm_dolfinx.gradients.sensitivity.Sensitivity` follows the steps of a problem, and carries
the derivative of its state along: displacements, histories and reactions. What the state depends
on is changed a little (:mod:`~mpm_dolfinx.gradients.parameters`), forces and histories are
evaluated beside the state (:mod:`~mpm_dolfinx.gradients.nearby`), and one linear solve with the
tangent of the step gives the derivative at its end (:mod:`~mpm_dolfinx.gradients.forward`). What
a step in time takes over of the velocities before is differentiated in
:mod:`~mpm_dolfinx.gradients.velocities`, and how T changes with its nodes in
:mod:`~mpm_dolfinx.gradients.slopes`.

:class:`~mpm_dolfinx.gradients.adjoint.Adjoint` notes the steps, and takes derivatives of
functionals backward through them (:mod:`~mpm_dolfinx.gradients.backward`), by parameters of many
values (:mod:`~mpm_dolfinx.gradients.many`) and exact derivatives of laws
(:mod:`~mpm_dolfinx.gradients.laws`). Which problems both follow is said in
:mod:`~mpm_dolfinx.gradients.followed`.
"""
