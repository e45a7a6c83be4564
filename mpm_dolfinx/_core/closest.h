// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

#include <cstddef>
#include <cstdint>

namespace core
{
// Points and flat or bilinear facets, lines, triangles or quadrilaterals by the number of nodes.
struct Search
{
  std::size_t points, facets;
  int nodes;
  const double *x, *normal;       // (points, dim); no normals: or null
  const double* corners;          // (facets, nodes, dim)
  const double* outward;          // (facets,)
  const std::uint8_t* present;    // (facets,)
  double reach, facing, sure, may, close; // see mpm_dolfinx.contact.facets
  int most;
};

struct Found
{
  std::int64_t* facet; // -1 where there is none, (points,)
  double *place, *gap; // (points, dim - 1), (points,)
  std::uint8_t* near;
  double* beside;
};

// Find the closest facet of each point. The oracle is NearFacets.closest. Returns whether all facets
// have an area.
bool find_closest(const Search& search, int dim, const Found& found);
} // namespace core
