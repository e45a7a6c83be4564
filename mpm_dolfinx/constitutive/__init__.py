# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials at the quadrature points of a body.

:mod:`~mpm_dolfinx.constitutive.assignment` says which material governs which points,
:mod:`~mpm_dolfinx.constitutive.governed` asks it, and looks at its answers;
:mod:`~mpm_dolfinx.constitutive.points` holds stress and internal variables at a body's points: each
trial displacement gradient is updated from the last converged state, and committed once a step has
converged. Averages of the volume ratio over groups of domains
(:mod:`~mpm_dolfinx.constitutive.averaging`, :mod:`~mpm_dolfinx.constitutive.groups`) stand between
the gradients and the materials; they leave a tangent of low rank besides the pointwise one.
"""
