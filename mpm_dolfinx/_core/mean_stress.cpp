// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// A pressure in place of the mean stress of a law, point by point.

#include "mean_stress.h"
#include "hot_loop.h"
#include "matrix.h"

namespace
{
template <int dim>
void replace(const core::Answered& law, const core::Replaced& result)
{
  constexpr int square = dim * dim;
  for (std::size_t p = 0; p < law.count; ++p)
  {
    const double* stress = law.stress + p * law.components;
    const double mean = (stress[0] + stress[1] + stress[2]) / 3.0;
    const double change = law.pressure[p] - mean;
    const bool small = law.small[p] != 0;
    for (int c = 0; c < law.components; ++c)
      result.stress[p * law.components + c] = stress[c] + (c < 3 ? change : 0.0);
    result.volume[p] = mean / law.bulk[p];

    core::Matrix<dim> H{}, inverse{};
    if (!small)
      for (int i = 0; i < dim; ++i)
        for (int J = 0; J < dim; ++J)
          H[i][J] = law.gradient[p * square + i * dim + J];
    core::inverse<dim>(H, inverse);
    double* slope = result.slope + p * square;
    for (int i = 0; i < dim; ++i)
      for (int J = 0; J < dim; ++J)
      {
        slope[i * dim + J] = inverse[J][i];
        result.P[p * square + i * dim + J] =
            law.P[p * square + i * dim + J] + change * slope[i * dim + J];
      }

    const double* A = law.A + p * square * square;
    double* tangent = result.A + p * square * square;
    const double turning = small ? 0.0 : change;
    for (int i = 0; i < dim; ++i)
      for (int J = 0; J < dim; ++J)
        for (int k = 0; k < dim; ++k)
          for (int L = 0; L < dim; ++L)
          {
            const int at = ((i * dim + J) * dim + k) * dim + L;
            tangent[at] = A[at] - law.bulk[p] * slope[i * dim + J] * slope[k * dim + L]
                          - turning * slope[i * dim + L] * slope[k * dim + J];
          }
  }
}
} // namespace

HOT_LOOP void core::replace_mean_stress(const Answered& law, int dim, const Replaced& result)
{
  if (dim == 2)
    replace<2>(law, result);
  else
    replace<3>(law, result);
}
