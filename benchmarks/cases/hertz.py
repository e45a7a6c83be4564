# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A rigid disc is pressed into an elastic block, or two cylinders into each other (Hertz 1882).

The half of both in plane strain. The pressure is compared with Hertz's for the force that was
found, in the mean of each facet; `half_width` is that of the pressure's second moment, and it and
`max_pressure` are over Hertz's. `force` is over the converged one, as in the plane a depth is that
of a body's size.
"""

from typing import Any

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem

import mpm_dolfinx as mpm

parser = kit.Parser("A rigid disc on an elastic block, or two elastic cylinders.")
parser.add_argument("--cells", type=kit.whole, default=4, help="cells in the half width")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument("--degree", type=int, choices=(1, 2), default=1, help="of both meshes")
parser.add_argument("--law", choices=("penalty", "nitsche"), default="penalty", help="of contact")
parser.add_argument("--penalty", type=kit.positive, default=1.0, help="of the contact")
parser.add_argument("--pair", action="store_true", help="two cylinders in contact")
parser.add_argument("--friction", type=float, default=0.0, help="of the contact")
parser.add_argument("--steps", type=kit.whole, default=8, help="load steps")
args = parser.parse()

comm = MPI.COMM_WORLD
young, poisson, end = 1e3, 0.3, 3.0
radius, depth = (8.0, 0.0135) if args.pair else (6.0, 0.0108)
h = 0.2 / args.cells
strong = {"friction": args.friction, "penalty": args.penalty, "law": args.law}

# The force without friction by Nitsche's method of degree 2 with 8 cells; 4 give 5.4210 and 3.2655.

converged = 3.2679 if args.pair else 5.4217


def lines(size: float) -> np.ndarray:
    """Places from the middle outwards, `size` apart where bodies touch."""
    return kit.lines(size, 0.3, end)


def arc(x: np.ndarray) -> np.ndarray:
    """How far the surface of a cylinder has gone back."""
    return radius - np.sqrt(radius**2 - x**2) if args.pair else 0.0 * x


def half(
    size: float, sign: float
) -> tuple[mpm.Particles, Any, fem.Constant, list[fem.DirichletBC]]:
    """Half of a block or cylinder, below (1) or above (-1).

    Its surface, the motion of its base, and its conditions.
    """
    deep, fine = -sign * lines(h), kit.divided(lines(2.0 * size), 2)
    border = np.append(lines(h)[:-1], end + 0.2)  # what is pressed goes sideways
    places = [border, np.sort(np.append(deep, sign * 0.4 * h))]
    background = kit.grid(places, kit.DOMAINS["quad"])
    body = kit.grid([fine, np.sort(-sign * fine)], kit.DOMAINS[args.domain])
    x = body.geometry.x
    x[:, 1] -= sign * arc(x[:, 0]) * (1.0 - np.abs(x[:, 1]) / end)
    V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
    particles = mpm.Particles(body, V, degree=args.degree)
    surface = mpm.facet_tags(body, {1: lambda x: np.isclose(x[1], -sign * arc(x[0]))})
    base = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], -sign * end))
    motion = fem.Constant(background, np.zeros(2))
    return (
        particles,
        (surface, 1),
        motion,
        [mpm.held(V, 0, x=0.0), fem.dirichletbc(motion, base, V)],
    )


law = mpm.materials.LinearElastic(young, poisson)
lower, surface, _, bcs = half(h / 2.0, 1.0)
bodies = [mpm.Body(lower, law)]
if args.pair:
    upper, other, motion, more = half(1.3 * h / 2.0, -1.0)
    bodies.append(mpm.Body(upper, law))
    bcs += more
    touch = mpm.contact.Pair(lower, upper, facets=(surface, other), **strong)
else:
    disc = mpm.contact.disc((0.0, radius), radius)
    touch = mpm.contact.Rigid(lower, disc, facets=surface, **strong)
problem = mpm.QuasiStaticProblem(bodies, bcs=bcs, terms=[touch])


def update(t: float) -> None:
    """Press them together."""
    if args.pair:
        motion.value = (0.0, -depth * t)
    else:
        touch.move((0.0, -depth * t))


try:
    for _ in kit.progress(problem.steps(args.steps, update=update), args.steps, args):
        pass
except mpm.MPMError as error:
    kit.report(args, kit.outcome(problem.history, error), (), error)

# Points of a facet follow each other once they are sorted by their place.

x, p, area = (
    comm.bcast(kit.gathered(values)) for values in (touch.points[:, 0], touch.pressure, touch.area)
)
order = np.argsort(x)
facets = comm.allreduce(len(surface[0].find(1)))
each = len(x) // facets
length, force = (v[order].reshape(-1, each).sum(axis=1) for v in (area, area * p))
ends = np.concatenate([[0.0], np.cumsum(length)])
together = young / (1.0 - poisson**2) / (2.0 if args.pair else 1.0)
curved = radius / 2.0 if args.pair else radius
width, exact = kit.hertz((ends[1:] + ends[:-1]) / 2.0, force, length, together, curved)
found = float(np.abs(problem.reaction(touch)[1])) * 2.0
most = 2.0 * found / np.pi / width
moment = (area * p * x**2).sum() / (area * p).sum()
off = force / length - exact
numbers = {
    **kit.outcome(problem.history, None),
    "pressure_error": float(np.sqrt((off**2 * length).sum() / (exact**2 * length).sum())),
    "max_pressure": float(p.max() / most),
    "half_width": float(np.sqrt(4.0 * moment) / width),
    "force": found / converged,
    "line_search_halvings": problem.history.statistics["halvings"],
    "particles": sum(body.particles.num_global for body in bodies),
}
rows = [
    ("domains", f"{numbers['particles']} ({args.domain}), {args.cells} cells in the half width"),
    ("linear solves", f"{numbers['iterations']} in {len(problem.history.steps)} steps"),
    ("error of the pressure", f"{100 * numbers['pressure_error']:.2f} % in L2"),
    ("largest pressure, over Hertz's", f"{numbers['max_pressure']:.4f}"),
    ("half width, over Hertz's", f"{numbers['half_width']:.4f}"),
    ("force, over the converged one", f"{numbers['force']:.4f}"),
]
if args.plot:
    fig, axes = kit.figure(7.0, 4.5)
    if fig is not None:
        ax, s = axes["main"], np.linspace(0.0, 1.0, 200)
        ax.plot(s, np.sqrt(1.0 - s**2), color="0.2", label="Hertz", lw=1.2, ls="--")
        label = f"means of facets, {args.law}"
        middle = (ends[1:] + ends[:-1]) / 2.0 / width
        ax.plot(middle, force / length / most, "o", ms=5, color=kit.COLOURS["blue"], label=label)
        ax.set(xlim=(0.0, 1.4), ylim=(0.0, None), ylabel="pressure over Hertz's largest")
        ax.set(xlabel="distance from the middle over the half width")
        ax.legend()
    kit.save(fig, args)

kit.report(args, numbers, rows)

if args.default:
    assert numbers["pressure_error"] < 0.07 and abs(numbers["half_width"] - 1.0) < 0.04
