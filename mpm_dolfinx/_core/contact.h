// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

#include <cstddef>
#include <cstdint>

namespace core
{
// Points that meet facets: see mpm_dolfinx.contact.stencil. A point has `count` places in its stencil:
// itself, the `nodes` of its facet and, with friction, those of the facet of its anchor.
struct Meeting
{
  std::size_t points;
  int count, nodes;
  const double* x;                    // (points, count, dim)
  const double *shape, *slope, *bend; // (points, nodes), (., e, nodes), (., e, e, nodes)
  const double* anchored;             // (points, nodes)
  const double* outward;              // (points,), as all below
  const double *stiffness, *tangential;
  const std::uint8_t* touched;
  const double *gap, *stretch; // at the last converged step; of areas
  double friction, cohesion, limit, touch;
  bool smooth; // whether there is no friction
};

struct Met
{
  double *pushes, *rubs;     // (points, 1 + nodes, dim)
  double *pressure, *shear;  // (points,), (points, dim)
  std::uint8_t *inside, *slips;
};

// Set what acts on points and nodes. The oracle is mpm_dolfinx.contact.stencil.acting.
void act(const Meeting& meeting, int dim, const Met& result);

// Set its derivatives, (points, 1 + nodes, dim, count, dim).
void differentiate(const Meeting& meeting, int dim, double* derivatives);

// A side of blocks: places of a stencil, from `first` on, or the point itself, which is spread over
// `nodes` of its facet by shape functions (points, nodes).
struct Side
{
  int first, nodes;
  const double* shapes; // or null
};

// Add derivatives (points, places, dim, count, dim), times weights, to blocks by their numbers.
void add_blocks(std::size_t points, int dim, int places, int count, const double* derivatives,
                const double* weights, const std::int64_t* number, const Side& rows,
                const Side& columns, double* blocks);

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
