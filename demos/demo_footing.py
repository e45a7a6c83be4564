# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later

# # Bearing capacity of a strip footing
#
# It illustrates how to:
# - drive a problem by displacement and read the force of a support,
# - see volumetric locking in a limit load, and its cure, `f_bar="patch"`,
# - grade the cells of a background and of a body.
#
# ## Problem
#
# A smooth rigid strip of half width $b$ = 0.5 m is pushed into weightless undrained soil, of which
# the right half is 5 m by 5 m, with rollers at both sides and a smooth base. The soil is von
# Mises', perfectly plastic on Hencky elasticity,
#
# $$
# f = \frac{\sqrt{2 J_2}}{\rho_y} - 1 \le 0, \qquad E = 10\ \mathrm{GPa}, \quad \nu = 0.48, \quad
# c = \frac{\rho_y}{\sqrt2} = 490\ \mathrm{kPa}. \tag{1}
# $$
#
# The mean pressure under the strip cannot exceed Prandtl's
#
# $$
# p_\mathrm{lim} = (2 + \pi)\, c = 2519\ \mathrm{kPa}, \tag{2}
# $$
#
# the same for a smooth and a rough strip. The strip moves by 2 mm; strains stay small since $E$ is
# 14 000 times $\rho_y$.
#
# ## Method
#
# At the limit load all of the motion is plastic, and plastic flow keeps the volume: $\det F$ = 1 at
# every quadrature point (elasticity with $\nu$ = 0.48 asks for nearly the same). A background cell
# has two unknowns to meet such conditions with. One particle of one point sets one, 2 by 2
# particles set four: there is then hardly any motion left that obeys them all, and the body
# *locks*. The pressure passes the limit and goes on rising.
#
# With `f_bar="patch"` the material sees
#
# $$
# \bar F = (\bar J / J)^{1/2} F, \qquad
# \bar J = \frac{1}{V} \int_\mathrm{patch} J\, \mathrm{d}X, \tag{3}
# $$
#
# where a patch is a fixed group of domains of about one background cell: one condition for two
# unknowns, as in the continuum. `docs/locking.md` says when to use which average.
#
# ## Implementation

from mpi4py import MPI

import demo_tools as tools
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = tools.Parser("Bearing capacity of a smooth strip footing on undrained soil.")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument(
    "--cell", type=tools.positive, default=0.125, help="background cell size at the footing, m"
)
parser.add_argument(
    "--particles-per-cell", type=tools.whole, default=2, help="quadrilaterals, each way"
)
parser.add_f_bar("patch")
parser.add_order()
parser.add_argument("--steps", type=tools.whole, default=40, help="steps")
args = parser.parse()

comm = MPI.COMM_WORLD
half_width, size, settlement = 0.5, 5.0, 0.002  # m
young, poisson, cohesion = 1e7, 0.48, 490.0  # kPa, -, kPa
limit = (2.0 + np.pi) * cohesion
h = half_width / max(1, round(half_width / args.cell))

# The grid lines: cells of `--cell` where the soil flows, 1.75 m to the side and 1 m deep, and from
# there on each a fifth longer than the one before. (The cell is rounded so that the strip ends at a
# line.) Two more cells above the ground make room for the heave.


def lines(fine: float) -> np.ndarray:
    """Grid lines from 0 to `size`, at first `h` apart."""
    cells = np.full(round(fine / h), h)
    longer = h * 1.2 ** np.arange(1, 100)
    longer = longer[: 1 + np.argmax(np.cumsum(longer) >= size - cells.sum())]
    longer *= (size - cells.sum()) / longer.sum()
    return np.concatenate([[0.0], np.cumsum(cells), cells.sum() + np.cumsum(longer)])


def divided(along: np.ndarray, parts: int) -> np.ndarray:
    """Lines that divide each interval of others into equal parts."""
    places = np.arange((len(along) - 1) * parts + 1) / parts
    return np.interp(places, np.arange(len(along)), along)


def grid(x: np.ndarray, y: np.ndarray, kind: mesh.CellType) -> mesh.Mesh:
    """A mesh with given grid lines: that of a rectangle with its vertices moved."""
    domain = tools.box([len(x) - 1.0, len(y) - 1.0], [len(x) - 1, len(y) - 1], kind)
    for axis, along in enumerate((x, y)):
        place = domain.geometry.x[:, axis]
        place[:] = np.interp(place, np.arange(len(along)), along)
    return domain


across, up = lines(1.75), size - lines(1.0)[::-1]
above = np.append(up, size + h * np.arange(1, 3))
background = grid(across, above, mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))
each = args.particles_per_cell
body = grid(divided(across, each), divided(up, each), tools.DOMAINS[args.domain])

# Quadrilaterals of degree 1 have 2 by 2 points here.

if args.quadrature_degree is None and args.domain == "quad" and args.degree == 1:
    args.quadrature_degree = 2
particles = mpm.Particles(body, V, **tools.order(args))

# Rollers, and the strip: the nodes of the background at the ground, up to its edge, move down in
# every step, since the background itself never moves.


background.topology.create_connectivity(1, 2)


def held(component: int, where, value: float = 0.0) -> fem.DirichletBC:
    facets = mesh.locate_entities(background, 1, where)
    dofs = fem.locate_dofs_topological(V.sub(component), 1, facets)
    return fem.dirichletbc(value, dofs, V.sub(component))


footing = held(
    1, lambda x: np.isclose(x[1], size) & (x[0] < half_width * (1.0 + 1e-9)), -settlement
)
problem = mpm.QuasiStaticProblem(
    particles,
    mpm.materials.VonMises(young, poisson, rho_y=np.sqrt(2.0) * cohesion),
    bcs=[
        held(0, lambda x: np.isclose(x[0], 0.0) | np.isclose(x[0], size)),
        held(1, lambda x: np.isclose(x[1], 0.0)),
        footing,
    ],
    f_bar=args.f_bar,
    stabilisation=tools.stabilisation(args),
    petsc_options_prefix="footing_",
)

# The Dirichlet values are totals at full load, so the load factor is the share of the settlement.

path = [(0.0, 0.0)]
failure = None
try:
    for step in tools.progress(problem.steps(args.steps), args.steps, args):
        path.append((step.load, -problem.reaction(footing)[1] / half_width))
except mpm.MPMError as error:
    failure = error

# ## Result
#
# The mean pressure at the end over the limit (2), and by how much the pressure rose over the last
# tenth of the settlement: a limit load has been reached if that is nothing.

load, pressure = np.array(path).T
before = float(np.interp(0.9 * load[-1], load, pressure))
numbers = {
    **tools.outcome(problem.history, failure),
    "pressure": pressure[-1],
    "limit": limit,
    "ratio": pressure[-1] / limit,
    "plateau": pressure[-1] / before - 1.0 if before > 0.0 else np.nan,
    "particles": particles.num_global,
}
rows = [
    ("particles", f"{particles.num_global} ({args.domain}), F-bar: {args.f_bar}"),
    ("cells at the footing", f"{h:g} m, {each} particles each way"),
    ("steps", f"{len(path) - 1}, settlement {1e3 * settlement * load[-1]:g} mm"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("pressure", f"{pressure[-1]:.0f} kPa, limit {limit:.0f} kPa, ratio {numbers['ratio']:.3f}"),
    ("rise over the last tenth", f"{100.0 * numbers['plateau']:.2f} %"),
]

# The picture: where the soil flows, with the displacement magnified, and the pressure.

if args.plot:
    fig, axes = tools.figure(13.0, 5.0, [["soil", "path"]], width_ratios=[1.7, 1.0])
    warp = 60.0
    colours = mpm.plot.domains(
        particles,
        100.0 * particles.plastic_strain,
        ax=axes["soil"],
        warp=warp,
        cmap="YlGnBu",
        vmin=0.0,
        linewidth=0.15,
    )
    if comm.rank == 0:
        ax = axes["soil"]
        sunk = size - warp * settlement * load[-1]
        ax.fill_between([0.0, half_width], sunk, sunk + 0.12, color=tools.COLOURS["grey"])
        ax.set(xlim=(0.0, 2.0), ylim=(size - 1.15, size + 0.18), xlabel="x, m", ylabel="y, m")
        ax.set_title(f"Soil under the strip, displacement times {warp:g}")
        fig.colorbar(colours, ax=ax, label="plastic strain, %", shrink=0.7)
        ax = axes["path"]
        ax.axhline(limit, color="0.2", lw=1.2, ls="--")
        ax.text(2.0, 0.985 * limit, "Prandtl", va="top", ha="right", color="0.2")
        ax.plot(1e3 * settlement * load, pressure, color=tools.COLOURS["blue"])
        ax.set(xlabel="settlement, mm", ylabel="mean pressure, kPa")
        ax.set(xlim=(0.0, None), ylim=(0.0, None))
        ax.set_title(f"{numbers['ratio']:.3f} of the limit (F-bar: {args.f_bar})")
    tools.save(fig, args)

tools.report(args, numbers, rows, failure)

# With the default arguments the limit is met from above, and kept.

if args.default:
    assert 0.98 < numbers["ratio"] < 1.05
    assert abs(numbers["plateau"]) < 0.005
