// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Where the tangents of domains add up: blocks between background nodes, and scalars between dofs.

#pragma once

#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace core
{
// Sparsity of the sum over domains, and where each pair of a support's nodes is in it.
struct Pattern
{
  std::vector<std::int32_t> offsets, nodes, positions;
};
Pattern pattern(const std::int64_t* offsets, const std::int32_t* nodes, std::size_t count,
                std::size_t num_nodes);

// Entries of a pattern of blocks (dim, dim) by the numbers of their dofs (-1: none), in compressed
// rows of scalars. Sources are their places among the values of the blocks, one behind these for
// entries that are not of the pattern.
struct Entries
{
  std::vector<std::int32_t> offsets{0}, columns;
  std::vector<std::uint32_t> sources;
};

// What numbers tell of a pattern.
struct Numbered
{
  const std::int32_t* offsets;
  const std::int32_t* nodes;
  std::size_t num_nodes;
  int dim;
  const std::int32_t* numbers;
};

// A range of rows, those of one rank.
struct Range
{
  std::int32_t first, last;
};

// The rows inside the range, with further entries that other ranks have there: columns inside the
// range (less its first), other columns, and the places of the further entries in both together.
struct Reduced
{
  Entries inside, outside;
  std::vector<std::int64_t> places;
};
Reduced reduce(const Numbered& pattern, Range range, const std::int32_t* further_offsets,
               const std::int32_t* further_columns);

// The rows outside the range, and their numbers.
std::pair<std::vector<std::int32_t>, Entries> foreign_rows(const Numbered& pattern, Range range);

// y = K x with blocks in compressed rows.
void multiply(const std::int32_t* offsets, const std::int32_t* nodes, std::size_t num_nodes,
              int dim, const double* values, const double* x, double* y);
} // namespace core
