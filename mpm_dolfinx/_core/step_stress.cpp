// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Stress of a whole step in time and of damping, point by point.

#include "step_stress.h"
#include "hot_loop.h"
#include "matrix.h"

#include <cmath>

namespace
{
using core::Damping;
using core::inverse;
using core::Matrix;
using core::Step;
using core::StepEnds;

template <int dim>
Matrix<dim> read(const double* values)
{
  Matrix<dim> result;
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
      result[i][j] = values[i * dim + j];
  return result;
}

template <int dim>
Matrix<dim> product(const Matrix<dim>& a, const Matrix<dim>& b)
{
  Matrix<dim> result;
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
    {
      result[i][j] = 0.0;
      for (int k = 0; k < dim; ++k)
        result[i][j] += a[i][k] * b[k][j];
    }
  return result;
}

template <int dim>
double contraction(const Matrix<dim>& a, const Matrix<dim>& b)
{
  double sum = 0.0;
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
      sum += a[i][j] * b[i][j];
  return sum;
}

// Set 1/2 (G_ai A_iJkL - G_ak S_LJ + delta_ak M_LJ), M the second Piola stress of the step.
template <int dim>
void set_tangent(const double* A, const Matrix<dim>& G, const Matrix<dim>& S, const Matrix<dim>& M,
                 double* tangent)
{
  constexpr int rest = dim * dim * dim;
  for (int a = 0; a < dim; ++a)
  {
    double* row = tangent + a * rest;
    for (int e = 0; e < rest; ++e)
    {
      double sum = 0.0;
      for (int i = 0; i < dim; ++i)
        sum += G[a][i] * A[i * rest + e];
      row[e] = 0.5 * sum;
    }
    for (int J = 0; J < dim; ++J)
      for (int k = 0; k < dim; ++k)
        for (int L = 0; L < dim; ++L)
          row[(J * dim + k) * dim + L] += 0.5 * ((a == k ? M[L][J] : 0.0) - G[a][k] * S[L][J]);
  }
}

// Add Gonzalez' correction c E to the second Piola stress M of the step, which is the mean of S and
// that at the beginning, and to the tangent what does not come by M.
template <int dim>
class Correction {
public:
  Correction(const StepEnds& ends, std::size_t p, bool one_sided, const Matrix<dim>& F,
             const Matrix<dim>& mean, const Matrix<dim>& change, const Matrix<dim>& S,
             Matrix<dim>& M)
  {
    for (int I = 0; I < dim; ++I)
      for (int J = 0; J < dim; ++J)
      {
        _E[I][J] = 0.0;
        for (int k = 0; k < dim; ++k)
          _E[I][J] += 0.5 * (mean[k][I] * change[k][J] + mean[k][J] * change[k][I]);
      }
    _size = contraction<dim>(_E, _E) + ends.small * ends.small;
    _c = (ends.energy[p] - ends.old_energy[p] - contraction<dim>(M, _E)) / _size;
    _acts = !one_sided || _c > 0.0;
    if (!_acts)
      return;
    Matrix<dim> X;
    for (int I = 0; I < dim; ++I)
      for (int J = 0; J < dim; ++J)
        X[I][J] = S[I][J] - M[I][J] - 2.0 * _c * _E[I][J];
    for (int k = 0; k < dim; ++k)
      for (int L = 0; L < dim; ++L)
      {
        _slope[k][L] = 0.0;
        for (int I = 0; I < dim; ++I)
          _slope[k][L] += 0.5 * F[k][I] * (X[I][L] + X[L][I]);
      }
    for (int I = 0; I < dim; ++I)
      for (int J = 0; J < dim; ++J)
        M[I][J] += _c * _E[I][J];
  }

  void add(const double* A, const Matrix<dim>& F, const Matrix<dim>& mean,
           const Matrix<dim>& inverted, const Matrix<dim>& S, double* tangent) const
  {
    if (!_acts)
      return;
    constexpr int rest = dim * dim * dim;
    // E_IJ dM_IJ of the mean alone: 1/2 (B_iJ A_iJkL - B_kJ S_LJ) with B = F^-T E.
    Matrix<dim> B, dc = _slope, left = product<dim>(mean, _E);
    for (int i = 0; i < dim; ++i)
      for (int J = 0; J < dim; ++J)
      {
        B[i][J] = 0.0;
        for (int I = 0; I < dim; ++I)
          B[i][J] += inverted[I][i] * _E[I][J];
      }
    for (int k = 0; k < dim; ++k)
      for (int L = 0; L < dim; ++L)
      {
        double sum = 0.0;
        for (int J = 0; J < dim; ++J)
        {
          for (int i = 0; i < dim; ++i)
            sum += B[i][J] * A[i * rest + (J * dim + k) * dim + L];
          sum -= B[k][J] * S[L][J];
        }
        dc[k][L] = (dc[k][L] - 0.5 * sum) / _size;
      }
    for (int a = 0; a < dim; ++a)
      for (int J = 0; J < dim; ++J)
        for (int k = 0; k < dim; ++k)
        {
          double square = 0.0;
          for (int I = 0; I < dim; ++I)
            square += mean[a][I] * F[k][I];
          for (int L = 0; L < dim; ++L)
            tangent[a * rest + (J * dim + k) * dim + L] +=
                left[a][J] * dc[k][L] + 0.5 * _c * ((J == L ? square : 0.0) + mean[a][L] * F[k][J]);
        }
  }

private:
  Matrix<dim> _E, _slope;
  double _size, _c;
  bool _acts;
};

template <int dim>
std::vector<std::int64_t> step_stress_of(const StepEnds& ends, double* stress, double* tangent)
{
  constexpr int square = dim * dim, fourth = square * square;
  std::vector<std::int64_t> singular;
  for (std::size_t p = 0; p < ends.count; ++p)
  {
    const Matrix<dim> H = read<dim>(ends.gradient + p * square);
    const Matrix<dim> old_H = read<dim>(ends.old_gradient + p * square);
    const Matrix<dim> P = read<dim>(ends.P + p * square);
    const Matrix<dim> old_P = read<dim>(ends.old_P + p * square);
    const double* A = ends.A + p * fourth;
    double *own = stress + p * square, *slope = tangent + p * fourth;
    const auto kind = static_cast<Step>(ends.kind[p * ends.stride]);
    if (kind == Step::mean_of_stresses)
    {
      for (int e = 0; e < square; ++e)
        own[e] = 0.5 * ends.factor * (ends.P[p * square + e] + ends.old_P[p * square + e]);
      for (int e = 0; e < fourth; ++e)
        slope[e] = 0.5 * ends.factor * A[e];
      continue;
    }
    Matrix<dim> inverted, old_inverted, F = H, mean, change, M;
    const double det = inverse<dim>(H, inverted), old_det = inverse<dim>(old_H, old_inverted);
    if (det == 0.0 || old_det == 0.0 || !std::isfinite(det))
    {
      singular.push_back(static_cast<std::int64_t>(p));
      continue;
    }
    for (int i = 0; i < dim; ++i)
    {
      F[i][i] += 1.0;
      for (int j = 0; j < dim; ++j)
      {
        mean[i][j] = (i == j) + 0.5 * (H[i][j] + old_H[i][j]);
        change[i][j] = H[i][j] - old_H[i][j];
      }
    }
    const Matrix<dim> S = product<dim>(inverted, P), old_S = product<dim>(old_inverted, old_P);
    for (int I = 0; I < dim; ++I)
      for (int J = 0; J < dim; ++J)
        M[I][J] = 0.5 * (S[I][J] + old_S[I][J]);
    const Matrix<dim> G = product<dim>(mean, inverted);
    if (kind != Step::simo_tarnow)
    {
      const bool one_sided = kind == Step::dissipative;
      const Correction<dim> correction(ends, p, one_sided, F, mean, change, S, M);
      set_tangent<dim>(A, G, S, M, slope);
      correction.add(A, F, mean, inverted, S, slope);
    }
    else
      set_tangent<dim>(A, G, S, M, slope);
    const Matrix<dim> total = product<dim>(mean, M);
    for (int i = 0; i < dim; ++i)
      for (int J = 0; J < dim; ++J)
        own[i * dim + J] = ends.factor * total[i][J];
    for (int e = 0; e < fourth; ++e)
      slope[e] *= ends.factor;
  }
  return singular;
}

template <int dim>
void damping_of(const Damping& damping, double* stress, double* tangent)
{
  constexpr int square = dim * dim, fourth = square * square;
  for (std::size_t p = 0; p < damping.count; ++p)
  {
    const Matrix<dim> H = read<dim>(damping.gradient + p * square);
    const Matrix<dim> old_H = read<dim>(damping.old_gradient + p * square);
    const double* C = damping.stiffness + p * fourth;
    const bool large = !damping.small[p];
    double *own = stress + p * square, *slope = tangent + p * fourth;
    Matrix<dim> F{}, mean{}, E, S;
    for (int i = 0; i < dim; ++i)
    {
      F[i][i] = mean[i][i] = 1.0;
      for (int j = 0; large && j < dim; ++j)
      {
        F[i][j] += H[i][j];
        mean[i][j] += 0.5 * (H[i][j] + old_H[i][j]);
      }
    }
    for (int I = 0; I < dim; ++I)
      for (int J = 0; J < dim; ++J)
      {
        E[I][J] = 0.0;
        for (int k = 0; k < dim; ++k)
          E[I][J] += 0.5
                     * (mean[k][I] * (H[k][J] - old_H[k][J]) + mean[k][J] * (H[k][I] - old_H[k][I]));
      }
    // dS_IJkL = C_IJMN dE_MN/dF_kL
    double dS[fourth];
    for (int a = 0; a < square; ++a)
    {
      const double* row = C + a * square;
      double sum = 0.0;
      for (int K = 0; K < dim; ++K)
        for (int L = 0; L < dim; ++L)
          sum += row[K * dim + L] * E[K][L];
      S[a / dim][a % dim] = damping.factor * sum;
      for (int k = 0; k < dim; ++k)
        for (int L = 0; L < dim; ++L)
        {
          double entry = 0.0;
          for (int M = 0; M < dim; ++M)
            entry += F[k][M] * (row[M * dim + L] + row[L * dim + M]);
          dS[a * square + k * dim + L] = 0.5 * damping.factor * entry;
        }
    }
    const Matrix<dim> total = product<dim>(mean, S);
    constexpr int rest = dim * square;
    for (int i = 0; i < dim; ++i)
    {
      for (int J = 0; J < dim; ++J)
        own[i * dim + J] = total[i][J];
      for (int e = 0; e < rest; ++e)
      {
        double sum = 0.0;
        for (int I = 0; I < dim; ++I)
          sum += mean[i][I] * dS[I * rest + e];
        slope[i * rest + e] = sum;
      }
      for (int J = 0; large && J < dim; ++J)
        for (int L = 0; L < dim; ++L)
          slope[i * rest + (J * dim + i) * dim + L] += 0.5 * S[L][J];
    }
  }
}
} // namespace

HOT_LOOP std::vector<std::int64_t> core::step_stress(const StepEnds& ends, int dim, double* stress,
                                                     double* tangent)
{
  return dim == 2 ? step_stress_of<2>(ends, stress, tangent)
                  : step_stress_of<3>(ends, stress, tangent);
}

HOT_LOOP void core::damping(const Damping& damping, int dim, double* stress, double* tangent)
{
  if (dim == 2)
    damping_of<2>(damping, stress, tangent);
  else
    damping_of<3>(damping, stress, tangent);
}
