# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws that are updated in Python, and laws whose updates fail at will."""

import copy

import numpy as np
import returns

import mpm_dolfinx as mpm
from mpm_dolfinx._core import is_as_inherited
from mpm_dolfinx.materials import Hencky, VonMises


def assert_as_in_python(law, path):
    """Compare a compiled law with the same in NumPy along a path, ``(steps, n, dim, dim)``."""
    reference, state = in_python(law), law.initial_state(*path[0].shape[:2])
    for H in path:
        H[0] = 0.0
        mine, theirs = law.update(H, state), reference.update(H, state)
        assert mine.state.keys() == theirs.state.keys()
        for key, values in theirs.state.items():
            bound = 1e-11 * np.abs(values).max()
            np.testing.assert_allclose(mine.state[key], values, rtol=0.0, atol=bound)
        bound = 2e-9 * np.abs(theirs.tangent).max()
        np.testing.assert_allclose(mine.tangent, theirs.tangent, rtol=0.0, atol=bound)
        state = theirs.state


def in_python(law):
    """Return the same law without its compiled update, as laws are that override something."""
    found = copy.copy(law)
    found.__class__ = type(type(law).__name__, (type(law),), {"integrate": returns.integrate})
    assert not is_as_inherited(found, "_loop")
    return found


class Brittle(VonMises):
    """Von Mises' law, whose update fails where a step strains a point by more than ``limit``.

    Without a strength it stays elastic.
    """

    def __init__(self, limit, rho_y=1e9, hardening=0.0):
        super().__init__(1e3, 0.3, rho_y=rho_y, hardening=hardening)
        self.limit = limit

    def initial_state(self, n, dim):
        return {**super().initial_state(n, dim), "before": np.zeros((n, dim, dim))}

    def update(self, displacement_gradient, state, tangent=True):
        change = np.abs(displacement_gradient - state["before"]).max(axis=(1, 2))
        failed = np.flatnonzero(change > self.limit)
        if len(failed):
            raise mpm.ConvergenceError("The step is too large for the law", failed)
        answer = super().update(displacement_gradient, state, tangent)
        new = {**answer.state, "before": displacement_gradient.copy()}
        return answer._replace(state=new)


class Sulky(Hencky):
    """Hencky's law, whose updates fail at some calls, with a tangent that is ``factor`` of its own.

    Attributes:
        calls: Numbers of the calls that fail; the first one is 1.
        count: How many there were.
    """

    def __init__(self, calls, factor=1.0):
        super().__init__(1e3, 0.3)
        self.calls, self.factor, self.count = calls, factor, 0

    def update(self, displacement_gradient, state, tangent=True):
        self.count += 1
        if self.count in self.calls:
            raise mpm.ConvergenceError("Not now", [0] if len(displacement_gradient) else [])
        answer = super().update(displacement_gradient, state, tangent)
        return answer._replace(tangent=self.factor * answer.tangent)
