# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later

# # A block squeezed between plates
#
# It illustrates how to:
# - solve in three dimensions, with hexahedra or tetrahedra as particle domains,
# - choose a frame in which the conditions on the background stay what they are,
# - drive a body by a plane that moves: a pressure that depends on the displacement,
# - follow a path, `update=`, and find a reaction,
# - make a picture in space.
#
# ## Problem
#
# A cube of 2 m lies between two stiff plates, which come together until its height is 60 % of what
# it was. Between rough plates it bulges to a barrel; between smooth ones it stays a block, for
# which the answer is known. The material is von Mises', perfectly plastic:
#
# $$
# f = \frac{\sqrt{2 J_2}}{\rho_y} - 1 \le 0, \qquad E = 10\ \mathrm{MPa}, \quad \nu = 0.3, \quad
# \sigma_y = \sqrt{3/2}\, \rho_y = 100\ \mathrm{kPa}. \tag{1}
# $$
#
# ## Frame and conditions
#
# Three planes of symmetry leave an eighth of the cube, 1 m each way. Conditions are on nodes of the
# background, which is reset after each step: a set of nodes that is right at first must be right
# at the end. The nodes near a plate that moves are not such a set. So the plate stays, at
# $z = 0$, and the plane of symmetry half-way between the plates comes down to it:
#
# - on the background's nodes at $z = 0$, $u = 0$ (rough) or $u_z = 0$ (smooth),
# - on those at $x = 0$ and at $y = 0$, $u_x = 0$ and $u_y = 0$,
# - the top of the body stays in the plane $z = h(t) = 1 - 0.4\, t$.
#
# The last is a condition on the body, whose top is where it was made and rides along. A pressure
# does it, on facets that are tagged,
#
# $$
# p = k\, (z - h(t)), \qquad z = X_z + d_z, \qquad k = 1000\, E / L, \tag{2}
# $$
#
# a bed of very stiff springs, without friction. It acts along the normal of the deformed facets and
# depends on $d$; both are in the tangent. Material that rolls from the side onto the plate
# meets the nodes at $z = 0$ and stays there.
#
# ## What is known
#
# Volume changes by elasticity alone. Between smooth plates the Kirchhoff stress is $-\sigma_y$
# along $z$, so that at the relative height $\lambda$ the force on a plate and the volume are
#
# $$
# N = \sigma_y \frac{A_0}{\lambda}, \qquad
# J = \exp\Bigl(-\frac{\sigma_y}{3 K}\Bigr). \tag{3}
# $$
#
# At rough plates the force is larger, as friction holds the ends together. Elements of low order
# exaggerate it: they cannot flow at constant volume as freely as the material (locking), and the
# force falls with the size of the cells. The shape is hardly touched by that.
#
# ## Implementation

from mpi4py import MPI

import demo_tools as tools
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = tools.Parser("Von Mises block in space, squeezed between two plates.")
parser.add_argument("--domain", choices=("hex", "tet"), default="hex", help="particle domains")
parser.add_argument("--plates", choices=("rough", "smooth"), default="rough", help="the plates")
parser.add_argument("--elements", type=tools.whole, default=4, help="background cells, 1 m")
parser.add_argument("--steps", type=tools.whole, default=40, help="steps")
parser.add_order()
args = parser.parse()

comm = MPI.COMM_WORLD
young, poisson, yield_stress = 10e6, 0.3, 100e3  # Pa, -, Pa
squeeze, stiffness = 0.4, 1000.0 * young  # m, Pa/m
TOP = 1

# The background is a cell higher than the eighth and twice as wide; a cell holds two hexahedra
# each way, or six tetrahedra for each of them. Hexahedra have eight quadrature points here: with
# a single one they have modes of motion without any strain there, and in a flow as free as this
# one those grow until domains are lost.

h = 1.0 / args.elements
background = mesh.create_box(
    comm,
    [[0.0, 0.0, 0.0], [2.0, 2.0, 1.0 + h]],
    [2 * args.elements, 2 * args.elements, args.elements + 1],
    mesh.CellType.hexahedron,
)
V = fem.functionspace(background, ("Lagrange", args.degree, (3,)))
body = mesh.create_box(
    comm,
    [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]],
    [2 * args.elements] * 3,
    mesh.CellType.hexahedron if args.domain == "hex" else mesh.CellType.tetrahedron,
)
order = tools.order(args)
if args.domain == "hex" and order["degree"] == 1:
    order["quadrature_degree"] = args.quadrature_degree or 2
particles = mpm.Particles(body, V, method="cpdi2", **order)

# Conditions on the background's three planes. Those of the plate are one for each direction.


def held(component, plane):
    facets = mesh.locate_entities_boundary(background, 2, lambda x: np.isclose(x[plane], 0.0))
    dofs = fem.locate_dofs_topological(V.sub(component), 2, facets)
    return fem.dirichletbc(0.0, dofs, V.sub(component))


plate = held(2, 2)
bcs = [held(0, 0), held(1, 1), plate]
if args.plates == "rough":
    bcs += [held(0, 2), held(1, 2)]

# The plane (2) is UFL on the body mesh, as any load may be. Loads are multiplied by
# `particles.load`; a path sets it to one if the load's size is its own affair.

top = mesh.locate_entities_boundary(body, 2, lambda x: np.isclose(x[2], 1.0))
tags = mesh.meshtags(body, 2, np.sort(top), np.full(len(top), TOP, dtype=np.int32))
plane = fem.Constant(body, 1.0)
above = ufl.SpatialCoordinate(body)[2] + particles.displacement[2] - plane
problem = mpm.QuasiStaticProblem(
    particles,
    mpm.materials.VonMises(young, poisson, yield_stress=yield_stress),
    bcs=bcs,
    pressures=[(stiffness * above, TOP)],
    facet_tags=tags,
    petsc_options_prefix="block_",
    stabilisation=tools.stabilisation(args),
)


def update(t):
    plane.value = 1.0 - squeeze * t
    particles.load.value = 1.0


curve = [(0.0, 0.0)]
failure = None
try:
    for step in tools.progress(problem.steps(args.steps, update), args.steps, args):
        curve.append((squeeze * step.load, problem.reaction(plate)[2]))
except mpm.MPMError as error:
    failure = error

# ## Result
#
# The height, from the nodes of the top; the barrel, the largest over the smallest distance from
# the axis along the edge of the side face that lies in the plane $y = 0$; the volume, which should
# be about that of (3); and the reaction of the whole plate, four times the quarter's.

own = particles.W.dofmap.index_map.size_local
X, x = particles.W.tabulate_dof_coordinates()[:own], tools.nodes(particles)
height = 2.0 * tools.mean(x[:, 2], np.isclose(X[:, 2], 1.0))
profile = np.isclose(X[:, 0], 1.0) & np.isclose(X[:, 1], 0.0)
barrel = tools.largest(x[profile, 0]) / tools.smallest(x[profile, 0])
bulk = young / (3.0 * (1.0 - 2.0 * poisson))
J = np.exp(-yield_stress / (3.0 * bulk))
volume_error = tools.total(particles.volume) / (J * tools.total(particles.initial_volume)) - 1.0
reaction = 4.0 * curve[-1][1]
smooth = 4.0 * yield_stress / (1.0 - curve[-1][0])

numbers = {
    **tools.outcome(problem.history, failure),
    "height": height,
    "barrel": barrel,
    "volume_error": abs(volume_error),
    "reaction": reaction,
    "reaction_smooth": smooth,
    "plastic_strain": tools.largest(particles.plastic_strain),
    "particles": particles.num_global,
}
rows = [
    ("particles", f"{particles.num_global} ({args.domain}), cells of {h:g} m"),
    ("linear solves", f"{numbers['iterations']}, {numbers['cutbacks']} cutbacks"),
    ("height", f"{height:.5f} m of 2 m"),
    ("barrel", f"{barrel:.4f}"),
    ("volume", f"off by {100 * volume_error:.3f} %"),
    ("force on a plate", f"{reaction / 1e3:.2f} kN (smooth plates, exact: {smooth / 1e3:.2f} kN)"),
]

# The picture: the lower half is made whole by reflection in the planes of symmetry, but for the
# quarter in front, and the upper half is the lower one's mirror image. `mpm.plot.grid` gives the
# domains to pyvista, which draws them without a window; where that cannot be, matplotlib draws
# the same faces. The upper plate is left out. Beside it, the force over the approach of the plates.


def images(points):
    """Return the seven images of points, in a frame whose z is zero half-way."""
    signs = [(a, b, c) for a in (1, -1) for b in (1, -1) for c in (1, -1) if (a, b) != (1, -1)]
    return [(points - (0.0, 0.0, 0.5 * height)) * sign for sign in signs]


def rendered(grid, limit):
    """Draw by pyvista; return an array of pixels."""
    import pyvista

    pyvista.OFF_SCREEN = True
    plotter = pyvista.Plotter(off_screen=True, window_size=(1500, 1200))
    plotter.set_background("white")
    bar = {
        "title": "plastic strain",
        "vertical": False,
        "position_x": 0.28,
        "position_y": 0.02,
        "width": 0.46,
        "height": 0.07,
        "title_font_size": 34,
        "label_font_size": 30,
        "color": "black",
        "fmt": "%.1f",
    }
    for i, points in enumerate(images(grid.points)):
        part = grid.copy()
        part.points = points
        plotter.add_mesh(
            part,
            scalars="plastic_strain",
            cmap="YlGnBu",
            ambient=0.35,
            clim=(0.0, limit),
            show_edges=True,
            edge_color="#404040",
            line_width=1.0,
            show_scalar_bar=i == 0,
            scalar_bar_args=bar,
        )
    low = -0.5 * height
    floor = pyvista.Box(bounds=(-1.75, 1.75, -1.75, 1.75, low - 0.06, low - 0.001))
    plotter.add_mesh(floor, color="#c8c8c8", lighting=False)
    plotter.camera_position = [(4.6, -5.6, 3.2), (0.0, 0.0, -0.25), (0.0, 0.0, 1.0)]
    plotter.camera.zoom(1.12)
    pixels = plotter.screenshot(return_img=True)
    plotter.close()
    return pixels


def drawn(ax, grid, limit):
    """Draw by matplotlib: the surface's faces, far ones first."""
    import matplotlib as mpl
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    surface = grid.extract_surface(algorithm="dataset_surface")
    shades = mpl.colormaps["YlGnBu"](surface.cell_data["plastic_strain"] / limit)
    for points in images(surface.points):
        faces = [points[face] for face in surface.regular_faces]
        ax.add_collection3d(Poly3DCollection(faces, facecolors=shades, edgecolors="0.3", lw=0.3))
    ax.set(xlim=(-1.5, 1.5), ylim=(-1.5, 1.5), zlim=(-1.0, 1.0), xticks=[], yticks=[], zticks=[])
    ax.set_box_aspect((3.0, 3.0, 2.0))
    ax.view_init(elev=20.0, azim=-50.0)
    ax.set_axis_off()


if args.plot:
    grid = mpm.plot.grid(particles)
    fig, _ = tools.figure(12.5, 5.6, ())
    if comm.rank == 0:
        limit = max(float(grid.cell_data["plastic_strain"].max()), 1e-12)
        try:
            pixels = rendered(grid, limit)
        except RuntimeError:  # no way to draw without a window
            drawn(fig.add_axes([0.0, 0.0, 0.56, 0.95], projection="3d"), grid, limit)
        else:
            ax = fig.add_axes([0.0, 0.0, 0.56, 0.93])
            ax.imshow(pixels)
            ax.set_axis_off()
        title = f"A cube, squeezed to {100 * height / 2.0:.0f} % between {args.plates} plates"
        fig.text(0.02, 0.94, title, size=13, weight="bold")
        ax = fig.add_axes([0.65, 0.13, 0.33, 0.74])
        way, force = np.array(curve).T
        blue, orange = tools.COLOURS["blue"], tools.COLOURS["orange"]
        ax.plot(100.0 * way, 4.0 * force / 1e3, "-o", ms=3.5, color=blue, label=f"{args.plates}")
        line = np.linspace(0.0, way[-1], 50)
        label = "smooth, exact (3)"
        ax.plot(100 * line, 4e-3 * yield_stress / (1 - line), "--", color=orange, label=label)
        ax.set(xlabel="approach of the plates, % of the height", ylabel="force, kN")
        ax.set(ylim=(0.0, None), xlim=(0.0, None))
        ax.set_title("Force on a plate")
        ax.legend(loc="upper left")
    tools.save(fig, args)

tools.report(args, numbers, rows, failure)

# With the default arguments the numbers are known; with smooth plates those of (3) are met.

if args.plates == "smooth":
    assert abs(reaction / smooth - 1.0) < 1e-3 and abs(barrel - 1.0) < 1e-6
if args.default:
    assert abs(height - 1.2) < 1e-3 and 1.4 < barrel < 1.55
    assert abs(volume_error) < 0.015 and reaction > smooth
