// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Derivatives of the updates of material.cpp, backward.
//
// With l = dF F^-1 and f = F F_n^-1 the trial b moves by db = w b + b w^T + f db_n f^T, where
// w = l - f dF_n F_n^-1 f^-1. In its axes the rates of tau and of the b that is kept are those of
// the law in principal strains, and beside the diagonal those of db times quotients of differences;
// dP = (dtau - tau l^T) F^-T. Backward is the transpose of it all.

#include "principal_laws.h"

#include <array>
#include <cmath>
#include <cstddef>

namespace
{
using namespace core;

template <std::size_t n>
using Square = std::array<std::array<double, n>, n>;

template <std::size_t n>
Square<n> operator*(const Square<n>& a, const Square<n>& b)
{
  Square<n> result{};
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t k = 0; k < n; ++k)
      for (std::size_t j = 0; j < n; ++j)
        result[i][j] += a[i][k] * b[k][j];
  return result;
}

// a + factor b
template <std::size_t n>
Square<n> sum(Square<n> a, double factor, const Square<n>& b)
{
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j < n; ++j)
      a[i][j] += factor * b[i][j];
  return a;
}

template <std::size_t n>
Square<n> transposed(const Square<n>& a)
{
  Square<n> result;
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j < n; ++j)
      result[j][i] = a[i][j];
  return result;
}

template <int dim>
Matrix<dim> matrix_of(const double* values, double unit = 0.0)
{
  Matrix<dim> result;
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
      result[i][j] = values[i * dim + j] + (i == j ? unit : 0.0);
  return result;
}

template <int dim>
void put(const Matrix<dim>& a, double* values)
{
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
      values[i * dim + j] = a[i][j];
}

template <typename Law>
double rigidity(const Law& law)
{
  return law.shear;
}

double rigidity(const CamClay<>& law) { return law.modulus; }

double rigidity(const NeoHooke<>& law) { return law.shear; }

constexpr int most = 3 + max_variables + 8;

// A law in principal strains: its answer, and the derivatives of stresses, elastic strains and
// variables by strains, old variables, parameters and the share of a return that time is for.
struct Answered
{
  Response<> own;
  double rigidity, by[6 + max_variables][most];
};

template <Law name, template <typename> class LawOf>
void answer(const Change& u, std::size_t p, const std::array<double, 3>& strain, Answered& result)
{
  constexpr int variables = num_variables(name), constants = num_parameters(name);
  constexpr int share = 3 + variables + constants, inputs = share + 1;
  static_assert(inputs <= most);
  using T = Dual<inputs>;
  double values[constants];
  T numbers[constants];
  std::array<T, 3> strains;
  Response<T> law;
  for (int k = 0; k < constants; ++k)
  {
    numbers[k] = values[k] = u.parameters[k](p);
    numbers[k].by.set(3 + variables + k, 1.0);
  }
  for (int a = 0; a < 3; ++a)
  {
    strains[a] = strain[a];
    strains[a].by.set(a, 1.0);
  }
  for (int k = 0; k < variables; ++k)
  {
    law.variables[k] = result.own.variables[k] = u.old_variables[k][p];
    law.variables[k].by.set(3 + k, 1.0);
  }
  T in_time = u.share(p);
  in_time.by.set(share, 1.0);
  const LawOf<double> plain(values);
  InTime<LawOf<double>>{plain, values[0], values[1], in_time.value}(strain, u.tolerance, result.own);
  InTime<LawOf<T>, T>{LawOf<T>(numbers), numbers[0], numbers[1], in_time}(strains, u.tolerance, law);
  result.rigidity = rigidity(plain);
  for (int i = 0; i < inputs; ++i)
  {
    for (int a = 0; a < 3; ++a)
    {
      result.by[a][i] = law.stress[a].by[i];
      result.by[3 + a][i] = law.elastic_strain[a].by[i];
    }
    for (int k = 0; k < variables; ++k)
      result.by[6 + k][i] = law.variables[k].by[i];
  }
}

void answer(const Change& u, std::size_t p, const std::array<double, 3>& strain, Answered& result)
{
  switch (u.law)
  {
  case Law::neo_hooke:
    return answer<Law::neo_hooke, NeoHooke>(u, p, strain, result);
  case Law::von_mises:
    return answer<Law::von_mises, VonMises>(u, p, strain, result);
  case Law::mohr_coulomb:
    return answer<Law::mohr_coulomb, MohrCoulomb>(u, p, strain, result);
  case Law::drucker_prager:
    return answer<Law::drucker_prager, DruckerPrager>(u, p, strain, result);
  case Law::mu_i:
    return answer<Law::mu_i, MuIRheology>(u, p, strain, result);
  case Law::cam_clay:
    return answer<Law::cam_clay, CamClay>(u, p, strain, result);
  default:
    return answer<Law::hencky, Hencky>(u, p, strain, result);
  }
}

// A step of a point, and what its derivatives are made of.
template <int dim>
struct Step
{
  static constexpr int m = num_components<dim>;

  Trial<dim> seen;
  int variables, constants, inputs;
  bool history;
  Answered law;
  Matrix<dim> F, tau, grown, f, back, old_inverse; // grown is the trial b, back that of f
  std::array<double, 3> kept, stretch; // kept is b - 1 after the step, stretch the trial b
  double of_stress[dim][dim], of_kept[dim][dim];

  Step(const Change& u, std::size_t p)
      : seen(u.gradient + p * dim * dim,
             u.old_gradient == nullptr ? nullptr : u.old_gradient + p * dim * dim,
             u.old_c == nullptr ? nullptr : u.old_c + p * m),
        variables(num_variables(u.law)), constants(num_numbers(u.law)),
        inputs(3 + variables + constants), history(u.old_gradient != nullptr)
  {
    answer(u, p, seen.strain, law);
    const Response<>& own = law.own;
    tau = from_principal<dim>(own.stress, seen.axes);
    F = matrix_of<dim>(u.gradient + p * dim * dim, 1.0);
    grown = unpack<dim>(seen.vector.data());
    for (int i = 0; i < dim; ++i)
      grown[i][i] += 1.0;
    if (history)
    {
      const double* old = u.old_gradient + p * dim * dim;
      inverse<dim>(matrix_of<dim>(old), old_inverse);
      f = F * old_inverse;
      back = matrix_of<dim>(old, 1.0) * seen.inverse_F;
    }
    for (int a = 0; a < 3; ++a)
    {
      stretch[a] = 1.0 + (a < dim ? seen.principal[a < dim ? a : 0] : seen.vector[2]);
      kept[a] = own.plastic ? std::expm1(2.0 * own.elastic_strain[a]) : stretch[a] - 1.0;
    }
    for (int a = 0; a < dim; ++a)
      for (int b = 0; b < dim; ++b)
      {
        const double by_growth = logarithm_quotient(seen.principal[a], seen.principal[b]);
        of_stress[a][b] = own.shear[a][b] * by_growth;
        of_kept[a][b] = own.plastic ? own.shear[a][b] / (2.0 * law.rigidity) * by_growth
                                          / logarithm_quotient(kept[a], kept[b])
                                    : 1.0;
      }
  }

  void pull(const Change& u, std::size_t p) const
  {
    const Matrix<dim> of_P = matrix_of<dim>(u.of_P + p * dim * dim);
    const Matrix<dim> turned = transposed(seen.axes), inverse_T = transposed(seen.inverse_F);
    const Matrix<dim> worked = of_P * seen.inverse_F;
    const double* of_vector = u.of_stress + p * m;
    Matrix<dim> weight = sum(unpack<dim>(of_vector), 0.5, worked);
    weight = turned * (sum(weight, 0.5, transposed(worked)) * seen.axes);
    Matrix<dim> of_b{};
    if (history)
      of_b = turned * (unpack<dim>(u.of_c + p * m) * seen.axes);
    double in[most] = {};
    auto add = [&](int number, double weight) {
      for (int i = 0; i < inputs; ++i)
        in[i] += law.by[number][i] * weight;
    };
    for (int a = 0; a < 3; ++a)
    {
      const double of_tau = a < dim ? weight[a < dim ? a : 0][a < dim ? a : 0] : of_vector[2];
      add(a, of_tau);
      if (history)
      {
        const double of_c = a < dim ? of_b[a < dim ? a : 0][a < dim ? a : 0] : u.of_c[p * m + 2];
        add(3 + a, 2.0 * (1.0 + kept[a]) * of_c);
      }
    }
    for (int k = 0; k < variables; ++k)
      add(6 + k, u.of_variables[p * variables + k]);
    for (int k = 0; k < variables; ++k)
      u.of_old_variables[p * variables + k] = in[3 + k];
    for (int k = 0; k < constants; ++k)
      u.of_numbers[p * constants + k] = in[3 + variables + k];
    Matrix<dim> growth;
    for (int a = 0; a < dim; ++a)
    {
      for (int b = 0; b < dim; ++b)
        growth[a][b] = of_stress[a][b] * weight[a][b] + of_kept[a][b] * of_b[a][b];
      growth[a][a] = 0.5 * in[a] / stretch[a];
    }
    growth = seen.axes * (growth * turned);
    const Matrix<dim> moved = sum(growth, 1.0, growth) * grown;
    Matrix<dim> of_F = moved * inverse_T;
    put<dim>(sum(of_F, -1.0, transposed(worked) * (tau * inverse_T)),
             u.of_gradient + p * dim * dim);
    if (!history)
      return;
    const Matrix<dim> f_T = transposed(f);
    put<dim>(sum(Matrix<dim>{}, -1.0, f_T * of_F), u.of_old_gradient + p * dim * dim);
    pack<dim>(f_T * (growth * f), u.of_old_c + p * m);
    if constexpr (dim == 2)
      u.of_old_c[p * m + 2] = 0.5 * in[2] / stretch[2];
  }
};

template <int dim>
void pull(const Change& u)
{
  for (std::size_t p = 0; p < u.count; ++p)
    Step<dim>(u, p).pull(u, p);
}
} // namespace

void core::pull_logarithmic(const Change& change, int dim)
{
  dim == 2 ? pull<2>(change) : pull<3>(change);
}
