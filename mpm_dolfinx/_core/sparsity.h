// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Where the tangents of domains add up: blocks between background nodes, and scalars between dofs.
// Rows and columns may belong to different fields.

#pragma once

#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace core
{
// The nodes of one field that each domain sees, sorted, in compressed rows.
struct Seen
{
  const std::int64_t* offsets;
  const std::int32_t* nodes;
  std::size_t num_nodes;
};

// Sparsity of the sum over domains, and where each pair of the nodes that one sees is in it.
struct Pattern
{
  std::vector<std::int32_t> offsets, nodes, positions;
};
Pattern pattern(const Seen& rows, const Seen& columns, std::size_t count);

// Entries of patterns of blocks by the numbers of their dofs (-1: none), in compressed rows of
// scalars. Sources are their places among the values of the blocks, one behind these for entries
// that are not of the patterns.
struct Entries
{
  std::vector<std::int32_t> offsets{0}, columns;
  std::vector<std::uint32_t> sources;
};

// A pattern whose columns are the nodes of one field, with that many dofs each and their numbers.
struct Columns
{
  const std::int32_t* offsets;
  const std::int32_t* nodes;
  int dim;
  const std::int32_t* numbers;
};

// The rows of one field, with patterns beside each other. Values are those of one pattern after
// the other, in blocks (dim of the rows, dim of the columns).
struct Numbered
{
  std::size_t num_nodes;
  int dim;
  const std::int32_t* numbers;
  std::vector<Columns> parts;
};

// A range of numbers.
struct Range
{
  std::int32_t first, last;
};

// The rows in a range, with further entries that other ranks have there: columns of this rank (less
// the first of them), other columns, and the places of the further entries in both together.
struct Reduced
{
  Entries inside, outside;
  std::vector<std::int64_t> places;
};
Reduced reduce(const Numbered& patterns, Range rows, Range rank,
               const std::int32_t* further_offsets, const std::int32_t* further_columns);

// The rows outside the range, and their numbers.
std::pair<std::vector<std::int32_t>, Entries> foreign_rows(const Numbered& patterns, Range range);

// y = K x with blocks in compressed rows.
void multiply(const std::int32_t* offsets, const std::int32_t* nodes, std::size_t num_nodes,
              int dim, const double* values, const double* x, double* y);
} // namespace core
