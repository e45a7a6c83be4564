# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Every argument that is a value takes each kind of them, with one result, and refuses the rest.

The arguments are found by their annotation, so that a new one must come into the table.
"""

import inspect

import numpy as np
import pytest
import scenes
from compare import raises
from scenes import QUADRILATERAL, WORLD, in_order

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic

LAW = LinearElastic(1e3, 0.3)
#: Kinds whose forms are those of numbers; the others compile their own.
QUICK = ("Constant", "function")


def ground(degree=1):
    V = scenes.vectors(scenes.box([-0.5, 0.0], [1.5, 1.0], [4, 2], QUADRILATERAL), degree)
    body = scenes.box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL)
    return mpm.Particles(body, V, degree=degree)


def sides(p):
    return mpm.facet_tags(p.mesh, {1: mpm.region(y=1.0), 2: mpm.region(x=1.0)})


def moved(p, supports=(), **body):
    """Return the displacement of a body after a step."""
    held = [] if supports else [mpm.held(p.V, y=0.0)]
    options = {"body_force": (0.0, -1.0), "facet_tags": sides(p)} | body
    problem = mpm.QuasiStaticProblem(mpm.Body(p, LAW, **options), bcs=held, supports=supports)
    problem.solve()
    return in_order(p, p.centroid)


def supported(support):
    def observed(p, value):
        support_of = support(p, value)
        return moved(p, [support_of, mpm.boundary.fixed(p, sides(p), 1, modulus=1e3)])

    return observed


def watered(name):
    """Return what observes the water of a body after a step, by an argument of a PoreFluid."""

    def observed(p, value):
        given = {"permeability": 0.3, "drained": [(1.0, 1)], "storage": 0.1} | {
            name: [(value, 1 if name == "drained" else 2)]
            if name in ("drained", "inflow")
            else value
        }
        problem = mpm.PorousProblem(
            mpm.Body(p, LAW, pore_fluid=mpm.PoreFluid(**given), facet_tags=sides(p)),
            bcs=[mpm.held(p.V, y=0.0)],
        )
        problem.step(0.1)
        return np.array(in_order(p, problem.pore_pressure[0].at_points()))

    return observed


def thrown(p, value):
    problem = mpm.DynamicProblem(mpm.Body(p, LAW, density=1.0, velocity=value))
    return problem.momentum, problem.angular_momentum


def stopped(name):
    def observed(p, value):
        given = {"normal": 1.0, "tangential": 1.0} | {name: value}
        quiet = mpm.boundary.dashpot(p, sides(p), 2, **given)
        body = mpm.Body(p, LAW, density=1.0, velocity=(1.0, 1.0))
        problem = mpm.DynamicProblem(body, supports=[quiet])
        problem.step(0.01)
        return problem.momentum

    return observed


def in_ufl(name):
    def observed(p, value):
        d, v = p.displacement, ufl.TestFunction(p.W)
        R = ufl.inner(ufl.sym(ufl.grad(d)), ufl.grad(v)) * ufl.dx
        given = {"density": 1.0, "velocity": (1.0, 0.5)} | {name: value}
        return mpm.DynamicParticleProblem(R, p, **given).momentum

    return observed


def prescribed(p, value):
    bc = mpm.held(p.V, where=lambda x: x[1] < 2.0, value=value)
    held = fem.Function(p.V)
    fem.set_bc(held.x.array, [bc])
    held.x.scatter_forward()
    at = held.x.array.reshape(-1, 2)[: p.V.dofmap.index_map.size_local]
    places = p.V.tabulate_dof_coordinates()[: len(at)]
    every = np.vstack(WORLD.allgather(np.hstack([places, at])))
    return every[np.lexsort(every.T[:3])]


def roller(**given):
    return supported(lambda p, value: mpm.boundary.roller(p, sides(p), 2, **_with(given, value)))


def fixed(**given):
    return supported(lambda p, value: mpm.boundary.fixed(p, sides(p), 2, **_with(given, value)))


def _with(given, value):
    return {name: value if one is None else one for name, one in given.items()}


NORMAL = (1.0, 0.0)
#: For each argument the shape of its value, what is observed, and the degree of the body.
TABLE = {
    ("Body", "density"): ((), lambda p, v: moved(p, density=v), 1),
    ("Body", "body_force"): ((2,), lambda p, v: moved(p, body_force=v), 1),
    ("Body", "tractions"): ((2,), lambda p, v: moved(p, tractions=[(v, 1)]), 1),
    ("Body", "pressures"): ((), lambda p, v: moved(p, pressures=[(v, 1)]), 1),
    ("Body", "pore_pressure"): ((), lambda p, v: moved(p, pore_pressure=v), 1),
    ("Body", "initial_stress"): ((3, 3), lambda p, v: moved(p, initial_stress=v), 1),
    ("Body", "velocity"): ((2,), thrown, 1),
    ("PoreFluid", "permeability"): ((), watered("permeability"), 2),
    ("PoreFluid", "storage"): ((), watered("storage"), 2),
    ("PoreFluid", "drained"): ((), watered("drained"), 2),
    ("PoreFluid", "inflow"): ((), watered("inflow"), 2),
    ("PoreFluid", "pressure"): ((), watered("pressure"), 2),
    ("DynamicParticleProblem", "density"): ((), in_ufl("density"), 1),
    ("DynamicParticleProblem", "velocity"): ((2,), in_ufl("velocity"), 1),
    ("boundary.roller", "normal"): ((2,), roller(normal=None), 1),
    ("boundary.roller", "value"): ((), roller(normal=NORMAL, value=None), 1),
    ("boundary.roller", "modulus"): ((), roller(normal=NORMAL, modulus=None), 1),
    ("boundary.fixed", "value"): ((2,), fixed(value=None), 1),
    ("boundary.fixed", "modulus"): ((), fixed(modulus=None), 1),
    ("boundary.dashpot", "normal"): ((), stopped("normal"), 1),
    ("boundary.dashpot", "tangential"): ((), stopped("tangential"), 1),
    ("held", "value"): ((2,), prescribed, 1),
}
CASES = [pytest.param(*case, *row, id=".".join(case)) for case, row in TABLE.items()]


def arguments():
    """Yield the public arguments that are annotated as values."""
    faces = {
        "": mpm,
        "boundary.": mpm.boundary,
        "contact.": mpm.contact,
        "materials.": mpm.materials,
    }
    for face, module in faces.items():
        for name in module.__all__:
            thing = getattr(module, name)
            if not callable(thing):
                continue
            for parameter in inspect.signature(thing).parameters.values():
                if "Value" in str(parameter.annotation).replace("ValueError", ""):
                    yield face + name, parameter.name


def test_the_table_has_every_argument():
    assert set(arguments()) == set(TABLE)


def values(shape, numbers, mesh):
    """Return a value that is the same everywhere as each kind."""
    one = np.asarray(numbers)
    x = ufl.SpatialCoordinate(mesh)
    space = fem.functionspace(mesh, ("Lagrange", 1, shape) if shape else ("Lagrange", 1))
    function = fem.Function(space)
    function.x.array.reshape(-1, one.size)[:] = one.ravel()
    constant = fem.Constant(mesh, one)
    nothing = x[0] - x[0]
    found = {
        "Constant": constant,
        "Function": function,
        "UFL": constant + nothing * constant,
        "function": lambda x: numbers,
    }
    if len(shape) == 1:
        found["list of UFL"] = [fem.Constant(mesh, one[0]), float(one[1]) + nothing]
    return found


NUMBERS = {
    (): 1.25,
    (2,): [0.6, 0.8],
    (3, 3): [[-3.0, 0.5, 0.0], [0.5, -2.0, 0.0], [0.0, 0.0, -1.0]],
}


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("thing", "name", "shape", "observed", "degree"), CASES)
def test_each_kind_of_value_is_the_same(thing, name, shape, observed, degree, compiled):
    p = ground(degree)
    expected = observed(p, NUMBERS[shape])
    mesh_of = (lambda p: p.V.mesh) if thing == "held" else (lambda p: p.mesh)
    for kind in values(shape, NUMBERS[shape], mesh_of(p)):
        if (kind in QUICK) == compiled and thing != "held":
            continue
        p = ground(degree)
        value = values(shape, NUMBERS[shape], mesh_of(p))[kind]
        if thing == "held" and kind == "Function":
            value = fem.Function(p.V)
            value.x.array.reshape(-1, 2)[:] = NUMBERS[shape]
        if thing == "held" and "UFL" in kind:
            raises(lambda p=p, v=value: observed(p, v), mpm.MPMError, "a Function on V or")
            continue
        found = observed(p, value)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11, err_msg=kind)


@pytest.mark.slow
@pytest.mark.parametrize(("thing", "name", "shape", "observed", "degree"), CASES)
def test_a_function_of_coordinates_is_ufl_of_them(thing, name, shape, observed, degree):
    """One that is right for UFL and arrays alike."""
    if thing == "held" or name == "permeability":
        return

    def of(x):
        scale = 1.0 + 0.5 * x[0]
        found = np.asarray(NUMBERS[shape])
        rows = [[scale * v for v in row] for row in np.atleast_2d(found).tolist()]
        if shape == (3, 3):
            return np.array(rows) if isinstance(x, np.ndarray) else rows
        return rows[0] if shape else rows[0][0]

    p, q = ground(degree), ground(degree)
    in_ufl = of(ufl.SpatialCoordinate(q.mesh))
    for one, other in zip(observed(p, of), observed(q, in_ufl), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


WRONG = {
    "words": lambda p: "much",
    "a truth": lambda p: True,
    "complex": lambda p: 1j,
    "not a number": lambda p: np.nan,
    "an object": lambda p: object(),
    "a dictionary": lambda p: {1: 2.0},
    "uneven lists": lambda p: [1.0, [2.0, 3.0]],
}


@pytest.mark.parametrize(("thing", "name", "shape", "observed", "degree"), CASES)
def test_what_is_no_value_is_refused_by_one_sentence(thing, name, shape, observed, degree):
    numbers = f"{' x '.join(map(str, shape))} finite numbers" if shape else "a finite number"
    for make in WRONG.values():
        p = ground(degree)
        raises(
            lambda p=p, make=make: observed(p, make(p)),
            mpm.MPMError,
            rf"must be {numbers}, .*a Constant, a Function .*or a function of coordinates.*, not "
            "|of a PoreFluid must .* not nan|a list of 2 densities",
        )
    if thing != "held":
        p, foreign = ground(degree), ground(degree).mesh
        foreign_value = values(shape, NUMBERS[shape], foreign)["Function"]
        raises(lambda: observed(p, foreign_value), mpm.MPMError, "lives on another mesh")
    p = ground(degree)
    raises(lambda: observed(p, np.ones((2, 2))), mpm.MPMError, "shape|must be 3 x 3")
    if name != "permeability":
        raises(lambda: observed(p, lambda x: x.no), mpm.MPMError, "The function that gives")


def test_a_parameter_of_a_material_says_what_it_may_be():
    for wrong in ("soft", True, 1j, object()):
        raises(
            lambda wrong=wrong: Hencky(wrong, 0.3),
            mpm.MPMError,
            "young must be a finite number, one number per point, .* not ",
        )
