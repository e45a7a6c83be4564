# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Exchange between ranks: rows sent by global index, even shares, shared garbage.

Nothing here knows a mesh or a particle. :mod:`~mpm_dolfinx.parallel.exchange` sends rows of arrays
to the ranks that ask for their global indices; :mod:`~mpm_dolfinx.parallel.bisection` parts points
in space evenly and :mod:`~mpm_dolfinx.parallel.balance` parts a count;
:mod:`~mpm_dolfinx.parallel.totals` makes one value of those of all ranks; what PETSc leaves when a
problem ends is freed on all ranks together by :mod:`~mpm_dolfinx.parallel.garbage`;
:mod:`~mpm_dolfinx.parallel.conjugate_gradients` solves well-conditioned symmetric systems;
:mod:`~mpm_dolfinx.parallel.compilation` compiles forms, from a cache that other runs share.
"""
