# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A block squeezed between plates.

demos/demo_block3d.py is its simplest form and has the equations.
"""

from mpi4py import MPI

import kit
import numpy as np

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

parser = kit.Parser("Von Mises block in space, squeezed between two plates.")
parser.add_argument("--domain", choices=("hex", "tet"), default="hex", help="particle domains")
parser.add_argument("--plates", choices=("rough", "smooth"), default="rough", help="the plates")
parser.add_argument("--elements", type=kit.whole, default=4, help="background cells, 1 m")
parser.add_steps(40)
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
order = kit.order(args)
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
    mpm.Body(
        particles,
        mpm.materials.VonMises(young, poisson, yield_stress=yield_stress),
        pressures=[(stiffness * above, TOP)],
        facet_tags=tags,
    ),
    bcs=bcs,
    solver=mpm.Solver(petsc_options_prefix="block_", stabilisation=kit.stabilisation(args)),
)


def update(t):
    plane.value = 1.0 - squeeze * t
    particles.load.value = 1.0


curve = [(0.0, 0.0)]
failure = None
try:
    for step in kit.progress(problem.steps(**kit.chosen(args), update=update), args.steps, args):
        curve.append((squeeze * step.load, problem.reaction(plate)[2]))
except mpm.MPMError as error:
    failure = error

# The height, from the nodes of the top; the barrel, the largest over the smallest distance from
# the axis along the edge of the side face that lies in the plane $y = 0$; the volume, which should
# be about that of (3); and the reaction of the whole plate, four times the quarter's.

own = particles.W.dofmap.index_map.size_local
X, x = particles.W.tabulate_dof_coordinates()[:own], kit.nodes(particles)
height = 2.0 * kit.mean(x[:, 2], np.isclose(X[:, 2], 1.0))
profile = np.isclose(X[:, 0], 1.0) & np.isclose(X[:, 1], 0.0)
barrel = kit.largest(x[profile, 0]) / kit.smallest(x[profile, 0])
bulk = young / (3.0 * (1.0 - 2.0 * poisson))
J = np.exp(-yield_stress / (3.0 * bulk))
volume_error = kit.total(particles.volume) / (J * kit.total(particles.initial_volume)) - 1.0
reaction = 4.0 * curve[-1][1]
smooth = 4.0 * yield_stress / (1.0 - curve[-1][0])

numbers = {
    **kit.outcome(problem.history, failure),
    "height": height,
    "barrel": barrel,
    "volume_error": abs(volume_error),
    "reaction": reaction,
    "reaction_smooth": smooth,
    "plastic_strain": kit.largest(particles.plastic_strain),
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
    fig, _ = kit.figure(12.5, 5.6, ())
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
        blue, orange = kit.COLOURS["blue"], kit.COLOURS["orange"]
        ax.plot(100.0 * way, 4.0 * force / 1e3, "-o", ms=3.5, color=blue, label=f"{args.plates}")
        line = np.linspace(0.0, way[-1], 50)
        label = "smooth, exact (3)"
        ax.plot(100 * line, 4e-3 * yield_stress / (1 - line), "--", color=orange, label=label)
        ax.set(xlabel="approach of the plates, % of the height", ylabel="force, kN")
        ax.set(ylim=(0.0, None), xlim=(0.0, None))
        ax.set_title("Force on a plate")
        ax.legend(loc="upper left")
    kit.save(fig, args)

kit.report(args, numbers, rows, failure)

# With the default arguments the numbers are known; with smooth plates those of (3) are met.

if args.plates == "smooth":
    assert abs(reaction / smooth - 1.0) < 1e-3 and abs(barrel - 1.0) < 1e-6
if args.default:
    assert abs(height - 1.2) < 1e-3 and 1.4 < barrel < 1.55
    assert abs(volume_error) < 0.015 and reaction > smooth
