# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A die is pressed into an elastic block and drawn along it: forces that should be steady.

demos/demo_ironing.py is its simplest form and has the equations. `scatter` is the standard
deviation of the normal force over its mean while the die slides, `ratio` the mean of the shear
force over the normal one there.
"""

import kit
import numpy as np

from dolfinx import fem

import mpm_dolfinx as mpm

parser = kit.Parser("A die is drawn along an elastic block.")
parser.add_argument("--friction", type=kit.positive, default=0.3, help="coefficient of friction")
parser.add_argument("--block", action="store_true", help="a flat die in place of a round one")
parser.add_argument("--stiff", action="store_true", help="a die 20 times as stiff as the block")
parser.add_argument("--passes", type=int, choices=(1, 2), default=2, help="of the contact")
parser.add_argument("--penalty", type=kit.positive, default=1.0, help="of the contact")
parser.add_argument("--steps", type=kit.whole, default=40, help="a fifth of them down")
args = parser.parse()

young, depth, way, radius, h = 1e3, 0.02, 1.4, 0.6, 0.125


def background(corner: tuple[float, float]) -> fem.FunctionSpace:
    """A background of its own, which need not match the other one."""
    domain = kit.box([36 * h, 14 * h], [36, 14], kit.DOMAINS["quad"])
    domain.geometry.x[:, :2] += corner
    return fem.functionspace(domain, ("Lagrange", 1, (2,)))


upper, lower = (
    kit.box(*shape, kit.DOMAINS["quad"]) for shape in (([0.8, 0.4], [10, 5]), ([3.0, 0.6], [48, 9]))
)
x = upper.geometry.x
if not args.block:
    arc = radius - np.sqrt(radius**2 - (x[:, 0] - 0.4) ** 2)
    x[:, 1] += arc * (1.0 - x[:, 1] / 0.4)
x[:, :2] += (0.3, 0.6)
die = mpm.Particles(upper, background((-0.47, -0.46)), quadrature_degree=2)
block = mpm.Particles(lower, background((-0.45, -0.49)), quadrature_degree=2)
touch = mpm.contact.Pair(die, block, args.friction, passes=args.passes, penalty=args.penalty)

top = mpm.facet_tags(upper, {1: mpm.region(y=1.0)})
base = mpm.facet_tags(lower, {1: mpm.region(y=0.0)})
position = fem.Constant(upper, (0.0, 0.0))
problem = mpm.QuasiStaticProblem(
    [
        mpm.Body(
            die, mpm.materials.Hencky(20.0 * young if args.stiff else young, 0.3), facet_tags=top
        ),
        mpm.Body(block, mpm.materials.Hencky(young, 0.3), facet_tags=base),
    ],
    supports=[mpm.boundary.fixed(die, top, 1, value=position), mpm.boundary.fixed(block, base, 1)],
    terms=[touch],
)


def path(t: float) -> None:
    """Move the die's top: down, then along."""
    position.value[:] = way * max(0.0, t - 0.2) / 0.8, -depth * min(1.0, t / 0.2)


forces, failure = [], None
run = problem.steps(args.steps, update=path)
try:
    for step in kit.progress(run, args.steps, args):
        shear, normal = problem.reaction(touch)
        forces.append((step.load, -float(shear), float(normal)))
except mpm.MPMError as error:
    failure = error
numbers = kit.outcome(problem.history, failure) | {"force": None, "scatter": None, "ratio": None}
rows = [("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks")]
t, shear, normal = np.array(forces or [(0.0, 0.0, 0.0)]).T
slides = t > 0.5
if slides.any():
    mean, ratios = float(normal[slides].mean()), shear[slides] / normal[slides]
    numbers |= {
        "force": mean,
        "scatter": float(normal[slides].std()) / mean,
        "ratio": float(ratios.mean()),
        "ratio_least": float(ratios.min()),
        "ratio_most": float(ratios.max()),
    }
    rows += [
        ("normal force while it slides", f"{mean:.3f}, scatter {100 * numbers['scatter']:.2f} %"),
        ("shear over normal force", f"{numbers['ratio']:.4f}"),
    ]
if args.plot:
    fig, axes = kit.figure(8.0, 4.0)
    if fig is not None:
        axes["main"].plot(t, normal, color=kit.COLOURS["blue"], label="normal force")
        axes["main"].plot(t, shear, color=kit.COLOURS["orange"], label="shear force")
        axes["main"].set(xlabel="t", ylabel="force on the die", ylim=(0.0, None))
        axes["main"].legend()
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)

if args.default:
    assert numbers["completed"] and numbers["cutbacks"] == 0
    assert numbers["scatter"] < 5e-3 and abs(numbers["ratio"] - 0.298) < 2e-3
