# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rules on cells, and meshes made of meshes.

A body mesh is an ordinary DOLFINx mesh whose cells are particle domains. This folder has what such
a mesh needs whatever moves it: quadrature on its cells and gradients at the points
(:mod:`~mpm_dolfinx.meshes.quadrature`), a bound of the Jacobian that tells which cells fold
(:mod:`~mpm_dolfinx.meshes.jacobian_bound`), meshes of boxes around points
(:mod:`~mpm_dolfinx.meshes.boxes`), the facets nearest to points
(:mod:`~mpm_dolfinx.meshes.nearest`), the values and tags of users on it
(:mod:`~mpm_dolfinx.meshes.values`, :mod:`~mpm_dolfinx.meshes.tags`), and meshes made of a mesh: on
other ranks (:mod:`~mpm_dolfinx.meshes.redistribution`), with cells cut or nodes moved
(:mod:`~mpm_dolfinx.meshes.remesh`). Each of the latter two can carry tags, nodal values and values
of cells from the mesh before to the one after.
"""
