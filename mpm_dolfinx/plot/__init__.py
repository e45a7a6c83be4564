# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pictures: a scene or a movie in one call, what a run did, and the parts to make one's own.

:func:`scene` draws the bodies of a problem in the plane or in space, coloured by a field;
:func:`movie` does so after each step of a run; :func:`history` shows loads, energies, linear
solves and cutbacks; :func:`sketch` draws what a problem is made of, before it runs. :func:`domains`
and :func:`background` add to axes of matplotlib, :func:`grid` gives the domains to pyvista.

Both packages are optional (``pip install 'mpm-dolfinx[plot]'``) and imported on rank 0 only,
when a picture is asked for. All functions are collective.
"""

from .looks import Look
from .movies import movie
from .outlines import background, domains, grid
from .runs import history
from .scenes import scene
from .sketches import sketch

__all__ = ["Look", "background", "domains", "grid", "history", "movie", "scene", "sketch"]


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
