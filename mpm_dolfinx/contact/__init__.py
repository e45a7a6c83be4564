# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact: rigid obstacles and other bodies, to touch, stick to, slide on and leave.

Contact acts at quadrature points on the body's own facets, so there is none before surfaces meet,
whatever the background's cells. A contact is a term: give it to a problem as ``terms=[contact]``.
"""

from .law import Coulomb, Friction, Rubbing
from .pair import Pair
from .rigid import Rigid
from .rigid_body import RigidBody
from .shapes import (
    Shape,
    box,
    cavity,
    cylinder,
    disc,
    plane,
    signed_distance,
    sphere,
)
from .triangulation import polygon, polyline, read_surface, terrain, triangulated

__all__ = [
    "Coulomb",
    "Friction",
    "Pair",
    "Rigid",
    "RigidBody",
    "Rubbing",
    "Shape",
    "box",
    "cavity",
    "cylinder",
    "disc",
    "plane",
    "polygon",
    "polyline",
    "read_surface",
    "signed_distance",
    "sphere",
    "terrain",
    "triangulated",
]
