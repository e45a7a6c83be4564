# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Problems from one list of keywords, for tests that walk through options of all kinds."""

from dataclasses import fields

import mpm_dolfinx as mpm

#: Names of Solver's arguments, also with the one that a problem's own table of options has.
SOLVER = {field.name: field.name for field in fields(mpm.Solver)} | {"linear_solver": "linear"}
BODY = tuple(field.name for field in fields(mpm.Body))[1:-1]
FLUID = {field.name: field.name for field in fields(mpm.PoreFluid)} | {
    "fluid_density": "density",
    "pore_pressure": "pressure",
}
del FLUID["density"], FLUID["pressure"]


def sorted_out(options):
    """Return options with those of a Solver made one."""
    of_solver = {SOLVER[k]: v for k, v in options.items() if k in SOLVER}
    rest = {k: v for k, v in options.items() if k not in SOLVER}
    return {**rest, "solver": mpm.Solver(**of_solver)} if of_solver else rest


def posed(kind, particles, *args, **options):
    """Return a problem of a kind; what is given for bodies is one for all, or a list.

    Args:
        kind: A class of problems.
        particles: Particles, or a list; of a residual in UFL the residual, with particles next.
        *args: The material, and the density; with UFL all that the problem takes.
        **options: Arguments of Body, PoreFluid, Solver and the problem.
    """
    if not issubclass(kind, mpm.QuasiStaticProblem):
        return kind(particles, *args, **sorted_out(options))
    names = ("material", "density", "body_force", "bcs")
    if kind is mpm.PorousProblem:
        names = ("material", "permeability", "density")
    options = {**dict(zip(names, args, strict=False)), **options}
    listed = isinstance(particles, list | tuple)
    count = len(particles) if listed else 1
    of_body = {k: options.pop(k) for k in BODY if k in options}
    of_fluid = {FLUID[k]: options.pop(k) for k in tuple(FLUID) if k in options}
    bodies = []
    for number, one in enumerate(particles if listed else [particles]):
        own = {k: _own(k, v, number, count, listed) for k, v in of_body.items()}
        fluid = {k: _own(k, v, number, count, listed) for k, v in of_fluid.items()}
        if fluid.get("permeability") is not None:
            own["pore_fluid"] = mpm.PoreFluid(**fluid)
        bodies.append(mpm.Body(one, **own))
    return kind(bodies if listed else bodies[0], **sorted_out(options))


def _own(name, value, number, count, listed):
    """Return what one of several bodies has of what is given."""
    pairs = name in ("tractions", "pressures", "drained", "inflow")
    each = isinstance(value, list) and (not pairs or all(isinstance(v, list) for v in value))
    return value[number] if listed and each and len(value) == count else value


def staged(problem, name=None, **options):
    """Begin a stage in which all bodies have what is given, or each its own of a list."""
    of_body = {k: options.pop(k) for k in BODY if k in options}
    given = problem.setup.given
    listed = isinstance(problem.particles, list | tuple)
    bodies = [
        body.replace(**{k: _own(k, v, n, len(given), listed) for k, v in of_body.items()})
        for n, body in enumerate(given)
        if of_body
    ]
    problem.stage(name, bodies, **options)
