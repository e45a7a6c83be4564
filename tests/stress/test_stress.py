# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quick scenes of the stress suite, a few of each class; ``make stress`` runs all."""

import json
from pathlib import Path

from mpi4py import MPI

import pytest
from marks import all_but, thinned
from scenes import WORLD

from stress import build, checks, generator, worker
from stress import run as suite

#: How many of each class, and classes whose scenes take long.
EACH = 2
LONG = ("many_particles", "flow_f_bar", "flow_high_order")


def quick():
    """Return the numbers of the scenes: with several ranks fewer, which complete."""
    numbers = [
        number
        for number, name in generator.numbers().items()
        if number % 1000 < EACH and name not in LONG
    ]
    if WORLD.size == 1:
        return all_but([number for number in numbers if number % 1000 == 0], numbers)
    stops = json.loads((Path(__file__).parent / "stops.json").read_text())
    return [n for n in numbers[::2] if str(n) not in stops]


@pytest.mark.filterwarnings("ignore:The domains have one quadrature point")
@pytest.mark.parametrize("number", quick())
def test_scene(number):
    scene = generator.scene(number)
    result = worker.run(scene, WORLD)
    allowed = ("completed",) if scene["well_posed"] else ("completed", "stopped")
    assert result["outcome"] in allowed, result["reason"]


@pytest.mark.parametrize("number", [32016, 34004])
def test_forces_that_cohesion_tells_balance(number):
    # They were told by the area of the step's end: 9e-5 and 7e-5 out of balance.
    result = worker.run(generator.scene(number), WORLD)
    assert result["outcome"] == "completed", result["reason"]


def test_scenes_are_the_same_each_time():
    numbers = generator.numbers()
    assert len(numbers) >= 500
    for number in list(numbers)[::8]:
        assert generator.scene(number) == generator.scene(number)


@pytest.mark.parametrize(
    ("number", "tamper", "complaint"),
    [
        (3000, lambda o: o.present[0].__imul__(1.0 + 1e-6), "out of balance"),
        (28001, lambda o: o.present[0].__imul__(1.0 + 1e-4), "out of balance"),
        (28003, lambda o: o.domains[0].__dict__.update(turned=0.0), "do not add up"),
        (30000, lambda o: o.domains[0].__dict__.update(turned=0.0), "do not add up"),
        (3000, lambda o: setattr(o, "work", 1.2 * o.work), "energy and work"),
        (4000, lambda o: o.scene["material"].update(rho_y=1e-6), "yield surface"),
        (35000, lambda o: o.scene["material"].update(cohesion=1e-6), "yield surface"),
        (35001, lambda o: o.scene["material"].update(cohesion=1e-6), "yield surface"),
        (35002, lambda o: o.scene["material"].update(cohesion=1e-6), "yield surface"),
        (3000, lambda o: o.domains[0].X.__imul__(1.0 + 1e-9), "mass"),
        (3000, lambda o: o.present[0].__imul__(-50.0), "J is not positive"),
    ],
)
def test_checks_find_what_is_wrong(number, tamper, complaint):
    scene = generator.scene(number)
    run = build.make(scene, WORLD)
    observer = checks.Observer(scene, run)
    for _ in run.problem.steps(scene["steps"], update=run.update):
        observer.step()
    assert observer.judge()[0] == []
    tamper(observer)
    assert any(complaint in sentence for sentence in observer.judge()[0])


@pytest.mark.parametrize(("support", "penalty"), thinned(2, [("roll", 2.0), ("stand", 1.0)]))
def test_what_is_below_a_floor_that_holds_it_balances(support, penalty):
    # A step folds the cell above the floor: a corner begins the next ones 5% of a cell below it, at
    # the nearest place of the boundary. As the cell goes on, forces were 1e-2 out of balance.
    scene = generator.scene(32028, 515253) | {"support": support}
    scene["contact"] |= {"penalty": penalty}
    run = build.make(scene, WORLD)
    observer, through = checks.Observer(scene, run), False
    background, domains = observer.backgrounds[0], observer.domains[0]
    for _ in run.problem.steps(scene["steps"], update=run.update):
        observer.step()
        through |= bool(background.beyond(domains.X + observer.previous[0]).any())
        complaints, figures = observer.judge()
        assert complaints == []
        assert figures["balance"] < 1e-8
    assert WORLD.allreduce(through, MPI.LOR)
    run.bcs.clear()
    assert "a run went on with what has left the background" in observer.judge()[0]


def test_another_seed_makes_other_scenes():
    scene = generator.scene(25001, 777123)
    assert scene == generator.scene(25001, 777123) != generator.scene(25001)
    # Many cells in each domain: singular values of T go down to 1e-8, and what acts along them was
    # left out of balance by 1.5e-7: balanced or refused, but not that.
    result = worker.run(scene, WORLD)
    assert result["outcome"] in ("completed", "stopped"), result["reason"]
    assert result["figures"].get("balance", 0.0) < 1e-8


def test_stops_of_another_seed_are_looked_at_by_class():
    listed = ["17000", "17001", "23002"]
    classes = {
        name: {"scenes": count, "well_posed": False, "share": 1.0, "stopped": 0}
        for name, (count, _, _) in generator.CLASSES.items()
    }
    report = dict.fromkeys(suite.OUTCOMES, 0) | {"classes": classes, "not_completed": {}}
    classes["absurd"]["stopped"] = 6
    assert suite.complaints(report, listed, 1) == []
    classes["absurd"]["stopped"] = 8
    assert suite.complaints(report, listed, 1) == ["absurd stops in 8 of 35 scenes"]
    classes["flow"]["stopped"] = 2
    assert len(suite.complaints(report, listed, 1)) == 2


def test_a_changed_state_is_noticed():
    scene = generator.scene(3000)
    run = build.make(scene, WORLD)
    observer = checks.Observer(scene, run)
    run.problem.solve(steps=1)
    assert "displacement 0" in observer.changes()
