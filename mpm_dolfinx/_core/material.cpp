// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Elasticity and laws of plasticity in logarithmic strain, point by point.

#include "material_update.h"

std::vector<std::int64_t> core::update_logarithmic(const Update& update, int dim)
{
  switch (update.law)
  {
  case Law::hencky:
    return update_all<Hencky<>>(update, dim);
  case Law::neo_hooke:
    return update_all<NeoHooke<>>(update, dim);
  case Law::von_mises:
    return update_all<VonMises<>>(update, dim);
  case Law::mohr_coulomb:
    return update_all<MohrCoulomb<>>(update, dim);
  case Law::drucker_prager:
    return update_all<DruckerPrager<>>(update, dim);
  case Law::mu_i:
    return update_all<MuIRheology<>>(update, dim);
  case Law::cam_clay:
    return update_all<CamClay<>>(update, dim);
  default:
    return update_averaged(update, dim);
  }
}
