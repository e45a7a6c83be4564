// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#include "sparsity.h"

#include <algorithm>
#include <numeric>
#include <stdexcept>
#include <tuple>
#include <type_traits>

core::Pattern core::pattern(const Seen& rows, const Seen& columns, std::size_t count,
                            std::vector<std::uint8_t> has)
{
  // Where groups see a node of a row: the pairs with their first column.
  struct Visit
  {
    std::int64_t pair;
    const std::int32_t *begin, *end; // columns
  };
  std::vector<std::int64_t> first(rows.num_nodes + 1, 0);
  for (std::int64_t e = 0; e < rows.offsets[count]; ++e)
    ++first[rows.nodes[e] + 1];
  std::partial_sum(first.begin(), first.end(), first.begin());
  std::vector<Visit> visits(rows.offsets[count]);
  std::vector<std::int64_t> next(first.begin(), first.end() - 1);
  Pattern result;
  result.pairs.assign(1, 0);
  for (std::size_t g = 0; g < count; ++g)
  {
    const std::int32_t *begin = columns.nodes + columns.offsets[g],
                       *end = columns.nodes + columns.offsets[g + 1];
    std::int64_t pair = result.pairs.back();
    for (std::int64_t e = rows.offsets[g]; e < rows.offsets[g + 1]; ++e, pair += end - begin)
      visits[next[rows.nodes[e]]++] = {pair, begin, end};
    result.pairs.push_back(pair);
  }
  if (has.empty())
    has.assign(result.pairs.back(), 1);
  if (has.size() != static_cast<std::size_t>(result.pairs.back()))
    throw std::invalid_argument("whether all pairs have a block");
  // Call f(column, pair) for the blocks of a row, those of several groups again.
  const auto for_each_pair = [&](std::size_t row, auto&& f) {
    for (std::int64_t v = first[row]; v < first[row + 1]; ++v)
      for (const std::int32_t* column = visits[v].begin; column != visits[v].end; ++column)
        if (const std::int64_t pair = visits[v].pair + (column - visits[v].begin); has[pair])
          f(*column, pair);
  };

  // Once for the rows, and once for the positions, of which it is known then how many bytes they take.
  result.offsets.assign(1, 0);
  std::vector<std::int32_t> place(columns.num_nodes, -1);
  std::size_t longest = 0;
  for (std::size_t row = 0; row < rows.num_nodes; ++row)
  {
    const std::size_t start = result.nodes.size();
    for_each_pair(row, [&](std::int32_t column, std::int64_t) {
      if (place[column] < 0)
      {
        place[column] = 0;
        result.nodes.push_back(column);
      }
    });
    std::sort(result.nodes.begin() + start, result.nodes.end());
    for (std::size_t e = start; e < result.nodes.size(); ++e)
      place[result.nodes[e]] = -1;
    longest = std::max(longest, result.nodes.size() - start);
    result.offsets.push_back(static_cast<std::int32_t>(result.nodes.size()));
  }
  if (longest > UINT16_MAX)
    throw std::overflow_error("a node of the background meets too many others");
  result.bytes = longest <= UINT8_MAX ? 1 : 2;
  result.positions.assign(result.bytes * has.size(), UINT8_MAX);
  const auto set = [&](auto* positions) {
    for (std::size_t row = 0; row < rows.num_nodes; ++row)
    {
      for (std::int32_t e = result.offsets[row]; e < result.offsets[row + 1]; ++e)
        place[result.nodes[e]] = e - result.offsets[row];
      for_each_pair(row, [&](std::int32_t column, std::int64_t pair) {
        positions[pair] = static_cast<std::remove_reference_t<decltype(*positions)>>(place[column]);
      });
    }
  };
  if (result.bytes == 1)
    set(result.positions.data());
  else
    set(reinterpret_cast<std::uint16_t*>(result.positions.data()));
  return result;
}

namespace
{
// The numbers of a node: the first of them, or -1, and how many there are.
std::pair<std::int32_t, std::int32_t> numbers_of(const std::int32_t* numbers, int dim)
{
  std::int32_t first = -1, count = 0;
  for (int i = 0; i < dim; ++i)
  {
    if (numbers[i] < 0)
      continue;
    if (first < 0)
      first = numbers[i];
    else if (numbers[i] != first + count)
      throw std::invalid_argument("the unknowns of a node do not follow each other");
    ++count;
  }
  return {first, count};
}

// Set where the rows of a node begin in an array, each of a length.
void set_starts(const core::Numbered& rows, std::size_t node, int array, std::int64_t start,
                std::int64_t length)
{
  for (int i = 0; i < rows.dim; ++i)
  {
    const bool numbered = rows.numbers[node * rows.dim + i] >= 0;
    rows.starts[(node * rows.dim + i) * 2 + array] = numbered ? start : -1;
    start += numbered ? length : 0;
  }
}

// Call f(first number, count, place) for the blocks in the rows of a node.
template <typename F>
void for_each_block(const core::Numbered& rows, std::size_t node, F&& f)
{
  for (const core::Columns& part : rows.parts)
    for (std::int32_t e = part.offsets[node]; e < part.offsets[node + 1]; ++e)
    {
      const auto [first, count] = numbers_of(part.numbers + part.nodes[e] * part.dim, part.dim);
      if (count > 0)
        f(first, count, part.places + e);
    }
}

std::int32_t as_place(std::int64_t place, core::Part part)
{
  return static_cast<std::int32_t>(4 * place + part);
}
} // namespace

std::pair<std::vector<core::Block>, std::int64_t> core::foreign_rows(const Numbered& rows,
                                                                     Range own)
{
  std::vector<std::tuple<std::int32_t, std::int32_t, std::size_t>> nodes;
  for (std::size_t node = 0; node < rows.num_nodes; ++node)
  {
    const auto [first, count] = numbers_of(rows.numbers + node * rows.dim, rows.dim);
    if (count == 0)
      set_starts(rows, node, 0, -1, 0), set_starts(rows, node, 1, -1, 0);
    else if (first < own.first || first >= own.last)
      nodes.emplace_back(first, count, node);
  }
  std::sort(nodes.begin(), nodes.end());
  std::pair<std::vector<Block>, std::int64_t> result;
  auto& [blocks, values] = result;
  values = 0;
  for (const auto& [row, height, node] : nodes)
  {
    std::int64_t length = 0;
    for_each_block(rows, node, [&](std::int32_t column, std::int32_t width, std::int32_t* place) {
      blocks.push_back({row, height, column, width});
      *place = as_place(length, sent);
      length += width;
    });
    set_starts(rows, node, 0, values, length);
    values += height * length;
  }
  return result;
}

core::Reduced core::reduce(const Numbered& rows, Range own, Range rank,
                           const std::vector<Block>& further,
                           const std::vector<std::int64_t>& runs)
{
  const std::int32_t count = own.last - own.first;
  std::vector<std::int32_t> node_of(count, -1);
  for (std::size_t node = 0; node < rows.num_nodes; ++node)
  {
    const std::int32_t first = numbers_of(rows.numbers + node * rows.dim, rows.dim).first;
    if (first >= own.first && first < own.last)
      node_of[first - own.first] = static_cast<std::int32_t>(node);
  }
  std::vector<std::size_t> order(further.size());
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(),
                   [&](auto a, auto b) { return further[a].row < further[b].row; });

  // The columns of a row's blocks, in their order; those that domains see have a place to be set,
  // further ones a place of theirs.
  struct Item
  {
    std::int32_t column, width;
    std::int32_t* place;
    bool operator<(const Item& other) const { return column < other.column; }
  };
  std::vector<Item> line;
  std::vector<std::int32_t> their_places(further.size());
  const auto is_inside = [&](std::int32_t column) {
    return column >= rank.first && column < rank.last;
  };
  std::size_t next = 0;
  const auto read = [&](std::int32_t r) { // return the number of rows that are alike
    std::int32_t height = 1;
    line.clear();
    if (node_of[r] >= 0)
    {
      height = numbers_of(rows.numbers + node_of[r] * rows.dim, rows.dim).second;
      for_each_block(rows, node_of[r], [&](std::int32_t column, std::int32_t width,
                                           std::int32_t* place) {
        line.push_back({column, width, place});
      });
    }
    for (; next < order.size() && further[order[next]].row == own.first + r; ++next)
    {
      const Block& block = further[order[next]];
      height = block.height;
      line.push_back({block.column, block.width, &their_places[order[next]]});
    }
    if (!std::is_sorted(line.begin(), line.end()))
      std::sort(line.begin(), line.end());
    return height;
  };

  // Once to count, so that nothing has more room than it needs, and once to set.
  Reduced result;
  Entries* const arrays[] = {&result.inside, &result.outside};
  for (Entries* part : arrays)
    part->offsets.assign(count + 1, 0);
  for (std::int32_t r = 0; r < count;)
  {
    const std::int32_t height = read(r);
    std::int64_t lengths[] = {0, 0};
    std::int32_t last = -1;
    for (const auto& [column, width, place] : line)
    {
      std::int64_t& length = lengths[is_inside(column) ? inside : outside];
      length += column == last ? 0 : width;
      const std::int64_t at = length - width;
      *place = as_place(at, is_inside(column) ? inside : outside);
      last = column;
    }
    for (std::int32_t i = 0; i < height; ++i)
      for (int side = 0; side < 2; ++side)
      {
        const std::int64_t end = arrays[side]->offsets[r + i] + lengths[side];
        if (end > INT32_MAX)
          throw std::overflow_error("too many entries for one rank; use more ranks");
        arrays[side]->offsets[r + i + 1] = static_cast<std::int32_t>(end);
      }
    if (node_of[r] >= 0)
      for (int side = 0; side < 2; ++side)
        set_starts(rows, node_of[r], side, arrays[side]->offsets[r], lengths[side]);
    r += height;
  }
  for (Entries* part : arrays)
    part->columns.resize(part->offsets.back());
  next = 0;
  for (std::int32_t r = 0; r < count;)
  {
    const std::int32_t height = read(r);
    for (std::int32_t i = 0; i < height; ++i)
      for (const auto& [column, width, place] : line)
      {
        const bool within = is_inside(column);
        std::int32_t* out = arrays[*place & 1]->columns.data()
                            + arrays[*place & 1]->offsets[r + i] + (*place >> 2);
        for (std::int32_t j = 0; j < width; ++j)
          out[j] = column + j - (within ? rank.first : 0);
      }
    r += height;
  }

  const std::int64_t shift = result.inside.offsets.back();
  for (std::size_t run = 0; run + 1 < runs.size(); ++run)
    for (std::int32_t i = 0; i < (runs[run] < runs[run + 1] ? further[runs[run]].height : 0); ++i)
      for (std::int64_t k = runs[run]; k < runs[run + 1]; ++k)
      {
        const int side = their_places[k] & 1;
        const std::int64_t start = arrays[side]->offsets[further[k].row - own.first + i]
                                   + (their_places[k] >> 2) + (side == outside ? shift : 0);
        for (std::int32_t j = 0; j < further[k].width; ++j)
          result.places.push_back(start + j);
      }
  return result;
}
