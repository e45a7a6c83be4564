// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace core
{
// Which stress of a whole step a point has.
enum class Step : std::uint8_t {
  mean_of_stresses, // a law of small strains
  simo_tarnow,
  gonzalez,   // with an energy
  dissipative // the same, where else the stress would give more than the energy has
};

// Stress of the material and displacement gradients at both ends of a step, all (count, dim, dim),
// with the derivative A of the stress at the end, (count, dim, dim, dim, dim).
struct StepEnds
{
  std::size_t count;
  const double *gradient, *old_gradient, *P, *old_P, *A;
  const double *energy, *old_energy; // (count,), or null where no point is of Gonzalez
  const std::uint8_t* kind;          // Step of each point, or of all
  std::size_t stride;                // 1 or 0 with it
  double small;                      // change of strain below which Gonzalez' correction fades
  double factor;                     // of stress and tangent
};

// Set stress (count, dim, dim) and tangent (count, dim, dim, dim, dim) of the step; return the
// points whose F is singular. See mpm_dolfinx.constitutive.step_stress, which is the oracle.
std::vector<std::int64_t> step_stress(const StepEnds& ends, int dim, double* stress,
                                      double* tangent);

// Displacement gradients at both ends of a step, (count, dim, dim), and the stiffness of the
// undeformed body, (count, dim, dim, dim, dim), by which a rate of strain is resisted.
struct Damping
{
  std::size_t count;
  const double *gradient, *old_gradient, *stiffness;
  const bool* small; // (count,), whether a law is of small strains
  double factor;     // of stress and tangent
};

// Set the stress of damping (count, dim, dim) and its derivative (count, dim, dim, dim, dim) by F.
void damping(const Damping& damping, int dim, double* stress, double* tangent);
} // namespace core
