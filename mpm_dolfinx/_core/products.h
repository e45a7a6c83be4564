// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Products with a matrix in compressed rows.

#pragma once

#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace core
{
// The rows of a matrix, with sorted columns.
struct SparseRows
{
  std::size_t count;
  const std::int32_t *offsets, *columns;
  const double* values;
};

// Where rows begin that have the same columns as those after them, up to the next beginning; the
// last is the number of rows.
std::vector<std::int32_t> equal_rows(const SparseRows& A);

// Set y to A x; `first` is that of equal_rows.
void multiply(const SparseRows& A, const std::int32_t* first, std::size_t num_first,
              const double* x, double* y);

// Offsets and columns of the rows of P^T A P, of which there are `count`.
std::pair<std::vector<std::int32_t>, std::vector<std::int32_t>>
galerkin_pattern(const SparseRows& A, const SparseRows& P, std::size_t count);

// Set values to those of P^T A P, which has the pattern of `result`.
void galerkin(const SparseRows& A, const SparseRows& P, const SparseRows& result, double* values);
} // namespace core
