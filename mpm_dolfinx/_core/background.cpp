// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#include "background.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <type_traits>

namespace
{
using namespace core;

// The interval of lines that holds x, or is next to it.
std::int64_t interval(const Lines& lines, double x)
{
  const double* v = lines.values;
  const auto last = static_cast<std::int64_t>(lines.count) - 2;
  if (lines.size == 0.0)
  {
    const std::int64_t place = std::upper_bound(v, v + lines.count, x) - v - 1;
    return std::clamp<std::int64_t>(place, 0, last);
  }
  auto place = static_cast<std::int64_t>(
      std::clamp((x - v[0]) / lines.size, 0.0, static_cast<double>(last)));
  if (x < v[place] && place > 0)
    --place;
  if (x >= v[place + 1] && place < last)
    ++place;
  return place;
}

// The cells of boxes that hold a point, or have it on a facet: the first in the input, or -1.
std::int64_t cell_of(const Boxes& boxes, const Tolerances& tolerances, const double* x)
{
  std::int64_t places[3][2], sides[3];
  for (int i = 0; i < boxes.dim; ++i)
  {
    const Lines& lines = boxes.lines[i];
    const std::int64_t place = interval(lines, x[i]);
    const double a = lines.values[place], b = lines.values[place + 1];
    const double error = tolerances.coordinates * std::max(std::abs(a), std::abs(b));
    const double reach = std::max(tolerances.facet * (b - a), error);
    const auto last = static_cast<std::int64_t>(lines.count) - 2;
    places[i][0] = b - x[i] <= reach ? std::min(place + 1, last) : place;
    places[i][1] = x[i] - a <= reach ? std::max<std::int64_t>(place - 1, 0) : place;
    sides[i] = places[i][0] == places[i][1] ? 1 : 2;
  }
  std::int64_t found = -1;
  std::int64_t pick[3] = {0, 0, 0};
  const auto box = [&] {
    std::int64_t number = 0;
    for (int i = 0; i < boxes.dim; ++i)
      number = number * (static_cast<std::int64_t>(boxes.lines[i].count) - 1) + places[i][pick[i]];
    return boxes.table[number];
  };
  for (;;)
  {
    const std::int64_t cell = box();
    if (cell >= 0 && (found < 0 || boxes.first[cell] < boxes.first[found]))
      found = cell;
    int i = 0;
    while (i < boxes.dim && ++pick[i] == sides[i])
      pick[i++] = 0;
    if (i == boxes.dim)
      return found;
  }
}
} // namespace

void core::locate(const Boxes& boxes, const Tolerances& tolerances, const double* points,
                  std::size_t count, std::int64_t* cells, double* reference, double* outside)
{
  const int dim = boxes.dim;
  for (std::size_t p = 0; p < count; ++p)
  {
    const double* x = points + p * dim;
    if (!std::all_of(x, x + dim, [](double c) { return std::isfinite(c); }))
      continue;
    const std::int64_t cell = cell_of(boxes, tolerances, x);
    if (cell < 0)
      continue;
    double* X = reference + p * dim;
    const double *slope = boxes.slopes + cell * dim * dim, *centre = boxes.centres + cell * dim;
    for (int i = 0; i < dim; ++i)
    {
      double sum = 0.0;
      for (int j = 0; j < dim; ++j)
        sum += slope[i * dim + j] * (x[j] - centre[j]);
      X[i] = boxes.middle[i] + sum;
    }
    const auto [least, most] = std::minmax_element(X, X + dim);
    const double worst = std::max(-*least, *most - 1.0);
    cells[p] = cell;
    outside[p] = worst <= std::max(tolerances.facet, boxes.slack[cell]) ? 0.0 : worst;
  }
}

template <typename Index>
core::RowEntries<Index> core::transfer_rows(std::size_t count, std::size_t k, int bs,
                                            const std::int64_t* nodes, const double* values,
                                            Index* offsets)
{
  RowEntries<Index> result;
  const std::size_t most = count * k * bs;
  result.columns.reserve(most);
  result.values.reserve(most);
  std::vector<std::size_t> order(k);
  offsets[0] = 0;
  for (std::size_t p = 0; p < count; ++p)
  {
    const std::int64_t* node = nodes + p * k;
    const double* value = values + p * k;
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::sort(order.begin(), order.end(), [&](auto a, auto b) { return node[a] < node[b]; });
    for (int c = 0; c < bs; ++c)
    {
      for (const std::size_t e : order)
        if (value[e] != 0.0)
        {
          result.columns.push_back(static_cast<Index>(node[e] * bs + c));
          result.values.push_back(value[e]);
        }
      offsets[p * bs + c + 1] = static_cast<Index>(result.values.size());
    }
  }
  return result;
}

template core::RowEntries<std::int32_t>
core::transfer_rows(std::size_t, std::size_t, int, const std::int64_t*, const double*,
                    std::int32_t*);
template core::RowEntries<std::int64_t>
core::transfer_rows(std::size_t, std::size_t, int, const std::int64_t*, const double*,
                    std::int64_t*);

namespace
{
// Call f(point, node, value) for dim, as a constant, and all nodes of all points.
template <typename F>
void for_each_value(const core::Basis& T, F&& f)
{
  const auto run = [&](auto dim) {
    for (std::size_t p = 0; p < T.count; ++p)
      for (std::size_t e = p * T.k; e < (p + 1) * T.k; ++e)
        f(dim, p * dim, T.nodes[e] * dim, T.values[e]);
  };
  if (T.dim == 2)
    run(std::integral_constant<int, 2>());
  else
    run(std::integral_constant<int, 3>());
}
} // namespace

void core::apply(const Basis& T, const double* x, double* y)
{
  std::fill(y, y + T.count * T.dim, 0.0);
  for_each_value(T, [&](auto dim, std::size_t point, std::int64_t node, double value) {
    for (int i = 0; i < dim; ++i)
      y[point + i] += value * x[node + i];
  });
}

void core::add_transposed(const Basis& T, const double* y, double* x)
{
  for_each_value(T, [&](auto dim, std::size_t point, std::int64_t node, double value) {
    for (int i = 0; i < dim; ++i)
      x[node + i] += value * y[point + i];
  });
}
