# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plates that crack, to the end: a phase field of fracture on the body's own mesh.

- `tension`: the notched square of Miehe, Hofacker & Welschinger (2010): 1 mm wide, notched to its
  middle, E = 210 kN/mm2, nu = 0.3, G_c = 2.7e-3 kN/mm. The crack runs straight through.
- `shear`: the same square, whose upper side moves along while no side moves across; the crack turns
  downwards.
- `l-panel`: Winkler's (2001) panel of concrete, 500 mm wide, lifted 30 mm from the end of its arm:
  E = 25.85 kN/mm2, nu = 0.18, G_c = 8.9e-5 kN/mm; forces are those of its 100 mm. Its crack runs
  from the corner through the leg, as in the test; its peak is not to be compared with that: a
  phase field of 20 mm has a strength of 6.6 N/mm2, concrete one of 2.7.
- `rubber`: a neo-Hookean plate with a notch of a fifth of its width, pulled to three times its
  height; it breaks on the way.

`--solver stock` is the same by stock DOLFINx on the body's mesh. `--cells` counts cells of the
background over the length of the phase field; those of the body are half as wide. `peak` is the
largest force, `energy` the energy that the crack has taken over that of its length with the
toughness on this mesh (`1 + 3 h / (8 l)` times the given one with AT1, `1 + h / (2 l)` with AT2),
where its length is known beforehand (tension, rubber), or else that
energy itself; `crack_length` how far what is broken reaches from the notch. `energy_end` is all
energy, stored and in cracks.
"""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import kit
import numpy as np

import ufl
from dolfinx import fem, mesh
from dolfinx.fem import petsc

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Fracture, Hencky, LinearElastic, NeoHooke

parser = kit.Parser("Plates that crack, to the end.")
parser.add_argument(
    "--case", choices=("tension", "shear", "l-panel", "rubber"), default="tension", help="which"
)
parser.add_argument("--cells", type=kit.whole, default=2, help="background cells a length")
parser.add_argument(
    "--solver",
    choices=("staggered", "monolithic", "stock"),
    default="staggered",
    help="displacements and damage in turn, by one Newton's method (tension and shear), or in turn "
    "by stock DOLFINx",
)
parser.add_argument("--model", choices=("AT1", "AT2"), default="AT1", help="of the phase field")
parser.add_argument("--split", choices=("volumetric", "spectral", "none"), help="of the energy")
parser.add_argument("--strain", choices=("small", "large"), default="small", help="of metals")
parser.add_argument("--body", choices=("carried", "free"), default="carried", help="or free nodes")
parser.add_argument("--slit", type=kit.positive, help="width of the notch over cells, if free")
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

    inner = first + h * np.arange(int((last - first) / h + 1e-6) + 1)
    before, after = outwards(first - lower), outwards(upper - inner[-1])
    return np.concatenate([(first - before)[:0:-1], inner, (inner[-1] + after)[1:]])


def around(low: float, high: float, middle: float, end: float, half: bool) -> tuple:
    """A stretch of lines that hits the ends of the body, and a middle (of a cell)."""
    most = np.floor(round(middle / h - 0.5 * half, 6))
    below = min(np.ceil(round((middle - low) / h, 6)), most) + 0.5 * half
    high = middle + np.ceil(round((high - middle) / h, 6)) * h + 0.5 * h * half
    return middle - below * h, high if high < end - h else end


slit = args.case != "l-panel"
width = (args.slit or 1.0) * h if args.body == "free" else 3 * h  # (one cell moves together)
end = 450.0 if args.case == "l-panel" else size[0]
places = [
    lines(0.0, end, *around(*fine_x, tip[0], end, False)),
    lines(0.0, size[1], *around(*fine_y, tip[1], size[1], slit)),
]
if args.case == "l-panel":
    places[0] = np.append(places[0], [470.0, 490.0, 500.0])
if slit and width < h:
    places[1] = np.sort(np.append(places[1], [tip[1] - width / 2, tip[1] + width / 2]))
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
where = {1: pulled, 2: bottom}
if args.case == "shear":
    where |= {3: mpm.region(x=0.0), 4: mpm.region(x=size[0])}
tags = mpm.facet_tags(body, where)
goal = (reach, 0.0) if args.case == "shear" else (0.0, reach)
along = 0 if args.case == "shear" else 1
if args.case == "l-panel":
    grip = mpm.boundary.roller(particles, tags, 1, (0.0, 1.0), reach)
else:
    grip = mpm.boundary.fixed(particles, tags, 1, value=goal)
held = [mpm.boundary.fixed(particles, tags, 2)]
if args.case == "shear":
    held += [mpm.boundary.roller(particles, tags, side, (0.0, 1.0)) for side in (3, 4)]


def energies(u: fem.Function) -> tuple[ufl.core.expr.Expr, ufl.core.expr.Expr]:
    """The energy that degrades and the rest, in UFL."""
    strain, shear = ufl.sym(ufl.grad(u)), elastic.shear
    volume, square = ufl.tr(strain), ufl.inner(strain, strain)

    def parted(value: ufl.core.expr.Expr) -> tuple[ufl.core.expr.Expr, ufl.core.expr.Expr]:
        above = ufl.conditional(ufl.gt(value, 0), value, 0.0)
        return above, value - above

    if split == "spectral":
        lame = elastic.bulk - 2 / 3 * shear
        radius = ufl.sqrt(square / 2 - volume**2 / 4 + 1e-24)
        parts = [parted(volume / 2 + radius), parted(volume / 2 - radius)]
        energies = [
            lame / 2 * of_volume**2 + shear * sum(one**2 for one in values)
            for of_volume, *values in zip(parted(volume), *parts, strict=True)
        ]
        return energies[0], energies[1]
    pressed = parted(volume)[1] if split == "volumetric" else 0.0 * volume
    rest = elastic.bulk / 2 * pressed**2
    return elastic.bulk / 2 * volume**2 + shear * (square - volume**2 / 3) - rest, rest


def surface_of(d: fem.Function) -> ufl.core.expr.Expr:
    """The energy that cracks take, in UFL."""
    weight, shape = (8 / 3, d) if args.model == "AT1" else (2.0, d**2)
    return toughness / weight * (shape / length + length * ufl.dot(ufl.grad(d), ufl.grad(d)))


def monolithic() -> tuple[mpm.ParticleProblem, mpm.ParticleField]:
    """The same energy in UFL, all unknowns at once; a penalty keeps damage from falling."""
    d = mpm.ParticleField(
        particles, fem.functionspace(body, ("Lagrange", 1)), "nodes", "body", "damage"
    )
    u, dx = particles.displacement, particles.dx
    (driving, rest), surface = energies(u), surface_of(d)
    penalty = toughness / length * (27 / 64 if args.model == "AT1" else 1.0) * 1e4
    fallen = ufl.conditional(ufl.le(d, d.previous), d - d.previous, 0.0)
    energy = (((1 - d) ** 2 + 1e-6) * driving + rest + surface + penalty / 2 * fallen**2) * dx
    over = particles.load * ufl.as_vector(goal)
    ds = ufl.Measure("ds", body, subdomain_data=tags)
    stiff = 1e3 * young
    grips = stiff / 2 * (ufl.dot(u - over, u - over) * ds(1) + ufl.dot(u, u) * ds(2))
    if args.case == "shear":
        grips += stiff / 2 * u[1] ** 2 * ds((3, 4))
    v, q = ufl.TestFunction(particles.W), ufl.TestFunction(d.W)
    R = [ufl.derivative(energy + grips, u, v), ufl.derivative(energy, d, q)]
    problem = mpm.ParticleProblem(R, particles, fields=[d], symmetric=True)
    problem.forms = (  # type: ignore[attr-defined]
        fem.form(-stiff * (u - over)[along] * ds(1)),
        fem.form(surface * dx),
        fem.form((((1 - d) ** 2 + 1e-6) * driving + rest) * dx),
    )
    return problem, d


class Stock:
    """The same by stock DOLFINx on the body's mesh: alternate minimisation, bounds by PETSc.

    Nothing of this package is in it but the mesh and its tags.
    """

    def __init__(self) -> None:
        W = fem.functionspace(body, ("Lagrange", 1, (2,)))
        Q = fem.functionspace(body, ("Lagrange", 1))
        self.u, self.d = fem.Function(W), fem.Function(Q)
        self._least, self._most = fem.Function(Q), fem.Function(Q)
        self._most.x.array[:] = 1.0
        if args.case == "l-panel":
            self._most.interpolate(lambda x: 1.0 * (x[0] < 400.0))
        dx = ufl.Measure("dx", body, metadata={"quadrature_degree": 2})
        driving, rest = energies(self.u)
        stored = (((1 - self.d) ** 2 + 1e-6) * driving + rest) * dx
        surface = surface_of(self.d) * dx
        self._force = ufl.derivative(stored, self.u, ufl.TestFunction(W))
        self._grip = fem.Constant(body, 0.0)
        pulled = [(1, along, self._grip)]
        if args.case != "l-panel":
            pulled.append((1, 1 - along, fem.Constant(body, 0.0)))
        held = [(2, i) for i in range(2)] + [(3, 1), (4, 1)] * (args.case == "shear")
        pulled += [(tag, i, fem.Constant(body, 0.0)) for tag, i in held]
        bcs = []
        for tag, i, value in pulled:
            dofs = fem.locate_dofs_topological(W.sub(i), 1, tags.find(tag))
            bcs.append(fem.dirichletbc(value, dofs, W.sub(i)))
        self._gripped = fem.locate_dofs_topological(W.sub(along), 1, tags.find(1))
        direct = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
        limits = {"snes_rtol": 1e-8, "snes_stol": 0.0, "snes_atol": 1e-8 * toughness * h}
        self._elastic = petsc.NonlinearProblem(
            self._force,
            self.u,
            bcs=bcs,
            petsc_options_prefix="u_",
            petsc_options=direct | limits,
        )
        self._cracks = petsc.NonlinearProblem(
            ufl.derivative(stored + surface, self.d, ufl.TestFunction(Q)),
            self.d,
            petsc_options_prefix="d_",
            petsc_options=direct | limits | {"snes_type": "vinewtonrsls"},
        )
        self._cracks.solver.setVariableBounds(self._least.x.petsc_vec, self._most.x.petsc_vec)
        self._residual = fem.form(self._force)
        self._energies = fem.form(surface), fem.form(stored)
        self.alternations = self.iterations = 0

    def steps(self, number: int) -> Iterator[SimpleNamespace]:
        """Go up in equal steps."""
        for load in np.arange(1, number + 1) / number:
            self._grip.value = load * reach
            for _ in range(2000):
                before = self.d.x.array.copy()
                for problem in (self._elastic, self._cracks):
                    problem.solve()
                    reason = problem.solver.getConvergedReason()
                    if reason < 0:
                        raise mpm.MPMError(f"PETSc's SNES stops with {reason}.")
                self.alternations += 1
                self.iterations += self._elastic.solver.getIterationNumber()
                if kit.largest(np.abs(self.d.x.array - before)) < 1e-4:
                    break
            self._least.x.array[:] = self.d.x.array
            yield SimpleNamespace(load=load)

    def measured(self) -> tuple[float, float, float]:
        residual = petsc.assemble_vector(self._residual)
        residual.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        owned = len(residual.array_r)
        force = kit.total(residual.array_r[self._gripped[self._gripped < owned]].sum())
        surface, stored = (kit.total(fem.assemble_scalar(form)) for form in self._energies)
        return force, surface, stored


if args.solver != "staggered" and (args.case == "rubber" or args.strain != "small"):
    parser.error("--solver monolithic and stock are for small strain")
if args.solver == "stock":
    problem = Stock()
    damage = problem.d
elif args.solver == "monolithic":
    if args.case not in ("tension", "shear") or split != "volumetric":
        parser.error("--solver monolithic is for tension and shear, --split volumetric")
    problem, damage = monolithic()
else:
    made = mpm.Body(particles, law)
    if args.case == "l-panel":  # whole around the load
        owned = np.arange(particles.num_local, dtype=np.int32)
        end = mesh.compute_midpoints(body, 2, owned)[:, 0] > 400.0
        parts_of = mesh.meshtags(body, 2, owned, np.where(end, 2, 1).astype(np.int32))
        made = mpm.Body(particles, {1: law, 2: elastic}, cell_tags=parts_of)
    problem = mpm.QuasiStaticProblem(made, supports=[grip, *held])
    damage = problem.damage[0].field


def measured() -> tuple[float, float, float]:
    """Force, energy of the crack, energy that is stored."""
    if args.solver == "stock":
        return problem.measured()
    if args.solver == "monolithic":
        values = [kit.total(fem.assemble_scalar(form)) for form in problem.forms]
        return values[0], values[1], values[2]
    points = problem.points[0]
    stored = kit.total(points.last.strain_energy() * points.strain.weights.ravel())
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


def middle() -> list[list[float]]:
    """Where the crack is, as a mean over what is broken in strips of a length across its way."""
    across = 1 if args.case == "shear" else 0
    owned = damage.function_space.dofmap.index_map.size_local
    weights = np.maximum(damage.x.array[:owned] - 0.5, 0.0)
    strips = np.floor(nodes[:owned, across] / length).astype(int)
    found = []
    for strip in range(round(size[across] / length) + 1):
        own = weights * (strips == strip)
        sum_of = kit.total(own)
        if sum_of > 0.0:
            found.append([kit.total(own * x) / sum_of for x in nodes[:owned].T])
    return found


if args.solver == "stock":
    ended: dict[str, Any] = {"completed": 1, "load": path[-1] / reach, "failure": None}
    ended |= {"iterations": problem.iterations, "cutbacks": 0}
    counts = {"alternations": problem.alternations, "field_solves": problem.alternations}
else:
    ended, counts = kit.outcome(problem.history, failure), problem.history.statistics
numbers = {
    "peak": scale * force.max(),
    "energy": surface[-1] / (seen * ligament) if ligament else scale * surface[-1],
    "crack_length": max(kit.largest(away), 0.0),
    "energy_end": surface[-1] + stored[-1],
    "peak_at": path[force.argmax()],
    "fallen": fallen,
    "alternations": int(counts["alternations"]),
    "field_solves": int(counts["field_solves"]),
    "crack": middle(),
    "curve": np.stack([path, scale * force, surface, stored], axis=1).tolist(),
}
if args.plot and args.solver != "stock":
    mpm.plot.scene(problem, "damage", path=args.plot, background=False, cmap="magma_r")
table = [
    ("peak", f"{numbers['peak']:.4f} at {numbers['peak_at']:.4g}"),
    ("energy of the crack", f"{numbers['energy']:.4f}"),
    ("crack reaches", f"{numbers['crack_length']:.4f}"),
    ("alternations", f"{numbers['alternations']}"),
]
kit.report(args, ended | numbers, table, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert abs(numbers["energy"] - 1.0) < 0.05
    assert numbers["fallen"] <= 1e-10
