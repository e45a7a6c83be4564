# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""T: from the background's dofs to the nodes of particle domains.

A method says how the nodes of a domain follow the background; each has its file
(:mod:`~mpm_dolfinx.transfer.cpdi`, :mod:`~mpm_dolfinx.transfer.gimp`,
:mod:`~mpm_dolfinx.transfer.points`) and gives rows, one for each node of the body. Of the rows come
the matrix T (:mod:`~mpm_dolfinx.transfer.matrix`), the weights that classical MPM is written in
(:mod:`~mpm_dolfinx.transfer.weights`) and the background nodes that a body touches
(:mod:`~mpm_dolfinx.transfer.touched`). A displacement goes up by ``d = T u``, a force comes down by
``T^T r``.
"""

from .matrix import transfer_matrix
from .weights import Weights, domain_weights, sum_by_particle

__all__ = ["Weights", "domain_weights", "sum_by_particle", "transfer_matrix"]
