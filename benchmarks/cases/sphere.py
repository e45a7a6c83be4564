# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A rigid sphere is pressed into an elastic half-space (Hertz 1882)."""

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A rigid sphere is pressed into an elastic half-space.")
parser.add_argument("--cells", type=kit.whole, default=6, help="cells in the radius of contact")
parser.add_argument("--domain", choices=("hex", "tet"), default="hex", help="particle domains")
parser.add_argument("--law", choices=("penalty", "nitsche"), default="penalty", help="of contact")
parser.add_argument("--penalty", type=kit.positive, default=1.0, help="of the contact")
parser.add_argument("--steps", type=kit.whole, default=4, help="steps")
args = parser.parse()

# A quarter of the half-space z < 0, to 6 radii of contact. On its faces in there the displacement
# is that of the force in a point (Boussinesq 1885), which is that of the pressure to (a / L)^2.

radius, a, end = 30.0, 1.0, 6.0
young, poisson = 1e3, 0.3
h = a / args.cells
stiff, shear = young / (1 - poisson**2), young / (2 + 2 * poisson)
force, depth = 4.0 * stiff * a**3 / (3.0 * radius), a**2 / radius
most = 1.5 * force / (np.pi * a**2)


def lines(fine: float) -> np.ndarray:
    """Places from 0 to the end, at first `h` apart, then each half as far again."""
    cells = [h] * round(fine / h)
    while sum(cells) < end:
        cells.append(1.5 * cells[-1])
    tail = np.array(cells[round(fine / h) :])
    tail *= (end - round(fine / h) * h) / tail.sum()
    return np.concatenate([[0.0], np.cumsum([*cells[: round(fine / h)], *tail])])


# The background has the body's lines, but for one more above, 0.4 cells over the ground, and the
# outermost, which are a little farther away, as the body is pressed outwards.

across, up = lines(4.0 * a / 3.0), -lines(a)[::-1]
border = end + 0.05 * a
beside, over = np.append(across[:-1], border), np.concatenate([[-border], up[1:], [0.4 * h]])
V = fem.functionspace(
    kit.grid([beside, beside, over], mesh.CellType.hexahedron), ("Lagrange", 1, (3,))
)
block = mpm.Particles(
    kit.grid([kit.divided(along, 2) for along in (across, across, up)], kit.DOMAINS[args.domain]), V
)
ground = mesh.locate_entities_boundary(block.mesh, 2, lambda x: np.isclose(x[2], 0.0))
tags = mesh.meshtags(block.mesh, 2, np.sort(ground), np.full(len(ground), 1, np.int32))
ball = mpm.contact.Rigid(
    block,
    mpm.contact.sphere((0.0, 0.0, radius), radius),
    facets=(tags, 1),
    penalty=args.penalty,
    law=args.law,
)


def boussinesq(x: np.ndarray) -> np.ndarray:
    """The displacement by a force in the origin."""
    r, deep = np.hypot(x[0], x[1]), np.maximum(-x[2], 0.0)
    rho = np.maximum(np.hypot(r, deep), h)
    factor = force / (4.0 * np.pi * shear * rho)
    out = factor * (deep / rho**2 - (1.0 - 2.0 * poisson) / (rho + deep))
    return np.stack([out * x[0], out * x[1], -factor * (2.0 - 2.0 * poisson + (deep / rho) ** 2)])


far = fem.Function(V)
far.interpolate(boussinesq)
faces = fem.locate_dofs_geometrical(V, lambda x: np.isclose(np.abs(x).max(axis=0), border))
bcs = [fem.dirichletbc(far, faces)]
for axis in range(2):
    space = V.sub(axis)
    collapsed, _ = space.collapse()
    dofs = fem.locate_dofs_geometrical((space, collapsed), lambda x, i=axis: np.isclose(x[i], 0.0))
    bcs.append(fem.dirichletbc(fem.Function(collapsed), dofs, space))
problem = mpm.QuasiStaticProblem(
    mpm.Body(block, mpm.materials.LinearElastic(young, poisson)), bcs=bcs, terms=[ball]
)

# The force grows with the depth to the power of 3/2, and the far field with the force.

run = problem.steps(args.steps, update=lambda t: ball.move((0.0, 0.0, -depth * t ** (2.0 / 3.0))))
try:
    for _ in kit.progress(run, args.steps, args):
        pass
except mpm.MPMError as error:
    kit.report(args, kit.outcome(problem.history, error), (), error)

# The radius of contact is that of the second moment of the pressure, which has 2/5 of its square.
# The pressure is compared with Hertz's for the force that was found, in the mean of each facet.

x, p, w = ball.points, ball.pressure, ball.area
found = -4.0 * float(problem.reaction(ball)[2])
r2 = (x[:, :2] ** 2).sum(axis=1)
moment, whole = kit.total(w * p * r2), kit.total(w * p)
width = (0.75 * found * radius / stiff) ** (1.0 / 3.0)
exact = 1.5 * found / (np.pi * width**2) * np.sqrt(np.maximum(1.0 - r2 / width**2, 0.0))
each = {"hex": 4, "tet": 6}[args.domain]  # points of a facet, one after the other
sums = [(w * values).reshape(-1, each).sum(axis=1) for values in (p, exact, np.ones_like(p))]
errors = [kit.total((v**2) / np.maximum(sums[2], 1e-300)) for v in (sums[0] - sums[1], sums[1])]
numbers = {
    **kit.outcome(problem.history, None),
    "force": found,
    "error_force": abs(found / force - 1.0),
    "error_radius": abs(np.sqrt(2.5 * moment / whole) / a - 1.0),
    "error_pressure": float(np.sqrt(errors[0] / errors[1])),
    "error_most": abs(kit.largest(p) / most - 1.0),
    "halvings": problem.history.statistics["halvings"],
    "particles": block.num_global,
}
rows = [
    ("domains", f"{block.num_global} ({args.domain}), {args.cells} cells in the radius"),
    ("linear solves", f"{numbers['iterations']} in {len(problem.history.steps)} steps"),
    ("force", f"{found:.4f}, Hertz {force:.4f}"),
    ("error of the radius", f"{100 * numbers['error_radius']:.2f} %"),
    ("error of the pressure", f"{100 * numbers['error_pressure']:.2f} % in L2"),
    ("error of its maximum", f"{100 * numbers['error_most']:.2f} %"),
]
if args.plot:
    fig, axes = kit.figure(7.0, 4.5)
    points = [kit.gathered(values) for values in (np.sqrt(r2) / a, p / most)]
    if fig is not None:
        ax, s = axes["main"], np.linspace(0.0, 1.0, 200)
        ax.plot(s, np.sqrt(1.0 - s**2), color="0.2", label="Hertz", lw=1.2, ls="--")
        ax.plot(*points, ".", ms=3, color=kit.COLOURS["blue"], label=f"points, {args.law}")
        ax.set(xlim=(0.0, 1.4), ylim=(0.0, None), xlabel="r / a", ylabel="pressure over Hertz's")
        ax.legend()
    kit.save(fig, args)

kit.report(args, numbers, rows)

if args.default:
    assert numbers["error_force"] < 0.03 and numbers["error_radius"] < 0.03
    assert numbers["error_pressure"] < 0.08
