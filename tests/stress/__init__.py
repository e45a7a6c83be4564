# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The stress suite: seeded scenes from mild to absurd, each with independent checks.

``generator`` makes a scene (a dictionary of plain numbers) from its number, ``build`` a problem
from a scene, ``checks`` looks at what a run left without asking the package for its opinion,
``worker`` runs scenes in a process of their own, ``run`` runs them all and reports
(``make stress``). ``test_stress.py`` has the quick ones for ``make test``.
"""
