// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Tractions of contact at points, of obstacles as of other bodies: see mpm_dolfinx.contact.law.

#pragma once

#include "dual.h"

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace core
{
// Points that may touch: what is known of the last converged step, and the law of friction.
struct Touching
{
  const double *stiffness, *tangential; // (points,)
  const std::uint8_t* touched;
  const double *gap, *stretch; // at the last converged step; of areas
  const double* behind;        // tractions (points, dim) that press, or null
  // Largest shears by a law of a user, and their derivatives by pressure, gap, way from the anchor
  // and tangential stiffness, (points, 5); or null: they are by Coulomb's law.
  const double* bounds;
  double friction, cohesion, limit, touch;
  double still; // changes of positions in a step that are none
  bool smooth;  // whether there is no friction
};

// A pressure, and whether it acts, or is about to.
template <typename T>
struct Press
{
  T value;
  bool acts;
};

template <typename T, int dim>
struct Traction
{
  T pressure;
  std::array<T, dim> shear;
  bool inside, slips;
};

// The pressure of a gap, or of a traction of the body that presses, but for what gap is left; and,
// where it acts, a pressure on top.
template <typename T, std::size_t dim>
Press<T> pressing(const Touching& known, std::size_t p, const T& gap, const std::array<T, dim>& n,
                  const T* top = nullptr)
{
  const double k = known.stiffness[p];
  T pressure = -k * gap;
  bool acts = value_of(gap) <= known.touch;
  if (known.behind)
  {
    for (std::size_t i = 0; i < dim; ++i)
      pressure = pressure + known.behind[p * dim + i] * n[i];
    acts = value_of(pressure) >= -k * known.touch;
  }
  if (top)
    pressure = pressure + *top;
  return {acts ? pressure : T(0.0), acts};
}

// The mean pressure of a step between two gaps: the loss of the energy k/2 <-gap>^2 over the change.
template <typename T>
Press<T> mean_pressing(const Touching& known, std::size_t p, double before, const T& gap)
{
  const bool was = before <= known.touch, is = value_of(gap) <= known.touch;
  const T first(was ? before : 0.0), last = is ? gap : T(0.0), change = gap - T(before);
  const bool once = was != is && std::abs(value_of(change)) > known.touch;
  const T share = once ? T((last - first) * inverse(change)) : T(1.0);
  return {-0.5 * known.stiffness[p] * ((first + last) * share), true};
}

// Correct gradients at some places, along given vectors, so that their product with the changes of
// these is a given difference.
template <typename T, std::size_t dim>
void correct(std::array<T, dim>* gradient, const std::array<T, dim>* change,
             const std::array<T, dim>* along, std::size_t count, const T& difference, double still)
{
  T size(0.0), lacks = difference;
  for (std::size_t k = 0; k < count; ++k)
  {
    size = size + dot(along[k], along[k]);
    lacks = lacks - dot(gradient[k], change[k]);
  }
  if (!(value_of(size) > still * still))
    return;
  const T factor = lacks * inverse(size);
  for (std::size_t k = 0; k < count; ++k)
    for (std::size_t i = 0; i < dim; ++i)
      gradient[k][i] = gradient[k][i] + factor * along[k][i];
}

// The largest shear by Coulomb's law.
template <typename T>
T coulomb(const T& pressure, double stretch, double friction, double cohesion, double limit)
{
  const T pressed = value_of(pressure) > 0.0 ? friction * pressure : T(0.0);
  const T bound = pressed + T(cohesion * stretch);
  return value_of(bound) < limit * stretch ? bound : T(limit * stretch);
}

// The share of its way that a point has been in contact: all of it where it was before, and the
// part behind the surface where it has come from outside, on a straight line.
template <typename T>
T since_touch(const Touching& known, std::size_t p, const T& gap)
{
  if (known.touched[p] != 0 || !(known.gap[p] > 10.0 * known.touch))
    return T(1.0);
  return value_of(gap) < 0.0 ? T(T(-1.0) * gap * inverse(T(known.gap[p]) - gap)) : T(0.0);
}

// What acts on a point with the normal n at the way delta from its anchor.
template <typename T, std::size_t dim>
Traction<T, dim> traction_of(const Touching& known, std::size_t p, const Press<T>& press,
                             const T& gap, const std::array<T, dim>& n,
                             const std::array<T, dim>& delta)
{
  Traction<T, dim> acts{press.value, {}, false, false};
  acts.inside = value_of(gap) <= known.touch || value_of(press.value) != 0.0;
  if (known.smooth || !acts.inside)
    return acts;
  const T normal = dot(n, delta), factor = -known.tangential[p] * since_touch(known, p, gap);
  for (std::size_t i = 0; i < dim; ++i)
    acts.shear[i] = factor * (delta[i] - n[i] * normal);
  const T square = dot(acts.shear, acts.shear);
  const double* given = known.bounds ? known.bounds + 5 * p : nullptr;
  T bound = given ? T(given[0])
                  : coulomb(press.value, known.stretch[p], known.friction, known.cohesion,
                            known.limit);
  acts.slips
      = std::sqrt(value_of(square)) > value_of(bound) + known.tangential[p] * known.touch;
  if (!acts.slips)
    return acts;
  const T size = root(square);
  if (given)
  {
    const T stiffness = -1.0 * factor, way = size * inverse(stiffness);
    const std::array<T, 4> by = {press.value, gap, way, stiffness};
    for (std::size_t i = 0; i < 4; ++i)
      bound = bound + given[1 + i] * (by[i] - T(value_of(by[i])));
  }
  const T less = bound * inverse(size);
  for (T& part : acts.shear)
    part = part * less;
  return acts;
}

// Points of which gaps (points,), normals and ways from anchors (points, dim) are known. In a step of
// a motion normals are those of its middle, and gaps at its beginning, those at which points begin to
// be pressed (points,), and changes (points, dim) are known too; otherwise these are null.
struct Separation
{
  std::size_t points;
  const double *gap, *n, *delta;
  const double *before, *offset, *change;
};

// Set pressures (points,), tractions by these and by friction (points, dim), and which points touch
// and slip.
void act(const Touching& known, const Separation& seen, int dim, double* pressure, double* normal,
         double* shear, std::uint8_t* inside, std::uint8_t* slips);

// Set the derivatives of tractions by a pressure on top, (points, dim).
void differentiate_by_pressure(const Touching& known, const Separation& seen, int dim,
                               double* slopes);

// Set the derivatives of tractions by positions (points, dim, dim), from those of gaps (points, dim)
// and of normals (points, dim, dim).
void differentiate(const Touching& known, const Separation& seen, int dim, const double* of_gap,
                   const double* of_normal, double* slopes);
} // namespace core
