# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which of the meshes that a body has left are still known."""

from mpm_dolfinx.meshes.trail import Trail


class Move:
    """A move from one numbered mesh to another, which takes what is on the first to the other."""

    def __init__(self, source, target):
        self.source, self.target = source, target

    def then(self, move):
        assert move.source == self.target
        return Move(self.source, move.target)

    def carry(self, thing):
        return self.target if thing == self.source else thing


def test_the_first_mesh_and_the_last_eight_are_known():
    trail = Trail()
    assert trail.carry(0) == 0
    for number in range(12):
        trail.append(Move(number, number + 1))
    known = [number for number in range(12) if trail.carry(number) == 12]
    assert known == [0, *range(4, 12)]
    assert trail.carry(2) == 2
