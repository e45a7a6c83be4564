# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Softening with a length: a sheared bar and a biaxial test, on grids of any fineness and angle.

The bar, 4 long, is held at one end and moved across at the other; its sides do not move along it.
So it is the same at each height, and has an exact answer: with the length l and the mixture
2 k - kappa of average and local strain, a band of half-width w = 3/4 pi l yields alone, and at the
stress of s = 2 k - kappa its ends have slipped by 2 sqrt(3) s (w + l).

The biaxial test is a specimen of 1 by 2 between smooth plates, the lower of which holds its
right half; a weak place on its left side begins a band at 45 degrees.

The width of a band is that of a uniform one with the same second moment: sqrt(12) times the
smaller standard deviation of places, weighed by the rate of the plastic strain in the last step.
``energy`` is the work done on the body, ``forces`` are the forces at tenths of the path.
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Softening with a length: width of a band and force on any grid.")
parser.add_argument("--case", choices=("bar", "biaxial"), default="bar", help="what is strained")
parser.add_argument(
    "--cells", type=kit.whole, default=16, help="background cells in a unit of length"
)
parser.add_argument("--angle", type=float, default=0.0, help="of the background grid, degrees")
parser.add_argument("--length", type=float, default=0.12, help="of the average; 0: none")
parser.add_argument(
    "--law", choices=("von-mises", "tresca", "drucker-prager"), default="von-mises", help="law"
)
parser.add_f_bar("patch")
parser.add_order()
parser.add_argument("--steps", type=kit.whole, default=24, help="steps")
args = parser.parse()

comm = MPI.COMM_WORLD
bar = args.case == "bar"
size = np.array([4.0, 0.25]) if bar else np.array([1.0, 2.0])
h = 1.0 / args.cells
path = 0.06  # displacement at the end
young, poisson, strength, residual, decay = 1000.0, 0.3, 1.0, 0.3, 15.0  # strength: in shear

# The body has two domains in each cell each way; the background is turned about its middle and
# reaches as far as the body comes.

counts = [max(1, round(2 * args.cells * side)) for side in size]
body = kit.box(list(size), counts, mesh.CellType.quadrilateral)
middle = 0.5 * size
turn = np.radians(args.angle)
low, high = -0.5 * size - path - h, 0.5 * size + path + h
if args.angle:
    c, s = abs(np.cos(turn)), abs(np.sin(turn))
    half = np.array([[c, s], [s, c]]) @ high
    low, high = -half, half
numbers_of_cells = np.ceil((high - low) / h).astype(int)
low = -0.5 * h * numbers_of_cells if args.angle else np.floor(low / h) * h
background = mesh.create_rectangle(
    comm, [low, low + h * numbers_of_cells], numbers_of_cells, mesh.CellType.quadrilateral
)
x = background.geometry.x
x[:, :2] = (
    x[:, :2] @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + middle
)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
if args.quadrature_degree is None and args.degree == 1:
    args.quadrature_degree = 2
particles = mpm.Particles(body, V, **kit.order(args))

# A weak place: 2 % less strength in the middle of the bar, 10 % on the left side of the specimen.

weak = np.array([0.5 * size[0], 0.0]) if bar else np.array([0.0, 0.5])
yields = fem.Function(fem.functionspace(body, ("Discontinuous Lagrange", 0)))


def weakened(X: np.ndarray) -> np.ndarray:
    """Strength in shear."""
    away = np.abs(X[0] - weak[0]) if bar else np.hypot(X[0] - weak[0], X[1] - weak[1])
    depth, size_of_it = (0.02, 0.1) if bar else (0.1, 0.16)
    return strength * (1.0 - depth * np.exp(-((away / size_of_it) ** 2)))


yields.interpolate(weakened)
if args.law == "von-mises":
    yields.x.array[:] *= np.sqrt(3.0)
    metal = mpm.materials.VonMises(young, poisson, yield_stress=yields)
    law: mpm.materials.Material = metal.with_softening(decay, residual=residual)
elif args.law == "tresca":
    clay = mpm.materials.Tresca(young, poisson, yields)
    law = clay.with_softening(decay, cohesion=residual * 0.97)
else:
    soil = mpm.materials.DruckerPrager(young, poisson, yields, 10.0, match="plane_strain")
    law = soil.with_softening(decay, cohesion=residual * 0.97)

# The plates.

sides = {
    1: lambda X: np.isclose(X[0], 0.0),
    2: lambda X: np.isclose(X[0], size[0]),
    3: lambda X: np.isclose(X[1], 0.0),
    4: lambda X: np.isclose(X[1], size[1]),
}
found = {tag: mesh.locate_entities_boundary(body, 1, where) for tag, where in sides.items()}
facets = np.concatenate(list(found.values()))
values = np.concatenate([np.full(len(f), tag, np.int32) for tag, f in found.items()])
order = np.argsort(facets)
tags = mesh.meshtags(body, 1, facets[order], values[order])
if bar:
    plate = mpm.boundary.fixed(particles, tags, 2, value=(0.0, path))
    supports = [mpm.boundary.fixed(particles, tags, 1), plate]
    supports += [mpm.boundary.roller(particles, tags, tag, normal=(1.0, 0.0)) for tag in (3, 4)]
else:
    plate = mpm.boundary.roller(particles, tags, 4, normal=(0.0, -1.0), value=path)
    foot = mpm.facet_tags(body, {1: mpm.region(x=(0.5, 1.0), y=0.0)})
    supports = [mpm.boundary.roller(particles, tags, 3, normal=(0.0, -1.0)), plate]
    supports += [mpm.boundary.roller(particles, foot, 1, normal=(1.0, 0.0))]

problem = mpm.QuasiStaticProblem(
    mpm.Body(particles, law, f_bar=args.f_bar, length=args.length or None),
    supports=supports,
    solver=mpm.Solver(petsc_options_prefix="softening_", stabilisation=kit.stabilisation(args)),
)

curve = [(0.0, 0.0)]
(points,) = problem.points
before = last = points.last.plastic_strain()
failure = None
sign, across = (1.0, size[1]) if bar else (-1.0, 1.0)
try:
    for step in kit.progress(problem.steps(args.steps), args.steps, args):
        curve.append((step.load * path, sign * problem.reaction(plate)[1] / across))
        before, last = last, points.last.plastic_strain()
except mpm.MPMError as error:
    failure = error

# Second moments of the plastic strain rate about its middle.

rate = points.strain.weights * (last - before)
nodes = particles.W.tabulate_dof_coordinates()[particles.domain_nodes, :2]
places = np.einsum("qk,nki->nqi", particles.undeformed.rule.shapes, nodes)
whole = max(kit.total(rate), 1e-300)
centre = np.array([kit.total(rate * places[:, :, i]) / whole for i in range(2)])
away = places - centre
moments = np.array(
    [[kit.total(rate * away[:, :, i] * away[:, :, j]) / whole for j in range(2)] for i in range(2)]
)
width = np.sqrt(12.0 * (moments[0, 0] if bar else np.linalg.eigvalsh(moments)[0]))
u, force = np.array(curve).T
numbers = {
    **kit.outcome(problem.history, failure),
    "peak": force.max(),
    "energy": np.trapezoid(force, u),
    "width": float(width),
    "forces": [float(np.interp(path * k / 10, u, force)) for k in range(1, 11)],
    "alternations": sum(step.alternations for step in problem.history.steps),
    "particles": particles.num_global,
}
rows = [
    ("peak of the force", f"{numbers['peak']:.4f}"),
    ("work done", f"{numbers['energy']:.5f}"),
    ("width of the band", f"{numbers['width']:.4f}"),
    ("alternations", f"{numbers['alternations']}"),
]
kit.report(args, numbers, rows, failure)
