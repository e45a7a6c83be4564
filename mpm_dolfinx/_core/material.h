// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace core
{
// A parameter of a material: one value for all points, or one for each.
struct Parameter
{
  const double* values;
  std::size_t stride;
  double operator()(std::size_t point) const { return values[point * stride]; }
};

enum class Law {
  hencky,         // bulk, shear
  neo_hooke,      // Lame's first constant, shear
  von_mises,      // bulk, shear, rho_y, hardening
  mohr_coulomb,   // bulk, shear, sin(phi), sin(psi), 2 c cos(phi), cut-off, volume correction
  drucker_prager, // bulk, shear, eta, eta_psi, xi c, largest mean stress, volume correction
  mu_i,           // bulk, shear, mu_s, mu_2 - mu_s, d sqrt(rho_s)/I_0, duration of the step
  cam_clay,       // compression, swelling, M, shear, reference pressure
  // Laws that soften by an average end with the decay, what drives it, and what plastic strain at
  // the point takes from that; angles are in radians, c_r and phi_r residual values.
  von_mises_averaged,      // bulk, shear, rho_y, hardening, residual share
  mohr_coulomb_averaged,   // bulk, shear, c, c_r, phi, phi_r, psi, cut-off, volume correction, 0
  drucker_prager_averaged, // the same, with the number of the cone: outer, inner, plane strain
};

constexpr std::size_t max_parameters = 13;
constexpr std::size_t max_variables = 2;

// How many parameters and internal variables a law has.
constexpr std::size_t num_parameters(Law law)
{
  switch (law)
  {
  case Law::hencky:
  case Law::neo_hooke:
    return 2;
  case Law::von_mises:
    return 4;
  case Law::mu_i:
    return 6;
  case Law::cam_clay:
    return 5;
  case Law::von_mises_averaged:
    return 8;
  case Law::mohr_coulomb_averaged:
  case Law::drucker_prager_averaged:
    return 13;
  default:
    return 7;
  }
}
constexpr std::size_t num_variables(Law law)
{
  return law <= Law::neo_hooke ? 0 : law == Law::cam_clay ? 2 : 1;
}

// What takes the place of the mean stress at each point, and what comes of it: a pressure, the
// modulus of the augmentation, and the gap of volume with its compliance and derivatives (see
// mpm_dolfinx.materials.given_pressure).
struct GivenPressure
{
  const double* pressure;
  Parameter augmentation;
  double *gap, *compliance, *slope, *by_pressure;
};

constexpr double whole = 1.0;

// Input and output of an update of many points; see update_plastic in module.cpp. Without
// old_gradient there is no history; of a return there is only a share where flow takes time. With
// trial strains, Mandel vectors of the law's own strain, it is one of stress and strain: A has the
// derivatives of the stress by them, and c the elastic strains.
struct Update
{
  Law law;
  std::size_t count;
  const double *gradient, *old_gradient, *old_c, *trial;
  const double* old_variables[max_variables];
  Parameter parameters[max_parameters];
  Parameter share{&whole, 0};
  double tolerance;
  double *P, *A, *stress, *c;
  double* variables[max_variables];
  const GivenPressure* given = nullptr;
};

// Update all points; return those whose det F or trial b is not positive and finite, or, with a
// given pressure, that have no volume strain for it.
std::vector<std::int64_t> update_logarithmic(const Update& update, int dim);

// What a law has derivatives by: its parameters, and the share of a return.
constexpr std::size_t num_numbers(Law law) { return num_parameters(law) + 1; }

// A step of many points that has been made, and derivatives of something by all that goes into it
// and comes out of it. Without old_gradient there is no history. The
// numbers of points, num_numbers of each, lie together, and so do their variables.
struct Change
{
  Law law;
  std::size_t count;
  const double *gradient, *old_gradient, *old_c;
  const double* old_variables[max_variables];
  Parameter parameters[max_parameters];
  Parameter share;
  double tolerance;
  double *of_gradient, *of_old_gradient, *of_old_c, *of_old_variables, *of_numbers;
  double *of_P, *of_stress, *of_c, *of_variables;
};

// Set the derivatives by what goes in from those by what comes out.
void pull_logarithmic(const Change& change, int dim);

// Whether there are derivatives of a law: laws that soften by an average end have none.
constexpr bool has_derivatives(Law law) { return law < Law::von_mises_averaged; }
} // namespace core
