# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which tests ``make test`` runs, and which are left to ``make test-all``."""

import re

import pytest

#: Of a family about ranks, how many sets of parameters more than two ranks run.
MOST = 3
#: Steps that are taken back, on all ranks: how, depends on no term or law.
FAILURES = re.compile("ends_on|fail|interrupt|signal")
#: Files: what is kept goes to all of them as columns, whatever it is.
FILES = re.compile("checkpoint|restart|restore")
#: What ranks do together besides solving: files, failures, other meshes, features with each other.
TOGETHER = (
    FILES,
    FAILURES,
    re.compile("mesh|repartition|split"),
    re.compile("combination|feature|scene"),
)
#: Errors of what users give, which ranks agree on: all that is public is asked in tests/parallel.
REFUSALS = re.compile("refuse|no_sense|what_cannot_be|not_go_together")
#: Ranks that do not get as far as an answer.
APART = re.compile("differ|fail|refuse|one_rank|out_of_range")
#: Whole runs, whose answers one rank has looked at: what these are made of has tests of its own.
WHOLE_RUNS = re.compile(
    r"tests/(boundary|constitutive|gradients|plot|problems|solvers|stabilisation|stepping|"
    r"structures|system)/|/test_sections\.py"
)
#: Physics and contact, texts that are read, arrays that each rank has for itself.
ALONE = re.compile(
    r"tests/(benchmarks|contact|demos|docs|materials|physics|stress)/|tests/test_|"
    r"/test_(jacobian_bound|law|nearest|order|quadrature|shapes)\.py"
)


def slow(*values):
    """Return values of a test's parameter that are left to ``make test-all``."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def thinned(every, cases):
    """Return a test's cases, tuples of values; all but one in ``every`` are slow ones.

    For a product of sets choose a number without a divisor in common with their sizes, or the same
    values are left out again and again.
    """
    return [
        pytest.param(*values, marks=[pytest.mark.slow] if place % every else [])
        for place, values in enumerate(cases)
    ]


def all_but(quick, values):
    """Return values of a test's parameter of which only the quick ones are in ``make test``."""
    return [v if v in quick else pytest.param(v, marks=pytest.mark.slow) for v in values]


def between_ranks(items, ranks):
    """Part a run on several ranks into what ``make test`` does, and what it leaves to one rank.

    One rank has run everything. Several ranks run

    - what has ranks as its subject: files called ``parallel``, functions with ``rank`` in their
      name, tests marked ``mpi``; two ranks all sets of parameters, more ``MOST`` of each, and
      nothing else,
    - one set of parameters of each other function, which is no refusal: a ghost, a boundary between
      parts or a collective call does not know Poisson's ratio,
    - of a file of whole runs only a function about ranks, or the first where there is none, and the
      first about each thing that ranks do together; of physics, of contact, and of what a rank does
      for itself, only the latter; of files, and of steps that fail and are taken back, one in a
      folder.

    Args:
        items: The tests.
        ranks: How many there are.

    Returns:
        The tests to run, and the others.
    """
    named = [(i.nodeid.split("::")[0], getattr(i, "originalname", i.name)) for i in items]
    chosen, others, sets = [], [], {}
    met = {(path, "whole") for path, name in named if "rank" in name and not APART.search(name)}
    for item, (path, name) in zip(items, named, strict=True):
        place = sets[path, name] = sets.get((path, name), -1) + 1
        if "parallel" in path or "rank" in name or item.get_closest_marker("mpi"):
            (others if ranks > 2 and place >= MOST else chosen).append(item)
            continue
        folder = path.rpartition("/")[0]
        things = {
            (folder if thing in (FILES, FAILURES) else path, thing)
            for thing in TOGETHER
            if thing.search(name)
        }
        if not ALONE.search(path):
            things.add((path, "whole" if WHOLE_RUNS.search(path) else name))
        if ranks > 2 or place or things <= met or REFUSALS.search(name):
            others.append(item)
        else:
            met |= things
            chosen.append(item)
    return chosen, others
