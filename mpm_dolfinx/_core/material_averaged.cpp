// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Laws that soften with an average of the plastic strain.

#include "law_answer.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace
{
using namespace core;

// What a law that softens is made of, and the law with a share of what its strength falls by.
template <typename Law>
struct Strength;

template <>
struct Strength<VonMises<>>
{
  static constexpr int count = 5;
  double p[count];
  VonMises<> at(double left) const
  {
    const double weaker[4] = {p[0], p[1], p[2] * (p[4] + (1.0 - p[4]) * left), p[3]};
    return VonMises<>(weaker);
  }
};

// Cohesion, friction, dilation, cut-off and volume correction of the frictional laws.
struct FrictionalStrength
{
  static constexpr int count = 10;
  static constexpr double steepest = 89.0 / 180.0 * 3.14159265358979323846;
  double p[count];

  double cohesion(double left) const { return p[3] + (p[2] - p[3]) * left; }
  double friction(double left) const { return std::min(p[5] + (p[4] - p[5]) * left, steepest); }
  double dilation(double friction) const { return std::min(p[6], friction); }
};

template <>
struct Strength<MohrCoulomb<>> : FrictionalStrength
{
  MohrCoulomb<> at(double left) const
  {
    const double angle = friction(left);
    const double weaker[7] = {p[0], p[1], std::sin(angle), std::sin(dilation(angle)),
                              2.0 * cohesion(left) * std::cos(angle), p[7], p[8]};
    return MohrCoulomb<>(weaker);
  }
};

template <>
struct Strength<DruckerPrager<>> : FrictionalStrength
{
  DruckerPrager<> at(double left) const
  {
    const double angle = friction(left), sine = std::sin(angle);
    const double psi = std::sin(dilation(angle));
    const int match = static_cast<int>(p[9]);
    double flow, slope;
    if (match == 2)
    {
      flow = psi / std::sqrt(1.0 + psi * psi / 3.0);
      slope = std::sqrt(1.0 - flow * flow / 3.0) + flow * sine / 3.0;
    }
    else
    {
      const double sign = match == 0 ? -1.0 : 1.0, root_three = std::sqrt(3.0);
      slope = root_three * (3.0 + sign * sine) / 6.0;
      flow = psi * 6.0 / (root_three * (3.0 + sign * psi));
    }
    const double eta = sine / slope, strength = std::cos(angle) / slope * cohesion(left);
    const double apex = eta == 0.0 ? std::numeric_limits<double>::infinity() : strength / eta;
    const double weaker[7] = {p[0], p[1], eta, flow, strength, std::min(apex, p[7]), p[8]};
    return DruckerPrager<>(weaker);
  }
};

// A law whose strength falls with an average of the plastic strain, and by itself grows with that
// at the point; see mpm_dolfinx.materials.softening.
template <typename Law>
struct Averaged
{
  static constexpr double stride = 1e-5, round_off = 1e-15;
  static constexpr int most = 100;
  Strength<Law> strength;
  double decay, drive, own;

  explicit Averaged(const double* p)
  {
    for (int k = 0; k < strength.count; ++k)
      strength.p[k] = p[k];
    decay = p[strength.count];
    drive = p[strength.count + 1];
    own = p[strength.count + 2];
  }

  // Answer with the strength after a plastic strain at the point; return what that is then.
  // (Inlined wherever it is asked it would take compilers many times as long.)
  [[gnu::noinline, gnu::flatten]] double answer(const std::array<double, 3>& strain,
                                                double tolerance, double before, double kappa,
                                                Response<>& r) const
  {
    const double driving = decay * (drive - own * kappa);
    r.variables[0] = before;
    strength.at(driving > 0.0 ? std::exp(-driving) : 2.0 - std::exp(driving))(strain, tolerance, r);
    return r.variables[0];
  }

  // Where the plastic strain is that which follows from it, by regula falsi with halvings.
  double root(const std::array<double, 3>& strain, double tolerance, double before, double high,
              Response<>& r) const
  {
    auto excess = [&](double kappa) { return answer(strain, tolerance, before, kappa, r) - kappa; };
    const double size = round_off * high;
    double low = before, f_low = high - before, f_high = excess(high);
    for (int k = 0; k < most && f_high > 0.0; ++k)
    {
      low = high;
      f_low = f_high;
      high += 2.0 * f_high;
      f_high = excess(high);
    }
    double best = high, least = std::abs(f_high);
    int side = 0;
    for (int k = 0; k < most && least > size && high - low > size; ++k)
    {
      const double x = (low * f_high - high * f_low) / (f_high - f_low), f = excess(x);
      if (std::abs(f) < least)
      {
        best = x;
        least = std::abs(f);
      }
      if (f > 0.0)
      {
        low = x;
        f_low = f;
        if (side == 1)
          f_high *= 0.5;
        side = 1;
      }
      else
      {
        high = x;
        f_high = f;
        if (side == -1)
          f_low *= 0.5;
        side = -1;
      }
    }
    return best;
  }

  void operator()(const std::array<double, 3>& strain, double tolerance, Response<>& r) const
  {
    const double before = r.variables[0];
    const double first = answer(strain, tolerance, before, before, r);
    if (!(first > before))
      return;
    Response<> side = r;
    const double kappa = root(strain, tolerance, before, first, side);
    const double found = answer(strain, tolerance, before, kappa, r);
    // Derivatives by the plastic strain that softens, towards less of it, where all stay plastic.
    const double step = stride / std::max(decay, 1.0);
    double growth = 3.0 * found;
    std::array<double, 3> slope = r.stress, flow, change{};
    for (int a = 0; a < 3; ++a)
      slope[a] *= 3.0;
    for (int k = 1; k <= 2; ++k)
    {
      const double weight = k == 1 ? -4.0 : 1.0;
      growth += weight * answer(strain, tolerance, before, kappa - k * step, side);
      for (int a = 0; a < 3; ++a)
        slope[a] += weight * side.stress[a];
    }
    growth /= 2.0 * step;
    double size = 0.0, trace = 0.0;
    for (int a = 0; a < 3; ++a)
    {
      flow[a] = strain[a] - r.elastic_strain[a];
      size += flow[a] * flow[a];
      trace += flow[a];
    }
    size = std::sqrt(size);
    if (size == 0.0)
      return;
    // The flow times the compliance, once for all columns of the tangent.
    const double twice = 2.0 * strength.p[1], lame = strength.p[0] - twice / 3.0;
    const double less = lame / (3.0 * lame + twice) * trace;
    for (int b = 0; b < 3; ++b)
    {
      change[b] = flow[b];
      for (int a = 0; a < 3; ++a)
        change[b] -= (flow[a] - less) / twice * r.normal[a][b];
    }
    const double factor = root_two_thirds / (size * (1.0 - growth) * 2.0 * step);
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b)
        r.normal[a][b] += factor * slope[a] * change[b];
  }
};

} // namespace

core::LawAnswer core::answer_averaged(Law law)
{
  switch (law)
  {
  case Law::von_mises_averaged:
    return answer<Averaged<VonMises<>>>;
  case Law::mohr_coulomb_averaged:
    return answer<Averaged<MohrCoulomb<>>>;
  default:
    return answer<Averaged<DruckerPrager<>>>;
  }
}
