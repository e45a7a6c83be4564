# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Residuals and tangents on the body mesh.

Loads of a user become forms on the body mesh (:mod:`~mpm_dolfinx.assembly.loads`); each integral
gets the quadrature rule that it needs (:mod:`~mpm_dolfinx.assembly.rules`);
:mod:`~mpm_dolfinx.assembly.body_forms` makes vectors and matrices on the body's nodes of it, and
:mod:`~mpm_dolfinx.assembly.fused` goes to the background domain by domain without ever forming the
body's matrix.
"""
