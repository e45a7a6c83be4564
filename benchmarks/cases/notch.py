# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plates that crack, to the end: a phase field of fracture on the body's own mesh.

- `tension`: the notched square of Miehe, Hofacker & Welschinger (2010): 1 mm wide, notched to its
  middle, E = 210 kN/mm2, nu = 0.3, G_c = 2.7e-3 kN/mm. The crack runs straight through.
- `shear`: the same square, whose upper side moves along; the crack turns downwards.
- `l-panel`: Winkler's (2001) panel of concrete, 500 mm wide, lifted 30 mm from the end of its arm:
  E = 25.85 kN/mm2, nu = 0.18, G_c = 8.9e-5 kN/mm; forces are those of its 100 mm. Its crack runs
  from the corner through the leg, as in the test; its peak is not to be compared with that: a
  phase field of 20 mm has a strength of 6.6 N/mm2, concrete one of 2.7.
- `rubber`: a neo-Hookean plate with a notch of a fifth of its width, pulled to three times its
  height; it breaks on the way.

`--cells` counts cells of the background over the length of the phase field; those of the body are
half as wide. `peak` is the largest force, `energy` the energy that the crack has taken over that
of its length with the toughness on this mesh (`1 + 3 h / (8 l)` times the given one with AT1,
`1 + h / (2 l)` with AT2), where its length is known beforehand (tension, rubber), or else that
energy itself; `crack_length` how far what is broken reaches from the notch. `energy_end` is all
energy, stored and in cracks.
"""

from mpi4py import MPI

import kit
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Fracture, Hencky, LinearElastic, NeoHooke

parser = kit.Parser("Plates that crack, to the end.")
parser.add_argument(
    "--case", choices=("tension", "shear", "l-panel", "rubber"), default="tension", help="which"
)
parser.add_argument("--cells", type=kit.whole, default=2, help="background cells a length")
parser.add_argument(
    "--solver",
    choices=("staggered", "monolithic"),
    default="staggered",
    help="displacements and damage in turn, or by one Newton's method (tension and shear)",
)
parser.add_argument("--model", choices=("AT1", "AT2"), default="AT1", help="of the phase field")
parser.add_argument("--split", choices=("volumetric", "spectral", "none"), help="of the energy")
parser.add_argument("--strain", choices=("small", "large"), default="small", help="of metals")
parser.add_argument("--body", choices=("carried", "free"), default="carried", help="or free nodes")
parser.add_argument("--length", type=kit.positive, help="of the phase field")
parser.add_argument("--steps", type=kit.whole, help="load steps")
parser.add_argument("--reach", type=kit.positive, help="displacement at the end")
args = parser.parse()
comm = MPI.COMM_WORLD

# size, where it may crack (x, y), tip of the notch, ligament, law, toughness, length, end, steps

WHOLE = {"tension": 0.01, "rubber": 0.05}  # share of the peak at which it is broken
PANEL = ((0.0, 280.0), (220.0, 340.0), (250.0, 250.0), None, 8.9e-5, 20.0, 0.8, 40)
SCENES = {
    "tension": ((1.0, 1.0), (0.42, 1.0), (0.4, 0.6), (0.5, 0.5), 0.5, 2.7e-3, 0.05, 7e-3, 40),
    "shear": ((1.0, 1.0), (0.42, 1.0), (0.0, 0.56), (0.5, 0.5), None, 2.7e-3, 0.04, 0.016, 50),
    "l-panel": ((500.0, 500.0), *PANEL),
    "rubber": ((1.0, 1.0), (0.1, 1.0), (0.38, 0.62), (0.2, 0.5), 0.8, 1.05, 0.06, 2.1, 60),
}
size, fine_x, fine_y, tip, ligament, toughness, length, reach, steps = SCENES[args.case]
length, reach = args.length or length, args.reach or reach
number = args.steps or steps
young, poisson = (25.85, 0.18) if args.case == "l-panel" else (210.0, 0.3)
split = args.split or ("spectral" if args.case == "shear" else "volumetric")
elastic = {"small": LinearElastic, "large": Hencky}[args.strain](young, poisson)
if args.case == "rubber":
    elastic = NeoHooke(1.0, 0.3)
law = Fracture(elastic, toughness, length, model=args.model, split=split)
h = length / args.cells
coarse = 0.04 if args.case == "l-panel" else 0.1  # largest cells over the size


def lines(lower: float, upper: float, first: float, last: float) -> np.ndarray:
    """Lines h apart where it may crack, with one cell's middle at the notch; wider outside."""

    def outwards(gap: float) -> np.ndarray:
        steps, width = [0.0], h
        while steps[-1] < gap - 1e-9:
            width = min(1.4 * width, coarse * (upper - lower))
            steps.append(steps[-1] + width)
        return np.array(steps) * (gap / steps[-1] if steps[-1] > 0 else 1.0)

    inner = first + h * np.arange(round((last - first) / h) + 1)
    before, after = outwards(first - lower), outwards(upper - inner[-1])
    return np.concatenate([(first - before)[:0:-1], inner, (inner[-1] + after)[1:]])


def around(low: float, high: float, middle: float, end: float, half: bool) -> tuple:
    """A stretch of lines that hits the ends of the body, and a middle (of a cell)."""
    most = np.floor(round(middle / h - 0.5 * half, 6))
    below = min(np.ceil(round((middle - low) / h, 6)), most) + 0.5 * half
    high = middle + np.ceil(round((high - middle) / h, 6)) * h + 0.5 * h * half
    return middle - below * h, high if high < end - h else end


slit = args.case != "l-panel"
width = h if args.body == "free" else 3 * h  # what lies in one cell moves together
places = [
    lines(0.0, size[0], *around(*fine_x, tip[0], size[0], False)),
    lines(0.0, size[1], *around(*fine_y, tip[1], size[1], slit)),
]
parts = 1 if args.body == "free" else 2
whole = kit.grid([kit.divided(along, parts) for along in places], kit.DOMAINS["quad"])
owned = np.arange(whole.topology.index_map(2).size_local, dtype=np.int32)
x, y = mesh.compute_midpoints(whole, 2, owned)[:, :2].T
gone = (x < tip[0]) & (np.abs(y - tip[1]) < 0.5 * width)
if args.case == "l-panel":
    gone = (x > tip[0]) & (y < tip[1])
body = mesh.create_submesh(whole, 2, np.flatnonzero(~gone).astype(np.int32))[0]
V = None
if args.body == "carried":
    room = [(0.15, 0.15), (0.15, 0.15 + reach / size[1] * (args.case != "shear"))]
    padded = []
    for along, (below, above), extent in zip(places, room, size, strict=True):
        more = np.arange(1, int(np.ceil(above * extent / (0.1 * extent))) + 1) * 0.1 * extent
        padded.append(np.concatenate([[-below * extent], along, along[-1] + more]))
    V = fem.functionspace(kit.grid(padded, kit.DOMAINS["quad"]), ("Lagrange", 1, (2,)))
particles = mpm.Particles(body, V, quadrature_degree=2)

if args.case == "l-panel":
    pulled = mpm.region(x=(450.0, 490.0), y=250.0)
    bottom = mpm.region(x=(0.0, 250.0), y=0.0)
else:
    pulled, bottom = mpm.region(y=size[1]), mpm.region(y=0.0)
tags = mpm.facet_tags(body, {1: pulled, 2: bottom})
goal = (reach, 0.0) if args.case == "shear" else (0.0, reach)
along = 0 if args.case == "shear" else 1
if args.case == "l-panel":
    grip = mpm.boundary.roller(particles, tags, 1, (0.0, 1.0), reach)
else:
    grip = mpm.boundary.fixed(particles, tags, 1, value=goal)
held = mpm.boundary.fixed(particles, tags, 2)


def monolithic() -> tuple[mpm.ParticleProblem, mpm.ParticleField, float]:
    """The same energy in UFL, all unknowns at once; a penalty keeps damage from falling."""
    d = particles.field(fem.functionspace(body, ("Lagrange", 1)), "nodes", "body", "damage")
    u, dx = particles.displacement, particles.dx
    strain = ufl.sym(ufl.grad(u))
    volume = ufl.tr(strain)
    deviator = ufl.inner(strain, strain) - volume**2 / 3
    grown = ufl.conditional(ufl.gt(volume, 0), volume, 0.0)
    driving = law.law.bulk / 2 * grown**2 + law.law.shear * deviator
    rest = law.law.bulk / 2 * (volume - grown) ** 2
    slope = ufl.dot(ufl.grad(d), ufl.grad(d))
    if args.model == "AT1":
        surface = 3 * toughness / 8 * (d / length + length * slope)
        penalty = toughness / length * 27 / 64 * 1e4
    else:
        surface = toughness / 2 * (d**2 / length + length * slope)
        penalty = toughness / length * 1e4
    fallen = ufl.conditional(ufl.le(d, d.previous), d - d.previous, 0.0)
    energy = (((1 - d) ** 2 + 1e-6) * driving + rest + surface + penalty / 2 * fallen**2) * dx
    over = particles.load * ufl.as_vector(goal)
    ds = ufl.Measure("ds", body, subdomain_data=tags)
    stiff = 1e3 * young
    grips = stiff / 2 * (ufl.dot(u - over, u - over) * ds(1) + ufl.dot(u, u) * ds(2))
    v, q = ufl.TestFunction(particles.W), ufl.TestFunction(d.W)
    R = [ufl.derivative(energy + grips, u, v), ufl.derivative(energy, d, q)]
    problem = mpm.ParticleProblem(R, particles, fields=[d], symmetric=True)
    problem.forms = (  # type: ignore[attr-defined]
        fem.form(-stiff * (u - over)[along] * ds(1)),
        fem.form(surface * dx),
        fem.form((((1 - d) ** 2 + 1e-6) * driving + rest) * dx),
    )
    return problem, d


if args.solver == "monolithic":
    if args.case not in ("tension", "shear") or args.strain != "small" or split != "volumetric":
        parser.error("--solver monolithic is for tension and shear, small, --split volumetric")
    problem, damage = monolithic()
else:
    made = mpm.Body(particles, law)
    if args.case == "l-panel":  # whole around the load
        owned = np.arange(particles.num_local, dtype=np.int32)
        end = mesh.compute_midpoints(body, 2, owned)[:, 0] > 400.0
        parts_of = mesh.meshtags(body, 2, owned, np.where(end, 2, 1).astype(np.int32))
        made = mpm.Body(particles, {1: law, 2: elastic}, cell_tags=parts_of)
    problem = mpm.QuasiStaticProblem(made, supports=[grip, held])
    damage = problem.damage[0].field


def measured() -> tuple[float, float, float]:
    """Force, energy of the crack, energy that is stored."""
    if args.solver == "monolithic":
        values = [kit.total(fem.assemble_scalar(form)) for form in problem.forms]
        return values[0], values[1], values[2]
    points = problem.points[0]
    stored = kit.total(points.strain_energy() * points.weights.ravel())
    return float(problem.reaction(grip)[along]), problem.damage[0].surface_energy(), stored


failure, rows, fallen = None, [(0.0, 0.0, 0.0, 0.0)], 0.0
before = damage.x.array.copy()
scale = 100.0 if args.case == "l-panel" else 1.0
try:
    for step in kit.progress(problem.steps(number), number, args):
        fallen = max(fallen, kit.largest(before - damage.x.array))
        before = damage.x.array.copy()
        rows.append((step.load * reach, *measured()))
        top = max(row[1] for row in rows)
        if args.case in WHOLE and rows[-1][1] < WHOLE[args.case] * top:
            break
except mpm.MPMError as told:
    failure = told

path, force, surface, stored = np.array(rows).T
nodes = damage.function_space.tabulate_dof_coordinates()[:, :2]
broken = damage.x.array > 0.9
away = np.linalg.norm(nodes[broken] - tip, axis=1)
share = 3 / 8 if args.model == "AT1" else 1 / 2
seen = toughness * (1 + share * h / length)
statistics = problem.history.statistics
numbers = {
    "peak": scale * force.max(),
    "energy": surface[-1] / (seen * ligament) if ligament else scale * surface[-1],
    "crack_length": max(kit.largest(away), 0.0),
    "energy_end": surface[-1] + stored[-1],
    "peak_at": path[force.argmax()],
    "fallen": fallen,
    "alternations": int(statistics["alternations"]),
    "field_solves": int(statistics["field_solves"]),
    "curve": np.stack([path, scale * force, surface, stored], axis=1).tolist(),
}
if args.plot:
    mpm.plot.scene(problem, "damage", path=args.plot, background=False, cmap="magma_r")
table = [
    ("peak", f"{numbers['peak']:.4f} at {numbers['peak_at']:.4g}"),
    ("energy of the crack", f"{numbers['energy']:.4f}"),
    ("crack reaches", f"{numbers['crack_length']:.4f}"),
    ("alternations", f"{numbers['alternations']}"),
]
kit.report(args, kit.outcome(problem.history, failure) | numbers, table, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert abs(numbers["energy"] - 1.0) < 0.05
    assert numbers["fallen"] <= 1e-10
