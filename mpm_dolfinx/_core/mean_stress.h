// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

#include <cstddef>
#include <cstdint>

namespace core
{
// What a law has answered at points, and the pressure that takes the place of its mean stress.
struct Answered
{
  std::size_t count;
  const double *gradient, *P, *A; // F - I and P, (count, dim, dim), and dP/dF
  const double* stress;           // Mandel vectors, (count, components)
  int components;
  const double *pressure, *bulk; // (count,); the modulus is that of the law
  const std::uint8_t* small;     // whether the law is one of small strains, (count,)
};

struct Replaced
{
  double *P, *A, *stress; // as above, of the law with the pressure; A at constant pressure
  double *volume, *slope; // volume strain, (count,), and its derivative by F
};

// See mpm_dolfinx.constitutive.pressure, which is the oracle.
void replace_mean_stress(const Answered& law, int dim, const Replaced& result);
} // namespace core
