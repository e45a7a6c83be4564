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
// The nodes of one field that each group of domains sees, in compressed rows.
struct Seen
{
  const std::int64_t* offsets;
  const std::int32_t* nodes;
  std::size_t num_nodes;
};

// Sparsity of the sum over groups in compressed rows of blocks, which are sorted; where the pairs
// of the nodes that each group sees begin, and the place of each pair in the row of its first node,
// in one byte if that is enough and in two otherwise. Pairs without a block have the largest number.
struct Pattern
{
  std::vector<std::int32_t> offsets, nodes;
  std::vector<std::int64_t> pairs;
  std::vector<std::uint8_t> positions;
  std::size_t bytes; // of each of these
};
// `has` tells which pairs have a block; where it is empty all have.
Pattern pattern(const Seen& rows, const Seen& columns, std::size_t count,
                std::vector<std::uint8_t> has);

// A block between two nodes at the unknowns: the first number of its rows and how many there are,
// and the same of its columns. Those of a node follow each other.
struct Block
{
  std::int32_t row, height, column, width;
};

// Blocks between the nodes of one field's rows and of one field's columns, which have dim dofs each
// with their numbers (-1: none). Places say where the values of a block are: 4 times the place in
// the rows of its node, and the array.
struct Columns
{
  const std::int32_t* offsets;
  const std::int32_t* nodes;
  int dim;
  const std::int32_t* numbers;
  std::int32_t* places;
};

// Arrays of values: own rows in columns of this rank, own rows in others, rows of other ranks.
enum Part : std::int32_t
{
  inside = 0,
  outside = 1,
  sent = 2
};

// The rows of one field, with blocks of several fields beside each other. Starts say where each row
// begins in the array of values inside (or sent) and in that outside; -1 where a dof has no number.
struct Numbered
{
  std::size_t num_nodes;
  int dim;
  const std::int32_t* numbers;
  std::int64_t* starts;
  std::vector<Columns> parts;
};

// A range of numbers.
struct Range
{
  std::int32_t first, last;
};

// Set places and starts of the rows of other ranks, which come by their numbers; return the blocks
// and the number of values.
std::pair<std::vector<Block>, std::int64_t> foreign_rows(const Numbered& rows, Range own);

// Rows of scalars.
struct Entries
{
  std::vector<std::int32_t> offsets, columns;
};

// The rows in a range, with further blocks that other ranks have there: columns of this rank (less
// the first of them), other columns, and the places of the further values in both arrays together.
struct Reduced
{
  Entries inside, outside;
  std::vector<std::int64_t> places;
};

// Set places and starts of the rows in a range. Of the further blocks the first ones, in runs of one
// row each, have values that come from other ranks.
Reduced reduce(const Numbered& rows, Range own, Range rank, const std::vector<Block>& further,
               const std::vector<std::int64_t>& runs);

// Compressed rows of a matrix, with sorted columns and PETSc's kind of integer.
template <typename Index>
struct Compressed
{
  const Index *offsets, *columns;
};

// Call f(entry, whether inside, place) for the entries of rows of which a matrix has columns of this
// rank, less the first of them, inside and others outside; return whether it has places for all.
template <typename Index, typename F>
bool for_each_place(std::size_t count, const Compressed<Index>& entries,
                    const Compressed<Index>& inside, const Compressed<Index>& outside, Index first,
                    Index last, F&& f)
{
  for (std::size_t row = 0; row < count; ++row)
  {
    Index places[] = {outside.offsets[row], inside.offsets[row]};
    for (Index e = entries.offsets[row]; e < entries.offsets[row + 1]; ++e)
    {
      const bool own = entries.columns[e] >= first && entries.columns[e] < last;
      const Compressed<Index>& matrix = own ? inside : outside;
      const Index column = entries.columns[e] - (own ? first : 0);
      Index& place = places[own];
      while (place < matrix.offsets[row + 1] && matrix.columns[place] < column)
        ++place;
      if (place == matrix.offsets[row + 1] || matrix.columns[place] != column)
        return false;
      f(e, own, place);
    }
  }
  return true;
}
} // namespace core
