// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#include "products.h"
#include "hot_loop.h"

#include <algorithm>

using core::SparseRows;

std::vector<std::int32_t> core::equal_rows(const SparseRows& A)
{
  std::vector<std::int32_t> first(1, 0);
  for (std::size_t row = 1; row < A.count; ++row)
    if (!std::equal(A.columns + A.offsets[row - 1], A.columns + A.offsets[row],
                    A.columns + A.offsets[row], A.columns + A.offsets[row + 1]))
      first.push_back(static_cast<std::int32_t>(row));
  if (A.count > 0)
    first.push_back(static_cast<std::int32_t>(A.count));
  return first;
}

HOT_LOOP void core::multiply(const SparseRows& A, const std::int32_t* first, std::size_t num_first,
                             const double* x, double* y)
{
  constexpr int lanes = 8; // sums that the processor makes at a time
  std::vector<double> seen; // x in the columns of equal rows
  for (std::size_t g = 0; g + 1 < num_first; ++g)
  {
    const std::int32_t* columns = A.columns + A.offsets[first[g]];
    const std::int32_t length = A.offsets[first[g] + 1] - A.offsets[first[g]];
    if (seen.size() < static_cast<std::size_t>(length))
      seen.resize(length);
    for (std::int32_t k = 0; k < length; ++k)
      seen[k] = x[columns[k]];
    for (std::int32_t row = first[g]; row < first[g + 1]; ++row)
    {
      const double* values = A.values + A.offsets[row];
      double sums[lanes] = {}, rest = 0.0;
      std::int32_t k = 0;
      for (; k + lanes <= length; k += lanes)
        for (int lane = 0; lane < lanes; ++lane)
          sums[lane] += values[k + lane] * seen[k + lane];
      for (; k < length; ++k)
        rest += values[k] * seen[k];
      for (double sum : sums)
        rest += sum;
      y[row] = rest;
    }
  }
}

std::pair<std::vector<std::int32_t>, std::vector<std::int32_t>>
core::galerkin_pattern(const SparseRows& A, const SparseRows& P, std::size_t count)
{
  // The rows of P that have each coarse number.
  std::vector<std::int32_t> ends(count + 1, 0), rows(P.offsets[P.count]);
  for (std::int32_t e = 0; e < P.offsets[P.count]; ++e)
    ++ends[P.columns[e] + 1];
  for (std::size_t a = 0; a < count; ++a)
    ends[a + 1] += ends[a];
  std::vector<std::int32_t> place(ends.begin(), ends.end() - 1);
  for (std::size_t row = 0; row < P.count; ++row)
    for (std::int32_t e = P.offsets[row]; e < P.offsets[row + 1]; ++e)
      rows[place[P.columns[e]]++] = static_cast<std::int32_t>(row);

  const std::vector<std::int32_t> first = equal_rows(A);
  std::vector<std::int32_t> group(P.count); // of equal rows
  for (std::size_t g = 0; g + 1 < first.size(); ++g)
    std::fill(group.begin() + first[g], group.begin() + first[g + 1], static_cast<std::int32_t>(g));
  const auto is_like_last = [&](std::size_t a) {
    return a > 0
           && std::equal(rows.begin() + ends[a - 1], rows.begin() + ends[a], rows.begin() + ends[a],
                         rows.begin() + ends[a + 1], [&](std::int32_t one, std::int32_t other) {
      return group[one] == group[other];
    });
  };

  std::vector<std::int32_t> offsets(1, 0), columns;
  std::vector<std::int32_t> fine(P.count, -1), coarse(count, -1); // who has seen a column last
  for (std::int32_t a = 0; a < static_cast<std::int32_t>(count); ++a)
  {
    if (is_like_last(a)) // as the numbers of one node are
    {
      const auto end = static_cast<std::int32_t>(columns.size());
      for (std::int32_t k = offsets[a - 1]; k < end; ++k)
        columns.push_back(columns[k]);
      offsets.push_back(static_cast<std::int32_t>(columns.size()));
      continue;
    }
    for (std::int32_t n = ends[a]; n < ends[a + 1]; ++n)
      for (std::int32_t k = A.offsets[rows[n]]; k < A.offsets[rows[n] + 1]; ++k)
      {
        const std::int32_t column = A.columns[k];
        if (fine[column] == a)
          continue;
        fine[column] = a;
        for (std::int32_t e = P.offsets[column]; e < P.offsets[column + 1]; ++e)
          if (coarse[P.columns[e]] != a)
          {
            coarse[P.columns[e]] = a;
            columns.push_back(P.columns[e]);
          }
      }
    std::sort(columns.begin() + offsets.back(), columns.end());
    offsets.push_back(static_cast<std::int32_t>(columns.size()));
  }
  return {std::move(offsets), std::move(columns)};
}

HOT_LOOP void core::galerkin(const SparseRows& A, const SparseRows& P, const SparseRows& result,
                             double* values)
{
  std::fill(values, values + result.offsets[result.count], 0.0);
  std::vector<double> line(result.count, 0.0); // a row of A P
  for (std::size_t row = 0; row < A.count; ++row)
  {
    if (P.offsets[row] == P.offsets[row + 1])
      continue;
    for (std::int32_t k = A.offsets[row]; k < A.offsets[row + 1]; ++k)
      for (std::int32_t e = P.offsets[A.columns[k]]; e < P.offsets[A.columns[k] + 1]; ++e)
        line[P.columns[e]] += A.values[k] * P.values[e];
    // (the rows of the result that this one adds to have places for all that is not zero)
    const auto for_each_place = [&](auto&& f) {
      for (std::int32_t e = P.offsets[row]; e < P.offsets[row + 1]; ++e)
        for (std::int32_t k = result.offsets[P.columns[e]]; k < result.offsets[P.columns[e] + 1]; ++k)
          f(P.values[e], k, line[result.columns[k]]);
    };
    for_each_place([&](double weight, std::int32_t k, double sum) { values[k] += weight * sum; });
    for_each_place([&](double, std::int32_t, double& sum) { sum = 0.0; });
  }
}
