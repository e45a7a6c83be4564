# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A rigid pile, disc, wedge or footing is pressed into undrained clay.

demos/demo_pipe.py is its simplest form. A wedge cuts the clay, and most of its face bears on what
the cut has laid bare; a mesh that is held together on the axis would cover that with its first
facet alone. So for a wedge the clay is parted there: it leans on a smooth wall, and the tip goes
down between the two. The wedge's `ratio` is the force over the depth, which is the same at all
depths, in the last half of the path, over the exact one.

A footing that goes deep is that of Kardani, Nazem, Carter & Abbo (2015), 1 m wide on weightless
clay of 10 by 5 m: `--obstacle footing --depth 1 --young 100 --poisson 0.495 --wide 5 --deep 5`.
Clay that passes its edge is drawn out, and as facets are straight, long ones would make it wider:
`--edge 8`. `curve` has depths and forces over c and 1 m.
"""

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A rigid obstacle is pressed into von Mises soil.")
parser.add_argument("--obstacle", choices=("pile", "disc", "wedge", "footing"), default="disc")
parser.add_argument("--friction", type=float, default=0.0, help="coefficient of friction")
parser.add_argument("--depth", type=kit.positive, help="0.6, 0.03 of the footing by default")
parser.add_argument("--angle", type=kit.positive, default=45.0, help="half angle of the wedge")
parser.add_argument("--cell", type=kit.positive, default=0.125, help="background cell size")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument("--young", type=kit.positive, default=500.0, help="modulus over cohesion")
parser.add_argument("--poisson", type=float, default=0.45, help="Poisson's ratio")
parser.add_argument("--wide", type=kit.positive, default=4.0, help="half width of the soil, m")
parser.add_argument("--deep", type=kit.positive, default=2.5, help="its depth, m")
parser.add_argument("--radius", type=kit.positive, help="of corners: 0.05, 0.01 of the footing")
parser.add_argument("--law", choices=("penalty", "nitsche"), default="penalty", help="of contact")
parser.add_argument("--penalty", type=kit.positive, default=1.0, help="of the contact")
parser.add_argument(
    "--tangential-penalty", type=kit.positive, default=0.1, help="shear over confined modulus"
)
parser.add_argument("--steps", type=kit.whole, help="a hundredth of a width each by default")
parser.add_f_bar("patch")
parser.add_mixed()
parser.add_argument("--degree", type=int, choices=(1, 2), default=1, help="of the basis")
parser.add_argument("--domains-per-cell", type=kit.whole, default=2, help="each way")
parser.add_argument(
    "--finer", type=kit.count, default=0, help="how often cells are halved towards the edge at 0.5"
)
parser.add_argument(
    "--edge", type=kit.whole, default=1, help="domains are so much narrower where they pass an edge"
)
args = parser.parse()

# The right half of the soil; obstacles are 1 m wide but for the wedge.

wide, deep, h = args.wide, args.deep, args.cell
young, poisson, cohesion = args.young, args.poisson, 1.0
depth = args.depth or (0.03 if args.obstacle == "footing" else 0.6)
steps = args.steps or (20 if args.obstacle == "footing" else round(100.0 * depth))


def lines(end: float, fine: float) -> np.ndarray:
    """Places from 0 to `end`, at first `h` apart, then each a fifth farther, 0.5 at most."""
    cells = [h] * round(fine / h)
    while sum(cells) < end - 1e-9:
        cells.append(min(1.2 * cells[-1], 0.5))
    tail = np.array(cells[round(fine / h) :])
    tail *= (end - fine) / tail.sum()
    return np.concatenate([h * np.arange(round(fine / h) + 1), fine + np.cumsum(tail)])


across, up = lines(wide, 1.5), -lines(deep, 1.0)[::-1]
across, up = kit.finer_at(0.5, across, args.finer), kit.finer_at(0.0, up, args.finer)
above = kit.finer_at(0.0, h * np.arange(round(1.0 / h) + 1), args.finer)
room = np.append(up, above[1:])
parted = args.obstacle == "wedge"
aside = np.append(-h, across) if parted else across
V = fem.functionspace(
    kit.grid([aside, room], mesh.CellType.quadrilateral), ("Lagrange", args.degree, (2,))
)
rule = args.quadrature_degree
if rule is None and args.domain == "quad" and args.degree == 1:
    rule = 2
sides = [kit.divided(along, args.domains_per_cell) for along in (across, up)]
passing = sides[0][(sides[0] > 0.15) & (sides[0] < 0.55)]
sides[0] = np.union1d(sides[0], kit.divided(passing, args.edge))
soil = mpm.Particles(
    kit.grid(sides, kit.DOMAINS[args.domain]),
    V,
    degree=args.degree,
    quadrature_degree=rule,
)


def rounded(radius: float):
    """A block of half width 0.5 on the ground."""
    return mpm.contact.box((-0.5, 0.0), (0.5, 4.0), radius)


slope = np.tan(np.radians(args.angle))
shape = {
    "pile": lambda: rounded(args.radius or 0.05),
    "footing": lambda: rounded(args.radius or 0.01),
    "disc": lambda: mpm.contact.disc((0.0, 0.5), 0.5),
    "wedge": lambda: mpm.contact.polygon([(0, 0), (3 * slope, 3), (-3 * slope, 3)]),
}[args.obstacle]()
surface, axis = mpm.region(y=0.0), mpm.region(x=0.0)
tags = mpm.facet_tags(soil.mesh, {1: lambda x: surface(x) | (axis(x) & parted)})
obstacle = mpm.contact.Rigid(
    soil,
    shape,
    mpm.contact.Coulomb(args.friction, stiffness=args.tangential_penalty),
    facets=(tags, 1),
    penalty=args.penalty,
    law=args.law,
)


terms, held = [obstacle], [mpm.held(V, 0, x=wide), mpm.held(V, y=-deep)]
if parted:
    plane = mpm.contact.plane((0.0, 0.0), (1.0, 0.0))
    terms.append(mpm.contact.Rigid(soil, plane, facets=(tags, 1)))
else:
    held.append(mpm.held(V, 0, x=0.0))
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        soil,
        mpm.materials.VonMises(young, poisson, rho_y=np.sqrt(2.0) * cohesion),
        f_bar=args.f_bar if args.mixed == "none" else "none",
    ),
    bcs=held,
    mixed=None if args.mixed == "none" else args.mixed,
    terms=terms,
)


def hill() -> float:
    """Force of half a smooth wedge over depth and cohesion (Hill, Lee & Tupper 1947)."""
    beta = np.radians(args.angle)

    def rest(turn: float) -> float:
        return float(np.cos(2 * beta - turn) - np.cos(turn) / (1 + np.sin(turn)))

    low, high = 0.0, 2 * beta
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if rest(low) * rest(middle) > 0 else (low, middle)
    return 2 * (1 + low) * np.sin(beta) / (np.cos(beta) - np.sin(beta - low))


path, failure = [(0.0, 0.0)], None
run = problem.steps(steps, update=lambda t: obstacle.move((0.0, -depth * t)))
try:
    for step in kit.progress(run, steps, args):
        path.append((depth * step.load, float(-problem.reaction(obstacle)[1])))
except mpm.MPMError as error:
    failure = error
reached, force = np.array(path).T
ratio = None
if args.obstacle == "footing":
    ratio = float(force[-1]) / ((2.0 + np.pi) * cohesion * 0.5)
if parted and args.friction == 0.0 and failure is None:
    late = reached > 0.5 * depth
    ratio = float(force[late] @ reached[late] / (reached[late] @ reached[late])) / hill()
history = problem.history
most = max(history.iterations, default=0)
numbers = {
    **kit.outcome(history, failure),
    "depth": float(reached[-1]),
    "force": 2.0 * float(force[-1]) / cohesion,
    "ratio": ratio,
    "curve": [list(point) for point in zip(reached, 2.0 * force / cohesion, strict=True)],
    "iterations_per_step": float(np.mean(history.iterations)) if history.iterations else 0.0,
    "iterations_most": most,
    "penetration": kit.largest(-obstacle.gap) / h,
    "particles": soil.num_global,
}
rows = [
    (args.obstacle, f"{soil.num_global} domains, cells of {h:g}, friction {args.friction:g}"),
    ("depth", f"{reached[-1]:.3f} in {len(history.steps)} steps, {history.cutbacks} cutbacks"),
    ("linear solves", f"{history.total_iterations}, {numbers['iterations_per_step']:.1f} a step"),
    ("force over c and 1 m", f"{numbers['force']:.3f}"),
    ("penetration in cells", f"{numbers['penetration']:.1e}"),
]
if ratio is not None:
    rows.append(("force over the exact one", f"{ratio:.4f}"))

if args.plot:
    fig, axes = kit.figure(12.0, 5.0, [["soil", "force"]])
    mpm.plot.scene(problem, "plastic_strain", ax=axes["soil"], background=False)
    if fig is not None:
        axes["soil"].set(xlim=(0.0, 2.0), ylim=(-1.6, 0.7), xlabel="x, m", ylabel="y, m")
        axes["force"].plot(2.0 * force / cohesion, -reached, color=kit.COLOURS["blue"])
        axes["force"].set(xlabel="force over c and 1 m", ylabel="depth, m")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

if args.default:
    assert numbers["completed"] and numbers["cutbacks"] <= 2
