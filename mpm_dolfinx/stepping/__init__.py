# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps: tried, committed, taken back.

:mod:`~mpm_dolfinx.stepping.loading` goes through the steps: it sets the load, lets the system
solve, and commits or goes back to the last converged step and tries a smaller one, as
:mod:`~mpm_dolfinx.stepping.control` says. A displacement may control the load instead
(:mod:`~mpm_dolfinx.stepping.displacement_control`). Particles that leave the background between
steps are dealt with in :mod:`~mpm_dolfinx.stepping.leaving`, and where a step fails
:mod:`~mpm_dolfinx.stepping.diagnosis` says where.
"""

from .control import Run, StepControl

__all__ = ["Run", "StepControl"]
