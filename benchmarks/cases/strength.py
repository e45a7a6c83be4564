# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Strength of soils: a slope, a vertical cut, and a strip footing on soil with friction.

`factor` is what is found and `exact` what is known: the factor of safety of Griffiths & Lane's
first slope (1999), gamma H/c of a vertical cut in undrained soil (bounds 3.775 and 3.786), N_c
of Prandtl and Reissner, and N_gamma of soil with weight and without cohesion (Martin 2005).
"""

from mpi4py import MPI

import kit
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Strength of soils: slope, vertical cut, footing.")
CASES = ("slope", "vertical_cut", "footing", "footing_weight")
parser.add_argument("--case", choices=CASES, default="slope")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument(
    "--cell", type=kit.positive, default=0.1, help="background cells, over the height or half width"
)
parser.add_argument("--friction-angle", type=float, default=20.0, help="of slope and footing")
parser.add_argument("--tolerance", type=kit.positive, default=0.01, help="of the factor of safety")
parser.add_argument(
    "--limit", type=kit.positive, default=2.0, help="displacement that stands, weight height^2/E"
)
parser.add_argument("--steps", type=kit.whole, default=20, help="steps of the footing")
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
if not 1.0 <= args.fine <= 5.0:
    parser.error(f"argument --fine: {args.fine:g} is not from 1 to 5")

comm, kind = MPI.COMM_WORLD, kit.DOMAINS[args.domain]
has_strip = args.case.startswith("footing")
height = 0.5 if has_strip else 1.0  # of slope and cut, or half width of the strip
h = height / round(1.0 / args.cell)


def space(width: float, depth: float) -> fem.FunctionSpace:
    """The background, with two rows of cells above the body."""
    cells = [round(width / h), round(depth / h) + 2]
    grid = mesh.create_rectangle(
        comm, [[0.0, 0.0], [h * c for c in cells]], cells, mesh.CellType.quadrilateral
    )
    return fem.functionspace(grid, ("Lagrange", 1, (2,)))


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
if args.case == "slope":
    weight, crest, foot = 20.0, 1.2 * height, 2.0 * height
    cells = [2 * round((crest + foot) / h), 2 * round(height / h)]
    body = kit.box([crest + foot, height], cells, kind)
    x = body.geometry.x
    x[:, 0] *= (crest + foot * (1.0 - x[:, 1] / height)) / (crest + foot)
    V = space(crest + foot + 4 * h, height)
    law = mpm.materials.MohrCoulomb(young, 0.3, 1.0, args.friction_angle)
    bcs = [held(V, 0, 0.0), *floor(V)]
    exact = 1.40 if args.friction_angle == 20.0 else np.nan
elif args.case == "vertical_cut":
    weight, wide, deep = 3.0, 2.25 * height, 1.375 * height
    wide, deep = h * round(wide / h), h * round(deep / h)
    full = kit.box([wide, deep], [2 * round(wide / h), 2 * round(deep / h)], kind)
    cells = np.arange(full.topology.index_map(2).size_local, dtype=np.int32)
    x = mesh.compute_midpoints(full, 2, cells)
    edge = h * round(1.5 * height / h)
    body = mesh.create_submesh(full, 2, cells[(x[:, 0] < edge) | (x[:, 1] < deep - height)])[0]
    V = space(wide, deep)
    law = mpm.materials.Tresca(young, 0.49, cohesion=1.0)
    bcs = [held(V, 0, 0.0, wide), *floor(V)]
    exact = 3.776
else:
    # As in footing.py a line of the background is a little beyond the strip's edge, and one a
    # little below the ground.
    young, size = 1e6, 3.0
    across, down = (kit.lines(h, share * args.fine * height, size) for share in (1.0, 2.0 / 3.0))
    up = size - down[::-1]
    taper = np.clip((size - across) / 1.5, 0.0, 1.0) * (across > 0.0)
    over = 0.002 * h
    heights = np.append(up - over * np.clip(up, 0.0, 1.0), size - over + h * np.arange(1, 3))
    grid = kit.grid([across + 0.04 * h * taper, heights], mesh.CellType.quadrilateral)
    V = fem.functionspace(grid, ("Lagrange", args.degree, (2,)))
    body = kit.grid([kit.divided(along, args.domains_per_cell) for along in (across, up)], kind)
    cohesion = 1.0 if args.case == "footing" else 0.0
    dilation = args.friction_angle if args.dilation_angle is None else args.dilation_angle
    bcs = [held(V, 0, 0.0, size), held(V, 1, 0.0)]
    tangent = np.tan(np.radians(args.friction_angle))
    N_q = np.exp(np.pi * tangent) * np.tan(np.radians(45.0 + args.friction_angle / 2.0)) ** 2
    exact = (N_q - 1.0) / tangent
    settlement = 1.2e-4
    if args.case == "footing_weight":
        weight = 1.0
        known = {
            (20.0, False): 1.579,
            (30.0, False): 7.653,
            (20.0, True): 2.839,
            (30.0, True): 14.754,
        }
        exact = known.get((args.friction_angle, args.rough), np.nan)
        # So stiff that the heave beside the strip adds nothing.
        young, settlement = 1e7, 1e-6 * height * np.nan_to_num(exact, nan=10.0)
    law = mpm.materials.MohrCoulomb(young, 0.3, cohesion, args.friction_angle, dilation)

particles = mpm.Particles(
    body,
    V,
    degree=args.degree if has_strip else 1,
    quadrature_degree=args.quadrature_degree,
)
supports = []
if has_strip:
    under = mesh.locate_entities_boundary(
        body, 1, lambda x: np.isclose(x[1], size) & (x[0] < height * (1.0 + 1e-9))
    )
    tags = mesh.meshtags(body, 1, np.sort(under), np.full(len(under), 1, np.int32))
    supports = [
        mpm.boundary.fixed(particles, tags, 1, value=(0.0, -settlement))
        if args.rough
        else mpm.boundary.roller(particles, tags, 1, normal=(0.0, -1.0), value=settlement)
    ]

problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        law,
        density=weight,
        body_force=(0.0, -1.0),
        f_bar=args.f_bar if args.mixed == "none" else "none",
        initial_stress=mpm.geostatic(size, weight, 0.5, (0.0, -1.0))
        if has_strip and weight
        else None,
    ),
    bcs=bcs,
    supports=supports,
    mixed=None if args.mixed == "none" else args.mixed,
    solver=mpm.Solver(petsc_options_prefix="strength_", stabilisation=kit.stabilisation(args)),
)

# The footing is pushed down; slope and cut carry their weight, and then their strength is reduced.

failure, factor, path = None, np.nan, [(0.0, 0.0)]
try:
    if has_strip:
        for step in kit.progress(problem.steps(args.steps), args.steps, args):
            pressure = -problem.reaction(supports[0])[1] / height
            unit = weight * height if weight else 1.0  # or the cohesion
            path.append((step.load * settlement, pressure / unit))
        factor = path[-1][1]
    else:
        problem.solve(2)
        limit = args.limit * weight * height**2 / young
        found = mpm.strength_reduction(problem, tolerance=args.tolerance, displacement=limit)
        scale = weight * height if args.case == "vertical_cut" else 1.0
        factor = scale * found.factor
        path = [(d, scale * f) for d, f in zip(found.displacements, found.factors, strict=True)]
except mpm.MPMError as error:
    failure = error

numbers = {
    **kit.outcome(problem.history, failure),
    "factor": factor,
    "exact": exact,
    "ratio": factor / exact,
    "plateau": kit.rise(*zip(*path, strict=True)) if has_strip else np.nan,
    "particles": particles.num_global,
}
rows = [
    ("case", f"{args.case}, cells of {h:g}, {particles.num_global} {args.domain}"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("factor", f"{factor:.4g}, known {exact:.4g}, ratio {factor / exact:.3f}"),
]
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
        axes["path"].plot(*np.array(path).T, color=kit.COLOURS["blue"])
        axes["path"].set(xlabel="largest displacement", ylabel="factor", title=args.case)
    kit.save(fig, args)
kit.report(args, numbers, rows, failure)
