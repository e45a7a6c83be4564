# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later

# # An elastic cantilever that bends by more than its length allows to ignore
#
# It illustrates how to:
# - load a face of the body by a traction that rides on it,
# - support a body at its own end, on grid lines or anywhere between them,
# - choose the degree of background and domains,
# - see that it does not matter how the body's faces cut the background.
#
# The bending of a slender beam is hard for material point methods: its faces cut the background's
# cells anywhere, and where a face leaves a sliver of the body in a cell, the nodes of that cell
# have next to no stiffness. Codes of low order stop after a fraction of this load, or need a grid
# that is fine enough to hide it.
#
# ## Problem
#
# A beam, $L = 10$ m long and 1 m deep, in plane strain and without weight, is held at $x = 0$. A
# dead load $P = 100$ kN/m, spread over its end face, pulls the tip down in 50 steps:
#
# $$
# R(d; v) = \int P_1 : \nabla v \,\mathrm{d}X
#   - \lambda \int_{X_1 = L} t \cdot v \,\mathrm{d}S = 0,
# \qquad t = (0, -P / 1\,\mathrm{m}), \tag{1}
# $$
#
# with $P_1$ the first Piola stress and $\lambda$ the load factor. The material is Hencky's with
# $E = 12$ MPa and $\nu = 0.2$. The beam's end moves down by 83 % and inwards by 55 % of its length.
#
# ## Method
#
# A step's increment $u$ lives in the background space $V$ of degree $k$, and moves the nodes of
# domains whose displacement is of degree $m$ (`--degree`, `--domain-degree`):
#
# $$
# d = d_n + T_n u, \qquad (T_n)_{ci} = N_i\bigl(X_c + d_n(X_c)\bigr). \tag{2}
# $$
#
# Domains of degree 2 or 3 have curved edges and several quadrature points. Where a cell is filled
# below one half, the increments of degree $k \ge 2$ are tied to the polynomials of the neighbours
# $K_1$, $K_2$ of each facet $F$ by a ghost penalty (`--stabilisation`),
#
# $$
# \sum_F \frac{\gamma\, G}{h^2} \int_{K_1 \cup K_2} (u_1 - u_2) \cdot (v_1 - v_2) \,\mathrm{d}x,
# \qquad \gamma = 10^{-4}, \tag{3}
# $$
#
# where $u_1$, $u_2$ are the polynomials of $u$ in either cell, continued over both. It vanishes for
# polynomials of degree $k$, so it takes no accuracy away.
#
# ## Reference
#
# Finite elements of degree 2 on the same continuum, converged to $10^{-4}$, give shortening and
# deflection of the middle of the tip over the length:
#
# $$
# \begin{array}{lcc}
# \text{root} & \text{shortening} & \text{deflection} \\
# \text{clamped} & 0.554005 & 0.825387 \\
# \text{pinned} & 0.555218 & 0.828139
# \end{array} \tag{4}
# $$
#
# Clamped, both components vanish on the root; pinned, only the horizontal one does, and the
# vertical one in the root's middle. (The inextensible elastica of a thin beam is another problem.)
#
# ## Implementation

from mpi4py import MPI

import demo_tools as tools
import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = tools.Parser("Elastic cantilever that bends through a background under a dead load.")
parser.add_argument("--cell", type=tools.positive, default=0.5, help="background cell size, m")
parser.add_argument("--particles-per-cell", type=tools.whole, default=2, help="domains, each way")
parser.add_argument("--domain", choices=("quad", "tri"), default="quad", help="particle domains")
parser.add_argument("--root", choices=("clamped", "pinned"), default="clamped", help="support")
parser.add_argument("--offset", type=float, default=0.0, help="of the beam, downwards, m")
parser.add_argument("--steps", type=tools.whole, default=50, help="load steps")
parser.add_f_bar()
parser.add_order()
args = parser.parse()
if not -0.5 <= args.offset <= 1.0:
    parser.error("argument --offset: the beam leaves the background; -0.5 to 1 m will do")

comm = MPI.COMM_WORLD
length, depth, axis = 10.0, 1.0, 9.5 - args.offset  # m
young, poisson, load = 12e6, 0.2, 100e3  # Pa, -, N/m
REFERENCE = {"clamped": (0.554005, 0.825387), "pinned": (0.555218, 0.828139)}

# The background is 11 m by 10 m and a little more: a row of cells above leaves room for an offset
# upwards.

h = args.cell
cells = [round(11.0 / h), round(10.0 / h) + (1 if args.offset < 0.0 else 0)]
background = tools.box([cells[0] * h, cells[1] * h], cells, mesh.CellType.quadrilateral)
V = fem.functionspace(background, ("Lagrange", args.degree, (2,)))

along = [max(1, round(side / h * args.particles_per_cell)) for side in (length, depth)]
body = mesh.create_rectangle(
    comm,
    [[0.0, axis - depth / 2.0], [length, axis + depth / 2.0]],
    along,
    tools.DOMAINS[args.domain],
    diagonal=mesh.DiagonalType.left_right,
)

ends = np.sort(mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[0], length)))
tags = mesh.meshtags(body, 1, ends, np.full(len(ends), 1, dtype=np.int32))

# The root stays on the grid line $x = 0$, so its conditions are the background's. Pinned, the
# vertical displacement is held at one node of the background, the nearest to the beam's axis.

side = mesh.locate_entities_boundary(background, 1, lambda x: np.isclose(x[0], 0.0))
bcs = [fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(0), 1, side), V.sub(0))]
if args.root == "clamped":
    held = fem.locate_dofs_topological(V.sub(1), 1, side)
else:
    nodes = V.tabulate_dof_coordinates()
    gap = np.where(np.isclose(nodes[:, 0], 0.0), abs(nodes[:, 1] - axis + 1e-6 * h), np.inf)
    held = (2 * np.flatnonzero(gap < tools.smallest(gap) + 1e-9 * h) + 1).astype(np.int32)
bcs.append(fem.dirichletbc(0.0, held, V.sub(1)))

particles = mpm.Particles(body, V, **tools.order(args))
problem = mpm.QuasiStaticProblem(
    particles,
    mpm.materials.Hencky(young, poisson),
    bcs=bcs,
    tractions=[((0.0, -load / depth), 1)],
    facet_tags=tags,
    f_bar=args.f_bar,
    petsc_options_prefix="cantilever_",
    stabilisation=tools.stabilisation(args),
)

# The tip is the body's node at half depth of its end; where the domains have none there, the mean
# of the two nodes next to it.

X = particles.W.tabulate_dof_coordinates()[: particles.W.dofmap.index_map.size_local]
gap = np.where(np.isclose(X[:, 0], length), abs(X[:, 1] - axis), np.inf)
at_tip = gap < tools.smallest(gap) + 1e-9
along_axis = abs(X[:, 1] - axis) < tools.smallest(gap) + 1e-9


def tip() -> tuple[float, float]:
    """Shortening and deflection of the tip over the length."""
    d = particles.displacement.x.array.reshape(-1, 2)[: len(X)][at_tip]
    count = tools.total(np.ones(len(d)))
    return tuple(-tools.total(d[:, i]) / count / length for i in (0, 1))


path = [(0.0, 0.0, 0.0)]
shapes = []
failure = None
try:
    for step in tools.progress(problem.steps(args.steps), args.steps, args):
        path.append((step.load, *tip()))
        if args.plot and step.load >= 0.2 * (len(shapes) + 1) - 1e-9 and step.load < 1.0:
            shapes.append(tools.gathered(tools.nodes(particles)[along_axis]))
except mpm.MPMError as error:
    failure = error

# ## Result
#
# `error` is the larger error of the two numbers in (4), for a run that is complete.

shortening, deflection = tip()
exact = REFERENCE[args.root]
error = max(abs(shortening - exact[0]), abs(deflection - exact[1]))
numbers = {
    **tools.outcome(problem.history, failure),
    "shortening": shortening,
    "deflection": deflection,
    "error": error if failure is None else None,
    "particles": particles.num_global,
    "ghost_facets": problem.history.statistics["ghost_facets"],
}
degrees = f"degree {args.domain_degree or args.degree} on {args.degree}"
rows = [
    ("particles", f"{particles.num_global} ({args.domain}, {degrees}), cells of {h:g} m"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("shortening / length", f"{shortening:.6f} (finite elements {exact[0]:.6f})"),
    ("deflection / length", f"{deflection:.6f} (finite elements {exact[1]:.6f})"),
    ("larger error", f"{error:.1e}"),
]

# The picture: the beam on its background, its axis at each fifth of the load, and the tip's way
# beside that of the finite elements.

CURVE = {
    "clamped": ((0.2, 0.153344, 0.487205), (0.6, 0.429610, 0.751601), (1.0, 0.554005, 0.825387)),
    "pinned": ((0.2, 0.153673, 0.488225), (0.6, 0.430493, 0.753587), (1.0, 0.555218, 0.828139)),
}

if args.plot:
    fig, axes = tools.figure(13.0, 5.6, [["beam", "tip"]], width_ratios=[1.15, 1.0])
    mpm.plot.background(V, ax=axes["beam"], color="0.88")
    mpm.plot.domains(particles, ax=axes["beam"], warp=0.0, facecolor="0.94", edgecolor="0.75")
    stress = particles.stress
    mises = np.sqrt(
        1.5
        * np.sum(
            (stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)) ** 2,
            axis=(1, 2),
        )
    )
    colours = mpm.plot.domains(particles, mises / 1e6, ax=axes["beam"], cmap="YlGnBu", vmin=0.0)
    if comm.rank == 0:
        ax = axes["beam"]
        for line in shapes:
            ax.plot(*line[np.argsort(line[:, 0] - line[:, 1])].T, color="0.55", lw=1.0)
        ax.set(xlim=(0.0, 11.0), ylim=(0.0, cells[1] * h), xlabel="x, m", ylabel="y, m")
        ax.set_title(f"The beam bends through the background, {degrees}")
        fig.colorbar(colours, ax=ax, label="von Mises stress, MPa", shrink=0.8)
        ax, way = axes["tip"], np.array(path)
        for i, (name, colour) in enumerate((("shortening", "orange"), ("deflection", "blue"))):
            ax.plot(way[:, 0], way[:, i + 1], color=tools.COLOURS[colour], label=name)
            points = np.array(CURVE[args.root])
            ax.plot(
                points[:, 0],
                points[:, i + 1],
                "o",
                color=tools.COLOURS[colour],
                mfc="white",
                mew=1.6,
                label="finite elements" if i else None,
            )
        ax.set(xlim=(0.0, 1.03), ylim=(0.0, None), xlabel="load over 100 kN/m")
        ax.set_ylabel("of the tip, over the length")
        ax.set_title(f"Tip: off by {100 * error:.2g} % of the length")
        ax.legend(loc="lower right")
    tools.save(fig, args)

tools.report(args, numbers, rows, failure)

# With the default arguments the numbers are known.

if args.default:
    assert failure is None, failure
    assert error < 1e-2
    assert numbers["iterations"] <= 240 and numbers["cutbacks"] == 0
