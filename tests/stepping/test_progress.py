# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The bar on the terminal, and silence."""

import scenes


def test_silent_without_progress(capsys):
    scenes.block().solve(steps=2)
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_a_bar_counts_the_steps(capsys):
    scenes.block().solve(steps=3, progress=True)
    told = capsys.readouterr().err.split("\r")
    if scenes.WORLD.rank == 0:
        counts = [part.split("|")[-1].split()[0] for part in told if "/3" in part]
        assert counts[0] == "0/3" and counts[-1] == "3/3"
        assert set(counts) <= {"0/3", "1/3", "2/3", "3/3"}
