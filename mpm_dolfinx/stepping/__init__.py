# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps: tried, committed, taken back.

:mod:`~mpm_dolfinx.stepping.loading` goes through runs: it sets the load of each step, and tries a
smaller one where that fails, as :mod:`~mpm_dolfinx.stepping.control` says. A step is tried in
:mod:`~mpm_dolfinx.stepping.trial`, which commits it or goes back to the last converged one, and
solved in :mod:`~mpm_dolfinx.stepping.solving`. A displacement may control the load instead
(:mod:`~mpm_dolfinx.stepping.displacement_control`). Particles that leave the background between
steps are dealt with in :mod:`~mpm_dolfinx.stepping.leaving`, and where a step fails
:mod:`~mpm_dolfinx.stepping.diagnosis` says where.
"""

from .control import Run, StepControl

__all__ = ["Run", "StepControl"]
