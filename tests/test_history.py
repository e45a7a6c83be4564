# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a run tells of itself."""

import scenes
from scenes import TRIANGLE, WORLD

PHASES = {"locate", "transfer", "constitutive", "assemble", "factorise", "solve", "commit"}


def test_history_and_statistics(capsys):
    problem = scenes.slump(TRIANGLE, 10e3, h=1.0)
    history = problem.solve(steps=5, progress=True)
    assert history is problem.history
    assert len(history.steps) == len(history.load) == len(history.iterations) == 5
    for step in history.steps:
        assert len(step.residuals) == step.iterations + 1
        assert step.residuals[-1] <= 1e-9
    statistics = history.statistics
    assert set(statistics.seconds) == PHASES
    assert all(s >= 0.0 for s in statistics.seconds.values())
    assert all(statistics.seconds[name] > 0.0 for name in ("assemble", "factorise", "solve"))
    assert statistics["factorisations"] == history.total_iterations
    assert statistics["residuals"] >= history.total_iterations + 5
    assert statistics["transfers"] == 5
    free = statistics["free_dofs"]
    assert 0 < free < problem.particles.T.getSize()[1]
    assert ("5/5" in capsys.readouterr().err) == (WORLD.rank == 0)
