// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Small matrices.

#pragma once

#include <array>

namespace core
{
template <int dim>
using Matrix = std::array<std::array<double, dim>, dim>;

// The inverse of I + H; returns its determinant.
template <int dim>
double inverse(const Matrix<dim>& H, Matrix<dim>& result)
{
  Matrix<dim> F = H;
  for (int i = 0; i < dim; ++i)
    F[i][i] += 1.0;
  double det;
  if constexpr (dim == 2)
  {
    det = F[0][0] * F[1][1] - F[0][1] * F[1][0];
    result = {{{F[1][1] / det, -F[0][1] / det}, {-F[1][0] / det, F[0][0] / det}}};
  }
  else
  {
    for (int k = 0; k < 3; ++k)
    {
      const auto &a = F[(k + 1) % 3], &b = F[(k + 2) % 3];
      result[0][k] = a[1] * b[2] - a[2] * b[1];
      result[1][k] = a[2] * b[0] - a[0] * b[2];
      result[2][k] = a[0] * b[1] - a[1] * b[0];
    }
    det = F[0][0] * result[0][0] + F[0][1] * result[1][0] + F[0][2] * result[2][0];
    for (auto& row : result)
      for (double& entry : row)
        entry /= det;
  }
  return det;
}
} // namespace core
