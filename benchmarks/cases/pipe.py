# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pipe deep in undrained clay is pushed aside: the clay flows round it (Randolph & Houlsby 1984).

The force on a length of it is `factor` times strength and diameter, which are 1: 11.94 where clay
adheres to the pipe with all of its strength, 9.14 where the pipe is smooth. The lines of the clay
go round the pipe, those of the background do not know it. A pressure in the clay keeps it on the
pipe.
"""

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A pipe deep in clay: resistance of the flow round it.")
parser.add_argument("--cell", type=kit.positive, default=1 / 12, help="background cell, diameters")
parser.add_argument("--rough", action="store_true", help="clay adheres with all of its strength")
parser.add_argument("--free", action="store_true", help="free nodes within 1.5 cells of the pipe")
parser.add_argument("--per-cell", type=kit.whole, default=2, help="domains each way in a cell")
parser.add_argument("--young", type=kit.positive, default=3000.0, help="modulus over strength")
parser.add_argument("--way", type=kit.positive, default=0.02, help="how far, diameters")
parser.add_argument("--before", type=kit.positive, default=20.0, help="pressure over strength")
parser.add_argument("--steps", type=kit.whole, default=12, help="steps")
parser.add_f_bar("patch")
args = parser.parse()

# The right half of the clay, four diameters to all sides, with domains that grow by a tenth
# outwards: angles and radii are the coordinates of its mesh first.

radius, far, poisson = 0.5, 4.0, 0.49
n = round(1.0 / args.cell)
size = 1.0 / n / args.per_cell
growing = size * 1.1 ** np.arange(200)
growing = growing[: 1 + np.argmax(np.cumsum(growing) >= far - radius)]
growing *= (far - radius) / growing.sum()
outwards = radius + np.append(0.0, np.cumsum(growing))
angles = np.linspace(-np.pi / 2, np.pi / 2, round(np.pi * radius / size) + 1)
body = kit.grid([angles, outwards], mesh.CellType.quadrilateral)
x = body.geometry.x
angle, r = x[:, 0].copy(), x[:, 1].copy()
x[:, 0] = np.where(np.isclose(np.abs(angle), np.pi / 2), 0.0, r * np.cos(angle))
x[:, 1] = r * np.sin(angle)

across = mpm.grid_lines(0.0, far + 1.0, 1.0 / n, equal=(0.0, 1.5))
grid = kit.grid([across, np.append(-across[:0:-1], across)], mesh.CellType.quadrilateral)
V = fem.functionspace(grid, ("Lagrange", 1, (2,)))


def from_pipe(x: np.ndarray) -> np.ndarray:
    """Distance to the pipe."""
    return np.hypot(x[0], x[1]) - radius


clay = mpm.Particles(
    body,
    V,
    quadrature_degree=args.quadrature_degree or 2,
    free=(lambda x: from_pipe(x) < 1.5 / n) if args.free else None,
)
tags = mpm.facet_tags(
    body, {1: lambda x: from_pipe(x) < 1e-9, 2: lambda x: from_pipe(x) > 0.98 * (far - radius)}
)

# The stiffness of contact is in proportion to 4 G: by default it is the confined modulus, 51 G.

pipe = mpm.contact.Rigid(
    clay,
    mpm.contact.disc((0.0, 0.0), radius),
    mpm.contact.Coulomb(cohesion=1.0) if args.rough else 0.0,
    facets=(tags, 1),
    modulus=2.0 * args.young / (1.0 + poisson),
)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        clay,
        mpm.materials.VonMises(args.young, poisson, rho_y=np.sqrt(2.0)),
        f_bar=args.f_bar,
        initial_stress=-args.before * np.eye(3),
    ),
    bcs=[mpm.held(V, 0, x=0.0)],
    supports=[mpm.boundary.fixed(clay, tags, 2)],
    terms=[pipe],
)
path, failure = [(0.0, 0.0)], None
try:
    problem.solve(1)
    run = problem.steps(args.steps, update=lambda t: pipe.move((0.0, -args.way * t)))
    for step in kit.progress(run, args.steps, args):
        path.append((args.way * step.load, -2.0 * float(problem.reaction(pipe)[1])))
except mpm.MPMError as error:
    failure = error

way, force = np.array(path).T
exact = 11.94 if args.rough else 9.14
numbers = {
    **kit.outcome(problem.history, failure),
    "factor": float(force[-1]),
    "exact": exact,
    "ratio": float(force[-1]) / exact,
    "plateau": kit.rise(way, force),
    "particles": clay.num_global,
}
rows = [
    ("clay", f"{clay.num_global} domains, cells of D/{n}, {'rough' if args.rough else 'smooth'}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("factor", f"{force[-1]:.3f}, exact {exact:g}, ratio {numbers['ratio']:.3f}"),
    ("rise over the last tenth", f"{100.0 * numbers['plateau']:.2f} %"),
]
if args.plot:
    fig, axes = kit.figure(12.0, 5.0, [["clay", "force"]])
    mpm.plot.scene(problem, "plastic_strain", ax=axes["clay"], background=False)
    if fig is not None:
        axes["clay"].set(xlim=(0.0, 1.6), ylim=(-1.6, 1.6), xlabel="x, D", ylabel="y, D")
        axes["force"].axhline(exact, color="0.2", lw=1.2, ls="--")
        axes["force"].plot(way, force, color=kit.COLOURS["blue"])
        axes["force"].set(xlabel="way, D", ylabel="force over strength and D")
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)

if args.default:
    assert 1.0 < numbers["ratio"] < 1.03 and numbers["cutbacks"] == 0
