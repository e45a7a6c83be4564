// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Views of NumPy arrays, and the checks that keep a wrong shape out of the loops.

#pragma once

#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <string>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace core
{
namespace nb = nanobind;

template <typename T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

using Reals = Array<const double>;
using RealsOut = Array<double>;
using Indices = Array<const std::int32_t>;
using IndicesOut = Array<std::int32_t>;
using Offsets = Array<const std::int64_t>;
using OffsetsOut = Array<std::int64_t>;

inline void require(bool condition, const char* what)
{
  if (!condition)
    throw std::invalid_argument(std::string("shapes do not go together: ") + what);
}
} // namespace core
