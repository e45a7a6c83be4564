// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Points in the cells of a background that are boxes of a rectilinear grid, and the rows of T.

#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace core
{
// The lines of a grid in one direction, and their distance where they are evenly spaced, else 0.
struct Lines
{
  std::size_t count;
  const double* values;
  double size;
};

// Cells that are boxes of a grid, or some of its boxes.
struct Boxes
{
  int dim;
  Lines lines[3];
  const std::int64_t* table;  // the cell in each box, -1 where there is none
  const std::int64_t* first;  // its number in the input: on a facet the first cell wins
  const double *slopes, *centres, *middle; // X = middle + slopes (x - centre)
  const double* slack;        // round-off of reference coordinates
};

// What is small beside coordinates, and in reference coordinates.
struct Tolerances
{
  double coordinates, facet;
};

// Set the cell of each point, its reference coordinates and how far they lie outside of it (0:
// inside), where there is one; points that are no numbers, or in no box with a cell, are left.
void locate(const Boxes& boxes, const Tolerances& tolerances, const double* points,
            std::size_t count, std::int64_t* cells, double* reference, double* outside);

// Entries of compressed rows.
template <typename Index>
struct RowEntries
{
  std::vector<Index> columns;
  std::vector<double> values;
};

// Rows of T for each of bs components, of points with the values of k nodes each: sorted, without
// zeros. Sets the offsets of the rows.
template <typename Index>
RowEntries<Index> transfer_rows(std::size_t count, std::size_t k, int bs,
                                const std::int64_t* nodes, const double* values, Index* offsets);

// Values of k nodes of the background at points, for dim components: T as it is found.
struct Basis
{
  std::size_t count, k;
  int dim;
  const std::int64_t* nodes; // (count, k)
  const double* values;
};

// Set y to T x.
void apply(const Basis& T, const double* x, double* y);

// Add T^T y to x.
void add_transposed(const Basis& T, const double* y, double* x);
} // namespace core
