# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A cone penetrates clay deep below its surface: the cone factor of a CPT.

A cone of 60 degrees and radius 1 stands in Tresca clay of strength 1 that fits around it and its
shaft, and is pushed down by two diameters. Lu et al. (2004) found 3.4 + 1.6 ln(G/c) for a smooth
one. As in demos/demo_pile.py the clay has a hole on the axis, filled by a thin smooth rod, so that
it parts below the tip.

What the cone displaces must go somewhere: clay that hardly changes volume, held on all sides, takes
it up as a pressure that grows with the way. So the side and the top bear the pressure of the ground
instead, and the cone is steady from three radii of way on.

`factor` is the resistance over section and strength in the mean of the last radius, `rise` what it
has grown by from the radius before, relative: it is not steady where that is not small.
"""

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("A cone is pushed into clay: cone factor.")
parser.add_argument("--rigidity", type=kit.positive, default=100.0, help="shear modulus over c")
parser.add_argument("--cell", type=kit.positive, default=0.25, help="background cell over radius")
parser.add_argument("--friction", type=float, default=0.0, help="coefficient of friction")
parser.add_argument("--depth", type=kit.positive, default=5.0, help="how far, in radii")
parser.add_argument("--hole", type=kit.positive, default=0.25, help="radius of the rod")
parser.add_argument("--before", type=kit.positive, default=8.0, help="pressure in the clay, over c")
parser.add_argument("--steps", type=kit.whole, help="25 for a radius by default")
parser.add_f_bar("patch")
args = parser.parse()

h, depth, hole, before = args.cell, args.depth, args.hole, args.before
shear, poisson = args.rigidity, 0.49
steps = args.steps or round(25.0 * depth)
height = 1.0 / np.tan(np.radians(30.0))  # of the cone
wide, above, below = round(4.0 * np.sqrt(args.rigidity)), 14.0, 20.0 + depth

# The clay's lines bend around the cone: where it stands they begin at its surface.

across = mpm.grid_lines(0.0, wide, h, equal=(0.0, 2.5))
up = mpm.grid_lines(-below, above, h, equal=(-depth - 1.5, height + 0.5))
room = [np.append(along, 2.0 * along[-1] - along[-2]) for along in (across, up)]
V = fem.functionspace(kit.grid(room, mesh.CellType.quadrilateral), ("Lagrange", 1, (2,)))
clay = kit.grid([kit.divided(across, 2), kit.divided(up, 2)], mesh.CellType.quadrilateral)
r, z = clay.geometry.x[:, 0], clay.geometry.x[:, 1]
inner = np.clip(z / height, hole, 1.0)
clay.geometry.x[:, 0] = inner + (wide - inner) * (r / wide) ** (1.0 + 0.1 * inner)

particles = mpm.Particles(clay, V, quadrature_degree=args.quadrature_degree or 2)
aside, top = mpm.region(x=wide), mpm.region(y=above)
inside = {1: lambda x: x[0] <= np.clip(x[1] / height, hole, 1.0) + 1e-9}
tags = mpm.facet_tags(clay, inside | {2: lambda x: aside(x) | top(x)})
look = {"facets": (tags, 1), "axisymmetric": True, "modulus": 4.0 * shear}
outline = [(0.0, 0.0), (1.0, height), (1.0, 60.0), (-1.0, 60.0), (-1.0, height)]
steel = mpm.contact.polygon(outline, radius=0.3)
cone = mpm.contact.Rigid(particles, steel, args.friction, **look)
rod = mpm.contact.Rigid(particles, mpm.contact.box((-hole, -80.0), (hole, 80.0)), **look)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        mpm.materials.Tresca(2.0 * (1.0 + poisson) * shear, poisson, 1.0),
        pressures=[(before, 2)],
        facet_tags=tags,
        f_bar=args.f_bar,
        initial_stress=-before * np.eye(3),
    ),
    bcs=[mpm.held(V, 1, y=-below)],
    terms=[cone, rod],
    axisymmetric=True,
)

# The clay presses on cone and rod first. What the rod fills is no part of the section.

path, failure = [(0.0, 0.0)], None
run = problem.steps(steps, update=lambda t: cone.move((0.0, -depth * t)))
try:
    problem.solve(1)
    for step in kit.progress(run, steps, args):
        pressure = -float(problem.reaction(cone)[1]) / (np.pi * (1.0 - hole**2))
        path.append((depth * step.load, pressure - before))
except mpm.MPMError as error:
    failure = error
down, factors = np.array(path).T
numbers = kit.outcome(problem.history, failure) | {
    "factor": None,
    "exact": 3.4 + 1.6 * np.log(args.rigidity),
    "rise": None,
    "particles": particles.num_global,
}
rows = [("way", f"{down[-1]:.2f} radii, {numbers['iterations']} linear solves")]
if failure is None:
    late, early = down > depth - 1.0, (down > depth - 2.0) & (down <= depth - 1.0)
    numbers["factor"] = float(factors[late].mean())
    rows.append(("cone factor", f"{numbers['factor']:.3f}, Lu et al. {numbers['exact']:.3f}"))
    if depth >= 2.0:
        numbers["rise"] = numbers["factor"] / float(factors[early].mean()) - 1.0
        rows.append(("rise over a radius", f"{100.0 * numbers['rise']:.1f} %"))
if args.plot:
    fig, axes = kit.figure(5.0, 5.0)
    if fig is not None:
        axes["main"].plot(factors, -down, color=kit.COLOURS["blue"])
        axes["main"].axvline(numbers["exact"], color="0.2", lw=1.2, ls="--")
        axes["main"].set(xlabel="cone factor", ylabel="way, radii")
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)
