// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

#include <cstddef>
#include <cstdint>

namespace core
{
// Lagrange facets of some degree: lines, triangles or quadrilaterals. Their shape functions are given
// by monomials, in the order of the powers of the first coordinate, then of those of the second.
struct Shape
{
  int degree, nodes, count;
  bool simplex;               // a triangle (or a line)
  const double* coefficients; // (count, nodes)
  double close;               // last step of a projection, the next one is its square
  int most;                   // steps of it
};

// Shape functions with derivatives: (points, nodes), (., e, nodes), (., e, e, nodes).
struct Tables
{
  double *shape, *slope, *bend;
};

// Set them at some places.
void tabulate(std::size_t points, int dim, const Shape& shape, const double* place,
              const Tables& tables);

// Project points on facets, each on one, from some places there. Returns whether all have an area.
bool project(std::size_t points, int dim, const Shape& shape, const double* x,
             const double* corners, double* place);

// Points and facets that may be near.
struct Search
{
  std::size_t points, facets;
  Shape shape;
  const double *x, *normal;       // (points, dim); no normals: or null
  const double* corners;          // (facets, nodes, dim)
  const double* outward;          // (facets,)
  const std::uint8_t* present;    // (facets,)
  double reach, facing, sure, may; // see mpm_dolfinx.contact.facets
};

struct Found
{
  std::int64_t* facet; // -1 where there is none, (points,)
  double *place, *gap; // (points, dim - 1), (points,)
  std::uint8_t* near;
  double* beside;
};

// Find the closest facet of each point. Returns whether all facets have an area.
bool find_closest(const Search& search, int dim, const Found& found);
} // namespace core
