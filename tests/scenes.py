# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Meshes, scenes and gathered arrays that several test files share."""

from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from posed import posed
from scipy.sparse import csr_array
from scipy.special import lambertw

import ufl
from dolfinx import fem, la, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import LinearElastic
from mpm_dolfinx.meshes.cells import input_cell_index

WORLD = MPI.COMM_WORLD
TRIANGLE, QUADRILATERAL = mesh.CellType.triangle, mesh.CellType.quadrilateral
TETRAHEDRON, HEXAHEDRON = mesh.CellType.tetrahedron, mesh.CellType.hexahedron
PLANE = [TRIANGLE, QUADRILATERAL]
ALL = [*PLANE, TETRAHEDRON, HEXAHEDRON]


def name(cell):
    """Return a name for a test's parameter."""
    return cell.name if isinstance(cell, mesh.CellType) else None


# -- Meshes ------------------------------------------------------------------------------


def box(lower, upper, n, cell, comm=WORLD, diagonal="left_right", **options):
    """Return a structured mesh of a rectangle or a box."""
    if len(n) == 3:
        return mesh.create_box(comm, [lower, upper], n, cell, **options)
    kind = getattr(mesh.DiagonalType, diagonal)
    return mesh.create_rectangle(comm, [lower, upper], n, cell, diagonal=kind, **options)


def unit(n, cell, comm=WORLD):
    """Return a mesh of the unit square or cube with n cells along each edge."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    return box([0.0] * dim, [1.0] * dim, [n] * dim, cell, comm)


def bend(domain, amount):
    """Move the vertices inside the unit square or cube; the same on any number of ranks."""
    dim = domain.geometry.dim
    x = domain.geometry.x[:, :dim]
    bubble = np.prod(16.0 ** (1.0 / dim) * x * (1.0 - x), axis=1)[:, None]
    x += amount * bubble * np.sin(np.outer(x @ [23.0, 37.0, 53.0][:dim], [1.0, 1.7, 2.3][:dim]))
    return domain


def shear(domain, gradient=((1.3, 0.4, 0.2), (-0.2, 0.9, 0.1), (0.1, 0.3, 1.1))):
    """Apply a linear map to a mesh."""
    dim = domain.geometry.dim
    domain.geometry.x[:, :dim] = domain.geometry.x[:, :dim] @ np.array(gradient)[:dim, :dim].T
    return domain


def vectors(domain, degree=1):
    """Return the vector Lagrange space on a mesh."""
    return fem.functionspace(domain, ("Lagrange", degree, (domain.geometry.dim,)))


# -- Conditions --------------------------------------------------------------------------


def fix(V, where, value=0.0, component=None):
    """Return a Dirichlet condition on the boundary facets where a marker holds."""
    facets = mesh.locate_entities_boundary(V.mesh, V.mesh.topology.dim - 1, where)
    space = V if component is None else V.sub(component)
    dofs = fem.locate_dofs_topological(space, V.mesh.topology.dim - 1, facets)
    if component is None and np.ndim(value) == 0:
        value = np.full(V.mesh.geometry.dim, float(value))
    return fem.dirichletbc(value, dofs, space)


def below(V, height):
    """Return a condition that holds all nodes of a background below a height, inside it too."""
    dim = V.mesh.geometry.dim
    dofs = fem.locate_dofs_geometrical(V, lambda x: x[dim - 1] < height)
    return fem.dirichletbc(np.zeros(dim), dofs, V)


def at(axis, *places):
    """Return a marker of the planes x[axis] = place."""
    return lambda x: np.isclose(x[axis][:, None], places).any(axis=1)


def everywhere(V):
    """Return a condition on all dofs of a space, and the Function that holds its values."""
    values = fem.Function(V)
    nodes = np.arange(V.dofmap.index_map.size_local + V.dofmap.index_map.num_ghosts)
    return fem.dirichletbc(values, nodes.astype(np.int32)), values


def facet_tags(domain, *markers):
    """Return tags 1, 2, ... of the boundary facets where each marker holds."""
    dim = domain.topology.dim - 1
    found = [mesh.locate_entities_boundary(domain, dim, marker) for marker in markers]
    values = np.concatenate([np.full(len(f), i + 1, np.int32) for i, f in enumerate(found)])
    facets = np.concatenate(found)
    order = np.argsort(facets)
    return mesh.meshtags(domain, dim, facets[order], values[order])


def cell_tags(domain, tag):
    """Return tags of the cells by a function of their midpoints ``(n, 3)``."""
    cells = domain.topology.index_map(domain.topology.dim)
    indices = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
    middle = mesh.compute_midpoints(domain, domain.topology.dim, indices)
    return mesh.meshtags(domain, domain.topology.dim, indices, tag(middle).astype(np.int32))


# -- Arrays of all ranks -----------------------------------------------------------------


def gather(array, comm=WORLD):
    """Return the rows of all ranks, in the order of ranks."""
    return np.concatenate(comm.allgather(np.asarray(array)))


def in_order(particles, values):
    """Return values of all particles, by global index."""
    comm = particles.mesh.comm
    index = gather(particles.global_index, comm)
    return gather(values, comm)[np.argsort(index)]


def total(particles, values):
    """Return the sum of values over all particles."""
    return particles.mesh.comm.allreduce(np.asarray(values).sum(axis=0))


def dense(matrix):
    """Return a PETSc matrix as a dense array, on all ranks."""
    indptr, indices, data = matrix.getValuesCSR()
    sizes = (len(indptr) - 1, matrix.getSize()[1])
    blocks = matrix.comm.tompi4py().allgather(csr_array((data, indices, indptr), sizes).toarray())
    return np.concatenate(blocks)


def coordinates(V):
    """Return the positions of all nodes of a space by global number."""
    owned = V.dofmap.index_map.size_local
    return gather(V.tabulate_dof_coordinates()[:owned, : V.mesh.geometry.dim], V.mesh.comm)


def own(function):
    """Return the owned part of a Function's array."""
    dofs = function.function_space.dofmap
    return function.x.array[: dofs.index_map.size_local * dofs.index_map_bs]


def assembled(form):
    """Return the owned part of a vector assembled by stock DOLFINx from one UFL form."""
    vector = fem.assemble_vector(fem.form(form))
    vector.scatter_reverse(la.InsertMode.add)
    return vector.array[: vector.index_map.size_local * vector.block_size]


def largest(values, comm=WORLD):
    """Return the largest absolute value on all ranks."""
    return comm.allreduce(float(np.abs(values).max(initial=0.0)), MPI.MAX)


def node_positions(particles):
    """Return the present positions of all nodes of the body, in any order."""
    d = own(particles.displacement).reshape(-1, particles.mesh.geometry.dim)
    X = particles.W.tabulate_dof_coordinates()[: len(d), : d.shape[1]]
    return gather(X + d, particles.mesh.comm)


def state(problem):
    """Return copies of everything that a failed step must leave as it was."""
    particles = problem.particles
    arrays = {
        "displacement": particles.displacement.x.array,
        "volume": particles.volume,
        "centroid": particles.centroid,
        "deformation_gradient": particles.deformation_gradient,
        "load": np.array(particles.load.value),
        **{f"reaction {i}": problem.reaction(bc) for i, bc in enumerate(problem.bcs)},
    }
    if particles.has_material:
        arrays["stress"] = particles.stress
        arrays["plastic_strain"] = particles.plastic_strain
        arrays["yield_function"] = problem.yield_function
    return {key: value.copy() for key, value in arrays.items()}


def assert_same_state(before, after):
    """Compare states bit by bit."""
    assert before.keys() == after.keys()
    for key in before:
        assert np.array_equal(before[key], after[key]), key


def move(particles, displacement, commit=True):
    """Give the nodes a displacement, a function of positions ``(n, gdim)``."""
    dim = particles.mesh.geometry.dim
    X = particles.W.tabulate_dof_coordinates()[:, :dim]
    particles.displacement.x.array[:] = displacement(X).ravel()
    if commit:
        particles.commit()


# -- Materials in UFL --------------------------------------------------------------------


def lame(young, poisson):
    """Return Lame's constants."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def neo_hookean(d, young=1e4, poisson=0.3):
    """Return the stored energy of a compressible neo-Hookean body in plane strain."""
    lmbda, mu = lame(young, poisson)
    F = ufl.Identity(2) + ufl.grad(d)
    J = ufl.det(F)
    return mu / 2 * (ufl.tr(F.T * F) - 2) - mu * ufl.ln(J) + lmbda / 2 * ufl.ln(J) ** 2


def hencky(d, young, poisson):
    """Return Hencky's stored energy in plane strain, by the eigenvalues of C."""
    lmbda, mu = lame(young, poisson)
    F = ufl.Identity(2) + ufl.grad(d)
    C = F.T * F
    mean = ufl.tr(C) / 2
    root = ufl.sqrt(((C[0, 0] - C[1, 1]) / 2) ** 2 + C[0, 1] ** 2 + 1e-12)
    a, b = ufl.ln(mean + root) / 2, ufl.ln(mean - root) / 2
    return lmbda / 2 * (a + b) ** 2 + mu * (a**2 + b**2)


def linear_stress(d, young, poisson):
    """Return the stress of linear elasticity in plane strain."""
    lmbda, mu = lame(young, poisson)
    strain = ufl.sym(ufl.grad(d))
    return lmbda * ufl.tr(strain) * ufl.Identity(2) + 2 * mu * strain


# -- A column under its weight, between rollers ------------------------------------------


class Column(NamedTuple):
    """Data of a column; M is the confined modulus, g0 the weight per volume."""

    length: float
    young: float
    poisson: float
    density: float
    rho_y: float = np.inf

    @property
    def g0(self):
        return 10.0 * self.density

    @property
    def K(self):
        return self.young / (3 * (1 - 2 * self.poisson))

    @property
    def G(self):
        return self.young / (2 * (1 + self.poisson))

    @property
    def M(self):
        return self.K + 4 * self.G / 3

    def strain(self, Y):
        """Return the exact compressive logarithmic strain (finite strain)."""
        load = self.g0 * (self.length - np.asarray(Y))
        w = np.real(lambertw(load / self.M))
        c = np.sqrt(2 / 3) * self.rho_y
        if np.isfinite(c):
            plastic = np.real(lambertw(load / self.K * np.exp(c / self.K))) - c / self.K
            w = np.where(np.sqrt(8 / 3) * self.G * w > self.rho_y, plastic, w)
        return w

    def stress(self, Y):
        """Return the exact stress across (x) and along (y) the column (finite strain)."""
        w = self.strain(Y)
        along = -self.g0 * (self.length - np.asarray(Y))
        across = -(self.K - 2 * self.G / 3) * w * np.exp(w)
        if np.isfinite(self.rho_y):
            plastic = along + np.sqrt(3 / 2) * self.rho_y * np.exp(w)
            across = np.where(np.sqrt(8 / 3) * self.G * w > self.rho_y, plastic, across)
        return across, along


A = Column(50.0, 1e4, 0.0, 80.0)
B = Column(10.0, 2e5, 0.3, 800.0, 20e3)


def column(
    case,
    ne,
    cell,
    material,
    comm=WORLD,
    gravity=10.0,
    material_of=None,
    method="cpdi2",
    quadrature_degree=None,
    **options,
):
    """Return a problem: a column one background cell wide, 2 x 2 particles in each.

    ``problem.bcs`` are the rollers on both sides and that at the base; ``material_of`` makes
    material and options from the body mesh.
    """
    h = case.length / ne
    V = vectors(box([0.0, 0.0], [h, case.length], [1, ne], QUADRILATERAL, comm))
    body = box([0.0, 0.0], [h, case.length], [2, 2 * ne], cell, comm)
    if material_of is not None:
        material, options = material_of(body)
    bcs = [fix(V, at(0, 0.0, h), component=0), fix(V, at(1, 0.0), component=1)]
    return posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V, method=method, quadrature_degree=quadrature_degree),
        material,
        density=case.density,
        body_force=(0.0, -gravity),
        bcs=bcs,
        **options,
    )


def stress_error(problem, case, component, exact):
    """Return the error of a stress component as in the issue's tables."""
    particles = problem.particles
    gap = np.abs(particles.stress[:, component, component] - exact) * particles.initial_volume
    volume = total(particles, particles.initial_volume)
    return total(particles, gap) / (case.g0 * case.length * volume)


# -- A column that slumps ----------------------------------------------------------------


def slump(
    cell,
    g0,
    material=None,
    h=0.5,
    width=20.0,
    comm=WORLD,
    height=8.0,
    method="cpdi2",
    quadrature_degree=None,
    **options,
):
    """Return the half model of a free elastoplastic column on a roller, 4 wide and 8 high."""
    n = [round(width / h), round(10.0 / h)]
    V = vectors(box([0.0, 0.0], [width, 10.0], n, QUADRILATERAL, comm))
    body = box([0.0, 0.0], [4.0, height], [round(8.0 / h), round(2 * height / h)], cell, comm)
    bcs = [fix(V, at(0, 0.0), component=0), fix(V, at(1, 0.0), component=1)]
    return posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V, method=method, quadrature_degree=quadrature_degree),
        material or mpm.materials.VonMises(1e6, 0.3, rho_y=20e3),
        density=1000.0,
        body_force=(0.0, -g0 / 1000.0),
        bcs=bcs,
        **options,
    )


# -- A small block that hangs, for tests of steps and errors ------------------------------


def block(material=None, cell=TRIANGLE, n=4, comm=WORLD, force=(0.0, -10.0), **options):
    """Return a unit block in a background of 2 x 1.5, held at its left side."""
    V = vectors(box([0.0, -0.25], [2.0, 1.25], [8, 6], QUADRILATERAL, comm))
    body = box([0.0, 0.0], [1.0, 1.0], [n, n], cell, comm)
    options.setdefault("bcs", [fix(V, at(0, 0.0))])
    return posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V),
        material or mpm.materials.Hencky(1e3, 0.3),
        density=2.0,
        body_force=force,
        **options,
    )


def times_tangent(problem, values):
    """Return the tangent of the last residual times a vector on W, at this rank's own dofs."""
    forms = problem.built.body_terms[0].forms
    if forms.stock:
        forms.assemble_tangent()
    vector = forms.r.duplicate()
    vector.array_w[:] = values.ravel()[: vector.getLocalSize()]
    return forms.stiffness_force(vector).array_r.copy()


def top(problem):
    """Return the height of the highest node."""
    return node_positions(problem.particles)[:, 1].max()


def falling(depth=1.0, outside="delete", method="cpdi2", density=3.0, cell=QUADRILATERAL):
    """Return a unit block, 0.5 above the end of the background, moved down as a whole."""
    V = vectors(box([-0.5, -0.5], [1.5, 1.5], [4, 4], QUADRILATERAL))
    bc, u = everywhere(V)
    u.x.array.reshape(-1, 2)[:] = [0.0, -depth]
    particles = mpm.Particles(unit(4, cell), V, method=method, outside=outside)
    return mpm.QuasiStaticProblem(
        mpm.Body(particles, LinearElastic(1e4, 0.3), density=density), bcs=[bc]
    )


def anywhere(body, seed=1):
    """Return a rank for each cell, by its input index."""
    cells = body.topology.index_map(body.topology.dim)
    every = np.random.default_rng(seed).integers(0, WORLD.size, cells.size_global)
    return every[input_cell_index(body)]


def pulled(material, end=0.4, **options):
    """Return a block that is pulled at its right side, where the background ends."""
    V = vectors(box([0.0, -0.5], [2.0, 1.5], [8, 8], QUADRILATERAL))
    body = box([0.0, 0.0], [1.0, 1.0], [4, 4], TRIANGLE)
    nodes = V.tabulate_dof_coordinates()
    grip = np.flatnonzero(nodes[:, 0] > 0.99).astype(np.int32)
    value = fem.Constant(V.mesh, np.array([end, 0.0]))
    bcs = [fix(V, at(0, 0.0)), fem.dirichletbc(value, grip, V)]
    problem = posed(mpm.QuasiStaticProblem, mpm.Particles(body, V), material, bcs=bcs, **options)
    return problem, value
