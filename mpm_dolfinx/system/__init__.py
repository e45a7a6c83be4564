# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The unknowns of the backgrounds, and residual and tangent in them.

What acts on bodies lives on their nodes, whatever moves these: it is a term
(:mod:`~mpm_dolfinx.system.term`). A body's own stress and loads are one
(:mod:`~mpm_dolfinx.system.body`), what couples two bodies is another
(:mod:`~mpm_dolfinx.system.coupling`), inertia a third (:mod:`~mpm_dolfinx.system.inertia`) by a
scheme (:mod:`~mpm_dolfinx.system.schemes`) that says what a step makes of velocities
(:mod:`~mpm_dolfinx.system.motion_step`). Each background space with the bodies on it is a field
(:mod:`~mpm_dolfinx.system.field`), with unknowns, conditions
(:mod:`~mpm_dolfinx.system.conditions`), and what acts on it beside the bodies, as a cure of badly
supported dofs (:mod:`~mpm_dolfinx.system.on_background`). T takes terms down to fields,

    r = sum_b T_b^T r_b,    K = sum_ab T_a^T K_ab T_b,

and :mod:`~mpm_dolfinx.system.reduced` is the one system that Newton's method sees, in the unknowns
of all fields (:mod:`~mpm_dolfinx.system.numbering`), with a first guess from the steps before
(:mod:`~mpm_dolfinx.system.predictor`). Unknowns that a term has of its own
(:mod:`~mpm_dolfinx.system.own`), as the motions of a rigid body, stand beside them.

The system is made of parts, each of which knows those before it alone: the unknowns and how they
move bodies (:mod:`~mpm_dolfinx.system.unknowns`), all terms with their histories
(:mod:`~mpm_dolfinx.system.terms`), their tangent (:mod:`~mpm_dolfinx.system.tangent`), their forces
and the sizes of these (:mod:`~mpm_dolfinx.system.balance`), what a linear solver must know of the
unknowns (:mod:`~mpm_dolfinx.system.levels`) and what resists them
(:mod:`~mpm_dolfinx.system.resistance`). Callers are given the part that they need.
"""
