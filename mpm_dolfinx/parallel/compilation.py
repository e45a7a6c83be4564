# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forms and expressions compiled by DOLFINx, and what a run that was killed meanwhile leaves.

FFCx begins a file in its cache, compiles, and notes that it is done; who finds a file that is begun
waits for the note. Nothing tells whether somebody still compiles, on this machine or on another
one that shares the cache, so a file that is left over is named and not taken away.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mpi4py import MPI

import ufl
from dolfinx import fem

from ..errors import MPMError, agree

__all__ = ["compiled_expression", "compiled_form"]

#: What FFCx says where it has waited in vain, and DOLFINx on several ranks after it.
WAITED = re.compile(r"JIT compilation timed out.*\bremove (?P<file>.+\.c)\)", re.DOTALL)


def compiled_form(form: ufl.Form, **options: Any) -> fem.Form:
    """Return a compiled form (collective).

    Args:
        form: The form, with an integral at least.
        **options: As for ``dolfinx.fem.form``.

    Raises:
        MPMError: Another run is compiling it, or was killed while it did.
    """
    with _waiting(form.integrals()[0].ufl_domain().ufl_cargo().comm):
        result: fem.Form = fem.form(form, **options)
        return result


def compiled_expression(expression: Any, points: Any, comm: MPI.Comm) -> fem.Expression:
    """Return a compiled expression at points of the reference cell (collective).

    Args:
        expression: UFL.
        points: The points, shape ``(n, tdim)``.
        comm: The ranks.

    Raises:
        MPMError: As :func:`compiled_form`.
    """
    with _waiting(comm):
        return fem.Expression(expression, points)


@contextmanager
def _waiting(comm: MPI.Comm) -> Iterator[None]:
    """Tell in a sentence, on all ranks, that a file in FFCx's cache is begun and not finished."""
    with agree(comm):
        try:
            yield
        except (TimeoutError, RuntimeError) as error:
            if found := WAITED.search(str(error)):
                raise _unfinished(Path(found["file"])) from None
            raise


def _unfinished(file: Path) -> MPMError:
    try:
        since = time.strftime(" on %Y-%m-%d at %H:%M:%S", time.localtime(file.stat().st_mtime))
    except OSError:
        since = ""
    return MPMError(
        f"A form is compiled by another run, or a run was killed while it compiled it{since}: if "
        f"none is compiling now, remove '{file}' and start again; else wait for it, or give "
        "jit_options={'timeout': 300} with the seconds to wait."
    )
