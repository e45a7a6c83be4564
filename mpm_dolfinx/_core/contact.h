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
struct Table
{
  const double *shape, *slope, *bend; // (points, nodes), (., e, nodes), (., e, e, nodes)
};

struct Meeting
{
  std::size_t points;
  int count, nodes;
  const double* x;        // (points, count, dim)
  Table table;            // where points are projected
  const double* anchored; // (points, nodes)
  const double* outward;  // (points,)
  Touching known;
  // In a step of a motion: positions of points and nodes where it begins (points, 1 + nodes, dim),
  // where points are projected in its middle, gaps where it begins, and those at which points begin to
  // be pressed (points,); otherwise null.
  const double* start;
  Table middle;
  const double *before, *offset;
};

struct Met
{
  double *pushes, *rubs;     // (points, 1 + nodes, dim)
  double* pressure;          // (points,)
  std::uint8_t *inside, *slips;
};

// Set what acts on points and nodes.
void act(const Meeting& meeting, int dim, const Met& result);

// Set the derivatives of forces on points and nodes by a pressure on top, (points, 1 + nodes, dim).
void differentiate_by_pressure(const Meeting& meeting, int dim, double* slopes);

// Set gaps (points,), normals, in a step those of its middle, and ways from anchors (points, dim).
void see(const Meeting& meeting, int dim, double* gap, double* n, double* delta);

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

// Add given derivatives of tractions at points by their positions, (points, dim, dim).
void add_slopes(std::size_t points, int dim, const double* slopes, const Sums& sums);
} // namespace core
