# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quick scenes of the stress suite, a few of each class; ``make stress`` runs all."""

import json
from pathlib import Path

import pytest
from scenes import WORLD

from stress import build, checks, generator, worker

#: How many of each class, and classes whose scenes take long.
EACH = 3
LONG = ("many_particles", "flow_f_bar", "flow_high_order")


def quick():
    """Return the numbers of the scenes: with several ranks fewer, and those that complete."""
    numbers = [
        number
        for number, name in generator.numbers().items()
        if number % 1000 < EACH and name not in LONG
    ]
    if WORLD.size == 1:
        return numbers
    stops = json.loads((Path(__file__).parent / "stops.json").read_text())
    return [n for n in numbers[::2] if str(n) not in stops]


@pytest.mark.filterwarnings("ignore:The domains have one quadrature point")
@pytest.mark.parametrize("number", quick())
def test_scene(number):
    scene = generator.scene(number)
    result = worker.run(scene, WORLD)
    allowed = ("completed",) if scene["well_posed"] else ("completed", "stopped")
    assert result["outcome"] in allowed, result["reason"]


def test_scenes_are_the_same_each_time():
    for number in quick():
        assert generator.scene(number) == generator.scene(number)
    assert len(generator.numbers()) >= 500


@pytest.mark.parametrize(
    ("number", "tamper", "complaint"),
    [
        (3000, lambda o: o.present[0].__imul__(1.0 + 1e-6), "out of balance"),
        (3000, lambda o: setattr(o, "work", 1.2 * o.work), "energy and work"),
        (4000, lambda o: o.scene["material"].update(rho_y=1e-6), "yield surface"),
        (3000, lambda o: o.domains[0].X.__imul__(1.0 + 1e-9), "mass"),
        (3000, lambda o: o.present[0].__imul__(-50.0), "J is not positive"),
    ],
)
def test_checks_find_what_is_wrong(number, tamper, complaint):
    scene = generator.scene(number)
    run = build.make(scene, WORLD)
    observer = checks.Observer(scene, run)
    for _ in run.problem.steps(scene["steps"], run.update):
        observer.step()
    assert observer.judge()[0] == []
    tamper(observer)
    assert any(complaint in sentence for sentence in observer.judge()[0])


def test_a_changed_state_is_noticed():
    scene = generator.scene(3000)
    run = build.make(scene, WORLD)
    observer = checks.Observer(scene, run)
    run.problem.solve(steps=1)
    assert "displacement 0" in observer.changes()
