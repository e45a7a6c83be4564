// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Laws of plasticity in principal logarithmic strains, for numbers and for numbers with derivatives.
//
// tests/returns.py has the same algorithms for all points together, which are their oracles.

#pragma once

#include "dual.h"
#include "isotropic.h"
#include "material.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <initializer_list>
#include <limits>
#include <type_traits>
#include <utility>

namespace core
{
using std::abs;
using std::exp;
using std::expm1;
using std::log;
using std::sqrt;

// Whether numbers have no derivatives; tangents are for these.
template <typename T>
constexpr bool bare = std::is_same_v<T, double>;

// Answer of the law in the principal frame: `normal` holds the derivatives of the stresses by the
// strains, `shear` the quotients of their differences; numbers with derivatives have no use for these.
template <typename T = double>
struct Response
{
  std::array<T, 3> stress, elastic_strain;
  std::array<T, core::max_variables> variables;
  bool plastic;
  T shear[3][3], normal[3][3];
};

// Hencky's law as the answer to a strain: what an elastic step gives.
template <typename T>
void answer_elastic(const std::array<T, 3>& strain, T bulk, T shear, Response<T>& r)
{
  const T lame = bulk - 2.0 / 3.0 * shear, sum = lame * (strain[0] + strain[1] + strain[2]);
  r.plastic = false;
  r.elastic_strain = strain;
  for (int a = 0; a < 3; ++a)
  {
    r.stress[a] = sum + 2.0 * shear * strain[a];
    if constexpr (bare<T>)
      for (int b = 0; b < 3; ++b)
      {
        r.normal[a][b] = lame + (a == b ? 2.0 * shear : 0.0);
        r.shear[a][b] = 2.0 * shear;
      }
  }
}

template <typename T>
T norm_of_difference(const std::array<T, 3>& x, const std::array<T, 3>& y)
{
  const T a = x[0] - y[0], b = x[1] - y[1], c = x[2] - y[2];
  return sqrt(a * a + b * b + c * c);
}

template <typename T = double>
struct Hencky
{
  T bulk, shear;
  explicit Hencky(const T* p) : bulk(p[0]), shear(p[1]) {}

  void operator()(const std::array<T, 3>& strain, double, Response<T>& r) const
  {
    answer_elastic(strain, bulk, shear, r);
  }
};

// tau = G (b - 1) + lambda ln J; see NeoHooke of mpm_dolfinx.materials.
template <typename T = double>
struct NeoHooke
{
  T lame, shear;
  explicit NeoHooke(const T* p) : lame(p[0]), shear(p[1]) {}

  void operator()(const std::array<T, 3>& strain, double, Response<T>& r) const
  {
    const T sum = lame * (strain[0] + strain[1] + strain[2]);
    r.plastic = false;
    r.elastic_strain = strain;
    for (int a = 0; a < 3; ++a)
    {
      r.stress[a] = sum + shear * expm1(2.0 * strain[a]);
      if constexpr (bare<T>)
        for (int b = 0; b < 3; ++b)
        {
          const double gap = strain[a] - strain[b];
          const double mean = 2.0 * shear * exp(strain[a] + strain[b]);
          r.shear[a][b] = mean * (gap == 0.0 ? 1.0 : std::sinh(gap) / gap);
          r.normal[a][b] = lame + (a == b ? mean : 0.0);
        }
    }
  }
};

// Radial return (Wilkins 1964) with the consistent tangent of Simo & Taylor (1985).
template <typename T = double>
struct VonMises
{
  T bulk, shear, rho_y, h;
  explicit VonMises(const T* p) : bulk(p[0]), shear(p[1]), rho_y(p[2]), h(p[3]) {}

  void operator()(const std::array<T, 3>& strain, double tolerance, Response<T>& r) const
  {
    const T plastic_strain = r.variables[0];
    const T trace = strain[0] + strain[1] + strain[2];
    std::array<T, 3> deviator;
    T size = 0.0;
    for (int a = 0; a < 3; ++a)
    {
      deviator[a] = strain[a] - trace / 3.0;
      size += deviator[a] * deviator[a];
    }
    size = sqrt(size);
    const T rho = rho_y + root_two_thirds * h * plastic_strain;
    r.plastic = 2.0 * shear * size / rho - 1.0 > tolerance;
    r.elastic_strain = strain;
    T along = 0.0, secant = 2.0 * shear;
    if (r.plastic)
    {
      const T slope = 2.0 / 3.0 * h;
      const T flow = (2.0 * shear * size - rho) / (2.0 * shear + slope);
      const T strength = rho + slope * flow;
      secant = strength / size;
      along = 2.0 * shear * slope / (2.0 * shear + slope) - secant;
      for (int a = 0; a < 3; ++a)
      {
        const T direction = deviator[a] / size;
        r.stress[a] = bulk * trace + strength * direction;
        r.elastic_strain[a] -= flow * direction;
      }
      r.variables[0] += root_two_thirds * flow;
    }
    else
      for (int a = 0; a < 3; ++a)
        r.stress[a] = bulk * trace + 2.0 * shear * deviator[a];
    if constexpr (bare<T>)
      for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b)
        {
          r.shear[a][b] = secant;
          r.normal[a][b] = bulk - secant / 3.0 + (a == b ? secant : 0.0);
          if (r.plastic)
            r.normal[a][b] += along * (deviator[a] / size) * (deviator[b] / size);
        }
  }
};

// Principal values in descending order; see mpm_dolfinx.materials.mohr_coulomb.
template <typename T = double>
struct MohrCoulomb
{
  T bulk, shear, friction, dilation, strength, tension, lame;
  bool corrects;
  explicit MohrCoulomb(const T* p)
      : bulk(p[0]), shear(p[1]), friction(p[2]), dilation(p[3]), strength(p[4]), tension(p[5]),
        lame(p[0] - 2.0 / 3.0 * p[1]), corrects(value_of(p[6]) != 0.0)
  {
  }

  using Vector = std::array<T, 3>;

  struct Answer
  {
    Vector stress, elastic;
    T normal[3][3];
  };

  Vector stress_of(const Vector& e) const
  {
    const T sum = lame * (e[0] + e[1] + e[2]);
    return {sum + 2.0 * shear * e[0], sum + 2.0 * shear * e[1], sum + 2.0 * shear * e[2]};
  }

  enum Where { plane, compression, extension };

  // The average over the two equal values of an edge.
  static Vector averaged(Where where, const Vector& x)
  {
    if (where == compression)
      return {0.5 * (x[0] + x[1]), 0.5 * (x[0] + x[1]), x[2]};
    if (where == extension)
      return {x[0], 0.5 * (x[1] + x[2]), 0.5 * (x[1] + x[2])};
    return x;
  }

  // Return to the plane or an edge, as if these went on for ever.
  Vector along(Where where, const Vector& strain, Answer* answer) const
  {
    const Vector yield = averaged(where, {1.0 + friction, 0.0, friction - 1.0});
    const Vector flow = averaged(where, {1.0 + dilation, 0.0, dilation - 1.0});
    const Vector e = averaged(where, strain);
    const Vector push = stress_of(flow), trial = stress_of(e);
    const T curvature = yield[0] * push[0] + yield[1] * push[1] + yield[2] * push[2];
    const T f = yield[0] * trial[0] + yield[1] * trial[1] + yield[2] * trial[2] - strength;
    const T multiplier = f / curvature;
    Vector elastic;
    for (int a = 0; a < 3; ++a)
      elastic[a] = e[a] - multiplier * flow[a];
    if (answer != nullptr)
    {
      answer->elastic = elastic;
      answer->stress = stress_of(elastic);
      if constexpr (!bare<T>)
        return elastic;
      const Vector pull = stress_of(yield);
      for (int a = 0; a < 3; ++a)
      {
        Vector unit{};
        unit[a] = 1.0;
        unit = averaged(where, unit);
        for (int b = 0; b < 3; ++b)
          answer->normal[a][b] = lame + 2.0 * shear * unit[b] - push[a] * pull[b] / curvature;
      }
    }
    return elastic;
  }

  // The answer with some stresses given and no plastic strain along the other axes.
  Answer at_stress(const Vector& strain, const std::array<bool, 3>& given,
                   const Vector& values) const
  {
    const T unit = 2.0 * shear;
    const int count = given[0] + given[1] + given[2];
    const T slope = 1.0 / (1.0 + count * lame / unit);
    T trace = 0.0;
    for (int a = 0; a < 3; ++a)
      trace += given[a] ? values[a] / unit : strain[a];
    trace *= slope;
    Answer answer;
    for (int a = 0; a < 3; ++a)
    {
      answer.elastic[a] = given[a] ? (values[a] - lame * trace) / unit : strain[a];
      answer.stress[a] = given[a] ? values[a] : lame * trace + unit * strain[a];
      for (int b = 0; b < 3; ++b)
        answer.normal[a][b] = given[a] || given[b] ? 0.0 : lame * slope + (a == b ? unit : 0.0);
    }
    return answer;
  }

  static double largest(std::initializer_list<T> values)
  {
    double result = -std::numeric_limits<double>::infinity();
    for (const T& value : values)
      result = std::max(result, value_of(value));
    return result;
  }

  // With the volume correction what opens at a point of the hydrostatic axis stays in the elastic
  // strain, to close again before there is pressure.
  void keep_volume(const Vector& strain, Answer& answer) const
  {
    if (!corrects)
      return;
    const T third = (strain[0] + strain[1] + strain[2]) / 3.0;
    answer.elastic = {third, third, third};
  }

  // Return to the cut-off, its edges and corners: what fits best, or fits.
  Answer tensile(const Vector& strain) const
  {
    const T t = tension, unit = 2.0 * shear;
    const T least = ((1.0 + friction) * t - strength) / (1.0 - friction);
    const T ratio = (1.0 + dilation) / (1.0 - dilation);
    double best = std::numeric_limits<double>::infinity();
    Answer answer{};
    auto compare = [&](const std::array<bool, 3>& given, const Vector& values, int number) {
      const Answer candidate = at_stress(strain, given, values);
      const Vector& s = candidate.stress;
      Vector p;
      for (int a = 0; a < 3; ++a)
        p[a] = strain[a] - candidate.elastic[a];
      double misfit = 0.0;
      switch (number)
      {
      case 0:
        misfit = largest({-p[0], (s[1] - t) / unit, (least - s[2]) / unit});
        break;
      case 1:
        misfit = largest({-p[0], -p[1], (s[2] - t) / unit, (least - s[2]) / unit});
        break;
      case 2:
        misfit = largest({-p[0], -p[1], -p[2]});
        break;
      case 3:
        misfit = largest({p[2], -ratio * p[2] - p[0], (s[1] - t) / unit, (least - s[1]) / unit});
        break;
      case 4:
        misfit = largest({p[2], -p[0], -p[1], -ratio * p[2] - p[0] - p[1]});
        break;
      default:
        misfit = largest({p[1], p[2], -ratio * (p[1] + p[2]) - p[0]});
      }
      if (misfit < best)
      {
        best = misfit;
        answer = candidate;
        if (number == 2)
          keep_volume(strain, answer);
      }
    };
    compare({true, false, false}, {t, t, t}, 0);
    compare({true, true, false}, {t, t, t}, 1);
    compare({true, true, true}, {t, t, t}, 2);
    compare({true, false, true}, {t, t, least}, 3);
    compare({true, true, true}, {t, t, least}, 4);
    compare({true, true, true}, {t, least, least}, 5);
    return answer;
  }

  // Return to the pyramid without cut-off.
  void pyramid(const Vector& strain, T apex, Answer& answer) const
  {
    const Vector e = along(plane, strain, nullptr);
    const bool low = e[0] < e[1], high = e[1] < e[2];
    if (!low && !high)
    {
      along(plane, strain, &answer);
      return;
    }
    for (const Where edge : {compression, extension})
      if (edge == compression ? low : high)
      {
        const Vector there = along(edge, strain, nullptr);
        if (there[0] >= there[2])
        {
          along(edge, strain, &answer);
          return;
        }
      }
    answer = at_stress(strain, {true, true, true}, {apex, apex, apex});
    keep_volume(strain, answer);
  }

  void operator()(const Vector& unsorted, double tolerance, Response<T>& r) const
  {
    int order[3] = {0, 1, 2};
    auto swap = [&](int i, int j) {
      if (unsorted[order[i]] < unsorted[order[j]])
        std::swap(order[i], order[j]);
    };
    swap(0, 1);
    swap(1, 2);
    swap(0, 1);
    const Vector strain = {unsorted[order[0]], unsorted[order[1]], unsorted[order[2]]};
    Answer answer;
    answer.stress = stress_of(strain);
    const T pull = (1.0 + friction) * answer.stress[0];
    const T push = (1.0 - friction) * answer.stress[2];
    const double room
        = tolerance * (std::abs(value_of(pull)) + std::abs(value_of(push)) + value_of(strength));
    const bool shears = pull - push - strength > room;
    const T apex = strength / (2.0 * friction);
    if (shears)
      pyramid(strain, apex, answer);
    // The cut-off lies beyond the apex where it is larger.
    if (answer.stress[0] - tension > room && !(tension >= apex))
      answer = tensile(strain);
    else if (!shears)
    {
      answer_elastic(unsorted, bulk, shear, r);
      return;
    }
    r.plastic = true;
    r.variables[0] += root_two_thirds * norm_of_difference(strain, answer.elastic);
    const double near = 1e-12
                        * std::max({std::abs(value_of(strain[0])), std::abs(value_of(strain[1])),
                                    std::abs(value_of(strain[2]))});
    for (int a = 0; a < 3; ++a)
    {
      r.stress[order[a]] = answer.stress[a];
      r.elastic_strain[order[a]] = answer.elastic[a];
      if constexpr (!bare<T>)
        continue;
      for (int b = 0; b < 3; ++b)
        r.normal[order[a]][order[b]] = answer.normal[a][b];
      for (int b = a + 1; b < 3; ++b)
      {
        const T difference = strain[a] - strain[b];
        T quotient;
        if (difference <= near)
          quotient = 0.5
                     * (answer.normal[a][a] - answer.normal[a][b] - answer.normal[b][a]
                        + answer.normal[b][b]);
        else
          quotient = 2.0 * shear * ((answer.elastic[a] - answer.elastic[b]) / difference);
        quotient = std::min(std::max(quotient, T(0.0)), T(2.0 * shear));
        r.shear[order[a]][order[b]] = r.shear[order[b]][order[a]] = quotient;
      }
    }
  }
};

// A trial strain as laws of two invariants see it: tau = p 1 + sqrt(2) q n, with the unit deviator
// n; q is the root of J2.
template <typename T>
struct Invariants
{
  T trace, size = 0.0;
  std::array<T, 3> deviator;
  explicit Invariants(const std::array<T, 3>& strain) : trace(strain[0] + strain[1] + strain[2])
  {
    for (int a = 0; a < 3; ++a)
    {
      deviator[a] = strain[a] - trace / 3.0;
      size += deviator[a] * deviator[a];
    }
    size = sqrt(size);
  }
};

// What such a law returns to: p, q, and their derivatives by the trace and the size of the deviator.
template <typename T>
struct Returned
{
  T p, q, p_trace = 0.0, p_size = 0.0, q_trace = 0.0, q_size = 0.0;
};

// Answer of such a law that yields, with the elastic strain of volume.
template <typename T>
void answer_returned(const std::array<T, 3>& strain, const Invariants<T>& trial,
                     const Returned<T>& law, T shear, T volume, Response<T>& r)
{
  const T root = root_two * shear * trial.size;
  const T ratio = root > 0.0 ? law.q / root : T(0.0), secant = 2.0 * shear * ratio;
  const T along = root_two * law.q_size - secant;
  std::array<T, 3> direction;
  r.plastic = true;
  for (int a = 0; a < 3; ++a)
  {
    direction[a] = trial.size > 0.0 ? trial.deviator[a] / trial.size : T(0.0);
    r.stress[a] = law.p + secant * trial.deviator[a];
    r.elastic_strain[a] = ratio * trial.deviator[a] + volume / 3.0;
  }
  r.variables[0] += root_two_thirds * norm_of_difference(strain, r.elastic_strain);
  if constexpr (!bare<T>)
    return;
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b)
    {
      r.shear[a][b] = secant;
      r.normal[a][b] = secant * ((a == b ? 1.0 : 0.0) - 1.0 / 3.0)
                       + along * direction[a] * direction[b] + law.p_trace
                       + law.p_size * direction[b] + root_two * law.q_trace * direction[a];
    }
}

// The cone, or the cap at the largest mean stress; see mpm_dolfinx.materials.drucker_prager.
template <typename T = double>
struct DruckerPrager
{
  T bulk, shear, eta, flow, strength, top;
  bool corrects;
  explicit DruckerPrager(const T* p)
      : bulk(p[0]), shear(p[1]), eta(p[2]), flow(p[3]), strength(p[4]), top(p[5]),
        corrects(value_of(p[6]) != 0.0)
  {
  }

  void operator()(const std::array<T, 3>& strain, double tolerance, Response<T>& r) const
  {
    const Invariants<T> trial(strain);
    const T mean = bulk * trial.trace, root = root_two * shear * trial.size;
    const double room = tolerance * value_of(root + abs(mean) + strength);
    const T f = root + eta * mean - strength;
    if (!(f > room || mean - top > room))
    {
      answer_elastic(strain, bulk, shear, r);
      return;
    }
    const T stiffness = shear + bulk * eta * flow;
    const T multiplier = f > 0.0 ? f / stiffness : T(0.0);
    Returned<T> law{mean - bulk * flow * multiplier, root - shear * multiplier};
    const bool keeps_volume = corrects && law.p > top;
    if (law.p > top)
    {
      const T limit = std::max(T(strength - eta * top), T(0.0));
      law.p = top;
      law.q_size = root < limit ? root_two * shear : T(0.0);
      law.q = std::min(root, limit);
    }
    else
    {
      law.p_trace = bulk * (1.0 - bulk * eta * flow / stiffness);
      law.q_size = root_two * shear * (1.0 - shear / stiffness);
      law.p_size = -root_two * shear * bulk * flow / stiffness;
      law.q_trace = -shear * bulk * eta / stiffness;
    }
    answer_returned(strain, trial, law, shear, keeps_volume ? trial.trace : T(law.p / bulk), r);
  }
};

// Friction by the inertial number, without cohesion and dilation; see mpm_dolfinx.materials.mu_i.
template <typename T = double>
struct MuIRheology
{
  T bulk, shear, friction, range, lag, time;
  explicit MuIRheology(const T* p)
      : bulk(p[0]), shear(p[1]), friction(p[2]), range(p[3]), lag(p[4]), time(p[5])
  {
  }

  void operator()(const std::array<T, 3>& strain, double tolerance, Response<T>& r) const
  {
    const Invariants<T> trial(strain);
    const T pressure = -bulk * trial.trace, root = root_two * shear * trial.size;
    const T f = root - friction * pressure, room = tolerance * (root + abs(pressure));
    if (!(f > room || -pressure > room))
    {
      answer_elastic(strain, bulk, shear, r);
      return;
    }
    if (!(pressure > 0.0))
    {
      answer_returned(strain, trial, Returned<T>{0.0, 0.0}, shear, trial.trace, r);
      return;
    }
    // shear lag m^2 + b m = f wait for the plastic shear m
    const T wait = time * sqrt(pressure), quick = shear * lag;
    const T b = shear * wait + lag * (range * pressure - f);
    const T slope = sqrt(b * b + 4.0 * quick * f * wait);
    const T slip = b > 0.0 ? T(2.0 * f * wait / (b + slope)) : T(0.5 * (slope - b) / quick);
    const T q = std::max(T(root - shear * slip), T(friction * pressure));
    Returned<T> law{-pressure, std::min(q, T((friction + range) * pressure))};
    const T excess = law.q / pressure - friction;
    law.p_trace = bulk;
    law.q_size = root_two * shear * (1.0 - shear * (lag * slip + wait) / slope);
    law.q_trace =
        -bulk * shear
        * (slip * lag * (friction + range) + wait * (friction - 0.5 * excess)) / slope;
    answer_returned(strain, trial, law, shear, trial.trace, r);
  }
};

// Two equations for the elastic strain of volume x and the multiplier y, with stresses over the old
// p_c; see mpm_dolfinx.materials.cam_clay.
template <typename T = double>
struct CamClay
{
  T plastic, swelling, ratio, modulus, pressure;
  explicit CamClay(const T* p)
      : plastic(p[0] - p[1]), swelling(p[1]), ratio(p[2]), modulus(p[3]), pressure(p[4])
  {
  }

  struct Point
  {
    T plastic, swelling, ratio, shear, reference, softness, volume, shape;

    struct Values
    {
      T p, p_c, left, q, flow, f;
    };

    // q is that of the ellipse, over M.
    Values at(const T& x, const T& y) const
    {
      Values v;
      v.p = reference * exp(x / swelling);
      v.p_c = exp((volume - x) / plastic);
      v.left = 1.0 + softness * y;
      v.q = 3.0 * shear * shape / v.left / ratio;
      v.flow = x - volume + y * (2.0 * v.p - v.p_c);
      v.f = v.q * v.q + v.p * (v.p - v.p_c);
      return v;
    }

    // Derivatives of the residuals: flow by x, by y, yield by x, by y.
    std::array<T, 4> jacobian(const Values& v, const T& y) const
    {
      const T slope = v.p / swelling, hardening = v.p_c / plastic;
      return {1.0 + y * (2.0 * slope + hardening), 2.0 * v.p - v.p_c,
              (2.0 * v.p - v.p_c) * slope + v.p * hardening, -2.0 * v.q * v.q * softness / v.left};
    }

    T volume_at(T y, T low, T high) const
    {
      for (int k = 0; k < halvings; ++k)
      {
        const T middle = 0.5 * (low + high);
        (at(middle, y).flow > 0.0 ? high : low) = middle;
      }
      return 0.5 * (low + high);
    }

    void search(T& x, T& y, T low, T high) const
    {
      T largest = 1.0, least = 0.0;
      for (int k = 0; k < halvings; ++k)
        if (at(volume_at(largest, low, high), largest).f > 0.0)
          largest *= 4.0;
        else
          break;
      for (int k = 0; k < halvings; ++k)
      {
        const T middle = 0.5 * (least + largest);
        (at(volume_at(middle, low, high), middle).f > 0.0 ? least : largest) = middle;
      }
      y = largest;
      x = volume_at(y, low, high);
    }

    // The change of the solution by a step of Newton's method.
    void step(const Values& v, const T& y, T& dx, T& dy) const
    {
      const auto [a, b, c, d] = jacobian(v, y);
      const T det = a * d - b * c;
      dx = -(d * v.flow - b * v.f) / det;
      dy = -(a * v.f - c * v.flow) / det;
    }

    // The derivatives of the solution: a step from it, where they are not known yet, has them.
    void differentiate(T& x, T& y, Values& v) const
    {
      const typename CamClay<>::Point own{value_of(plastic),   value_of(swelling),
                                          value_of(ratio),     value_of(shear),
                                          value_of(reference), value_of(softness),
                                          value_of(volume),    value_of(shape)};
      double found = value_of(x), multiplier = value_of(y);
      auto values = own.at(found, multiplier);
      own.solve(found, multiplier, values);
      x = found;
      y = multiplier;
      T dx, dy;
      step(at(x, y), y, dx, dy);
      x += dx;
      y += dy;
      v = at(x, y);
    }

    // From the trial state to the solution.
    void solve(T& x, T& y, Values& v) const
    {
      const T rates = 1.0 / swelling + 1.0 / plastic;
      const T critical = (volume / plastic - log(2.0 * reference)) / rates;
      const T low = std::min(volume, critical), high = std::max(volume, critical);
      bool done = false;
      T dx, dy;
      for (int k = 0; k < steps && !done; ++k)
      {
        step(v, y, dx, dy);
        x = std::min(std::max(T(x + dx), low), high);
        y = std::max(T(y + dy), T(0.0));
        v = at(x, y);
        const T size = v.p + v.p_c;
        done = abs(v.flow) <= nearly * swelling && abs(v.f) <= nearly * size * size
               && y > 0.0;
      }
      if (!done)
      {
        search(x, y, low, high);
        v = at(x, y);
      }
      step(v, y, dx, dy);
      if (std::isfinite(value_of(dx)) && std::isfinite(value_of(dy)))
      {
        x += dx;
        y += dy;
        v = at(x, y);
      }
    }
  };

  static constexpr double nearly = 1e-9;
  static constexpr int steps = 40, halvings = 80;

  void operator()(const std::array<T, 3>& strain, double tolerance, Response<T>& r) const
  {
    const T p_c = r.variables[1], trace = strain[0] + strain[1] + strain[2];
    std::array<T, 3> deviator, direction;
    T size = 0.0;
    for (int a = 0; a < 3; ++a)
    {
      deviator[a] = strain[a] - trace / 3.0;
      size += deviator[a] * deviator[a];
    }
    size = sqrt(size);
    const T shear = modulus / p_c;
    const Point point{plastic,        swelling,
                      ratio,          shear,
                      pressure / p_c, 6.0 * shear / (ratio * ratio),
                      -trace,         root_two_thirds * size};
    T x = -trace, y = 0.0;
    typename Point::Values v = point.at(x, y);
    r.plastic = v.f > tolerance;
    T p_v = v.p / swelling, p_s = 0.0, q_v = 0.0, q_s = 3.0 * shear;
    if (r.plastic)
    {
      if constexpr (bare<T>)
        point.solve(x, y, v);
      else
        point.differentiate(x, y, v);
      const auto [a, b, c, d] = point.jacobian(v, y);
      const T det = a * d - b * c, hardening = v.p_c / plastic, q = ratio * v.q;
      const T flow_v = 1.0 + y * hardening, f_v = v.p * hardening;
      const T f_s = -2.0 * q / (ratio * ratio) * 3.0 * shear / v.left;
      const T slope = v.p / swelling, fall = -q * point.softness / v.left;
      p_v = slope * (d * flow_v - b * f_v) / det;
      p_s = slope * (-b * f_s / det);
      q_v = fall * (a * f_v - c * flow_v) / det;
      q_s = 3.0 * shear / v.left + fall * (a * f_s / det);
    }
    const T secant = 2.0 * modulus / v.left;
    r.elastic_strain = strain;
    for (int a = 0; a < 3; ++a)
    {
      direction[a] = size > 0.0 ? deviator[a] / size : T(0.0);
      r.stress[a] = secant * deviator[a] - v.p * p_c;
      if (r.plastic)
        r.elastic_strain[a] = deviator[a] / v.left - x / 3.0;
    }
    if (r.plastic)
    {
      r.variables[0] += root_two_thirds * norm_of_difference(strain, r.elastic_strain);
      r.variables[1] *= v.p_c;
    }
    if constexpr (!bare<T>)
      return;
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b)
      {
        r.shear[a][b] = secant;
        r.normal[a][b] =
            secant * ((a == b ? 1.0 : 0.0) - 1.0 / 3.0)
            + (2.0 / 3.0 * q_s * p_c - secant) * direction[a] * direction[b]
            + p_c * (p_v - root_two_thirds * (p_s * direction[b] + q_v * direction[a]));
      }
  }
};

// A law whose flow takes time: a share of the return of the step's end is left between that and the
// trial state (Duvaut & Lions 1972); see mpm_dolfinx.materials.plastic. All of it where the share
// is 1.
template <typename Law, typename T = double>
struct InTime
{
  Law law;
  T bulk, shear, share;

  void operator()(const std::array<T, 3>& strain, double tolerance, Response<T>& r) const
  {
    const std::array<T, max_variables> before = r.variables;
    law(strain, tolerance, r);
    if (!(share < 1.0) || !r.plastic)
      return;
    Response<T> trial;
    answer_elastic(strain, bulk, shear, trial);
    auto leave = [this](const T& from, T& to) { to = from + share * (to - from); };
    for (std::size_t k = 0; k < max_variables; ++k)
      leave(before[k], r.variables[k]);
    for (int a = 0; a < 3; ++a)
    {
      leave(trial.stress[a], r.stress[a]);
      leave(trial.elastic_strain[a], r.elastic_strain[a]);
      if constexpr (bare<T>)
        for (int b = 0; b < 3; ++b)
        {
          leave(trial.normal[a][b], r.normal[a][b]);
          leave(trial.shear[a][b], r.shear[a][b]);
        }
    }
  }
};
} // namespace core
