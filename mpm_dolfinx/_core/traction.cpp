// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Tractions of contact and their derivatives at points of which gap, normal and way are known.

#include "traction.h"
#include "hot_loop.h"

namespace
{
using namespace core;

// What a point sees, as numbers with derivatives or without.
template <typename T, int dim>
struct Seen
{
  using Vector = std::array<T, dim>;
  T gap;
  Vector n, delta, change;

  Seen(const Separation& all, std::size_t p) : gap(all.gap[p])
  {
    for (int i = 0; i < dim; ++i)
    {
      n[i] = T(all.n[p * dim + i]);
      delta[i] = T(all.delta[p * dim + i]);
      change[i] = T(all.change ? all.change[p * dim + i] : 0.0);
    }
  }
};

// Return what acts on a point, and set its traction by pressure.
template <typename T, int dim>
Traction<T, dim> acting(const Touching& known, const Separation& all, std::size_t p,
                        const Seen<T, dim>& seen, std::array<T, dim>& normal,
                        const T* top = nullptr)
{
  normal = seen.n;
  Press<T> press;
  if (all.before)
  {
    const T gap = seen.gap - T(all.offset[p]), difference = seen.gap - T(all.before[p]);
    press = mean_pressing(known, p, all.before[p] - all.offset[p], gap);
    correct(&normal, &seen.change, &seen.change, 1, difference, known.still);
  }
  else
    press = pressing(known, p, seen.gap, seen.n, top);
  for (T& part : normal)
    part = press.value * part;
  return traction_of(known, p, press, seen.gap, seen.n, seen.delta);
}

template <int dim>
void act_in(const Touching& known, const Separation& all, double* pressure, double* normal,
            double* shear, std::uint8_t* inside, std::uint8_t* slips)
{
  std::array<double, dim> by;
  for (std::size_t p = 0; p < all.points; ++p)
  {
    const auto acts = acting<double, dim>(known, all, p, Seen<double, dim>(all, p), by);
    pressure[p] = acts.pressure;
    for (int i = 0; i < dim; ++i)
    {
      normal[p * dim + i] = by[i];
      shear[p * dim + i] = acts.shear[i];
    }
    inside[p] = acts.inside;
    slips[p] = acts.slips;
  }
}

template <int dim>
void differentiate_by_pressure_in(const Touching& known, const Separation& all, double* slopes)
{
  using T = Dual<dim>;
  T top;
  top.by.set(0, 1.0);
  std::array<T, dim> normal;
  for (std::size_t p = 0; p < all.points; ++p)
  {
    const auto acts = acting<T, dim>(known, all, p, Seen<T, dim>(all, p), normal, &top);
    for (int i = 0; i < dim; ++i)
      slopes[p * dim + i] = (normal[i] + acts.shear[i]).by[0];
  }
}

template <int dim>
void differentiate_in(const Touching& known, const Separation& all, const double* of_gap,
                      const double* of_normal, double* slopes)
{
  using T = Dual<dim>;
  std::array<T, dim> normal;
  for (std::size_t p = 0; p < all.points; ++p)
  {
    Seen<T, dim> seen(all, p);
    for (int j = 0; j < dim; ++j)
    {
      seen.gap.by.set(j, of_gap[p * dim + j]);
      seen.delta[j].by.set(j, 1.0);
      seen.change[j].by.set(j, 1.0);
      for (int i = 0; i < dim; ++i)
        seen.n[i].by.set(j, of_normal[(p * dim + i) * dim + j]);
    }
    const auto acts = acting<T, dim>(known, all, p, seen, normal);
    for (int i = 0; i < dim; ++i)
    {
      const T force = normal[i] + acts.shear[i];
      for (int j = 0; j < dim; ++j)
        slopes[(p * dim + i) * dim + j] = force.by[j];
    }
  }
}
} // namespace

HOT_LOOP void core::act(const Touching& known, const Separation& seen, int dim, double* pressure,
                        double* normal, double* shear, std::uint8_t* inside, std::uint8_t* slips)
{
  if (dim == 2)
    act_in<2>(known, seen, pressure, normal, shear, inside, slips);
  else
    act_in<3>(known, seen, pressure, normal, shear, inside, slips);
}

HOT_LOOP void core::differentiate_by_pressure(const Touching& known, const Separation& seen, int dim,
                                              double* slopes)
{
  if (dim == 2)
    differentiate_by_pressure_in<2>(known, seen, slopes);
  else
    differentiate_by_pressure_in<3>(known, seen, slopes);
}

HOT_LOOP void core::differentiate(const Touching& known, const Separation& seen, int dim,
                                  const double* of_gap, const double* of_normal, double* slopes)
{
  if (dim == 2)
    differentiate_in<2>(known, seen, of_gap, of_normal, slopes);
  else
    differentiate_in<3>(known, seen, of_gap, of_normal, slopes);
}
