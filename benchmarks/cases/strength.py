# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Strength of soils: a slope, a vertical cut, footings on soil with friction and on clay.

`factor` is what is found and `exact` what is known: the factor of safety of Griffiths & Lane's
first slope (1999), dry or, as in their fifth example, under a level of water that was lowered
slowly, and of the dam of their sixth, dry or with a reservoir 17.1 m deep; gamma H/c of a vertical
cut in undrained soil (bounds 3.775 and 3.786), and at most of a slope of 45 degrees on a firm base;
of strips N_c and N_q of Prandtl and Reissner, and N_gamma of soil with weight and without cohesion
(Martin 2005); N_c of a circular footing on clay (Cox, Eason & Hopkins 1961, Eason & Shield 1960).
`--recommended` is the way to limit loads that docs/limit-loads.md describes.
"""

from itertools import pairwise

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Strength of soils: slope, vertical cut, footing.")
CASES = ("slope", "dam", "vertical_cut", "footing", "footing_surcharge", "footing_weight", "circle")
parser.add_argument("--case", choices=CASES, default="slope")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument(
    "--recommended",
    action="store_true",
    help="degree 2, one domain of four points in a cell, cells halved at edge or toe, no averages",
)
parser.add_argument(
    "--cell",
    type=kit.positive,
    help="background cells, over the height or half width; 0.1, recommended 0.25 or 0.125",
)
parser.add_argument(
    "--halvings", type=kit.count, help="of cells at the edge, where recommended; 5, from 30° on 3"
)
parser.add_argument("--run", type=kit.positive, default=2.0, help="of the slope, for a rise of 1")
parser.add_argument("--friction-angle", type=float, default=20.0, help="of slope and footing")
parser.add_argument(
    "--water", type=float, help="level of water below the crest of slope or dam, over its height"
)
parser.add_argument("--tolerance", type=kit.positive, default=0.01, help="of the factor of safety")
parser.add_argument(
    "--steps", type=kit.whole, help="steps of the footing; 20, recommended 30, with weight 50"
)
parser.add_argument("--degree", type=int, choices=(1, 2), default=1, help="of the footing's basis")
parser.add_argument(
    "--fine",
    type=kit.positive,
    default=3.0,
    help="reach of equal cells from the footing's axis, half widths; two thirds of it downwards",
)
parser.add_argument("--rough", action="store_true", help="a rough strip, not a smooth one")
parser.add_f_bar("patch")
parser.add_mixed()
parser.add_argument(
    "--domains-per-cell", type=kit.whole, default=2, help="under the footing, each way"
)
parser.add_stabilisation()
parser.add_argument("--dilation-angle", type=float, help="of the footing's soil, else associated")
args = parser.parse()
if args.water is not None and args.case not in ("slope", "dam"):
    parser.error("argument --water: of a slope or a dam alone")
if not 1.0 <= args.fine <= 5.0:
    parser.error(f"argument --fine: {args.fine:g} is not from 1 to 5")

comm, kind = MPI.COMM_WORLD, kit.DOMAINS[args.domain]
has_strip = args.case.startswith("footing") or args.case == "circle"
if (args.case in ("footing_surcharge", "circle") or args.run != 2.0) and not args.recommended:
    parser.error("circle, footing_surcharge and --run are --recommended alone")
height = 0.5 if has_strip else 1.0  # of slope and cut, or half width of the strip
cell = args.cell or (0.1 if not args.recommended else 0.25 if has_strip else 0.125)
h = height / round(1.0 / cell)
if args.recommended:
    args.degree, args.quadrature_degree, args.stabilisation = 2, 3, "none"
    args.f_bar, args.mixed = "none", "none"
halvings = args.halvings
if halvings is None:
    halvings = 2 if not has_strip else 5 if args.friction_angle < 30.0 else 3


def space(width: float, depth: float) -> fem.FunctionSpace:
    """The background, with two rows of cells above the body."""
    cells = [round(width / h), round(depth / h) + 2]
    grid = mesh.create_rectangle(
        comm, [[0.0, 0.0], [h * c for c in cells]], cells, mesh.CellType.quadrilateral
    )
    return fem.functionspace(grid, ("Lagrange", args.degree, (2,)))


def ground(lines: list[np.ndarray], room: int) -> tuple[mesh.Mesh, fem.FunctionSpace]:
    """A body of one domain in each cell between lines, and its background.

    The latter has some cells more above the ground, and to the right where that is free.
    """
    body = mpm.grid(comm, lines, kind)
    across, up = lines
    across = np.append(across, across[-1] + np.diff(across)[-1] * np.arange(1, room))
    up = np.append(up, up[-1] + np.diff(up)[-1] * np.arange(1, 3))
    return body, fem.functionspace(mpm.grid(comm, [across, up]), ("Lagrange", 2, (2,)))


def held(V: fem.FunctionSpace, component: int, *places: float) -> fem.DirichletBC:
    """A roller on sides (component 0) or on the base (1)."""
    V.mesh.topology.create_connectivity(1, 2)
    where = mesh.locate_entities(
        V.mesh, 1, lambda x: np.isclose(x[component][:, None], places).any(axis=1)
    )
    dofs = fem.locate_dofs_topological(V.sub(component), 1, where)
    return fem.dirichletbc(0.0, dofs, V.sub(component))


def floor(V: fem.FunctionSpace) -> list[fem.DirichletBC]:
    """A rough base."""
    where = mesh.locate_entities_boundary(V.mesh, 1, lambda x: np.isclose(x[1], 0.0))
    return [
        fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(i), 1, where), V.sub(i))
        for i in (0, 1)
    ]


# Each but the last has a cohesion of 1, and a stiffness with which it hardly moves before it fails.

young, weight, exact = 1e5, 0.0, np.nan
water = None
path = None  # of the strip's settlement over the load factor; none: in proportion
friction = np.radians(args.friction_angle)
tangent = np.tan(friction)
if args.case == "slope":
    weight, crest, foot = 20.0, 1.2 * height, args.run * height
    width = crest + foot
    if args.recommended:
        lines = [
            mpm.grid_lines(0.0, width, h * np.hypot(args.run, 1.0)),
            mpm.grid_lines(0.0, height, h, finer_at=0.0, halvings=halvings),
        ]
        body, V = ground(lines, 3)
        moved = [body, V.mesh]
    else:
        cells = [2 * round(width / h), 2 * round(height / h)]
        body, V = kit.box([width, height], cells, kind), space(width + 4 * h, height)
        moved = [body]
    for domain in moved:
        x = domain.geometry.x
        x[:, 0] *= (crest + foot * (1.0 - x[:, 1] / height)) / width
    law = mpm.materials.MohrCoulomb(young, 0.3, 1.0, args.friction_angle)
    if args.friction_angle == 0.0:
        weight, law = 3.0, mpm.materials.Tresca(young, 0.49, cohesion=1.0)
    bcs = [held(V, 0, 0.0), *floor(V)]
    known = {(20.0, 2.0, None): 1.40, (20.0, 2.0, 0.0): 1.85, (20.0, 2.0, 0.7): 1.30}
    known[0.0, 1.0, None] = 6.08
    exact = known.get((args.friction_angle, args.run, args.water), np.nan)
    if args.water is not None:
        # The weight of soil is 20 kN/m3, that of water 9.81.
        water = mpm.WaterTable((1.0 - args.water) * height, 9.81 / 20.0 * weight / height)
elif args.case == "dam":
    # 21.3 m high, slopes of 18 and 23 degrees, on 7.3 m of the same soil. The widths that are given
    # do not close by 1.4 m: height, base and crest are kept, and both slopes share the rest.
    weight = 18.2 * 21.3 / 13.8
    base, toe, crest, shoulder, end, width = (
        height / 21.3 * np.array([7.3, 33.5, 99.83, 107.13, 157.9, 191.4])
    )
    # Columns crowd at the crest: where recommended they are as wide as two rows at the base. The
    # stiffness is theirs there, as Newton's method stalls where soil hardly moves before it fails.
    wide, high = (2.0 * h, h) if args.recommended else (0.5 * h, 0.5 * h)
    across, up = [
        np.unique(np.concatenate([mpm.grid_lines(*pair, size) for pair in pairwise(places)]))
        for places, size in (((0.0, toe, end, width), wide), ((0.0, base, base + height), high))
    ]
    if args.recommended:
        young = 1e5 / 13.8
        full, V = ground([across, up], 1)
    else:
        full = mpm.grid(comm, [across, up], kind)
        rows = h * np.arange(np.ceil((base + height) / h) + 2)
        V = fem.functionspace(
            mpm.grid(comm, [mpm.grid_lines(0.0, width, h), rows]), ("Lagrange", 1, (2,))
        )
    cells = np.arange(full.topology.index_map(2).size_local, dtype=np.int32)
    x = mesh.compute_midpoints(full, 2, cells)
    under = (x[:, 0] > toe) & (x[:, 0] < end)
    body = mesh.create_submesh(full, 2, cells[under | (x[:, 1] < base)])[0]
    for domain in [body, V.mesh] if args.recommended else [body]:
        x = domain.geometry.x
        share = np.clip((x[:, 1] - base) / height, 0.0, 1.0)
        top = np.interp(x[:, 0], [0.0, toe, end, width], [0.0, crest, shoulder, width])
        x[:, 0] += share * (top - x[:, 0])
    law = mpm.materials.MohrCoulomb(young, 0.3, 1.0, 37.0, args.dilation_angle or 0.0)
    bcs = [held(V, 0, 0.0, width), *floor(V)]
    exact = {None: 2.4, 0.197: 1.9}.get(args.water, np.nan)
    if args.water is not None:
        # It goes from the reservoir to the toe in a straight line.
        depth = (1.0 - args.water) * height
        inlet = toe + depth / height * (crest - toe)
        water = mpm.WaterTable([(inlet, base + depth), (end, base)], 9.81 / 18.2 * weight / height)
elif args.case == "vertical_cut":
    weight, wide, deep = 3.0, 2.25 * height, 1.375 * height
    wide, deep = h * round(wide / h), h * round(deep / h)
    edge, toe = h * round(1.5 * height / h), deep - height
    if args.recommended:
        lines = [
            mpm.grid_lines(0.0, wide, h, finer_at=edge, halvings=halvings),
            mpm.grid_lines(0.0, deep, h, finer_at=toe, halvings=halvings),
        ]
        full, V = ground(lines, 1)
    else:
        full = kit.box([wide, deep], [2 * round(wide / h), 2 * round(deep / h)], kind)
        V = space(wide, deep)
    cells = np.arange(full.topology.index_map(2).size_local, dtype=np.int32)
    x = mesh.compute_midpoints(full, 2, cells)
    body = mesh.create_submesh(full, 2, cells[(x[:, 0] < edge) | (x[:, 1] < toe)])[0]
    law = mpm.materials.Tresca(young, 0.49, cohesion=1.0)
    bcs = [held(V, 0, 0.0, wide), *floor(V)]
    exact = 3.776
else:
    young, settlement = 1e6, 1.2e-4
    N_q = np.exp(np.pi * tangent) * np.tan(0.25 * np.pi + 0.5 * friction) ** 2
    exact = (N_q - 1.0) / tangent if tangent > 0.0 else 2.0 + np.pi
    if args.case == "footing_surcharge":
        exact = N_q
    elif args.case == "circle":
        exact = 6.05 if args.rough else 5.69
    elif args.case == "footing_weight":
        weight = 1.0
        known = {
            (20.0, False): 1.579,
            (25.0, False): 3.461,
            (30.0, False): 7.653,
            (35.0, False): 17.58,
            (20.0, True): 2.839,
            (25.0, True): 6.491,
            (30.0, True): 14.754,
            (35.0, True): 34.48,
        }
        exact = known.get((args.friction_angle, args.rough), np.nan)
        # So stiff that the heave beside the strip adds nothing.
        young, settlement = 1e7, 1e-6 * height * np.nan_to_num(exact, nan=10.0)
    if args.recommended:
        # The ground reaches beyond Prandtl's mechanism, and less far under weight.
        turn = 0.25 * np.pi + 0.5 * friction
        reach = 1.0 + 2.0 * np.tan(turn) * np.exp(0.5 * np.pi * tangent)
        below = np.cos(friction) / np.cos(turn) * np.exp(turn * tangent)
        share = 0.8 if weight else 1.15
        size_x = height * max(4.0, share * reach)
        size = height * max(3.0, 1.2 * share * below)
        near = 2.0 * height
        across = mpm.grid_lines(
            0.0, size_x, h, equal=(0.0, near), finer_at=height, halvings=halvings
        )
        up = mpm.grid_lines(
            0.0, size, h, equal=(size - 0.625 * near, size), finer_at=size, halvings=halvings
        )
        body, V = ground([across, up], 1)
        young, path = 1e8, 2.0
        settlement = (18.0 if weight else 8.0) * np.nan_to_num(exact, nan=30.0) * height / young
        settlement *= weight * height if weight else 1.0
        bcs = [held(V, 0, 0.0, size_x), *floor(V)]
    else:
        # As in footing.py a line of the background is a little beyond the strip's edge, and one a
        # little below the ground.
        size = 3.0
        across, down = (
            kit.lines(h, share * args.fine * height, size) for share in (1.0, 2.0 / 3.0)
        )
        up = size - down[::-1]
        taper = np.clip((size - across) / 1.5, 0.0, 1.0) * (across > 0.0)
        over = 0.002 * h
        heights = np.append(up - over * np.clip(up, 0.0, 1.0), size - over + h * np.arange(1, 3))
        grid = kit.grid([across + 0.04 * h * taper, heights], mesh.CellType.quadrilateral)
        V = fem.functionspace(grid, ("Lagrange", args.degree, (2,)))
        body = kit.grid([kit.divided(along, args.domains_per_cell) for along in (across, up)], kind)
        bcs = [held(V, 0, 0.0, size), held(V, 1, 0.0)]
    cohesion = 1.0 if args.case in ("footing", "circle") else 0.0
    dilation = args.friction_angle if args.dilation_angle is None else args.dilation_angle
    stiffness = young
    if args.recommended and weight:
        # Stiffness in proportion to strength, as that of sand is: the load is the same, and what an
        # elastic step would be beyond yield no longer grows without end towards the surface.
        stiffness = fem.Function(fem.functionspace(body, ("DG", 0)))
        stiffness.interpolate(lambda x: young * np.clip((size - x[1]) / height, 1e-3, 1.0))
    if args.friction_angle == 0.0 or args.case == "circle":
        law = mpm.materials.Tresca(stiffness, 0.49, cohesion=1.0)
    else:
        law = mpm.materials.MohrCoulomb(stiffness, 0.3, cohesion, args.friction_angle, dilation)

particles = mpm.Particles(
    body,
    V,
    degree=args.degree if has_strip or args.recommended else 1,
    quadrature_degree=args.quadrature_degree,
)
supports, loads, tags = [], [], None
if has_strip:
    under = mpm.region(x=(0.0, height), y=size)
    tags = mpm.facet_tags(body, {2: mpm.region(y=size), 1: under})
    down = fem.Constant(body, (0.0, -settlement) if args.rough else settlement)
    supports = [
        mpm.boundary.fixed(particles, tags, 1, value=down)
        if args.rough
        else mpm.boundary.roller(particles, tags, 1, normal=(0.0, -1.0), value=down)
    ]
    loads = [((0.0, -1.0), 2)] if args.case == "footing_surcharge" else []
    before = mpm.geostatic(size, weight, 0.5, (0.0, -1.0), surcharge=1.0 if loads else 0.0)

problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        law,
        density=weight,
        body_force=(0.0, -1.0),
        tractions=loads,
        facet_tags=tags if loads else None,
        f_bar=args.f_bar if args.mixed == "none" else "none",
        pore_pressure=water,
        initial_stress=before if has_strip and (weight or loads) else None,
    ),
    bcs=bcs,
    supports=supports,
    mixed=None if args.mixed == "none" else args.mixed,
    axisymmetric=args.case == "circle",
    solver=mpm.Solver(petsc_options_prefix="strength_", stabilisation=kit.stabilisation(args)),
)

# The footing is pushed down; slope and cut carry their weight, and then their strength is reduced.

failure, factor, reason, curve = None, np.nan, None, [(0.0, 0.0)]
whole = settlement * np.array([0.0, -1.0] if args.rough else 1.0) if has_strip else None


def settle(t: float) -> None:
    """Settle in small steps at first: the strength at the edge comes with the pressure there."""
    down.value = whole * t**path


try:
    if has_strip:
        steps = args.steps or (20 if not path else 50 if weight else 30)
        area = np.pi * height**2 if args.case == "circle" else height
        unit = weight * height if weight else 1.0  # or the cohesion
        run = problem.steps(steps, update=settle if path else None)
        for step in kit.progress(run, steps, args):
            pressure = -problem.reaction(supports[0])[1] / area
            curve.append((step.load ** (path or 1.0) * settlement, pressure / unit))
        factor = curve[-1][1]
    else:
        problem.solve(2)
        found = mpm.strength_reduction(problem, tolerance=args.tolerance)
        scale = weight * height if law.parameters["friction_angle"] == 0.0 else 1.0
        factor, reason = scale * found.factor, found.reason
        curve = [(d, scale * f) for d, f in zip(found.displacements, found.factors, strict=True)]
except mpm.MPMError as error:
    failure = error

numbers = {
    **kit.outcome(problem.history, failure),
    "factor": factor,
    "exact": exact,
    "ratio": factor / exact,
    "reason": reason,
    "plateau": kit.rise(*zip(*curve, strict=True)) if has_strip else np.nan,
    "particles": particles.num_global,
}
rows = [
    ("case", f"{args.case}, cells of {h:g}, {particles.num_global} {args.domain}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("factor", f"{factor:.4g}, known {exact:.4g}, ratio {factor / exact:.3f}"),
]
if reason:
    rows.append(("search ended by", reason))
if has_strip:
    rows.append(("rise over the last tenth", f"{100.0 * numbers['plateau']:.2f} %"))
if args.plot:
    fig, axes = kit.figure(13.0, 5.0, [["soil", "path"]], width_ratios=[1.6, 1.0])
    colours = mpm.plot.domains(
        particles, particles.plastic_strain, ax=axes["soil"], cmap="YlGnBu", vmin=0.0, linewidth=0.1
    )
    if comm.rank == 0:
        axes["soil"].set(xlabel="x", ylabel="y", title="Plastic strain")
        fig.colorbar(colours, ax=axes["soil"], shrink=0.7)
        axes["path"].axhline(exact, color="0.2", lw=1.2, ls="--")
        axes["path"].plot(*np.array(curve).T, color=kit.COLOURS["blue"])
        axes["path"].set(xlabel="largest displacement", ylabel="factor", title=args.case)
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)
