# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The background mesh at points: which cell holds a point, and the basis there.

The way of a coordinate starts here. :mod:`~mpm_dolfinx.background.cells` finds cell and reference
coordinates of a point, :mod:`~mpm_dolfinx.background.basis` evaluates the basis there and brings it
to the rank that asked. What else is known of the background without a particle stands beside: pairs
of neighbouring cells, polynomials continued beyond a cell, and the rank that owns a place.
"""
