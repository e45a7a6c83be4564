# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which tests of a family ``make test`` runs, and which are left to ``make test-all``."""

import pytest


def slow(*values):
    """Return values of a test's parameter that are left to ``make test-all``."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def thinned(every, cases):
    """Return a test's cases, tuples of values; all but one in ``every`` are slow ones.

    For a product of sets choose a number without a divisor in common with their sizes, or the same
    values are left out again and again.
    """
    return [
        pytest.param(*values, marks=[pytest.mark.slow] if place % every else [])
        for place, values in enumerate(cases)
    ]


def all_but(quick, values):
    """Return values of a test's parameter of which only the quick ones are in ``make test``."""
    return [v if v in quick else pytest.param(v, marks=pytest.mark.slow) for v in values]
