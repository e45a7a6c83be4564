# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Comparisons of runs, states and errors."""

from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from scenes import WORLD

#: Tolerance of what is the same bit by bit on one rank: on several, MUMPS adds contributions in the
#: order in which messages arrive.
EXACT = 0.0 if WORLD.size == 1 else 1e-11


def outcome(problem, *more):
    """Return the arrays of a problem's particles, in the order of the input, and its reactions.

    ``more`` names further arrays of the particles.
    """
    values = {}
    for i, body in enumerate(problem.bodies):
        names = ["centroid", "volume", "deformation_gradient", *more]
        names += ["stress", "plastic_strain"] if body.has_material else []
        for name in names:
            values[f"{name} {i}"] = scenes.in_order(body, getattr(body, name))
    for i, bc in enumerate(problem.bcs):
        values[f"reaction {i}"] = problem.reaction(bc)
    return values


def same_run(one, two, tolerance):
    """Compare two outcomes: bit by bit, or relative to sizes (of reactions: the largest one)."""
    assert one.keys() == two.keys()
    reactions = [v for k, v in two.items() if k.startswith("reaction")]
    force = max((np.abs(v).max(initial=0.0) for v in reactions), default=0.0)
    for name, values in one.items():
        if tolerance == 0.0:
            assert np.array_equal(values, two[name]), name
            continue
        size = force if name.startswith("reaction") else np.abs(two[name]).max(initial=0.0)
        np.testing.assert_allclose(values, two[name], rtol=0.0, atol=tolerance * size, err_msg=name)


def raises(build, error, sentence):
    """Check class and sentence of an error, and that all ranks raise the same."""
    try:
        build()
        caught = None
    except Exception as exception:
        caught = exception
    texts = WORLD.allgather(f"{type(caught).__name__}: {caught}")
    assert all(text == texts[0] for text in texts), texts
    assert type(caught) is error, texts[0]
    message = str(caught)
    assert "\n" not in message and "Traceback" not in message
    with pytest.raises(error, match=sentence):
        raise caught
    return caught


def breaks(term, step):
    """Take a step in which the update of a term fails after its work, and mend the term."""
    update = term.update

    def broken():
        update()
        raise RuntimeError("broken")

    term.update = broken
    with pytest.raises(Exception, match="broken"):
        step()
    term.update = update


def error_of_blocks(problem, step=1e-5, size=1e-3):
    """Return the largest relative error of any block of a tangent, against differences.

    The state is one near the last converged step, in which all unknowns differ from it.
    """
    reduced = problem.reduced
    none = [np.zeros(len(field.bodies[0].increment.x.array)) for field in reduced.fields]
    reduced.begin(none, 1.0)
    x = reduced.unknowns.restricted(reduced.unknowns.forces)
    places = np.arange(*x.getOwnershipRange())
    x.array_w[:] = size * np.sin(37.0 * places)
    F, G, direction = x.duplicate(), x.duplicate(), x.duplicate()
    direction.array_w[:] = np.cos(23.0 * places)
    worst = 0.0
    for moved in reduced.unknowns.parts:
        along = direction.duplicate()
        along.set(0.0)
        along.array_w[moved] = direction.array_r[moved]
        assert reduced.residual(x + step * along, F) is None
        assert reduced.residual(x - step * along, G) is None
        differences = (F - G) * (0.5 / step)
        assert reduced.residual(x, F) is None
        reduced.tangent()  # the first one of an attempt has secants where points slip
        product = reduced.tangent() * along
        whole = scenes.largest(product.array_r)
        for part in reduced.unknowns.parts:
            own = max(scenes.largest(product.array_r[part]), 1e-6 * whole)
            error = scenes.largest(product.array_r[part] - differences.array_r[part])
            worst = max(worst, error / own)
    return worst


def error_of_a_term(term, bodies, start):
    """Return the error of a term's tangent, against differences, over the size of its forces.

    The motion is a smooth one of nodes, and any one of unknowns of its own, from some place. The
    bodies are left where they begin.

    Args:
        term: The term, which has begun a step.
        bodies: Its bodies.
        start: Displacements at which to look, for each body.
    """
    some = np.random.default_rng(7)
    dim = bodies[0].mesh.geometry.dim
    X = [body.W.tabulate_dof_coordinates()[:, :dim] for body in bodies]
    ways = [1e-8 * np.sin(x @ some.uniform(3, 9, (dim, dim)) + i).ravel() for i, x in enumerate(X)]
    own = term.own
    place, turn = some.uniform(-1.0, 1.0, (2, 0 if own is None else own.total))

    def forces(factor):
        for body, d, way in zip(bodies, start, ways, strict=True):
            body.displacement.x.array[:] = d + factor * way
        if own is not None:
            own.values = 5e-3 * place + 1e-8 * factor * turn
        assert term.update() is None
        found = [f.array_r.copy() for f in term.residuals()]
        return np.concatenate(found if own is None else [*found, own.residual[: own.count]])

    numeric = (8 * (forces(1.0) - forces(-1.0)) - (forces(2.0) - forces(-2.0))) / 12.0
    forces(0.0)
    motions = []
    for body, way in zip(bodies, ways, strict=True):
        vector = body.T.createVecLeft()
        vector.array_w[:] = way[: vector.getLocalSize()]
        motions.append(vector)
    if own is not None:
        motions.append(PETSc.Vec().createMPI(own.layout, comm=bodies[0].mesh.comm))
        motions[-1].array_w[:] = 1e-8 * turn[: own.count]
    exact = np.concatenate([f.array_r.copy() for f in term.stiffness_force(motions)])
    size = scenes.largest(exact)
    assert size > 0.0
    return scenes.largest(exact - numeric) / size
