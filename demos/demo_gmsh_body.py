# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
# Level: 2.4: A plate with stiffened holes bends; unstructured triangles

# # A body with holes, from gmsh
#
# It illustrates how to:
# - make a body with gmsh, its parts and edges named by physical groups,
# - take the groups as tags of cells and facets, `dolfinx.io.gmsh.model_to_mesh`,
# - give each part its own material, `{tag: material}`,
# - load a tagged edge, which goes with the body,
# - use an unstructured background of triangles.
#
# ## Problem
#
# A plate, 4 m long and 1 m high, has three round holes. Around each hole is a ring that is ten
# times stiffer than the plate. The plate is clamped at its left end; at its right end acts a dead
# traction upwards,
#
# $$
# t = (0, \bar t), \qquad \bar t = 12\ \mathrm{kPa}, \tag{1}
# $$
#
# and bends it by more than its height. Both materials are Hencky's, in plane strain,
#
# $$
# \tau = K\, \mathrm{tr}(\varepsilon)\, I + 2 G\, \mathrm{dev}\, \varepsilon, \qquad
# \varepsilon = \ln V, \qquad E = 1\ \mathrm{MPa} \text{ or } 10\ \mathrm{MPa}, \quad
# \nu = 0.3. \tag{2}
# $$
#
# The background is a rectangle of triangles of its own, made by gmsh too; the body's nodes are
# nowhere near its. Its left side is where the plate is held.
#
# ## Implementation

from mpi4py import MPI

import gmsh
import numpy as np

from dolfinx import fem

import mpm_dolfinx as mpm

try:
    from dolfinx.io import gmsh as gmshio
except ImportError:  # its name until DOLFINx 0.9
    from dolfinx.io import gmshio

comm = MPI.COMM_WORLD
length, height, radius, thickness = 4.0, 1.0, 0.25, 0.1  # m
centres = (0.8, 2.0, 3.2)
traction = 12e3  # Pa
PLATE, RINGS, END = 1, 2, 3

# ### Meshes
#
# gmsh works on rank 0; `model_to_mesh` spreads the mesh over all ranks. `fragment` cuts the
# plate along the rings, so that they share nodes.


def meshed(build, size):
    """The mesh that `build` describes, with tags of cells and facets."""
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    if comm.rank == 0:
        gmsh.model.add("model")
        build(gmsh.model)
        gmsh.option.setNumber("Mesh.MeshSizeMin", size)
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.model.mesh.generate(2)
    domain, cells, facets, *_ = gmshio.model_to_mesh(gmsh.model, comm, 0, gdim=2)
    gmsh.finalize()
    return domain, cells, facets


def discs(occ, size):
    return [(2, occ.addDisk(x, height / 2.0, 0.0, size, size)) for x in centres]


def plate(model):
    occ = model.occ
    rectangle = (2, occ.addRectangle(0.0, 0.0, 0.0, length, height))
    whole, _ = occ.cut([rectangle], discs(occ, radius))
    rings, _ = occ.cut(discs(occ, radius + thickness), discs(occ, radius))
    everything, parts = occ.fragment(whole, rings)
    occ.synchronize()
    ring_tags = {tag for part in parts[len(whole) :] for _, tag in part}
    plate_tags = {tag for _, tag in everything} - ring_tags
    model.addPhysicalGroup(2, sorted(plate_tags), PLATE, name="plate")
    model.addPhysicalGroup(2, sorted(ring_tags), RINGS, name="rings")
    box = (length - 1e-6, -1e-6, -1e-6, length + 1e-6, height + 1e-6, 1e-6)
    end = [tag for _, tag in model.getEntitiesInBoundingBox(*box, dim=1)]
    model.addPhysicalGroup(1, end, END, name="end")


def room(model):
    sheet = model.occ.addRectangle(0.0, -0.7, 0.0, 4.6, 4.6)
    model.occ.synchronize()
    model.addPhysicalGroup(2, [sheet], 1, name="background")


body, parts, edges = meshed(plate, 0.06)
background, _, _ = meshed(room, 0.12)

# ### Problem
#
# From here on nothing tells that gmsh was there.

V = fem.functionspace(background, ("Lagrange", 1, (2,)))
clamp = mpm.held(V, x=0.0)

particles = mpm.Particles(body, V)
problem = mpm.QuasiStaticProblem(
    mpm.Body(
        particles,
        {PLATE: mpm.materials.Hencky(1e6, 0.3), RINGS: mpm.materials.Hencky(10e6, 0.3)},
        tractions=[((0.0, traction), END)],
        cell_tags=parts,
        facet_tags=edges,
    ),
    bcs=[clamp],
)

problem.solve(steps=20)

# ## Result
#
# The deflection of the end, the area (whose value is known but for the polygons that stand for
# circles), and the error of the reaction, which is the load.

own = particles.W.dofmap.index_map.size_local
end = np.isclose(particles.W.tabulate_dof_coordinates()[:own, 0], length)
moved = particles.displacement.x.array.reshape(-1, 2)[:own][end]
shortening, deflection = comm.allreduce(moved.sum(axis=0)) / comm.allreduce(len(moved)) * (-1, 1)
force = np.array([0.0, traction * height])
error_reaction = float(np.abs(problem.reaction(clamp) + force).max()) / (traction * height)
area = comm.allreduce(particles.initial_volume.sum())
error_area = abs(area / (length * height - len(centres) * np.pi * radius**2) - 1.0)

if comm.rank == 0:
    solves = problem.history.total_iterations
    print(f"{particles.num_global} triangles, {solves} linear solves")
    print(f"deflection {deflection:.4f} m, shortening {shortening:.4f} m")
    print(f"error of the reaction {error_reaction:.1e}")

# The colours end at 250 kPa, which some domains of the rings exceed.

view = {"label": "von Mises stress, Pa", "limits": (0.0, 2.5e5), "background": False}
mpm.plot.scene(problem, "mises", "gmsh_body.png", **view)

# gmsh's meshes, and with them the last digits, may differ from version to version.

assert error_reaction < 1e-9 and error_area < 0.01
assert abs(deflection / 1.994 - 1.0) < 0.02

# ## Exercises
#
# 1. Make the rings as soft as the plate. How much more does it bend?
# 2. Add a fourth hole, without a ring, and give its edge a pressure, `pressures=`.
# 3. Halve the sizes of both meshes. Which digit of the deflection changes?
