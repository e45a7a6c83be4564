# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Messages of a run, from rank 0 through Python's ``logging`` under ``mpm_dolfinx``.

Steps and cutbacks are those of ``mpm_dolfinx.steps``, iterations of Newton's method those of
``mpm_dolfinx.newton``, all at the level ``INFO``. Nothing is shown unless the user asks for it,
as by ``logging.basicConfig(level=logging.INFO)``.
"""

from __future__ import annotations

import logging

from mpi4py import MPI

__all__ = ["NEWTON", "STEPS", "tell"]

ROOT = logging.getLogger("mpm_dolfinx")
ROOT.addHandler(logging.NullHandler())
STEPS = ROOT.getChild("steps")
NEWTON = ROOT.getChild("newton")


def tell(comm: MPI.Comm, logger: logging.Logger, message: str, *values: object) -> None:
    """Log a message on rank 0.

    Args:
        comm: The ranks.
        logger: Who says it.
        message: With places for the values, as for ``logging``.
        *values: The values.
    """
    if comm.rank == 0:
        logger.info(message, *values)
