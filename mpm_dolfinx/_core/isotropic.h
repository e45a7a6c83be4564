// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Isotropic functions of symmetric tensors in two and three dimensions, in principal axes.

#pragma once

#include "matrix.h"

#include <array>
#include <cmath>
#include <limits>

namespace core
{
constexpr double root_two = 1.41421356237309504880;
constexpr double root_half = 0.70710678118654752440;
constexpr double root_two_thirds = 0.81649658092772603273;

// Components of a Mandel vector: xx, yy, zz, xy, yz, xz.
constexpr int mandel_position[3][3] = {{0, 3, 5}, {3, 1, 4}, {5, 4, 2}};

template <int dim>
constexpr int num_components = dim == 2 ? 4 : 6;

template <int dim>
Matrix<dim> unpack(const double* vector)
{
  Matrix<dim> tensor;
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
      tensor[i][j] = vector[mandel_position[i][j]] * (i == j ? 1.0 : root_half);
  return tensor;
}

template <int dim>
void pack(const Matrix<dim>& tensor, double* vector)
{
  for (int i = 0; i < dim; ++i)
  {
    vector[i] = tensor[i][i];
    for (int j = i + 1; j < dim; ++j)
      vector[mandel_position[i][j]] = (tensor[i][j] + tensor[j][i]) * root_half;
  }
}

// Zero the entry (p, q) of a symmetric matrix by a rotation (Golub & Van Loan 2013, section
// 8.5.2), and turn the axes with it.
template <int dim>
void rotate(Matrix<dim>& S, Matrix<dim>& axes, int p, int q)
{
  const double off = S[p][q];
  if (off == 0.0)
    return;
  const double theta = 0.5 * (S[q][q] - S[p][p]) / off;
  const double t = std::copysign(1.0, theta) / (std::abs(theta) + std::hypot(theta, 1.0));
  const double c = 1.0 / std::sqrt(1.0 + t * t), s = t * c;
  S[p][p] -= t * off;
  S[q][q] += t * off;
  S[p][q] = S[q][p] = 0.0;
  if constexpr (dim == 3)
  {
    const int r = 3 - p - q;
    const double rp = S[r][p], rq = S[r][q];
    S[r][p] = S[p][r] = c * rp - s * rq;
    S[r][q] = S[q][r] = s * rp + c * rq;
  }
  for (int i = 0; i < dim; ++i)
  {
    const double ip = axes[i][p], iq = axes[i][q];
    axes[i][p] = c * ip - s * iq;
    axes[i][q] = s * ip + c * iq;
  }
}

// Eigenvalues and eigenvectors (columns) of a symmetric matrix by Jacobi's rotations.
template <int dim>
std::array<double, dim> eigen(Matrix<dim> S, Matrix<dim>& axes)
{
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
      axes[i][j] = i == j ? 1.0 : 0.0;
  if constexpr (dim == 2)
    rotate<2>(S, axes, 0, 1);
  else
    for (int sweep = 0; sweep < 20; ++sweep)
    {
      const double off = std::abs(S[0][1]) + std::abs(S[1][2]) + std::abs(S[0][2]);
      const double on = std::abs(S[0][0]) + std::abs(S[1][1]) + std::abs(S[2][2]);
      if (off <= 1e-2 * std::numeric_limits<double>::epsilon() * on)
        break;
      rotate<3>(S, axes, 0, 1);
      rotate<3>(S, axes, 0, 2);
      rotate<3>(S, axes, 1, 2);
    }
  std::array<double, dim> values;
  for (int a = 0; a < dim; ++a)
    values[a] = S[a][a];
  return values;
}

// (1/2 ln(1 + x) - 1/2 ln(1 + y))/(x - y), and its limit for x = y.
inline double logarithm_quotient(double x, double y)
{
  const double ratio = (x - y) / (1.0 + y);
  return 0.5 * (ratio == 0.0 ? 1.0 : std::log1p(ratio) / ratio) / (1.0 + y);
}

template <int dim>
Matrix<dim> from_principal(const std::array<double, 3>& values, const Matrix<dim>& axes)
{
  Matrix<dim> tensor;
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
    {
      tensor[i][j] = 0.0;
      for (int a = 0; a < dim; ++a)
        tensor[i][j] += axes[i][a] * values[a] * axes[j][a];
    }
  return tensor;
}

// A step as laws in logarithmic strain see it: the elastic b less the identity that it would come
// to without yielding, its principal values and axes, and the strains of these.
template <int dim>
struct Trial
{
  static constexpr int m = num_components<dim>;
  Matrix<dim> inverse_F, axes;
  std::array<double, dim> principal;
  std::array<double, 3> strain{};
  std::array<double, m> vector{};
  bool valid;

  // Without old_gradient there is no history.
  Trial(const double* gradient, const double* old_gradient, const double* old_c)
  {
    Matrix<dim> H;
    for (int i = 0; i < dim; ++i)
      for (int j = 0; j < dim; ++j)
        H[i][j] = gradient[i * dim + j];
    const double det = inverse<dim>(H, inverse_F);

    Matrix<dim> growth;
    if (old_gradient == nullptr)
    {
      for (int i = 0; i < dim; ++i)
        for (int j = 0; j < dim; ++j)
        {
          growth[i][j] = 2.0 * H[i][j];
          for (int k = 0; k < dim; ++k)
            growth[i][j] += H[i][k] * H[j][k];
        }
      pack<dim>(growth, vector.data());
    }
    else
    {
      Matrix<dim> old_H, difference, old_inverse, h, right;
      for (int i = 0; i < dim; ++i)
        for (int j = 0; j < dim; ++j)
        {
          old_H[i][j] = old_gradient[i * dim + j];
          difference[i][j] = H[i][j] - old_H[i][j];
        }
      inverse<dim>(old_H, old_inverse);
      const Matrix<dim> C = unpack<dim>(old_c);
      for (int i = 0; i < dim; ++i)
        for (int j = 0; j < dim; ++j)
        {
          h[i][j] = 0.0;
          for (int k = 0; k < dim; ++k)
            h[i][j] += difference[i][k] * old_inverse[k][j];
        }
      for (int i = 0; i < dim; ++i)
        for (int j = 0; j < dim; ++j)
        {
          right[i][j] = h[i][j];
          for (int k = 0; k < dim; ++k)
            right[i][j] += h[i][k] * C[k][j];
        }
      for (int i = 0; i < dim; ++i)
        for (int j = 0; j < dim; ++j)
        {
          growth[i][j] = 2.0 * right[i][j];
          for (int k = 0; k < dim; ++k)
            growth[i][j] += right[i][k] * h[j][k];
        }
      pack<dim>(growth, vector.data());
      for (int k = 0; k < m; ++k)
        vector[k] += old_c[k];
    }

    principal = eigen<dim>(unpack<dim>(vector.data()), axes);
    valid = det > 0.0 && std::isfinite(det);
    for (int a = 0; a < dim; ++a)
    {
      valid = valid && principal[a] > -1.0 && std::isfinite(principal[a]);
      strain[a] = 0.5 * std::log1p(principal[a]);
    }
    if constexpr (dim == 2)
      strain[2] = 0.5 * std::log1p(vector[2]);
  }
};
} // namespace core
