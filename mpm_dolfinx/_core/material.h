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

// Input and output of an update of many points; see update_logarithmic in module.cpp.
struct Update
{
  std::size_t count;
  const double *gradient, *old_gradient, *old_c, *old_plastic_strain;
  Parameter bulk, shear, rho_y, hardening;
  double tolerance;
  double *P, *A, *stress, *c, *plastic_strain;
};

// Update all points; return those whose det F or trial b is not positive and finite.
std::vector<std::int64_t> update_logarithmic(const Update& update, int dim);
} // namespace core
