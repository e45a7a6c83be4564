# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which tests ``make test`` runs, and which are left to ``make test-all``."""

import re

import pytest

#: Of a family on several ranks: prime to the sizes of most products of parameters.
EVERY = 11
#: Whole runs, whose answers one rank has looked at, and how many of them several ranks do again.
WHOLE_RUNS = re.compile(
    r"tests/(boundary|constitutive|contact|gradients|plot|problems|solvers|stabilisation|stepping|"
    r"structures|system)/|/test_sections\.py"
)
SOME = 8
#: What ranks do together in them: tests that say so stay.
TOGETHER = re.compile(
    "checkpoint|combination|ends_on|fail|feature|interrupt|mesh|no_sense|refuse|repartition|"
    "restart|restore|signal|split"
)
#: Physics, texts that are read, arrays that each rank has for itself.
ALONE = re.compile(
    r"tests/(benchmarks|demos|docs|materials|physics)/|"
    r"/test_(house|public_api|law|shapes|jacobian_bound)\.py"
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
      name, tests marked ``mpi``; two ranks all sets of parameters, more ``EVERY`` of each at most,
    - of each other function one in ``EVERY`` of its sets of parameters: a ghost, a boundary between
      parts or a collective call does not know Poisson's ratio,
    - in rooms of whole runs only one function in ``SOME``, and each that is about what ranks do
      together, such as errors, files or other meshes: what runs are made of has its own tests,
    - of physics, and of what a rank does for itself, only what is about ranks or such things.

    Args:
        items: The tests.
        ranks: How many there are.

    Returns:
        The tests to run, and the others.
    """
    chosen, others, functions, sets = [], [], {}, {}
    for item in items:
        path, name = item.nodeid.split("::")[0], getattr(item, "originalname", item.name)
        place = sets[path, name] = sets.get((path, name), -1) + 1
        if "parallel" in path or "rank" in name or item.get_closest_marker("mpi"):
            (others if ranks > 2 and place >= EVERY else chosen).append(item)
            continue
        left_out = place % EVERY
        if not TOGETHER.search(name):
            left_out = left_out or ALONE.search(path)
            if WHOLE_RUNS.search(path):
                names = functions.setdefault(path, {})
                left_out = left_out or names.setdefault(name, len(names)) % SOME
        (others if left_out else chosen).append(item)
    return chosen, others
