# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A block lies on a rough plane and the direction of its weight turns, until it slides.

That is where the weight makes an angle of `atan(friction)` with the plane's normal. The plane may
be tilted against the background. `stick_angle` is the last angle, in degrees, at which there was
equilibrium, `ratio` the shear force on the plane over the normal force there. Steps are halved
until no smaller one helps, so the run ends with an error, which is the answer: `completed` tells
that the block slid.
"""

import kit
import numpy as np

from dolfinx import fem

import mpm_dolfinx as mpm

parser = kit.Parser("A block on a rough plane, under a weight that turns.")
parser.add_argument("--friction", type=kit.positive, default=0.3, help="coefficient of friction")
parser.add_argument(
    "--tilt", type=float, default=0.0, help="of the plane against the grid, degrees"
)
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument("--steps", type=kit.whole, default=50, help="to 1.23 times the exact angle")
args = parser.parse()

turn = np.radians(args.tilt)
along, normal = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
weight = 100.0  # of an area, where Young's modulus is 1e4

# The block is 1 x 0.5, and stands with a corner off the lines of the background.

V = fem.functionspace(kit.box([3.5, 3.5], [14, 14], kit.DOMAINS["quad"]), ("Lagrange", 1, (2,)))
body = kit.box([1.0, 0.5], [8, 4], kit.DOMAINS[args.domain])
corner = np.array([1.03, 1.07])
body.geometry.x[:, :2] = corner + body.geometry.x[:, :2] @ np.array([along, normal])
block = mpm.Particles(body, V, quadrature_degree=2 if args.domain == "quad" else None)
plane = mpm.contact.Rigid(block, mpm.contact.plane(corner, normal), args.friction)
force = fem.Constant(body, (0.0, 0.0))
problem = mpm.QuasiStaticProblem(
    mpm.Body(block, mpm.materials.Hencky(1e4, 0.3), density=1.0, body_force=force),
    terms=[plane],
)

# The weight grows in the first quarter of the path, then it turns. No step ends at the exact angle.

exact = np.degrees(np.arctan(args.friction))


def angle(t: float) -> float:
    """Of the weight with the normal at a place of the path, in degrees."""
    return 1.23 * exact * max(t - 0.25, 0.0) / 0.75


def path(t: float) -> None:
    """Turn the weight."""
    a = np.radians(angle(t))
    direction = np.sin(a) * along - np.cos(a) * normal
    block.load.value = 1.0
    force.value[:] = weight * min(4.0 * t, 1.0) * direction


found, ratio, failure = 0.0, 0.0, None
run = problem.steps(args.steps, update=path)
try:
    for step in kit.progress(run, args.steps, args):
        reaction = problem.reaction(plane)
        found, ratio = angle(step.load), -float(reaction @ along / (reaction @ normal))
except mpm.ConvergenceError as error:
    failure = error
slid = failure is not None and found > 0.0
numbers = kit.outcome(problem.history, None if slid else failure) | {
    "completed": int(slid),
    "stick_angle": found,
    "exact": exact,
    "ratio": ratio,
}
rows = [
    ("last angle of equilibrium", f"{found:.4f} degrees, exact {exact:.4f}"),
    ("shear over normal force", f"{ratio:.6f}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
]
if args.plot:
    fig, axes = kit.figure(6.0, 5.0)
    mpm.plot.scene(problem, ax=axes["main"])
    kit.save(fig, args)
kit.report(args, numbers, rows, None if slid else failure)

if args.default:
    assert slid and abs(found - exact) < 0.008
