// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#include "sparsity.h"

#include <algorithm>
#include <numeric>
#include <stdexcept>

core::Pattern core::pattern(const Seen& rows, const Seen& columns, std::size_t count)
{
  // Which domains see a node, and as which of theirs.
  std::vector<std::int64_t> first(rows.num_nodes + 1, 0);
  for (std::int64_t e = 0; e < rows.offsets[count]; ++e)
    ++first[rows.nodes[e] + 1];
  std::partial_sum(first.begin(), first.end(), first.begin());
  struct Visit
  {
    std::int64_t domain;
    std::size_t pairs;
    std::int32_t slot;
  };
  std::vector<Visit> visits(rows.offsets[count]);
  std::vector<std::int64_t> next(first.begin(), first.end() - 1);
  std::size_t pairs = 0;
  for (std::size_t p = 0; p < count; ++p)
  {
    const std::size_t size = rows.offsets[p + 1] - rows.offsets[p];
    for (std::size_t a = 0; a < size; ++a)
      visits[next[rows.nodes[rows.offsets[p] + a]]++] = {static_cast<std::int64_t>(p), pairs,
                                                         static_cast<std::int32_t>(a)};
    pairs += size * (columns.offsets[p + 1] - columns.offsets[p]);
  }

  Pattern result;
  result.offsets.reserve(rows.num_nodes + 1);
  result.offsets.push_back(0);
  result.positions.resize(pairs);
  std::vector<std::int32_t> place(columns.num_nodes, -1);
  for (std::size_t row = 0; row < rows.num_nodes; ++row)
  {
    const auto start = static_cast<std::int32_t>(result.nodes.size());
    for (std::int64_t v = first[row]; v < first[row + 1]; ++v)
    {
      const std::int64_t p = visits[v].domain;
      for (std::int64_t e = columns.offsets[p]; e < columns.offsets[p + 1]; ++e)
        if (place[columns.nodes[e]] < start)
        {
          place[columns.nodes[e]] = start;
          result.nodes.push_back(columns.nodes[e]);
        }
    }
    std::sort(result.nodes.begin() + start, result.nodes.end());
    for (std::size_t e = start; e < result.nodes.size(); ++e)
      place[result.nodes[e]] = static_cast<std::int32_t>(e);
    for (std::int64_t v = first[row]; v < first[row + 1]; ++v)
    {
      const std::int64_t p = visits[v].domain;
      const std::size_t size = columns.offsets[p + 1] - columns.offsets[p];
      for (std::size_t b = 0; b < size; ++b)
        result.positions[visits[v].pairs + visits[v].slot * size + b] =
            place[columns.nodes[columns.offsets[p] + b]];
    }
    // Every place of a row is at or after its start, so the next row finds none of them new.
    for (std::size_t e = start; e < result.nodes.size(); ++e)
      place[result.nodes[e]] = -1;
    result.offsets.push_back(static_cast<std::int32_t>(result.nodes.size()));
  }
  return result;
}

namespace
{
// The number of values of a pattern.
std::size_t num_values(const core::Numbered& patterns, const core::Columns& part)
{
  return static_cast<std::size_t>(part.offsets[patterns.num_nodes]) * patterns.dim * part.dim;
}

// The number of values of all patterns.
std::size_t num_values(const core::Numbered& patterns)
{
  std::size_t count = 0;
  for (const core::Columns& part : patterns.parts)
    count += num_values(patterns, part);
  if (count >= UINT32_MAX)
    throw std::overflow_error("too many entries for one rank; use more ranks");
  return count;
}

// Call f(column, source) for the entries of a row of scalars.
template <typename F>
void for_each_entry(const core::Numbered& patterns, std::size_t row, F&& f)
{
  const std::size_t rows = patterns.dim, node = row / rows, i = row % rows;
  std::size_t first = 0;
  for (const core::Columns& part : patterns.parts)
  {
    const std::size_t dim = part.dim;
    for (std::int32_t e = part.offsets[node]; e < part.offsets[node + 1]; ++e)
      for (std::size_t j = 0; j < dim; ++j)
      {
        const std::int32_t column = part.numbers[part.nodes[e] * dim + j];
        if (column >= 0)
          f(column, static_cast<std::uint32_t>(first + (e * rows + i) * dim + j));
      }
    first += num_values(patterns, part);
  }
}
} // namespace

core::Reduced core::reduce(const Numbered& patterns, Range rows, Range rank,
                           const std::int32_t* further_offsets, const std::int32_t* further_columns)
{
  const auto none = static_cast<std::uint32_t>(num_values(patterns));
  const std::int32_t count = rows.last - rows.first;
  std::vector<std::int64_t> row_of(count, -1);
  for (std::size_t row = 0; row < patterns.num_nodes * patterns.dim; ++row)
    if (patterns.numbers[row] >= rows.first && patterns.numbers[row] < rows.last)
      row_of[patterns.numbers[row] - rows.first] = static_cast<std::int64_t>(row);

  Reduced result;
  result.places.reserve(further_offsets[count]);
  std::vector<std::pair<std::int32_t, std::uint32_t>> line;
  for (std::int32_t r = 0; r < count; ++r)
  {
    line.clear();
    if (row_of[r] >= 0)
      for_each_entry(patterns, row_of[r], [&](std::int32_t column, std::uint32_t source) {
        line.emplace_back(column, source);
      });
    for (std::int32_t e = further_offsets[r]; e < further_offsets[r + 1]; ++e)
      line.emplace_back(further_columns[e], none);
    if (!std::is_sorted(line.begin(), line.end()))
      std::sort(line.begin(), line.end());
    const std::size_t start[] = {result.inside.columns.size(), result.outside.columns.size()};
    std::int32_t last = -1;
    for (const auto& [column, source] : line)
    {
      if (column == last)
        continue;
      last = column;
      const bool inside = column >= rank.first && column < rank.last;
      Entries& part = inside ? result.inside : result.outside;
      part.columns.push_back(inside ? column - rank.first : column);
      part.sources.push_back(source);
    }
    // Places outside are counted below zero until the number of those inside is known.
    for (std::int32_t e = further_offsets[r]; e < further_offsets[r + 1]; ++e)
    {
      const std::int32_t column = further_columns[e];
      const bool inside = column >= rank.first && column < rank.last;
      const auto& columns = inside ? result.inside.columns : result.outside.columns;
      const auto place = std::lower_bound(columns.begin() + start[inside ? 0 : 1], columns.end(),
                                          inside ? column - rank.first : column)
                         - columns.begin();
      result.places.push_back(inside ? place : -1 - place);
    }
    result.inside.offsets.push_back(static_cast<std::int32_t>(result.inside.columns.size()));
    result.outside.offsets.push_back(static_cast<std::int32_t>(result.outside.columns.size()));
  }
  const auto shift = static_cast<std::int64_t>(result.inside.columns.size());
  for (std::int64_t& place : result.places)
    if (place < 0)
      place = shift - 1 - place;
  return result;
}

std::pair<std::vector<std::int32_t>, core::Entries> core::foreign_rows(const Numbered& patterns,
                                                                       Range range)
{
  num_values(patterns);
  std::pair<std::vector<std::int32_t>, Entries> result;
  auto& [rows, entries] = result;
  for (std::size_t row = 0; row < patterns.num_nodes * patterns.dim; ++row)
  {
    const std::int32_t number = patterns.numbers[row];
    if (number < 0 || (number >= range.first && number < range.last))
      continue;
    for_each_entry(patterns, row, [&](std::int32_t column, std::uint32_t source) {
      entries.columns.push_back(column);
      entries.sources.push_back(source);
    });
    rows.push_back(number);
    entries.offsets.push_back(static_cast<std::int32_t>(entries.columns.size()));
  }
  return result;
}

void core::multiply(const std::int32_t* offsets, const std::int32_t* nodes, std::size_t num_nodes,
                    int dim, const double* values, const double* x, double* y)
{
  std::fill(y, y + num_nodes * dim, 0.0);
  for (std::size_t row = 0; row < num_nodes; ++row)
    for (std::int32_t e = offsets[row]; e < offsets[row + 1]; ++e)
      for (int i = 0; i < dim; ++i)
        for (int j = 0; j < dim; ++j)
          y[row * dim + i] += values[(static_cast<std::size_t>(e) * dim + i) * dim + j]
                              * x[static_cast<std::size_t>(nodes[e]) * dim + j];
}
