# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A user's code that fails on one rank, and arguments that are wrong there: found by reflection."""

import functools
import inspect
import traceback

import numpy as np
import pytest
import scenes
from posed import posed
from ranks import LAST, differing, fails
from scenes import QUADRILATERAL

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import boundary, contact, io, plot
from mpm_dolfinx.io import Column, Kept, fill, of_cells
from mpm_dolfinx.materials import Fracture, Hencky, NeoHooke, VonMises
from mpm_dolfinx.parallel.boundary import Hooked, Owned, collective, hooks_of, is_collective
from mpm_dolfinx.system.schemes import Euler

PROBLEMS = (
    mpm.ParticleProblem,
    mpm.QuasiStaticProblem,
    mpm.DynamicProblem,
    mpm.DynamicParticleProblem,
    mpm.PorousProblem,
)
FACES = (mpm, boundary, contact, plot, io)


def public(of_kind):
    """Return what the faces of the package have of a kind, each once."""
    return list(
        dict.fromkeys(v for face in FACES for n in face.__all__ if of_kind(v := getattr(face, n)))
    )


CLASSES = [c for c in public(inspect.isclass) if is_collective(c.__init__)]
FUNCTIONS = [f for f in public(inspect.isfunction) if is_collective(f)]
#: What users call on one rank, for what is not spread over ranks yet, or with calls of their own.
LOCAL = {"geostatic", "grid_lines", "region", "of_cells", "read_surface", "signed_distance"}
LOCAL |= {"box", "cavity", "cylinder", "disc", "plane", "polygon", "polyline", "sphere"}
LOCAL |= {"terrain", "triangulated", "taped"}


def particles(lower=(0.0, 0.0), upper=(1.0, 1.0)):
    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL))
    return mpm.Particles(scenes.box(lower, upper, [3, 3], QUADRILATERAL), V, quadrature_degree=2)


def made(kind=mpm.QuasiStaticProblem, law=None, terms=lambda body: (), **options):
    body = particles()
    options = {"body_force": (0.0, -1.0), "bcs": [scenes.fix(body.V, scenes.at(0, 0.0))]} | options
    if issubclass(kind, mpm.DynamicProblem):
        options["density"] = 1.0
    law = Hencky(1e3, 0.3) if law is None else law
    return posed(kind, body, law, terms=terms(body), **options)


# -- What a user has written ------------------------------------------------------------------


def failing(base, name):
    """Return an heir in which something fails on the last rank."""

    made = {"base": base, "LAST": LAST}
    exec(
        f"class Own(base):\n"
        f"    def {name}(self, *args):\n"
        f"        if LAST: raise ValueError('no table')\n"
        f"        return super().{name}(*args)\n"
        if inspect.isfunction(inspect.getattr_static(base, name))
        else f"class Own(base):\n"
        f"    @property\n"
        f"    def {name}(self):\n"
        f"        if LAST: raise ValueError('no table')\n"
        f"        return super().{name}\n",
        made,
    )
    return made["Own"]


@collective()
def ask(body, thing, name):
    """Ask for something as this package does."""
    found = inspect.getattr_static(type(thing), name)
    if isinstance(found, property):
        return getattr(thing, name)
    count = len(inspect.signature(found).parameters) - 1
    return getattr(thing, name)(*[None] * count)


HOOKED = [
    *public(lambda c: inspect.isclass(c) and issubclass(c, Hooked) and not inspect.isabstract(c)),
    Euler,  # (a scheme, which are abstract)
]
HOOKED.remove(mpm.Problem)  # (of which users derive nothing: what it has its heirs have)
HOOKS = list(
    {
        inspect.getattr_static(base, name): (base, name)
        for base in reversed(HOOKED)
        for name in sorted(hooks_of(base))
    }.values()
)


@pytest.mark.mpi
@pytest.mark.parametrize(("base", "name"), HOOKS, ids=lambda v: getattr(v, "__name__", v))
def test_each_hook_that_fails_on_one_rank_fails_on_all(base, name, monkeypatch):
    # The heir's own method is asked, for what it does on the other ranks a stand-in is enough.
    own = failing(base, name)
    hook = inspect.getattr_static(base, name)
    monkeypatch.setattr(
        base, name, property(lambda _: 1) if isinstance(hook, property) else lambda *_: 1
    )
    thing = object.__new__(own)
    fails(lambda: ask(scenes.WORLD, thing, name), rf"Own\.{name}.* failed with ValueError: no")


#: What heirs of a problem are to write, as docs/ufl-data.md has it, and docs/checkpoints.md.
FOR_HEIRS = {"evaluate", "commit", "roll_back", "smooth", "end_step", "history_at"}
FOR_HEIRS |= {"converged_state", "set_converged_state"}
OWNED = public(lambda c: inspect.isclass(c) and issubclass(c, Owned) and c is not mpm.Problem)


def refused(make):
    try:
        make()
    except mpm.MPMError as error:
        return "takes the place of what this package has" in str(error)
    return False


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("base", OWNED, ids=lambda c: c.__name__)
def test_a_name_of_this_package_is_refused_to_a_method_that_does_not_call_it(base):
    ours = [c for c in base.__mro__ if c.__module__.startswith("mpm_dolfinx")]
    names = {name: c for c in reversed(ours) for name in vars(c) if not name.startswith("__")}
    names = {name: c for name, c in names.items() if not name.startswith("_abc_")}
    if issubclass(base, mpm.Problem):
        free = {name for name in FOR_HEIRS if names[name].__name__ == "Hooks"} | {"history_at"}
    else:
        owners = (mpm.Term, io.Kept, mpm.Scheme)
        free = {name for name, c in names.items() if c in owners}
        free |= {n for n in names for c in owners if n in vars(c) and not is_code(base, n)}
    for name in names:
        foreign = type("Foreign", (), {name: lambda *_: None})
        for heir in ((base,), {name: lambda *_: None}), ((foreign, base), {}):
            assert refused(lambda heir=heir: type("Own", *heir)) == (name not in free), name
        assert not refused(lambda: type("Own", (base, foreign), {})), name
        assert not refused(lambda: extending(base, name)), name
        assert not refused(lambda: type("Another", (extending(base, name),), {})), name
    assert names


def is_code(cls, name):
    value = inspect.getattr_static(cls, name)
    return callable(value) or hasattr(value, "__get__")


def extending(base, name):
    made = {"base": base}
    exec(
        f"class Own(base):\n    def {name}(self, *args):\n        return super().{name}(*args)",
        made,
    )
    return made["Own"]


def test_what_calls_in_other_ways_is_allowed():
    class Watched(mpm.QuasiStaticProblem):
        @functools.cached_property
        def yield_function(self):
            return super().yield_function

        @functools.cache
        def solve(self, *args, **given):
            return min((super(Watched, self).solve(*args, **given) for _ in range(1)), key=id)

        def laws(self):
            return mpm.QuasiStaticProblem.laws(self)

    problem = made(Watched)
    assert problem.solve(2).load == [0.5, 1.0]
    assert len(problem.yield_function) == problem.bodies[0].num_local


def test_what_a_class_of_a_user_stands_for_is_told():
    message = r"Clay.pressure takes .* give it another one, or have it call super\(\).pressure"
    with pytest.raises(mpm.MPMError, match=message):

        class Clay(mpm.QuasiStaticProblem):
            def pressure(self):
                return 5.0


def run(problem):
    problem.solve(2)
    problem.summary()
    return problem


def in_motion(terms):
    made(mpm.DynamicProblem, terms=terms).solve(time=0.2, dt=0.1)


REACHED = {
    **{name: lambda terms: run(made(terms=terms)) for name in (
        "take_part", "begin", "start", "residuals", "tangents",
        "reduced_tangents", "commit", "kept", "symmetric", "one_sided", "equation",
    )},
    **dict.fromkeys(("pace", "end_forces", "step_work"), in_motion),
}  # fmt: skip


@pytest.mark.parametrize("name", REACHED)
def test_a_term_that_fails_on_one_rank_in_a_run(name):
    def build(body):
        return [failing(mpm.Term, name)([body])]

    error = fails(lambda: REACHED[name](build), rf"Own\.{name}.* failed with ValueError: no table")
    if LAST:  # whose own error and where it was raised are not lost
        frames = traceback.extract_tb(error.__cause__.__traceback__)
        assert type(error.__cause__) is ValueError and frames[-1].name == name


def test_the_last_converged_state_is_whole_after_a_hook_failed_on_one_rank():
    class Own(mpm.Term):
        fails = False

        def residuals(self):
            if self.fails and LAST:
                raise ValueError("no table")
            return ()

    problem, twin = (made(terms=lambda body: [Own([body])]) for _ in range(2))
    for each in (problem, twin):
        each.solve(1)
        each.particles.load.value = 2.0
    before = problem.particles.converged_displacement.copy()
    problem.terms[0].fails = True
    fails(problem.step, r"Own\.residuals\(\) failed with ValueError: no table")
    assert np.array_equal(problem.particles.converged_displacement, before)
    problem.terms[0].fails = False
    for each in (problem, twin):
        each.particles.load.value = 2.0
        each.step()
    displaced = [each.particles.converged_displacement for each in (problem, twin)]
    assert np.array_equal(*displaced)


@pytest.mark.mpi
def test_a_truth_that_differs_between_ranks_is_named():
    class Own(mpm.Term):
        symmetric = property(lambda self: LAST)

    fails(lambda: made(terms=lambda body: [Own([body])]), r"Own\.symmetric differs between")


@pytest.mark.parametrize("name", ["strain_energy", "plastic_work"])
def test_a_law_whose_energy_fails_on_one_rank(name):
    law = failing(VonMises, name)(1e2, 0.3, rho_y=2.0)
    fails(
        lambda: made(mpm.DynamicProblem, law, scheme="conserving").step(0.1),
        rf"{name} of Own failed with ValueError: no table",
    )


@pytest.mark.mpi
def test_a_key_or_a_scheme_that_differs_between_ranks_is_named():
    class Named(Kept):
        def __init__(self, key):
            self.key = key

    problem = made()
    fails(lambda: problem.keep(Named(differing("a", 5))), "key of what is kept must be a string")
    fails(lambda: problem.keep(Named(differing("a", "b"))), "key differs between the ranks")

    class Own(mpm.Scheme):
        name = "own"

        def rates(self, dt, last):
            velocity = np.array([1.0 / dt, 0.0])
            return mpm.Rates(differing(1.0, 2.0) * velocity / dt, velocity, velocity)

    fails(lambda: made(mpm.DynamicProblem, scheme=Own()).step(0.1), "rates.* differs between")


@pytest.mark.mpi
def test_a_condition_or_cells_that_differ_between_ranks_are_named():
    problem = made()
    problem.solve(1)
    strange = scenes.fix(particles().V, scenes.at(0, 0.0))
    for wrong, words in (
        (strange, "one of the Dirichlet conditions of this problem"),
        (contact.Rigid(particles(), contact.plane((0.0, 9.0), (0.0, -1.0))), "differs"),
    ):
        fails(lambda wrong=wrong: problem.reaction(differing(problem.bcs[0], wrong)), words)
    fails(lambda: problem.remove(differing([0], [99])), "no cells 99 to be removed")
    V = problem.particles.V

    def freed(free):
        return mpm.Particles(scenes.unit(3, QUADRILATERAL), V, free=free, quadrature_degree=2)

    fails(lambda: freed(differing("auto", [1])), "free differs between the ranks: 'str'")


class Own(Kept):
    """Nodal values that go with a problem; on the last rank one method fails or differs."""

    key = "mine"

    def __init__(self, problem, where):
        self.problem, self.where = problem, where
        self.values = fem.Function(problem.particles.W)

    def fail(self, where):
        if LAST and where == self.where:
            raise ValueError("no table")

    def columns(self, body):
        self.fail("columns")
        return {} if body is None else {"v": Column(of_cells(self.values), "nodes")}

    def numbers(self):
        self.fail("numbers")
        return {"n": differing(1, 2) if self.where == "differ" else 1}

    def require(self, source, taken):
        self.fail("require")
        super().require(source, taken)

    def restore(self, taken):
        self.fail("restore")
        fill(self.values, taken.columns[0]["v"])


@pytest.mark.parametrize("where", ["columns", "numbers", "require", "restore", "differ"])
def test_what_is_kept_fails_on_one_rank(where, mpi_tmp_path):
    if where == "differ" and scenes.WORLD.size == 1:
        pytest.skip("ranks differ")
    problem = made()

    def keep():
        problem.keep(Own(problem, where))
        problem.save(mpi_tmp_path / "kept.npz")
        problem.restore(mpi_tmp_path / "kept.npz")

    fails(keep, "^mine n differs" if where == "differ" else rf"Own\.{where}\(\) failed with Value")


# -- What a user gives ------------------------------------------------------------------------


def methods():
    for cls in CLASSES:
        for name, value in inspect.getmembers(cls, inspect.isfunction):
            if is_collective(value):
                yield f"{cls.__name__}.{name}", value


CALLS = dict(methods()) | {f.__name__: f for f in FUNCTIONS}


def test_all_that_is_public_and_takes_arguments_is_compared():
    assert {f.__name__ for f in public(inspect.isfunction)} == LOCAL | {
        f.__name__ for f in FUNCTIONS
    }
    assert is_collective(mpm.Body.__post_init__)
    on_ranks = {c for c in public(inspect.isclass) if hasattr(c, "solve")} - {mpm.Problem}
    on_ranks |= {mpm.Adjoint, mpm.FieldEquation, mpm.Particles, mpm.Sensitivity, mpm.Tie}
    assert on_ranks <= set(CLASSES)
    assert {"solve", "steps", "step", "write", "save", "restore", "stage", "remove", "add"} <= {
        name.partition(".")[2] for name in CALLS
    }


@pytest.mark.parametrize("call", [*CLASSES, *FUNCTIONS])
def test_each_call_says_what_it_cannot_work_with(call):
    required = [
        p.name for p in inspect.signature(call).parameters.values()
        if p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD
    ]  # fmt: skip
    error = fails(lambda: call(*[object() for _ in required]), ".")
    assert "\n" not in str(error) and " at 0x" not in str(error)


@pytest.mark.mpi
@pytest.mark.parametrize("name", CALLS)
def test_each_argument_that_differs_is_named(name):
    call = CALLS[name]
    own = [p for p in inspect.signature(call).parameters.values() if p.name != "self"]
    method = "self" in inspect.signature(call).parameters
    for wrong in own:
        if wrong.kind in (wrong.VAR_KEYWORD, wrong.VAR_POSITIONAL):
            continue
        usual = {
            p.name: None
            for p in own
            if p.default is p.empty and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
        }
        values = usual | {wrong.name: differing(1.0, "another")}
        first = [scenes.WORLD] if method else []
        if wrong.name in call.__own__:
            continue
        fails(
            lambda first=first, values=values: call(*first, **values),
            rf"^{wrong.name} differs between the ranks: 1.0 on rank 0, 'another'",
        )


WRONG = {
    "unknown": lambda: made(**differing({}, {"foo": 1})),
    "nothing": lambda: made().remove(differing([0], None)),
    "function": lambda: made().remove(lambda x: [][LAST] if LAST else x[0] < 0.4),
    "no indices": lambda: made().split(differing([0], "abc")),
    "no particles": lambda: mpm.Body(differing(particles(), None), Hencky(1e3, 0.3)),
    "no body": lambda: mpm.QuasiStaticProblem(
        differing(mpm.Body(particles(), Hencky(1e3, 0.3)), None)
    ),
    "no tags": lambda: mpm.facet_tags(particles().mesh, differing({1: mpm.region(x=0.0)}, {})),
    "no problem": lambda: mpm.strength_reduction(differing(made(), None)),
    "no shape": lambda: contact.Rigid(particles(), differing(contact.disc((0.5, 2.0), 0.3), None)),
    "no truth": lambda: made().solve(progress=differing(False, None)),
    "half a truth": lambda: made().solve(progress=None if LAST else 0),
    "no free nodes": lambda: mpm.Particles(
        particles().mesh, particles().V, free=differing([0], "wall")
    ),
    "no parameter": lambda: mpm.Sensitivity(made(), differing([], [3.0])),
    "no scale": lambda: mpm.Sensitivity(made(), [1.0], differing([1.0], [np.inf])),
    "no picture": lambda: plot.scene(made(), differing("displacement", object())),
    "no movie": lambda: plot.movie(made(), [], "unwritten.gif", fps=differing(10.0, -1.0)),
    "no fluid": lambda: mpm.Body(
        particles(), Hencky(1e3, 0.3), pore_fluid=differing(mpm.PoreFluid(1.0), 1.0)
    ),
    "no solver": lambda: made(solver=differing(mpm.Solver(), "direct")),
    "no number of a body": lambda: made().error_of_particles(differing(0, 1)),
    "nothing to keep": lambda: made().keep(differing(Kept(), None)),
    "no condition": lambda: made().reaction(differing(None, "left")),
    "time": lambda: made().write("unwritten.pvd", time=differing(1.0, 2.0)),
}


@pytest.mark.mpi
@pytest.mark.parametrize("what", WRONG)
def test_arguments_that_are_wrong_on_one_rank(what):
    try:
        WRONG[what]()
        caught = None
    except Exception as error:
        caught = error
    ended = scenes.WORLD.allgather(f"{type(caught).__name__}: {caught}")
    assert caught is not None and len(set(ended)) == 1, ended


@pytest.mark.mpi
def test_options_of_laws_that_differ():
    def law(**options):
        return Fracture(Hencky(1e3, 0.3), 1.0, 0.5, **options)

    other = Fracture(NeoHooke(1e3, 0.3), 1.0, 0.5)
    fails(lambda: made(law=law(model=differing("AT1", "AT2"))), "^model of Fracture differs")
    fails(lambda: made(law=law(split=differing("none", "spectral"))), "^split of Fracture differs")
    fails(lambda: made(law=differing(law(), other)), "^law of Fracture differs .*Hencky")


def hanging():
    """A body under its weight, Young's modulus of it, and the problem."""
    body = particles()
    young = fem.Constant(body.mesh, 1e3)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, Hencky(young, 0.3), body_force=(0.0, -1.0)),
        bcs=[scenes.fix(body.V, scenes.at(0, 0.0))],
    )
    return body, young, problem


@pytest.mark.parametrize("found", [np.ones(2), "nothing"], ids=["shape", "kind"])
def test_what_a_function_of_derivatives_returns_on_one_rank(found):
    """Wrong on the last rank: words, or in the second of two states an array of another shape."""
    _, young, problem = hanging()
    gradient = mpm.Sensitivity(problem, [young])
    problem.solve(1)
    calls = []

    def look():
        calls.append(0)
        return found if LAST and len(calls) == 2 else np.ones(1)

    fails(lambda: gradient.of(look), "^A function of Sensitivity.of must")


@pytest.mark.mpi
def test_functionals_that_differ():
    body, young, problem = hanging()
    adjoint = mpm.Adjoint(problem, [young])
    problem.solve(2)
    misfit = ufl.inner(body.displacement, body.displacement) * ufl.dx
    zero = np.zeros_like(body.displacement.x.array)
    for functional in (
        differing(misfit, 3.0),
        differing(misfit, 2.0 * misfit),
        {differing(0, 1): misfit},
        lambda step: differing(misfit, None),
        lambda step: differing(misfit, {"displacement": zero}),
    ):
        fails(lambda functional=functional: adjoint.of(functional), "functional.* differs between")
    fails(
        lambda: adjoint.of(lambda step: {"displacement": differing(zero, zero[1:])}), "of the shape"
    )
    fails(lambda: adjoint.of(lambda step: differing({"displacement": zero}, 3.0)), "by 'displace")
    assert np.isfinite(adjoint.of(misfit)[0]).all()


@pytest.mark.mpi
def test_stiffnesses_and_permeabilities_that_differ():
    def tie():
        a, b = particles(), particles((0.0, 1.0), (1.0, 1.5))
        mpm.Tie(a, b, scenes.facet_tags(a.mesh, scenes.at(1, 1.0)), 1, differing(1e3, 1e5))

    def water():
        V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], QUADRILATERAL), 2)
        body = mpm.Particles(scenes.unit(2, QUADRILATERAL), V, degree=2)
        pores = mpm.PoreFluid(lambda J: differing(0.1, 0.2) * J**3)
        mpm.PorousProblem(mpm.Body(body, Hencky(1e3, 0.3), pore_fluid=pores))

    fails(tie, "^stiffness differs between the ranks: 1000.0 on rank 0, 100000.0")
    fails(water, "permeability differs between the ranks")


@pytest.mark.parametrize(
    "call, sentence",
    [
        (
            lambda body: mpm.DynamicProblem(body, dt=0.1),
            r"^DynamicProblem\(\).*; it has b",
        ),
        (lambda body: mpm.DynamicProblem(body, support=[]), "did you mean 'supports'"),
        (lambda body: mpm.QuasiStaticProblem(body).solve(step=3), "Problem.solve.*mean 'steps'"),
        (
            lambda body: mpm.materials.MohrCoulomb(1e4, 0.3, c=8.0),
            r"^MohrCoulomb\(\).*has young, p",
        ),
        (lambda body: mpm.materials.Tresca(1e4, 0.3, cohesio=8.0), "^Tresca.*mean 'cohesion'"),
        (
            lambda body: mpm.Body(body.particles, body.material, gravity=9.81),
            r"^Body\(\).*density, b",
        ),
        (lambda body: mpm.PoreFluid(k=1e-9), "^PoreFluid.*it has permeability, storage"),
        (lambda body: mpm.WaterTable(level=3.0, gamma=9.81), "^WaterTable.*it has level, weight"),
        (
            lambda body: mpm.DynamicProblem(body).solve(10),
            r"^DynamicProblem.solve\(\) got too many.*; it has time, dt",
        ),
    ],
)
def test_an_argument_by_a_wrong_name_is_told_of_the_class_that_is_called(call, sentence):
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL), 1)
    particles = mpm.Particles(scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL), V)
    body = mpm.Body(particles, mpm.materials.Hencky(1e3, 0.3), density=1.0)
    fails(lambda: call(body), sentence, TypeError)
