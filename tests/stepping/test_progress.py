# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The bar on the terminal, and silence."""

import scenes


def test_silent_without_progress(capsys):
    scenes.block().solve(steps=2)
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""
