// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Tractions of contact and their derivatives at points of which gap, normal and way are known.

#include "traction.h"
#include "hot_loop.h"

#include <algorithm>

namespace
{
using namespace core;

template <typename T, int dim>
std::array<T, dim> row(const T* values, std::size_t p)
{
  std::array<T, dim> found;
  std::copy_n(values + p * dim, dim, found.begin());
  return found;
}

template <typename T, int dim>
void act_in(const Touching& known, const Separation<T>& seen, T* pressure, T* shear,
            std::uint8_t* inside, std::uint8_t* slips)
{
  for (std::size_t p = 0; p < seen.points; ++p)
  {
    const auto n = row<T, dim>(seen.n, p);
    const T gap = seen.gap[p];
    const Press<T> press
        = seen.pressure ? Press<T>{seen.pressure[p], true} : pressing(known, p, gap, n);
    const auto acts = traction_of(known, p, press, gap, n, row<T, dim>(seen.delta, p));
    pressure[p] = acts.pressure;
    std::copy_n(acts.shear.begin(), dim, shear + p * dim);
    inside[p] = acts.inside;
    slips[p] = acts.slips;
  }
}

template <int dim>
void differentiate_in(const Touching& known, const Separation<double>& seen, double* slopes)
{
  constexpr int lanes = 2 + 2 * dim;
  using T = Dual<lanes>;
  for (std::size_t p = 0; p < seen.points; ++p)
  {
    T gap(seen.gap[p]);
    std::array<T, dim> n, delta;
    gap.by[1] = 1.0;
    for (int i = 0; i < dim; ++i)
    {
      n[i] = T(seen.n[p * dim + i]);
      n[i].by[2 + i] = 1.0;
      delta[i] = T(seen.delta[p * dim + i]);
      delta[i].by[2 + dim + i] = 1.0;
    }
    Press<T> press
        = seen.pressure ? Press<T>{T(seen.pressure[p]), true} : pressing(known, p, gap, n);
    press.value.by[0] = press.acts ? 1.0 : 0.0;
    const auto acts = traction_of(known, p, press, gap, n, delta);
    double* found = slopes + p * (1 + dim) * lanes;
    std::copy_n(acts.pressure.by.begin(), lanes, found);
    for (int i = 0; i < dim; ++i)
      std::copy_n(acts.shear[i].by.begin(), lanes, found + (1 + i) * lanes);
  }
}
} // namespace

HOT_LOOP void core::act(const Touching& known, const Separation<double>& seen, int dim, double* pressure,
                        double* shear, std::uint8_t* inside, std::uint8_t* slips)
{
  if (dim == 2)
    act_in<double, 2>(known, seen, pressure, shear, inside, slips);
  else
    act_in<double, 3>(known, seen, pressure, shear, inside, slips);
}

HOT_LOOP void core::act(const Touching& known, const Separation<Dual<1>>& seen, int dim,
                        Dual<1>* pressure, Dual<1>* shear, std::uint8_t* inside,
                        std::uint8_t* slips)
{
  if (dim == 2)
    act_in<Dual<1>, 2>(known, seen, pressure, shear, inside, slips);
  else
    act_in<Dual<1>, 3>(known, seen, pressure, shear, inside, slips);
}

HOT_LOOP void core::differentiate(const Touching& known, const Separation<double>& seen, int dim,
                                  double* slopes)
{
  if (dim == 2)
    differentiate_in<2>(known, seen, slopes);
  else
    differentiate_in<3>(known, seen, slopes);
}
