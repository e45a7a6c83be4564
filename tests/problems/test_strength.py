# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Factors of safety by one call, against a published slope and a bound of limit analysis."""

import signal
import warnings

from mpi4py.MPI import MAX

import numpy as np
import pytest
from marks import slow
from posed import posed
from routes import ROUTES
from scenes import QUADRILATERAL, WORLD, at, box, fix, in_order, vectors

from dolfinx import mesh

import mpm_dolfinx as mpm
from mpm_dolfinx import materials
from mpm_dolfinx.problems import strength

H = 10.0


def slope(cell=1.0, degree=1, beyond=0.0, **options):
    """Return the slope of Griffiths & Lane (1999), example 1: 2:1, phi 20, c/(gamma H) 0.05.

    Level ground lies beyond its crest.
    """
    crest, width, weight = 1.2 * H, 2 * H, 20.0
    long = beyond + crest + width
    n, k = (2 * round(length / cell) // degree for length in (long, H))
    body = box([0, 0], [long, H], [n, k], QUADRILATERAL)
    x = body.geometry.x
    own = np.maximum(x[:, 0] - beyond, 0.0)
    x[:, 0] -= own * (x[:, 1] / H) * width / (crest + width)
    cells = [round(long / cell) + 4, round(H / cell) + 1]
    V = vectors(box([0, 0], [cell * c for c in cells], cells, QUADRILATERAL), degree)
    return posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V, degree=degree),
        materials.MohrCoulomb(1e5, 0.3, cohesion=0.05 * weight * H, friction_angle=20.0),
        density=weight,
        body_force=(0.0, -1.0),
        bcs=[fix(V, at(0, 0), component=0), fix(V, at(1, 0))],
        **options or {"f_bar": "patch"},
    )


@pytest.mark.slow
@pytest.mark.parametrize("beyond", [4 * H, 20 * H])
def test_ground_far_from_a_slide_does_not_matter(beyond):
    """The same cells beside the slope, and no level ground beyond it or many heights."""
    factors = []
    for length in (0.0, beyond):
        problem = slope(2.0, beyond=length)
        problem.solve(2)
        factors.append(mpm.strength_reduction(problem).factor)
    assert factors[0] == pytest.approx(1.44, abs=0.01)  # cells of H/5
    assert factors[1] == pytest.approx(factors[0], abs=0.01)  # to which it is found


def cut(cell=0.125, weight=3.0):
    """Return a cut of height 1 beside a half space of undrained strength 1."""
    full = box([0, 0], [2.5, 1.5], [round(5 / cell), round(3 / cell)], QUADRILATERAL)
    own = np.arange(full.topology.index_map(2).size_local, dtype=np.int32)
    x = mesh.compute_midpoints(full, 2, own)
    body = mesh.create_submesh(full, 2, own[(x[:, 0] < 1.5) | (x[:, 1] < 0.5)])[0]
    cells = [round(2.5 / cell), round(1.5 / cell) + 1]
    V = vectors(box([0, 0], [cell * c for c in cells], cells, QUADRILATERAL))
    return mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V),
            materials.Tresca(1e5, 0.49, cohesion=1.0),
            density=weight,
            body_force=(0.0, -1.0),
            f_bar="patch",
        ),
        bcs=[fix(V, at(0, 0, 2.5), component=0), fix(V, at(1, 0))],
    )


@pytest.mark.slow
def test_slope_of_griffiths_and_lane():
    problem = slope()
    problem.solve(2)
    law = problem.points[0]
    found = mpm.strength_reduction(problem)
    assert found.factor == pytest.approx(1.40, abs=0.04)  # cells of H/10; see benchmarks/cases
    assert 0 < found.above - found.factor <= 0.01
    assert found.factors == sorted(found.factors) and found.factors[-1] == found.factor
    assert found.displacements == sorted(found.displacements)
    assert problem.history.steps[-1].load == 1.0 and problem.points[0] is law
    assert found.displacements[-1] > 3 * found.displacements[1]
    problem.step()  # with the strength that was given: nothing moves on


@pytest.mark.parametrize("step", [0.05, *slow(0.02, 0.1, 0.2)])
def test_slope_as_it_stands(step):
    """Steps change the factor by less than a hundredth.

    Long ones fail where the slope stands, and are tried again in shorter ones.
    """
    problem = slope()
    problem.solve(2)
    found = mpm.strength_reduction(problem, step=step)
    assert found.factor == pytest.approx(1.40, abs=0.01)  # by Griffiths & Lane
    assert 0 < found.above - found.factor <= 0.01 and found.reason == "flow"
    assert found.factors[:2] == [1.0, round(1.0 + step, 2)]
    factors, displacements, rates = found.curve.T
    stands = rates <= 0.03
    np.testing.assert_array_equal(found.factors, factors[stands])
    np.testing.assert_array_equal(found.displacements, displacements[stands])
    assert rates[0] == 0.0 and rates[1] < 0.001 < 0.03 < rates[~stands].min()


@pytest.mark.slow
def test_vertical_cut():
    problem = cut()
    problem.solve(2)
    found = mpm.strength_reduction(problem, step=0.08)
    assert 3.775 < 3.0 * found.factor < 1.07 * 3.786  # the bounds; cells of H/8


@pytest.mark.parametrize(
    "law",
    [
        materials.VonMises(1e4, 0.3, rho_y=6.0, hardening=10.0),
        materials.VonMises(1e4, 0.3, yield_stress=6.0),
        materials.Tresca(1e4, 0.3, cohesion=6.0),
        materials.DruckerPrager(1e4, 0.3, 6.0, 20.0, 5.0, tension_cutoff=3.0),
        materials.MohrCoulomb(1e4, 0.3, 6.0, 20.0, 20.0, tension_cutoff=3.0),
    ],
    ids=lambda law: type(law).__name__,
)
def test_strength_is_divided(law):
    half = law.weakened(2.0)
    assert half.symmetric == law.symmetric and type(half) is type(law)
    for name, value in law.parameters.items():
        now = half.parameters[name]
        if name in ("young", "poisson"):
            assert now == value
        elif name == "friction_angle":
            ratio = np.tan(np.radians(value)) / np.tan(np.radians(now))
            assert value == 0.0 or ratio == pytest.approx(2.0)
        elif name == "dilation_angle":
            assert now == min(value, half.parameters["friction_angle"])
        else:
            assert now == pytest.approx(value / 2.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The domains have 4")
def test_slope_with_a_pressure_of_its_own():
    """Cells of H/4 do; the strength that was given comes back."""
    problem = slope(2.5, 2, mixed="pressure")
    problem.solve(2)
    found = mpm.strength_reduction(problem)
    assert found.factor == pytest.approx(1.39, abs=0.02)  # F-bar over patches: 1.49
    assert problem.points[0].last.yield_function().max(initial=-1.0) < 0.0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The domains have 4")
def test_slope_with_a_pressure_by_both_routes(take):
    ends = []
    for route in ROUTES:
        take(route)
        problem = slope(2.5, 2, mixed="pressure")
        problem.solve(2)
        ends.append(mpm.strength_reduction(problem))
    assert ends[0].factors == ends[1].factors
    np.testing.assert_allclose(ends[0].displacements, ends[1].displacements, rtol=1e-5)


def block(law=None, kind=mpm.QuasiStaticProblem, **options):
    """Return a block that stands on its base."""
    V = vectors(box([0, 0], [3, 3], [3, 3], QUADRILATERAL))
    particles = mpm.Particles(box([0, 0], [2, 2], [4, 4], QUADRILATERAL), V, **options)
    law = law or materials.Tresca(1e3, 0.3, cohesion=6.0)
    return kind(
        mpm.Body(particles, law, density=1.0, body_force=(0.0, -4.0)),
        bcs=[fix(V, at(0, 0), component=0), fix(V, at(1, 0), component=1)],
    )


CHANGES = {
    "split": lambda problem: problem.split([0]),
    "rebase": lambda problem: problem.rebase(),
    "repartition": lambda problem: problem.repartition(0.0),
    "stage": lambda problem: problem.stage(bodies=problem.body().replace(body_force=(0.0, -4.0))),
    "remove": lambda problem: problem.remove(lambda x: (x[0] > 1.5) & (x[1] > 1.5)),
    "state": lambda problem: problem.state.adopt(problem.state.capture()),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_weak_stays_weak(change, mpi_tmp_path):
    problem = block()
    problem.solve(2)
    problem.points[0].laws.weaken(2.2)
    CHANGES[change](problem)
    assert problem.points[0].laws.weakening == 2.2
    problem.solve() if change in ("stage", "remove") else problem.step()

    def most(problem):
        """Return the largest maximum shear stress of Kirchhoff's, on any rank."""
        J = np.linalg.det(problem.particles.deformation_gradient)[:, None, None]
        s = np.linalg.eigvalsh(J * problem.particles.stress.reshape(-1, 3, 3))
        return WORLD.allreduce(0.5 * (s[:, 2] - s[:, 0]).max(initial=0.0), MAX)

    assert most(problem) == pytest.approx(6.0 / 2.2, rel=1e-9)
    if change != "state":
        return
    problem.save(mpi_tmp_path / "weak")
    again = block()
    again.restore(mpi_tmp_path / "weak")
    assert again.points[0].laws.weakening == 2.2
    for one in (problem, again):
        one.particles.load.value = 1.02
        one.step()
    assert most(again) == pytest.approx(6.0 / 2.2, rel=1e-9)
    ends = (in_order(one.particles, one.particles.centroid) for one in (problem, again))
    np.testing.assert_allclose(*ends, atol=1e-12)
    with pytest.raises(mpm.MPMError, match="the material is not the same"):
        block(materials.Tresca(1e3, 0.3, cohesion=6.0 / 2.2)).restore(mpi_tmp_path / "weak")


def test_stops_where_the_body_flows():
    """A block that stands on its base is left in the state before it flows.

    Uniform stress bears its weight at the base, 4 of height 2, where 12 are its strength.
    """
    problem = block()
    with pytest.raises(mpm.MPMError, match="whole load"):
        mpm.strength_reduction(problem)
    problem.solve(2)
    start = in_order(problem.particles, problem.particles.centroid)
    found = mpm.strength_reduction(problem)
    moved = in_order(problem.particles, problem.particles.centroid) - start
    assert 0 < np.linalg.norm(moved, axis=1).max() <= found.displacements[-1] < 0.05
    assert 1.5 < found.factor < 4.0
    assert found.above - found.factor <= 0.01
    yields = problem.points[0].last.yield_function().max()
    assert yields < 0.0  # of the strength that was given
    with pytest.raises(mpm.MPMError, match="positive"):
        mpm.strength_reduction(problem, step=0.0)
    with pytest.raises(mpm.MPMError, match="positive"):
        mpm.strength_reduction(problem, tolerance=np.inf)  # of which nothing would be found
    with pytest.raises(mpm.MPMError, match="at least 1e-09"):
        mpm.strength_reduction(problem, tolerance=1e-13)
    with pytest.raises(mpm.MPMError, match="above 1"):
        mpm.strength_reduction(problem, most=0.5)
    with pytest.raises(mpm.MPMError, match="QuasiStatic"):
        mpm.strength_reduction(problem.particles)


class Watched(mpm.QuasiStaticProblem):
    """A problem that notes with which factors it is tried, and does something before or after."""

    def step(self):
        factor = self.points[0].laws.weakening
        if not hasattr(self, "tried"):
            self.tried = []
        self.tried.append(factor)
        self.before(factor)
        done = super().step()
        self.after(factor)
        return done

    def before(self, factor):
        """Do something before a step."""

    def after(self, factor):
        """Do something after it."""


@pytest.mark.filterwarnings("ignore:The factor of safety")
@pytest.mark.parametrize("step", [0.02, 0.05, 0.1, 0.2])
def test_what_fails_from_afar_is_tried_again_from_nearer(step):
    """Where increments of more than 0.04 fail from 1.3 on, and all beyond 1.42."""
    problem = block(kind=Watched)
    problem.solve(2)

    def newton(factor):
        stood = max([f for f in problem.tried[:-1] if f not in failed], default=1.0)
        if factor > 1.42 or (factor > 1.3 and factor - stood > 0.04):
            failed.append(factor)
            raise mpm.ConvergenceError("It does not converge.")

    failed = []
    problem.before = newton
    found = mpm.strength_reduction(problem, step=step)
    assert 1.41 <= found.factor <= 1.42 < found.above <= found.factor + 0.01


def test_failures_far_from_a_slide_are_told():
    problem = block(kind=Watched)
    problem.solve(2)

    def newton(factor):
        if factor > 1.21:
            raise mpm.ConvergenceError("It does not converge.", [3])

    problem.before = newton
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = mpm.strength_reduction(problem)
    if WORLD.rank == 0:
        told = "may be too low: at 1.2125 Newton's method failed, for a body that does not flow"
        assert told in str(caught[-1].message) and "It does not converge" in str(caught[-1].message)
    assert found.reason == "no convergence" and found.failure.particles == [3]
    np.testing.assert_array_equal(found.curve[:, :2].T, [found.factors, found.displacements])


def test_a_body_that_slid_while_it_was_loaded_has_no_factor_of_one():
    """It comes to rest where it just stands; with all strengths its factor is in proportion."""
    found = []
    for cohesion, rests in ((4.0, 0), (2.0, 1)):
        problem = block(materials.Tresca(1e3, 0.3, cohesion=cohesion))
        problem.solve(2)
        for _ in range(rests):
            problem.step()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found.append(mpm.strength_reduction(problem).factor)
        told = [str(one.message) for one in caught if "far below 1" in str(one.message)]
        assert len(told) == (rests if WORLD.rank == 0 else 0)
    stood, slid = found
    assert slid == 1.0 and stood / 2.0 < 0.9
    assert stood == pytest.approx(2.5 * 4.0 / 6.0, rel=0.02)  # (as it is with a cohesion of 6)


def test_states_that_cannot_repeat_their_step_are_refused():
    problem = block(kind=Watched)
    problem.solve(2)

    def newton(factor):
        raise mpm.ConvergenceError("It does not converge.", [3])

    problem.before = newton
    with pytest.raises(mpm.MPMError, match="a factor would mean nothing: It does not") as caught:
        mpm.strength_reduction(problem)
    assert caught.value.particles == [3] and problem.points[0].laws.weakening == 1.0
    problem.before = lambda factor: None
    with pytest.raises(mpm.MPMError, match=r"above 0\.0015: it flows"):
        problem.particles.load.value = 3.0
        mpm.strength_reduction(problem)


def test_a_factor_at_which_the_body_flows_is_not_tried_again():
    problem = block(kind=Watched)
    problem.solve(2)
    found = mpm.strength_reduction(problem, step=0.5)
    beyond = 3.5  # (looked at once, as to whether it comes to rest)
    assert problem.tried[problem.tried.index(3.0) + 1] == beyond
    fell = [f for f in problem.tried if f not in found.factors and f != beyond]
    assert fell == sorted(set(fell), reverse=True) and found.above == fell[-1]
    assert found.reason == "flow" and found.failure is None
    last = len(found.factors)
    np.testing.assert_array_equal(found.curve[:last, :2].T, [found.factors, found.displacements])
    assert found.curve[last, 0] == found.above and np.all(found.curve[last:, 2] > 0.03)
    assert found.curve[:last, 2].max() <= 0.03 and len(fell) >= 3
    other = block()
    other.solve(2)
    again = mpm.strength_reduction(other)
    # (so soft a body strains by 0.05 of the loss before it flows, and by 0.15 after that)
    assert again.factor == pytest.approx(found.factor, rel=0.02)


def ctrl_c():
    """Press Ctrl-C, on all ranks."""
    signal.raise_signal(signal.SIGINT)


def fault():
    """Raise an error as a user's function may do."""
    raise ZeroDivisionError


@pytest.mark.parametrize("ends", [ctrl_c, fault])
def test_interrupted_reduction_leaves_the_last_state_that_counts(ends):
    problem = block(kind=Watched)
    problem.solve(2)
    law, here = problem.points[0], {}

    def after(factor):
        if len(problem.tried) == 3:
            here["d"] = problem.particles.converged_displacement.copy()
            here["steps"] = len(problem.history.steps)
        elif len(problem.tried) == 4:
            ends()

    problem.after = after
    with pytest.raises(KeyboardInterrupt if ends is ctrl_c else ZeroDivisionError):
        mpm.strength_reduction(problem)
    assert problem.tried == [1.0, 1.05, 1.1, 1.15] and problem.points[0].laws.weakening == 1.0
    np.testing.assert_array_equal(problem.particles.converged_displacement, here["d"])
    assert problem.points[0] is law and len(problem.history.steps) == here["steps"]
    problem.step()  # and with the strength that was given it stands there
    np.testing.assert_allclose(problem.particles.converged_displacement, here["d"], atol=1e-6)


def test_domains_that_may_be_split_are_refused():
    problem = block(on_distortion="split")
    problem.solve(2)
    with pytest.raises(mpm.MPMError, match="which a split of domains changes"):
        mpm.strength_reduction(problem)
    problem.particles.on_distortion = "error"
    found = mpm.strength_reduction(problem, tolerance=0.1, most=1.2)
    assert found.factor == 1.2 and found.above == np.inf
    assert found.reason == "most"


def test_a_law_without_strength_is_refused():
    V = vectors(box([0, 0], [1, 1], [1, 1], QUADRILATERAL))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(box([0, 0], [1, 0.5], [2, 1], QUADRILATERAL), V),
            materials.Hencky(1e3, 0.3),
            body_force=(0.0, -1.0),
        ),
        bcs=[fix(V, at(1, 0))],
    )
    problem.solve()
    with pytest.raises(
        mpm.MPMError, match="has a strength; those of this problem are elastic: Hencky"
    ):
        mpm.strength_reduction(problem)


def bank(cells, **options):
    """Return a slope of 45 degrees, height 1, of undrained strength 1 on a firm base."""
    body = box([0, 0], [2.5, 1], [5 * cells, 2 * cells], QUADRILATERAL)
    x = body.geometry.x
    x[:, 0] *= (1.5 + (1 - x[:, 1])) / 2.5
    h = 1.0 / cells
    V = vectors(
        box([0, 0], [2.5 + 4 * h, 1 + 2 * h], [5 * cells // 2 + 4, cells + 2], QUADRILATERAL)
    )
    f_bar = options.pop("f_bar", "patch")
    own = mpm.Body(
        mpm.Particles(body, V, **options),
        materials.Tresca(1e5, 0.49, cohesion=1.0),
        density=3.0,
        body_force=(0.0, -1.0),
        f_bar=f_bar,
    )
    bcs = [mpm.held(V, y=0.0), mpm.held(V, 0, x=0.0)]
    return mpm.QuasiStaticProblem(own, bcs=bcs)


def known_of_bank():
    """Return gamma H/c of the worst of slides along circles on the base: an upper bound."""
    a, b = (m.ravel() for m in np.meshgrid(np.linspace(0.5, 1.0, 26), np.linspace(1.2, 2.2, 51)))
    x = a[:, None] + b[:, None] * (np.arange(800) + 0.5 - 400) / 400  # (their radius is b)
    surface = np.clip(1.0 - x, 0.0, 1.0)
    down = np.sqrt(b[:, None] ** 2 - (x - a[:, None]) ** 2)
    height = np.maximum(surface - (b[:, None] - down), 0.0)
    width = b[:, None] / 400
    moment = (height * (a[:, None] - x) * width).sum(axis=1)
    arc = ((height > 0.0) * b[:, None] / down * width).sum(axis=1)
    return (b * arc / moment)[moment > 0.01].min()


@pytest.mark.parametrize("cells", [4, *slow(8)])
def test_averages_of_carried_and_of_free_nodes_err_to_both_sides(cells):
    """Patches of particles find too much, those of finite elements, which are soft, too little."""
    found = []
    for options in ({}, {"free": "auto"}):
        problem = bank(cells, **options)
        problem.solve(4)
        found.append(3.0 * mpm.strength_reduction(problem).factor)
    known = known_of_bank()
    assert known == pytest.approx(6.05, abs=0.02)
    assert known < found[0] < (1.0 + 0.55 / cells) * known
    assert (1.0 - 0.8 / cells) * known < found[1] < known


def test_what_comes_to_rest_is_no_slide(monkeypatch):
    """A few cells may give way at one factor, and the body stand at larger ones."""
    problem = block(kind=Watched)
    problem.solve(2)
    slid = strength._slid

    def opened(problem, before):
        rate = slid(problem, before)
        return 1.0 if problem.tried[-1] == 1.1 else rate

    monkeypatch.setattr(strength, "_slid", opened)
    found = mpm.strength_reduction(problem, most=1.3)
    assert found.factor == 1.3 and found.reason == "most" and found.above == np.inf
    assert found.factors == pytest.approx([1.0, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3])
    assert list(found.curve[:, 2] > 0.1) == [factor == 1.1 for factor in found.factors]
