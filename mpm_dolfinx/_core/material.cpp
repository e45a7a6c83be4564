// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Elasticity and laws of plasticity in logarithmic strain, point by point.
//
// The same algorithms as mpm_dolfinx.materials.kinematics, which is their oracle. All laws are
// isotropic, so stress and strain share the axes of the trial elastic b, and tangents have 8 (plane)
// or 21 (space) entries other than zero in that frame.

#include "law_answer.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace
{
using namespace core;

// A law with its parameters at a point.
struct LawAtPoint
{
  LawAnswer answer;
  double share, parameters[max_parameters];

  void operator()(const std::array<double, 3>& strain, double tolerance, Response<>& r) const
  {
    answer(parameters, share, strain, tolerance, r);
  }
};

// The volume strain at which a law answers a pressure, and what the tangent has of it; the
// algorithm of mpm_dolfinx.materials.given_pressure, point by point.
struct VolumeAtPressure
{
  static constexpr double tolerance = 1e-13, nearly = 1e-8, stride = 0.05;
  static constexpr int iterations = 100;

  double gap, compliance;
  std::array<double, 3> slope, by_pressure;

  // Set the answer of a law; return whether there is one.
  bool solve(const LawAtPoint& law, const std::array<double, 3>& trial, double yield_tolerance,
             double pressure, double augmentation, Response<>& r)
  {
    const std::array<double, core::max_variables> before = r.variables;
    const double theta = trial[0] + trial[1] + trial[2];
    double x = theta, reach = stride;
    double low = -std::numeric_limits<double>::infinity(), high = -low;
    bool near = false;
    for (int k = 0; k < iterations; ++k, reach *= 2.0)
    {
      const double shift = (x - theta) / 3.0;
      r.variables = before;
      law({trial[0] + shift, trial[1] + shift, trial[2] + shift}, yield_tolerance, r);
      const double mean = (r.stress[0] + r.stress[1] + r.stress[2]) / 3.0;
      const double extra = augmentation * (x - theta), over = mean + extra - pressure;
      double stiffness = augmentation;
      for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b)
          stiffness += r.normal[a][b] / 9.0;
      const double size = std::abs(mean) + std::abs(extra) + std::abs(pressure)
                          + std::abs(stiffness * x);
      bool open = !(std::abs(over) <= tolerance * size) && !near;
      near = std::abs(over) <= nearly * size;
      if (over < 0.0)
        low = std::max(low, x);
      if (over > 0.0)
        high = std::min(high, x);
      double next = x - std::min(over / stiffness, reach);
      if (!(next > low && next < high) && std::isfinite(0.5 * (low + high)))
        next = 0.5 * (low + high);
      open = open && next != x;
      if (!open)
      {
        finish(theta, x, stiffness, r);
        return true;
      }
      x = next;
    }
    return false;
  }

  void finish(double theta, double x, double stiffness, Response<>& r)
  {
    gap = theta - x;
    compliance = 1.0 / stiffness;
    std::array<double, 3> column{};
    slope = {};
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b)
      {
        column[a] += r.normal[a][b] / 3.0;
        slope[b] += r.normal[a][b] / 3.0 / stiffness;
      }
    for (int a = 0; a < 3; ++a)
    {
      by_pressure[a] = column[a] / stiffness;
      r.elastic_strain[a] += gap / 3.0;
      for (int b = 0; b < 3; ++b)
        r.normal[a][b] -= column[a] * slope[b];
    }
  }
};

// Set the first Piola stress of principal Kirchhoff stresses.
template <int dim>
void first_piola(const std::array<double, 3>& values, const Matrix<dim>& axes,
                 const Matrix<dim>& inverse_F, double* P)
{
  const Matrix<dim> tau = from_principal<dim>(values, axes);
  for (int i = 0; i < dim; ++i)
    for (int J = 0; J < dim; ++J)
    {
      P[i * dim + J] = 0.0;
      for (int j = 0; j < dim; ++j)
        P[i * dim + J] += tau[i][j] * inverse_F[J][j];
    }
}

// Set the Mandel vector of a tensor with given axes; in the plane the third value is that of z.
template <int dim>
void vector_of(const std::array<double, 3>& values, const Matrix<dim>& axes, double* vector)
{
  pack<dim>(from_principal<dim>(values, axes), vector);
  if constexpr (dim == 2)
    vector[2] = values[2];
}

// P = tau F^-T and dP/dF, put together from the dyads Q_a (F^-1 Q)_b.
//
// With l = dF F^-1, d eps_ab = g_ab (b_b l_ab + b_a l_ba) in the principal frame, g_ab the
// quotient (eps_a - eps_b)/(b_a - b_b) (Ogden 1984, section 2.6), and dP = d tau F^-T - P l^T.
template <int dim>
void tangent(const Response<>& r, const std::array<double, dim>& principal, const Matrix<dim>& axes,
             const Matrix<dim>& inverse_F, double* A)
{
  constexpr int size = dim * dim;
  double dyad[dim][dim][size];
  for (int b = 0; b < dim; ++b)
    for (int J = 0; J < dim; ++J)
    {
      double moved = 0.0;
      for (int l = 0; l < dim; ++l)
        moved += inverse_F[J][l] * axes[l][b];
      for (int a = 0; a < dim; ++a)
        for (int i = 0; i < dim; ++i)
          dyad[a][b][i * dim + J] = axes[i][a] * moved;
    }
  for (int k = 0; k < size * size; ++k)
    A[k] = 0.0;
  auto add = [&](double factor, const double* left, const double* right) {
    for (int i = 0; i < size; ++i)
    {
      const double scaled = factor * left[i];
      for (int j = 0; j < size; ++j)
        A[i * size + j] += scaled * right[j];
    }
  };
  for (int a = 0; a < dim; ++a)
    for (int b = 0; b < dim; ++b)
    {
      add(r.normal[a][b] - (a == b ? r.stress[a] : 0.0), dyad[a][a], dyad[b][b]);
      if (a != b)
      {
        const double rate = r.shear[a][b] * logarithm_quotient(principal[a], principal[b]);
        add(rate * (1.0 + principal[b]), dyad[a][b], dyad[a][b]);
        add(rate * (1.0 + principal[a]) - r.stress[a], dyad[a][b], dyad[b][a]);
      }
    }
}

template <int dim>
bool update_point(const double* gradient, const double* old_gradient, const double* old_c,
                  const LawAtPoint& law, double tolerance, Response<>& r, double* P, double* A,
                  double* stress, double* c, const core::GivenPressure* given, std::size_t point)
{
  constexpr int m = num_components<dim>;
  const Trial<dim> seen(gradient, old_gradient, old_c);
  if (!seen.valid)
    return false;
  const auto& [inverse_F, axes, principal, strain, trial, valid] = seen;
  if (given == nullptr)
    law(strain, tolerance, r);
  else
  {
    constexpr std::size_t size = dim * dim;
    VolumeAtPressure volume;
    if (!volume.solve(law, strain, tolerance, given->pressure[point], given->augmentation(point),
                      r))
    {
      given->gap[point] = std::numeric_limits<double>::quiet_NaN();
      return false;
    }
    given->gap[point] = volume.gap;
    given->compliance[point] = volume.compliance;
    first_piola<dim>(volume.slope, axes, inverse_F, given->slope + point * size);
    first_piola<dim>(volume.by_pressure, axes, inverse_F, given->by_pressure + point * size);
  }
  first_piola<dim>(r.stress, axes, inverse_F, P);
  vector_of<dim>(r.stress, axes, stress);
  if (A != nullptr)
    tangent<dim>(r, principal, axes, inverse_F, A);
  if (c != nullptr)
  {
    for (int k = 0; k < m; ++k)
      c[k] = trial[k];
    if (r.plastic)
    {
      std::array<double, 3> returned{};
      for (int a = 0; a < 3; ++a)
        returned[a] = std::expm1(2.0 * r.elastic_strain[a]);
      vector_of<dim>(returned, axes, c);
    }
  }
  return true;
}

// The answer of a law in its own strain: stress, its derivative, and elastic strain.
template <int dim>
void integrate_point(const double* trial, const LawAtPoint& law, double tolerance, Response<>& r,
                     double* D, double* stress, double* elastic)
{
  constexpr int m = num_components<dim>;
  Matrix<dim> axes;
  const std::array<double, dim> principal = eigen<dim>(unpack<dim>(trial), axes);
  std::array<double, 3> strain{0.0, 0.0, trial[2]};
  std::copy(principal.begin(), principal.end(), strain.begin());
  law(strain, tolerance, r);
  vector_of<dim>(r.stress, axes, stress);
  std::copy(trial, trial + m, elastic);
  if (r.plastic)
    vector_of<dim>(r.elastic_strain, axes, elastic);
  if (D == nullptr)
    return;
  std::fill(D, D + m * m, 0.0);
  double dyads[3][3][m] = {};
  for (int a = 0; a < dim; ++a)
    for (int b = 0; b < dim; ++b)
    {
      Matrix<dim> dyad;
      for (int i = 0; i < dim; ++i)
        for (int j = 0; j < dim; ++j)
          dyad[i][j] = axes[i][a] * axes[j][b];
      pack<dim>(dyad, dyads[a][b]);
    }
  if constexpr (dim == 2)
    dyads[2][2][2] = 1.0;
  auto add = [&](double factor, const double* left, const double* right) {
    for (int i = 0; i < m; ++i)
      for (int j = 0; j < m; ++j)
        D[i * m + j] += factor * left[i] * right[j];
  };
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b)
    {
      add(r.normal[a][b], dyads[a][a], dyads[b][b]);
      if (a < b && b < dim)
        add(2.0 * r.shear[a][b], dyads[a][b], dyads[a][b]);
    }
}

// The same in strains of the law, in a loop of its own: beside it updates in the plane take longer.
template <int dim>
void integrate_all(const core::Update& u, LawAnswer answer)
{
  constexpr int m = num_components<dim>;
  LawAtPoint law;
  law.answer = answer;
  for (std::size_t p = 0; p < u.count; ++p)
  {
    for (std::size_t k = 0; k < core::num_parameters(u.law); ++k)
      law.parameters[k] = u.parameters[k](p);
    law.share = u.share(p);
    Response<> r;
    for (std::size_t k = 0; k < core::num_variables(u.law); ++k)
      r.variables[k] = u.old_variables[k][p];
    integrate_point<dim>(u.trial + p * m, law, u.tolerance, r,
                         u.A == nullptr ? nullptr : u.A + p * m * m, u.stress + p * m,
                         u.c + p * m);
    for (std::size_t k = 0; k < core::num_variables(u.law); ++k)
      u.variables[k][p] = r.variables[k];
  }
}

template <int dim>
HOT_LOOP std::vector<std::int64_t> update_all(const core::Update& u, LawAnswer answer)
{
  constexpr int size = dim * dim, m = dim == 2 ? 4 : 6;
  std::vector<std::int64_t> invalid;
  const bool history = u.old_gradient != nullptr;
  const std::size_t parameters = core::num_parameters(u.law),
                    variables = core::num_variables(u.law);
  LawAtPoint law;
  law.answer = answer;
  for (std::size_t p = 0; p < u.count; ++p)
  {
    for (std::size_t k = 0; k < parameters; ++k)
      law.parameters[k] = u.parameters[k](p);
    law.share = u.share(p);
    Response<> r;
    for (std::size_t k = 0; k < variables; ++k)
      r.variables[k] = u.old_variables[k][p];
    const bool valid =
        update_point<dim>(u.gradient + p * size, history ? u.old_gradient + p * size : nullptr,
                          history ? u.old_c + p * m : nullptr, law, u.tolerance, r,
                          u.P + p * size, u.A == nullptr ? nullptr : u.A + p * size * size,
                          u.stress + p * m, history ? u.c + p * m : nullptr, u.given, p);
    for (std::size_t k = 0; k < variables; ++k)
      u.variables[k][p] = r.variables[k];
    if (!valid)
      invalid.push_back(static_cast<std::int64_t>(p));
  }
  return invalid;
}

LawAnswer answer_of(Law law)
{
  switch (law)
  {
  case Law::hencky:
    return answer<Hencky<>>;
  case Law::neo_hooke:
    return answer<NeoHooke<>>;
  case Law::von_mises:
    return answer<VonMises<>>;
  case Law::mohr_coulomb:
    return answer<MohrCoulomb<>>;
  case Law::drucker_prager:
    return answer<DruckerPrager<>>;
  case Law::mu_i:
    return answer<MuIRheology<>>;
  case Law::cam_clay:
    return answer<CamClay<>>;
  default:
    return answer_averaged(law);
  }
}
} // namespace

std::vector<std::int64_t> core::update_logarithmic(const Update& update, int dim)
{
  const LawAnswer answer = answer_of(update.law);
  if (update.trial != nullptr)
  {
    dim == 2 ? integrate_all<2>(update, answer) : integrate_all<3>(update, answer);
    return {};
  }
  return dim == 2 ? update_all<2>(update, answer) : update_all<3>(update, answer);
}
