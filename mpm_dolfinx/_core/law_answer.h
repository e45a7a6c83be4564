// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Laws in principal logarithmic strain as functions, each compiled once.

#pragma once

#include "hot_loop.h"
#include "principal_laws.h"

#include <array>

namespace core
{
// Answer to a strain, by parameters and the share of a return that time is for.
using LawAnswer = void (*)(const double* parameters, double share,
                           const std::array<double, 3>& strain, double tolerance, Response<>& r);

// That of laws that soften by an average.
LawAnswer answer_averaged(Law law);
} // namespace core

// (Each file that includes this has functions of its own laws.)
namespace
{
template <typename Law>
HOT_PART void answer(const double* parameters, double share, const std::array<double, 3>& strain,
                     double tolerance, core::Response<>& r)
{
  core::InTime<Law>{Law(parameters), parameters[0], parameters[1], share}(strain, tolerance, r);
}
} // namespace
