// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

#include "traction.h"

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
  const double* outward;              // (points,)
  Touching known;
};

struct Met
{
  double *pushes, *rubs;     // (points, 1 + nodes, dim)
  double *pressure, *shear;  // (points,), (points, dim)
  std::uint8_t *inside, *slips;
};

// Set what acts on points and nodes.
void act(const Meeting& meeting, int dim, const Met& result);

// Where derivatives at points add up: in blocks between nodes, those of the point's own facet, over
// which it is spread, then those of its stencil.
struct Sums
{
  int sources;                     // nodes of a point's own facet
  const double *weights, *shapes;  // (points,), (points, sources)
  const std::int64_t* group;       // (points,), which has the positions
  const std::int32_t* positions;   // (groups, sources + nodes, sources + count - 1)
  double* values;                  // (blocks, dim, dim)
};

// Add the derivatives of what acts.
void add_tangents(const Meeting& meeting, int dim, const Sums& sums);

// Add derivatives (points, 1 + nodes, dim, count, dim).
void add_derivatives(std::size_t points, int dim, int nodes, int count, const double* derivatives,
                     const Sums& sums);
} // namespace core
