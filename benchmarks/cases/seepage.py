# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Water flows steadily under a sheet pile that stands in a layer of soil on an impervious base.

With the pile's depth over that of the layer, s, the discharge over permeability and difference of
head is `K'(m) / (2 K(m))` with `m = sin(pi s / 2)` and the complete elliptic integrals K of modulus
m and K' of `sqrt(1 - m^2)` (Harr 1962). The flow is antisymmetric, so one half of the ground is
enough: under the pile's foot the head is the mean of those on both sides. The soil hardly moves.
`discharge` is found from the power that the flow takes.
"""

import kit
import numpy as np

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm

parser = kit.Parser("Seepage under a sheet pile.")
parser.add_argument("--depth", type=kit.positive, default=0.5, help="of the pile, over the layer's")
parser.add_argument("--cell", type=kit.positive, default=0.125, help="background cell size")
parser.add_argument("--halvings", type=kit.count, default=3, help="of cells at the pile's foot")
parser.add_argument("--steps", type=kit.whole, default=1, help="steps of a long time each")
args = parser.parse()
if args.depth >= 1.0:
    parser.error(f"argument --depth: {args.depth:g} is not below 1")

# Beyond four depths of the layer the flow is less than 1e-3 of that at the pile.

wide, foot, difference, permeability = 4.0, 1.0 - args.depth, 1.0, 1e-3
across = mpm.grid_lines(
    0.0, wide, args.cell, equal=(0.0, 1.0), finer_at=0.0, halvings=args.halvings
)
up = mpm.grid_lines(0.0, 1.0, args.cell, finer_at=foot, halvings=args.halvings)
foot = up[np.argmin(np.abs(up - foot))]
ground = kit.grid([across, up], kit.DOMAINS["quad"])
room = np.append(up, 1.0 + args.cell)
V = fem.functionspace(kit.grid([across, room], kit.DOMAINS["quad"]), ("Lagrange", 2, (2,)))
soil = mpm.Particles(ground, V, degree=2, quadrature_degree=4)
tags = mpm.facet_tags(ground, {1: mpm.region(x=0.0, y=(0.0, foot)), 2: mpm.region(y=1.0)})
problem = mpm.PorousProblem(
    mpm.Body(
        soil,
        mpm.materials.LinearElastic(1e8, 0.3),
        facet_tags=tags,
        pore_fluid=mpm.PoreFluid(permeability, drained=[(0.5 * difference, 1), (0.0, 2)]),
    ),
    bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=wide), mpm.held(V, y=0.0)],
)
failure = None
try:
    for _ in kit.progress(problem.steps(time=1e6 * args.steps, dt=1e6), args.steps, args):
        pass
except mpm.MPMError as error:
    failure = error


def elliptic(modulus: float) -> float:
    """The complete elliptic integral of the first kind, by the arithmetic-geometric mean."""
    a, b = 1.0, np.sqrt(1.0 - modulus**2)
    for _ in range(30):
        a, b = 0.5 * (a + b), np.sqrt(a * b)
    return np.pi / (2.0 * a)


m = np.sin(0.5 * np.pi * (1.0 - foot))
exact = elliptic(np.sqrt(1.0 - m**2)) / (2.0 * elliptic(m))
(p,) = problem.pore_pressure
power = kit.total(fem.assemble_scalar(fem.form(ufl.inner(ufl.grad(p), ufl.grad(p)) * ufl.dx)))
discharge = power / (0.5 * difference) / difference
numbers = kit.outcome(problem.history, failure) | {
    "discharge": discharge,
    "exact": exact,
    "error": abs(discharge / exact - 1.0),
    "particles": soil.num_global,
}
rows = [
    ("domains", f"{soil.num_global}, pile to {1.0 - foot:g} of the layer"),
    ("discharge over k and head", f"{discharge:.5f}, exact {exact:.5f}"),
]
if args.plot:
    fig, axes = kit.figure(8.0, 4.0)
    mpm.plot.scene(problem, "pore_pressure", ax=axes["main"], background=False)
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)

if args.default:
    assert numbers["completed"] and numbers["error"] < 0.01
