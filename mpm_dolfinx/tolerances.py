# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbers that are the same wherever something is compared or done in parts."""

from __future__ import annotations

import numpy as np

__all__ = [
    "ARMIJO",
    "BLOCK",
    "DIFFERENCE",
    "EQUAL",
    "HALF_DIGITS",
    "INEXACT",
    "LAST_PLACES",
    "LOCAL_ITERATIONS",
    "NEGLIGIBLE",
    "ROUND_OFF",
    "SLIGHT",
    "SMALL",
    "SOLVED",
    "UNCERTAIN",
]

#: Share of what something is compared with that counts as nothing. Errors of sums and quotients of
#: computed numbers are below it, and what users tell apart is above.
NEGLIGIBLE = 1e-9
#: Share that decides nothing: above what round-off leaves of derivatives, fits and distances, below
#: what anybody measures.
SMALL = 1e-6
#: Share that can be seen and does not matter, as of a motion that is rigid but for it.
SLIGHT = 1e-3
#: Share from which on a warning tells of it: of the motion by errors of time steps, of energy that
#: is gained, of the deformation that stress tells little of.
UNCERTAIN = 0.1
#: What may be left of a residual by what others go on with (inexact methods of Newton).
INEXACT = 0.1
#: Relative difference of numbers that are equal but for their last places.
EQUAL = 1e-12
#: What is left, relative to its parts, of a sum that vanishes: some hundred times the last place.
ROUND_OFF = 1e-13
#: Relative error of a number that was rounded a few times.
LAST_PLACES = 4.0 * np.finfo(float).eps
#: Half of the digits: the square of a smaller share vanishes beside one.
HALF_DIGITS = float(np.sqrt(np.finfo(float).eps))
#: Relative step of differences of second order: errors by it and by round-off are equal.
DIFFERENCE = float(np.cbrt(np.finfo(float).eps))
#: Relative residual of linear equations that are solved as well as by a factor, by iterations.
SOLVED = 1e-10
#: Share of the fall that a slope promises which a step must have (Armijo's rule).
ARMIJO = 1e-4
#: Most iterations for one number at a point, or one vector: more than any takes.
LOCAL_ITERATIONS = 100
#: Most points or domains that are looked at together, so that what is known of them stays in the
#: cache of a core.
BLOCK = 1 << 14
