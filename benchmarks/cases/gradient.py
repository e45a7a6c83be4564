# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of a run: a block on a rough base that slumps under its weight.

`motion` is one that is thrown along its base, and `porous` one of soil with water in its pores.

`difference` is that of the derivative of the displacement from central differences of whole runs,
relative and by the worst parameter, `taylor` the order of the remainder as all parameters change
together (with `--mode adjoint` of the integral of the squared displacement, by the stiffness in as
many groups of cells as there are parameters), `trend` what the derivative by stiffness differs by
from the slope of a cubic through runs within 10 %, with a ghost penalty, relative, and
`seconds_ratio` CPU seconds of the derivatives over those of the run.
"""

import time

from mpi4py import MPI

import kit
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

KINDS = {
    "elastic": {"young": 2e4, "poisson": 0.3, "weight": 1e3, "push": 300.0, "moved": 0.02},
    "von-mises": {
        "young": 5e4,
        "yield_stress": 1.2e3,
        "poisson": 0.3,
        "hardening": 2e3,
        "weight": 1e3,
    },
    "cam-clay": {
        "shear_modulus": 2e4,
        "compression": 0.1,
        "swelling": 0.02,
        "critical_ratio": 1.0,
        "preconsolidation": 1.5e3,
    },
    "motion": {"young": 5e4, "yield_stress": 1.5e3, "density": 100.0, "weight": 1e3, "speed": 0.3},
    "porous": {"young": 2e4, "permeability": 1e-4, "weight": 1e3, "load": 300.0, "storage": 1e-4},
}
#: Of runs through time.
DURATIONS = {"motion": 0.2, "porous": 0.5}
#: What is given where it is no parameter.
REST = {"weight": 1e3, "push": 0.0, "moved": 0.0}

parser = kit.Parser("Derivatives of a run: a block that slumps.")
parser.add_argument("--kind", choices=tuple(KINDS), default="von-mises", help="of the law")
parser.add_argument("--parameters", type=kit.whole, default=5, help="how many, 5 at most forward")
parser.add_argument(
    "--mode", choices=("forward", "adjoint"), default="forward", help="of differentiation"
)
parser.add_argument("--degree", type=int, choices=(1, 2), default=1, help="of the background")
parser.add_argument("--cells", type=kit.whole, default=6, help="background cells over its width")
parser.add_argument("--steps", type=kit.whole, default=10, help="load steps")
args = parser.parse()
backward = args.mode == "adjoint"
if args.parameters > (8 * args.cells**2 if backward else 5):
    parser.error(f"argument --parameters: {args.parameters} are too many")
if backward and args.kind in ("motion", "porous"):
    parser.error(f"argument --mode: adjoint is not for {args.kind}")

comm, kind = MPI.COMM_WORLD, mesh.CellType.quadrilateral
first = next(iter(KINDS[args.kind]))  # a stiffness
given = dict(list(KINDS[args.kind].items())[: args.parameters])
if backward:
    given = {f"{first} {i}": KINDS[args.kind][first] for i in range(args.parameters)}


def made(change=None, stabilisation="auto"):
    """A problem with the parameters, by name, of which some are multiplied by `1 + change`."""
    n, degree = args.cells, 2 if args.kind == "porous" else args.degree
    grid = mesh.create_rectangle(comm, [[0, 0], [2, 2.5]], [2 * n, 5 * n // 2], kind)
    V = fem.functionspace(grid, ("Lagrange", degree, (2,)))
    left = 0.5 if args.kind == "motion" else 0.0
    # two domains each way in a cell: with one of degree 2 a body that moves over lines has
    # hardly more nodes than the background, and motions of the background that it does not feel
    body = mesh.create_rectangle(comm, [[left, 0], [left + 1, 2]], [2 * n, 4 * n], kind)
    particles = mpm.Particles(body, V, degree=degree, quadrature_degree=2 * degree)
    values = {**REST, **KINDS[args.kind]}
    change = change or {}
    if not backward:
        values |= {name: values[name] * (1.0 + part) for name, part in change.items()}
    held = ("moved",)
    named = {
        name: fem.Constant(grid if name in held else body, value) for name, value in values.items()
    }
    if backward:
        named[first] = field = fem.Function(fem.functionspace(body, ("DG", 0)))
        parts = np.array([change.get(name, 0.0) for name in given])
        field.x.array[cells_of(field)] = values[first] * (1.0 + parts[groups(particles)])
        field.x.scatter_forward()
    solver = mpm.Solver(stabilisation=stabilisation, petsc_options={"snes_rtol": 1e-12})
    if args.kind == "motion":
        return thrown(particles, named, solver), named
    if args.kind == "porous":
        return pressed(particles, named, solver), named
    of_law = {name: named[name] for name in KINDS[args.kind] if name not in REST}
    if args.kind == "elastic":
        law = mpm.materials.Hencky(**of_law)
    elif args.kind == "von-mises":
        law = mpm.materials.VonMises(**of_law)
    else:
        law = mpm.materials.ModifiedCamClay(**of_law, reference_pressure=1e3)
        named["weight"].value = 500.0
    tags = mpm.facet_tags(body, {1: mpm.region(y=2.0)})
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            law,
            body_force=ufl.as_vector([0.0, -named["weight"]]),
            tractions=[(ufl.as_vector([named["push"], 0.0]), 1)],
            facet_tags=tags,
        ),
        bcs=[
            mpm.held(V, 0, x=0.0, value=named["moved"]),
            mpm.held(V, 0, y=0.0, value=named["moved"]),
            mpm.held(V, 1, y=0.0),
        ],
        solver=solver,
    )
    return problem, named


def groups(particles):
    """The group of each owned cell."""
    return particles.global_index * args.parameters // particles.num_global


def cells_of(field):
    """Where a Function has the values of owned cells."""
    space = field.function_space
    return space.dofmap.list[: space.mesh.topology.index_map(2).size_local, 0]


def squares(problem):
    """The integral of the squared displacement, a form."""
    d = problem.particles.displacement
    return 0.5 * ufl.inner(d, d) * ufl.dx


def thrown(particles, named, solver):
    """A block that is thrown along its base."""
    V, (young, strength, density, weight, speed) = (
        particles.V,
        (named[name] for name in KINDS["motion"]),
    )
    body = mpm.Body(
        particles,
        mpm.materials.VonMises(young, 0.3, yield_stress=strength, hardening=2e3),
        density=density,
        body_force=ufl.as_vector([0.0, -weight / density]),
        velocity=ufl.as_vector([speed, 0.0]),
    )
    return mpm.DynamicProblem(body, [mpm.held(V, 1, y=0.0)], solver=solver)


def pressed(particles, named, solver):
    """A block of soil with water, loaded on its top, which is drained."""
    V, (young, k, weight, load, storage) = (
        particles.V,
        (named[name] for name in KINDS["porous"]),
    )
    tags = mpm.facet_tags(particles.mesh, {1: mpm.region(y=2.0)})
    body = mpm.Body(
        particles,
        mpm.materials.NeoHooke(young, 0.3),
        body_force=ufl.as_vector([0.0, -weight]),
        tractions=[(ufl.as_vector([0.0, -load]), 1)],
        facet_tags=tags,
        pore_fluid=mpm.PoreFluid(lambda J: k * J**3, storage=storage, drained=[(0.0, 1)]),
    )
    bcs = [mpm.held(V, 0, x=0.0), mpm.held(V, 0, y=0.0), mpm.held(V, 1, y=0.0)]
    return mpm.PorousProblem(body, bcs, solver=solver)


def run(problem):
    """Make all steps."""
    if args.kind in DURATIONS:
        problem.solve(time=DURATIONS[args.kind], dt=DURATIONS[args.kind] / args.steps)
    else:
        problem.solve(args.steps)


def solved(change=None, stabilisation="auto"):
    """Displacements of a run with other parameters, or the integral of their squares."""
    problem, _ = made(change, stabilisation)
    run(problem)
    return looked(problem)


def looked(problem):
    """What is differentiated."""
    if backward:
        own = fem.assemble_scalar(fem.form(squares(problem)))
        return np.array([comm.allreduce(own) / np.sqrt(comm.size)])
    return problem.particles.displacement.x.array.copy()


def size(values):
    """Norm over all ranks; nodes of several ranks count several times."""
    return float(np.sqrt(kit.total(np.asarray(values) ** 2)))


def differentiated(stabilisation="auto"):
    """A run with its derivatives by the parameters, relative to them, and its CPU seconds."""
    problem, named = made(None, stabilisation)
    if backward:
        return differentiated_backward(problem, named[first])
    gradient = mpm.Sensitivity(problem, [named[name] for name in given])
    start = time.process_time()
    run(problem)
    seconds = time.process_time() - start
    pairs = zip(given.items(), gradient.displacement, strict=True)
    return problem, {name: value * own.x.array for (name, value), own in pairs}, seconds


def differentiated_backward(problem, field):
    """The same of the integral of the squared displacement."""
    adjoint = mpm.Adjoint(problem, [field])
    start = time.process_time()
    run(problem)
    (slope,) = adjoint.of(squares(problem))
    seconds = time.process_time() - start
    relative = (slope * field.x.array)[cells_of(field)]
    sums = np.bincount(groups(problem.particles), relative, minlength=len(given))
    sums = comm.allreduce(sums) / np.sqrt(comm.size)
    slopes = {name: np.array([value]) for name, value in zip(given, sums, strict=True)}
    return problem, slopes, seconds


plain = []
failure, history, numbers = None, mpm.History(), {}
try:
    solved()  # forms are compiled
    for _ in range(2):
        problem, _ = made()
        start = time.process_time()
        run(problem)
        plain.append(time.process_time() - start)
    cases = [differentiated() for _ in range(2)]
    problem, slopes, _ = cases[0]
    history = problem.history
    end = looked(problem)
    seconds = min(one[2] for one in cases)

    gaps = []
    for name, slope in list(slopes.items())[:5]:
        ends = [solved({name: sign * 2e-6}) for sign in (1.0, -1.0)]
        difference = (ends[0] - ends[1]) / 4e-6
        gaps.append(size(slope - difference) / size(difference))

    # below most kinks, above round-off
    changes, left = ((4e-4, 2e-4) if args.kind == "porous" else (4e-6, 2e-6)), []
    for change in changes:
        other = solved(dict.fromkeys(given, change))
        left.append(size(other - end - change * sum(slopes.values())))
    rate = float(np.log(left[0] / left[1]) / np.log(changes[0] / changes[1]))

    _, exact, _ = differentiated("ghost")
    within = np.linspace(-0.1, 0.1, 11)
    whole = list(given) if backward else [first]
    found = np.array([solved(dict.fromkeys(whole, change), "ghost") for change in within])
    slope = sum(exact[name] for name in whole)
    fitted = np.polynomial.polynomial.polyfit(within, found, 3)[1]
    numbers = {
        "taylor": rate,
        "difference": max(gaps),
        "trend": size(slope - fitted) / size(fitted),
        "seconds_ratio": kit.total(seconds) / kit.total(min(plain)) - 1.0,
    }
except mpm.MPMError as error:
    failure = error

rows = [
    ("parameters", ", ".join(list(given)[:5])),
    *((name, f"{value:.3g}") for name, value in numbers.items()),
]
kit.report(args, {**kit.outcome(history, failure), **numbers}, rows, failure)
