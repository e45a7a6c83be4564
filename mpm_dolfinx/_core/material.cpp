// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Elasticity and laws of plasticity in logarithmic strain, point by point.
//
// The same algorithms as mpm_dolfinx.materials (kinematics, neo_hooke, von_mises,
// mohr_coulomb, drucker_prager, mu_i, cam_clay), which are their oracles. All are isotropic, so stress and strain
// share the axes of the trial elastic b, and tangents have 8 (plane) or 21 (space) entries other
// than zero in that frame.

#include "material.h"
#include "hot_loop.h"
#include "matrix.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <initializer_list>
#include <limits>
#include <utility>
#include <vector>

namespace
{
using core::inverse;
using core::Matrix;

constexpr double root_two = 1.41421356237309504880;
constexpr double root_half = 0.70710678118654752440;
constexpr double root_two_thirds = 0.81649658092772603273;

// Components of a Mandel vector: xx, yy, zz, xy, yz, xz.
constexpr int mandel_position[3][3] = {{0, 3, 5}, {3, 1, 4}, {5, 4, 2}};

template <int dim>
Matrix<dim> unpack(const double* vector)
{
  Matrix<dim> tensor;
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
      tensor[i][j] = vector[mandel_position[i][j]] * (i == j ? 1.0 : root_half);
  return tensor;
}

template <int dim>
void pack(const Matrix<dim>& tensor, double* vector)
{
  for (int i = 0; i < dim; ++i)
  {
    vector[i] = tensor[i][i];
    for (int j = i + 1; j < dim; ++j)
      vector[mandel_position[i][j]] = (tensor[i][j] + tensor[j][i]) * root_half;
  }
}

// Zero the entry (p, q) of a symmetric matrix by a rotation (Golub & Van Loan 2013, section
// 8.5.2), and turn the axes with it.
template <int dim>
void rotate(Matrix<dim>& S, Matrix<dim>& axes, int p, int q)
{
  const double off = S[p][q];
  if (off == 0.0)
    return;
  const double theta = 0.5 * (S[q][q] - S[p][p]) / off;
  const double t = std::copysign(1.0, theta) / (std::abs(theta) + std::hypot(theta, 1.0));
  const double c = 1.0 / std::sqrt(1.0 + t * t), s = t * c;
  S[p][p] -= t * off;
  S[q][q] += t * off;
  S[p][q] = S[q][p] = 0.0;
  if constexpr (dim == 3)
  {
    const int r = 3 - p - q;
    const double rp = S[r][p], rq = S[r][q];
    S[r][p] = S[p][r] = c * rp - s * rq;
    S[r][q] = S[q][r] = s * rp + c * rq;
  }
  for (int i = 0; i < dim; ++i)
  {
    const double ip = axes[i][p], iq = axes[i][q];
    axes[i][p] = c * ip - s * iq;
    axes[i][q] = s * ip + c * iq;
  }
}

// Eigenvalues and eigenvectors (columns) of a symmetric matrix by Jacobi's rotations.
template <int dim>
std::array<double, dim> eigen(Matrix<dim> S, Matrix<dim>& axes)
{
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
      axes[i][j] = i == j ? 1.0 : 0.0;
  if constexpr (dim == 2)
    rotate<2>(S, axes, 0, 1);
  else
    for (int sweep = 0; sweep < 20; ++sweep)
    {
      const double off = std::abs(S[0][1]) + std::abs(S[1][2]) + std::abs(S[0][2]);
      const double on = std::abs(S[0][0]) + std::abs(S[1][1]) + std::abs(S[2][2]);
      if (off <= 1e-2 * std::numeric_limits<double>::epsilon() * on)
        break;
      rotate<3>(S, axes, 0, 1);
      rotate<3>(S, axes, 0, 2);
      rotate<3>(S, axes, 1, 2);
    }
  std::array<double, dim> values;
  for (int a = 0; a < dim; ++a)
    values[a] = S[a][a];
  return values;
}

// (1/2 ln(1 + x) - 1/2 ln(1 + y))/(x - y), and its limit for x = y.
double logarithm_quotient(double x, double y)
{
  const double ratio = (x - y) / (1.0 + y);
  return 0.5 * (ratio == 0.0 ? 1.0 : std::log1p(ratio) / ratio) / (1.0 + y);
}

template <int dim>
Matrix<dim> from_principal(const std::array<double, 3>& values, const Matrix<dim>& axes)
{
  Matrix<dim> tensor;
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
    {
      tensor[i][j] = 0.0;
      for (int a = 0; a < dim; ++a)
        tensor[i][j] += axes[i][a] * values[a] * axes[j][a];
    }
  return tensor;
}

// Answer of the law in the principal frame: `normal` holds the derivatives of the stresses by the
// strains, `shear` the quotients of their differences.
struct Response
{
  std::array<double, 3> stress, elastic_strain;
  std::array<double, core::max_variables> variables;
  bool plastic;
  double shear[3][3];
  double normal[3][3];
};

// Hencky's law as the answer to a strain: what an elastic step gives.
void answer_elastic(const std::array<double, 3>& strain, double bulk, double shear, Response& r)
{
  const double lame = bulk - 2.0 / 3.0 * shear, sum = lame * (strain[0] + strain[1] + strain[2]);
  r.plastic = false;
  r.elastic_strain = strain;
  for (int a = 0; a < 3; ++a)
  {
    r.stress[a] = sum + 2.0 * shear * strain[a];
    for (int b = 0; b < 3; ++b)
    {
      r.normal[a][b] = lame + (a == b ? 2.0 * shear : 0.0);
      r.shear[a][b] = 2.0 * shear;
    }
  }
}

double norm_of_difference(const std::array<double, 3>& x, const std::array<double, 3>& y)
{
  const double a = x[0] - y[0], b = x[1] - y[1], c = x[2] - y[2];
  return std::sqrt(a * a + b * b + c * c);
}

struct Hencky
{
  double bulk, shear;
  explicit Hencky(const double* p) : bulk(p[0]), shear(p[1]) {}

  void operator()(const std::array<double, 3>& strain, double, Response& r) const
  {
    answer_elastic(strain, bulk, shear, r);
  }
};

// tau = G (b - 1) + lambda ln J; see mpm_dolfinx.materials.neo_hooke.
struct NeoHooke
{
  double lame, shear;
  explicit NeoHooke(const double* p) : lame(p[0]), shear(p[1]) {}

  void operator()(const std::array<double, 3>& strain, double, Response& r) const
  {
    const double sum = lame * (strain[0] + strain[1] + strain[2]);
    r.plastic = false;
    r.elastic_strain = strain;
    for (int a = 0; a < 3; ++a)
    {
      r.stress[a] = sum + shear * std::expm1(2.0 * strain[a]);
      for (int b = 0; b < 3; ++b)
      {
        const double gap = strain[a] - strain[b];
        const double mean = 2.0 * shear * std::exp(strain[a] + strain[b]);
        r.shear[a][b] = mean * (gap == 0.0 ? 1.0 : std::sinh(gap) / gap);
        r.normal[a][b] = lame + (a == b ? mean : 0.0);
      }
    }
  }
};

// Radial return (Wilkins 1964) with the consistent tangent of Simo & Taylor (1985).
struct VonMises
{
  double bulk, shear, rho_y, h;
  explicit VonMises(const double* p) : bulk(p[0]), shear(p[1]), rho_y(p[2]), h(p[3]) {}

  void operator()(const std::array<double, 3>& strain, double tolerance, Response& r) const
  {
    const double plastic_strain = r.variables[0];
    const double trace = strain[0] + strain[1] + strain[2];
    std::array<double, 3> deviator;
    double size = 0.0;
    for (int a = 0; a < 3; ++a)
    {
      deviator[a] = strain[a] - trace / 3.0;
      size += deviator[a] * deviator[a];
    }
    size = std::sqrt(size);
    const double rho = rho_y + root_two_thirds * h * plastic_strain;
    r.plastic = 2.0 * shear * size / rho - 1.0 > tolerance;
    r.elastic_strain = strain;
    double along = 0.0, secant = 2.0 * shear;
    if (r.plastic)
    {
      const double slope = 2.0 / 3.0 * h;
      const double flow = (2.0 * shear * size - rho) / (2.0 * shear + slope);
      const double strength = rho + slope * flow;
      secant = strength / size;
      along = 2.0 * shear * slope / (2.0 * shear + slope) - secant;
      for (int a = 0; a < 3; ++a)
      {
        const double direction = deviator[a] / size;
        r.stress[a] = bulk * trace + strength * direction;
        r.elastic_strain[a] -= flow * direction;
      }
      r.variables[0] += root_two_thirds * flow;
    }
    else
      for (int a = 0; a < 3; ++a)
        r.stress[a] = bulk * trace + 2.0 * shear * deviator[a];
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
struct MohrCoulomb
{
  double bulk, shear, friction, dilation, strength, tension, lame;
  bool corrects;
  explicit MohrCoulomb(const double* p)
      : bulk(p[0]), shear(p[1]), friction(p[2]), dilation(p[3]), strength(p[4]), tension(p[5]),
        lame(p[0] - 2.0 / 3.0 * p[1]), corrects(p[6] != 0.0)
  {
  }

  using Vector = std::array<double, 3>;

  struct Answer
  {
    Vector stress, elastic;
    double normal[3][3];
  };

  Vector stress_of(const Vector& e) const
  {
    const double sum = lame * (e[0] + e[1] + e[2]);
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
    const double curvature = yield[0] * push[0] + yield[1] * push[1] + yield[2] * push[2];
    const double f = yield[0] * trial[0] + yield[1] * trial[1] + yield[2] * trial[2] - strength;
    const double multiplier = f / curvature;
    Vector elastic;
    for (int a = 0; a < 3; ++a)
      elastic[a] = e[a] - multiplier * flow[a];
    if (answer != nullptr)
    {
      const Vector pull = stress_of(yield);
      answer->elastic = elastic;
      answer->stress = stress_of(elastic);
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
    const double unit = 2.0 * shear;
    const int count = given[0] + given[1] + given[2];
    const double slope = 1.0 / (1.0 + count * lame / unit);
    double trace = 0.0;
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

  static double largest(std::initializer_list<double> values)
  {
    double result = -std::numeric_limits<double>::infinity();
    for (double value : values)
      result = value > result ? value : result;
    return result;
  }

  // With the volume correction what opens at a point of the hydrostatic axis stays in the elastic
  // strain, to close again before there is pressure.
  void keep_volume(const Vector& strain, Answer& answer) const
  {
    if (!corrects)
      return;
    const double third = (strain[0] + strain[1] + strain[2]) / 3.0;
    answer.elastic = {third, third, third};
  }

  // Return to the cut-off, its edges and corners: what fits best, or fits.
  Answer tensile(const Vector& strain) const
  {
    const double t = tension, unit = 2.0 * shear;
    const double least = ((1.0 + friction) * t - strength) / (1.0 - friction);
    const double ratio = (1.0 + dilation) / (1.0 - dilation);
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
  void pyramid(const Vector& strain, double apex, Answer& answer) const
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

  void operator()(const Vector& unsorted, double tolerance, Response& r) const
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
    const double pull = (1.0 + friction) * answer.stress[0];
    const double push = (1.0 - friction) * answer.stress[2];
    const double room = tolerance * (std::abs(pull) + std::abs(push) + strength);
    const bool shears = pull - push - strength > room;
    const double apex = strength / (2.0 * friction);
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
    const double near =
        1e-12 * std::max(std::max(std::abs(strain[0]), std::abs(strain[1])), std::abs(strain[2]));
    for (int a = 0; a < 3; ++a)
    {
      r.stress[order[a]] = answer.stress[a];
      r.elastic_strain[order[a]] = answer.elastic[a];
      for (int b = 0; b < 3; ++b)
        r.normal[order[a]][order[b]] = answer.normal[a][b];
      for (int b = a + 1; b < 3; ++b)
      {
        const double difference = strain[a] - strain[b];
        double quotient;
        if (difference <= near)
          quotient = 0.5
                     * (answer.normal[a][a] - answer.normal[a][b] - answer.normal[b][a]
                        + answer.normal[b][b]);
        else
          quotient = 2.0 * shear * ((answer.elastic[a] - answer.elastic[b]) / difference);
        quotient = std::min(std::max(quotient, 0.0), 2.0 * shear);
        r.shear[order[a]][order[b]] = r.shear[order[b]][order[a]] = quotient;
      }
    }
  }
};

// A trial strain as laws of two invariants see it: tau = p 1 + sqrt(2) q n, with the unit deviator
// n; q is the root of J2.
struct Invariants
{
  double trace, size = 0.0;
  std::array<double, 3> deviator;
  explicit Invariants(const std::array<double, 3>& strain) : trace(strain[0] + strain[1] + strain[2])
  {
    for (int a = 0; a < 3; ++a)
    {
      deviator[a] = strain[a] - trace / 3.0;
      size += deviator[a] * deviator[a];
    }
    size = std::sqrt(size);
  }
};

// What such a law returns to: p, q, and their derivatives by the trace and the size of the deviator.
struct Returned
{
  double p, q, p_trace = 0.0, p_size = 0.0, q_trace = 0.0, q_size = 0.0;
};

// Answer of such a law that yields, with the elastic strain of volume.
void answer_returned(const std::array<double, 3>& strain, const Invariants& trial,
                     const Returned& law, double shear, double volume, Response& r)
{
  const double root = root_two * shear * trial.size;
  const double ratio = root > 0.0 ? law.q / root : 0.0, secant = 2.0 * shear * ratio;
  const double along = root_two * law.q_size - secant;
  std::array<double, 3> direction;
  r.plastic = true;
  for (int a = 0; a < 3; ++a)
  {
    direction[a] = trial.size > 0.0 ? trial.deviator[a] / trial.size : 0.0;
    r.stress[a] = law.p + secant * trial.deviator[a];
    r.elastic_strain[a] = ratio * trial.deviator[a] + volume / 3.0;
  }
  r.variables[0] += root_two_thirds * norm_of_difference(strain, r.elastic_strain);
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
struct DruckerPrager
{
  double bulk, shear, eta, flow, strength, top;
  bool corrects;
  explicit DruckerPrager(const double* p)
      : bulk(p[0]), shear(p[1]), eta(p[2]), flow(p[3]), strength(p[4]), top(p[5]),
        corrects(p[6] != 0.0)
  {
  }

  void operator()(const std::array<double, 3>& strain, double tolerance, Response& r) const
  {
    const Invariants trial(strain);
    const double mean = bulk * trial.trace, root = root_two * shear * trial.size;
    const double room = tolerance * (root + std::abs(mean) + strength);
    const double f = root + eta * mean - strength;
    if (!(f > room || mean - top > room))
    {
      answer_elastic(strain, bulk, shear, r);
      return;
    }
    const double stiffness = shear + bulk * eta * flow;
    const double multiplier = f > 0.0 ? f / stiffness : 0.0;
    Returned law{mean - bulk * flow * multiplier, root - shear * multiplier};
    const bool keeps_volume = corrects && law.p > top;
    if (law.p > top)
    {
      const double limit = std::max(strength - eta * top, 0.0);
      law.p = top;
      law.q_size = root < limit ? root_two * shear : 0.0;
      law.q = std::min(root, limit);
    }
    else
    {
      law.p_trace = bulk * (1.0 - bulk * eta * flow / stiffness);
      law.q_size = root_two * shear * (1.0 - shear / stiffness);
      law.p_size = -root_two * shear * bulk * flow / stiffness;
      law.q_trace = -shear * bulk * eta / stiffness;
    }
    answer_returned(strain, trial, law, shear, keeps_volume ? trial.trace : law.p / bulk, r);
  }
};

// Friction by the inertial number, without cohesion and dilation; see mpm_dolfinx.materials.mu_i.
struct MuIRheology
{
  double bulk, shear, friction, range, lag, time;
  explicit MuIRheology(const double* p)
      : bulk(p[0]), shear(p[1]), friction(p[2]), range(p[3]), lag(p[4]), time(p[5])
  {
  }

  void operator()(const std::array<double, 3>& strain, double tolerance, Response& r) const
  {
    const Invariants trial(strain);
    const double pressure = -bulk * trial.trace, root = root_two * shear * trial.size;
    const double f = root - friction * pressure, room = tolerance * (root + std::abs(pressure));
    if (!(f > room || -pressure > room))
    {
      answer_elastic(strain, bulk, shear, r);
      return;
    }
    if (!(pressure > 0.0))
    {
      answer_returned(strain, trial, Returned{0.0, 0.0}, shear, trial.trace, r);
      return;
    }
    // shear lag m^2 + b m = f wait for the plastic shear m
    const double wait = time * std::sqrt(pressure), quick = shear * lag;
    const double b = shear * wait + lag * (range * pressure - f);
    const double slope = std::sqrt(b * b + 4.0 * quick * f * wait);
    const double slip = b > 0.0 ? 2.0 * f * wait / (b + slope) : 0.5 * (slope - b) / quick;
    const double q = std::max(root - shear * slip, friction * pressure);
    Returned law{-pressure, std::min(q, (friction + range) * pressure)};
    const double excess = law.q / pressure - friction;
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
struct CamClay
{
  double plastic, swelling, ratio, modulus, pressure;
  explicit CamClay(const double* p)
      : plastic(p[0] - p[1]), swelling(p[1]), ratio(p[2]), modulus(p[3]), pressure(p[4])
  {
  }

  struct Point
  {
    double plastic, swelling, ratio, shear, reference, softness, volume, shape;

    struct Values
    {
      double p, p_c, left, q, flow, f;
    };

    // q is that of the ellipse, over M.
    Values at(double x, double y) const
    {
      Values v;
      v.p = reference * std::exp(x / swelling);
      v.p_c = std::exp((volume - x) / plastic);
      v.left = 1.0 + softness * y;
      v.q = 3.0 * shear * shape / v.left / ratio;
      v.flow = x - volume + y * (2.0 * v.p - v.p_c);
      v.f = v.q * v.q + v.p * (v.p - v.p_c);
      return v;
    }

    // Derivatives of the residuals: flow by x, by y, yield by x, by y.
    std::array<double, 4> jacobian(const Values& v, double y) const
    {
      const double slope = v.p / swelling, hardening = v.p_c / plastic;
      return {1.0 + y * (2.0 * slope + hardening), 2.0 * v.p - v.p_c,
              (2.0 * v.p - v.p_c) * slope + v.p * hardening, -2.0 * v.q * v.q * softness / v.left};
    }

    double volume_at(double y, double low, double high) const
    {
      for (int k = 0; k < halvings; ++k)
      {
        const double middle = 0.5 * (low + high);
        (at(middle, y).flow > 0.0 ? high : low) = middle;
      }
      return 0.5 * (low + high);
    }

    void search(double& x, double& y, double low, double high) const
    {
      double largest = 1.0, least = 0.0;
      for (int k = 0; k < halvings; ++k)
        if (at(volume_at(largest, low, high), largest).f > 0.0)
          largest *= 4.0;
        else
          break;
      for (int k = 0; k < halvings; ++k)
      {
        const double middle = 0.5 * (least + largest);
        (at(volume_at(middle, low, high), middle).f > 0.0 ? least : largest) = middle;
      }
      y = largest;
      x = volume_at(y, low, high);
    }

    // From the trial state to the solution.
    void solve(double& x, double& y, Values& v) const
    {
      const double rates = 1.0 / swelling + 1.0 / plastic;
      const double critical = (volume / plastic - std::log(2.0 * reference)) / rates;
      const double low = std::min(volume, critical), high = std::max(volume, critical);
      bool done = false;
      auto step = [&](double& dx, double& dy) {
        const auto [a, b, c, d] = jacobian(v, y);
        const double det = a * d - b * c;
        dx = -(d * v.flow - b * v.f) / det;
        dy = -(a * v.f - c * v.flow) / det;
      };
      double dx, dy;
      for (int k = 0; k < steps && !done; ++k)
      {
        step(dx, dy);
        x = std::min(std::max(x + dx, low), high);
        y = std::max(y + dy, 0.0);
        v = at(x, y);
        const double size = v.p + v.p_c;
        done = std::abs(v.flow) <= nearly * swelling && std::abs(v.f) <= nearly * size * size
               && y > 0.0;
      }
      if (!done)
      {
        search(x, y, low, high);
        v = at(x, y);
      }
      step(dx, dy);
      if (std::isfinite(dx) && std::isfinite(dy))
      {
        x += dx;
        y += dy;
        v = at(x, y);
      }
    }
  };

  static constexpr double nearly = 1e-9;
  static constexpr int steps = 40, halvings = 80;

  void operator()(const std::array<double, 3>& strain, double tolerance, Response& r) const
  {
    const double p_c = r.variables[1], trace = strain[0] + strain[1] + strain[2];
    std::array<double, 3> deviator, direction;
    double size = 0.0;
    for (int a = 0; a < 3; ++a)
    {
      deviator[a] = strain[a] - trace / 3.0;
      size += deviator[a] * deviator[a];
    }
    size = std::sqrt(size);
    const double shear = modulus / p_c;
    const Point point{plastic,        swelling,
                      ratio,          shear,
                      pressure / p_c, 6.0 * shear / (ratio * ratio),
                      -trace,         root_two_thirds * size};
    double x = -trace, y = 0.0;
    Point::Values v = point.at(x, y);
    r.plastic = v.f > tolerance;
    double p_v = v.p / swelling, p_s = 0.0, q_v = 0.0, q_s = 3.0 * shear;
    if (r.plastic)
    {
      point.solve(x, y, v);
      const auto [a, b, c, d] = point.jacobian(v, y);
      const double det = a * d - b * c, hardening = v.p_c / plastic, q = ratio * v.q;
      const double flow_v = 1.0 + y * hardening, f_v = v.p * hardening;
      const double f_s = -2.0 * q / (ratio * ratio) * 3.0 * shear / v.left;
      const double slope = v.p / swelling, fall = -q * point.softness / v.left;
      p_v = slope * (d * flow_v - b * f_v) / det;
      p_s = slope * (-b * f_s / det);
      q_v = fall * (a * f_v - c * flow_v) / det;
      q_s = 3.0 * shear / v.left + fall * (a * f_s / det);
    }
    const double secant = 2.0 * modulus / v.left;
    r.elastic_strain = strain;
    for (int a = 0; a < 3; ++a)
    {
      direction[a] = size > 0.0 ? deviator[a] / size : 0.0;
      r.stress[a] = secant * deviator[a] - v.p * p_c;
      if (r.plastic)
        r.elastic_strain[a] = deviator[a] / v.left - x / 3.0;
    }
    if (r.plastic)
    {
      r.variables[0] += root_two_thirds * norm_of_difference(strain, r.elastic_strain);
      r.variables[1] *= v.p_c;
    }
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

// What a law that softens is made of, and the law with a share of what its strength falls by.
template <typename Law>
struct Strength;

template <>
struct Strength<VonMises>
{
  static constexpr int count = 5;
  double p[count];
  VonMises at(double left) const
  {
    const double weaker[4] = {p[0], p[1], p[2] * (p[4] + (1.0 - p[4]) * left), p[3]};
    return VonMises(weaker);
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
struct Strength<MohrCoulomb> : FrictionalStrength
{
  MohrCoulomb at(double left) const
  {
    const double angle = friction(left);
    const double weaker[7] = {p[0], p[1], std::sin(angle), std::sin(dilation(angle)),
                              2.0 * cohesion(left) * std::cos(angle), p[7], p[8]};
    return MohrCoulomb(weaker);
  }
};

template <>
struct Strength<DruckerPrager> : FrictionalStrength
{
  DruckerPrager at(double left) const
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
    return DruckerPrager(weaker);
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
  double answer(const std::array<double, 3>& strain, double tolerance, double before, double kappa,
                Response& r) const
  {
    const double driving = decay * (drive - own * kappa);
    r.variables[0] = before;
    strength.at(driving > 0.0 ? std::exp(-driving) : 2.0 - std::exp(driving))(strain, tolerance, r);
    return r.variables[0];
  }

  // Where the plastic strain is that which follows from it, by regula falsi with halvings.
  double root(const std::array<double, 3>& strain, double tolerance, double before, double high,
              Response& r) const
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

  void operator()(const std::array<double, 3>& strain, double tolerance, Response& r) const
  {
    const double before = r.variables[0];
    const double first = answer(strain, tolerance, before, before, r);
    if (!(first > before))
      return;
    Response side = r;
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

// A law whose flow takes time: a share of the return of the step's end is left between that and the
// trial state (Duvaut & Lions 1972); see mpm_dolfinx.materials.plastic. All of it where the share
// is 1.
template <typename Law>
struct InTime
{
  Law law;
  double bulk, shear, share;

  void operator()(const std::array<double, 3>& strain, double tolerance, Response& r) const
  {
    const std::array<double, core::max_variables> before = r.variables;
    law(strain, tolerance, r);
    if (!(share < 1.0) || !r.plastic)
      return;
    Response trial;
    answer_elastic(strain, bulk, shear, trial);
    auto leave = [this](double from, double& to) { to = from + share * (to - from); };
    for (std::size_t k = 0; k < core::max_variables; ++k)
      leave(before[k], r.variables[k]);
    for (int a = 0; a < 3; ++a)
    {
      leave(trial.stress[a], r.stress[a]);
      leave(trial.elastic_strain[a], r.elastic_strain[a]);
      for (int b = 0; b < 3; ++b)
      {
        leave(trial.normal[a][b], r.normal[a][b]);
        leave(trial.shear[a][b], r.shear[a][b]);
      }
    }
  }
};

// The volume strain at which a law answers a pressure, and what the tangent has of it; the
// algorithm of mpm_dolfinx.materials.given_pressure, point by point.
struct VolumeAtPressure
{
  static constexpr double tolerance = 1e-13, nearly = 1e-8, stride = 0.05;
  static constexpr int iterations = 100;

  double gap, compliance;
  std::array<double, 3> slope, by_pressure;

  // Set the answer of a law; return whether there is one.
  template <typename Law>
  bool solve(const Law& law, const std::array<double, 3>& trial, double yield_tolerance,
             double pressure, double augmentation, Response& r)
  {
    const std::array<double, core::max_variables> before = r.variables;
    const double theta = trial[0] + trial[1] + trial[2];
    double x = theta, reach = stride;
    double low = -std::numeric_limits<double>::infinity(), high = -low;
    bool near = false;
    for (int k = 0; k < iterations; ++k, reach *= 2.0)
    {
      const double shift = (x - theta) / 3.0;
      r.variables = before;
      law({trial[0] + shift, trial[1] + shift, trial[2] + shift}, yield_tolerance, r);
      const double mean = (r.stress[0] + r.stress[1] + r.stress[2]) / 3.0;
      const double extra = augmentation * (x - theta), over = mean + extra - pressure;
      double stiffness = augmentation;
      for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b)
          stiffness += r.normal[a][b] / 9.0;
      const double size = std::abs(mean) + std::abs(extra) + std::abs(pressure)
                          + std::abs(stiffness * x);
      bool open = !(std::abs(over) <= tolerance * size) && !near;
      near = std::abs(over) <= nearly * size;
      if (over < 0.0)
        low = std::max(low, x);
      if (over > 0.0)
        high = std::min(high, x);
      double next = x - std::min(over / stiffness, reach);
      if (!(next > low && next < high) && std::isfinite(0.5 * (low + high)))
        next = 0.5 * (low + high);
      open = open && next != x;
      if (!open)
      {
        finish(theta, x, stiffness, r);
        return true;
      }
      x = next;
    }
    return false;
  }

  void finish(double theta, double x, double stiffness, Response& r)
  {
    gap = theta - x;
    compliance = 1.0 / stiffness;
    std::array<double, 3> column{};
    slope = {};
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b)
      {
        column[a] += r.normal[a][b] / 3.0;
        slope[b] += r.normal[a][b] / 3.0 / stiffness;
      }
    for (int a = 0; a < 3; ++a)
    {
      by_pressure[a] = column[a] / stiffness;
      r.elastic_strain[a] += gap / 3.0;
      for (int b = 0; b < 3; ++b)
        r.normal[a][b] -= column[a] * slope[b];
    }
  }
};

// Set the first Piola stress of principal Kirchhoff stresses.
template <int dim>
void first_piola(const std::array<double, 3>& values, const Matrix<dim>& axes,
                 const Matrix<dim>& inverse_F, double* P)
{
  const Matrix<dim> tau = from_principal<dim>(values, axes);
  for (int i = 0; i < dim; ++i)
    for (int J = 0; J < dim; ++J)
    {
      P[i * dim + J] = 0.0;
      for (int j = 0; j < dim; ++j)
        P[i * dim + J] += tau[i][j] * inverse_F[J][j];
    }
}

// P = tau F^-T and dP/dF, put together from the dyads Q_a (F^-1 Q)_b.
//
// With l = dF F^-1, d eps_ab = g_ab (b_b l_ab + b_a l_ba) in the principal frame, g_ab the
// quotient (eps_a - eps_b)/(b_a - b_b) (Ogden 1984, section 2.6), and dP = d tau F^-T - P l^T.
template <int dim>
void tangent(const Response& r, const std::array<double, dim>& principal, const Matrix<dim>& axes,
             const Matrix<dim>& inverse_F, double* A)
{
  constexpr int size = dim * dim;
  double dyad[dim][dim][size];
  for (int b = 0; b < dim; ++b)
    for (int J = 0; J < dim; ++J)
    {
      double moved = 0.0;
      for (int l = 0; l < dim; ++l)
        moved += inverse_F[J][l] * axes[l][b];
      for (int a = 0; a < dim; ++a)
        for (int i = 0; i < dim; ++i)
          dyad[a][b][i * dim + J] = axes[i][a] * moved;
    }
  for (int k = 0; k < size * size; ++k)
    A[k] = 0.0;
  auto add = [&](double factor, const double* left, const double* right) {
    for (int i = 0; i < size; ++i)
    {
      const double scaled = factor * left[i];
      for (int j = 0; j < size; ++j)
        A[i * size + j] += scaled * right[j];
    }
  };
  for (int a = 0; a < dim; ++a)
    for (int b = 0; b < dim; ++b)
    {
      add(r.normal[a][b] - (a == b ? r.stress[a] : 0.0), dyad[a][a], dyad[b][b]);
      if (a != b)
      {
        const double rate = r.shear[a][b] * logarithm_quotient(principal[a], principal[b]);
        add(rate * (1.0 + principal[b]), dyad[a][b], dyad[a][b]);
        add(rate * (1.0 + principal[a]) - r.stress[a], dyad[a][b], dyad[b][a]);
      }
    }
}

template <int dim, typename Law>
bool update_point(const double* gradient, const double* old_gradient, const double* old_c,
                  const Law& law, double tolerance, Response& r, double* P, double* A,
                  double* stress, double* c, const core::GivenPressure* given, std::size_t point)
{
  constexpr int m = dim == 2 ? 4 : 6;
  Matrix<dim> H, inverse_F;
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
      H[i][j] = gradient[i * dim + j];
  const double det = inverse<dim>(H, inverse_F);

  double trial[m] = {};
  Matrix<dim> growth;
  if (old_gradient == nullptr)
  {
    for (int i = 0; i < dim; ++i)
      for (int j = 0; j < dim; ++j)
      {
        growth[i][j] = 2.0 * H[i][j];
        for (int k = 0; k < dim; ++k)
          growth[i][j] += H[i][k] * H[j][k];
      }
    pack<dim>(growth, trial);
  }
  else
  {
    Matrix<dim> old_H, difference, old_inverse, h, right;
    for (int i = 0; i < dim; ++i)
      for (int j = 0; j < dim; ++j)
      {
        old_H[i][j] = old_gradient[i * dim + j];
        difference[i][j] = H[i][j] - old_H[i][j];
      }
    inverse<dim>(old_H, old_inverse);
    const Matrix<dim> C = unpack<dim>(old_c);
    for (int i = 0; i < dim; ++i)
      for (int j = 0; j < dim; ++j)
      {
        h[i][j] = 0.0;
        for (int k = 0; k < dim; ++k)
          h[i][j] += difference[i][k] * old_inverse[k][j];
      }
    for (int i = 0; i < dim; ++i)
      for (int j = 0; j < dim; ++j)
      {
        right[i][j] = h[i][j];
        for (int k = 0; k < dim; ++k)
          right[i][j] += h[i][k] * C[k][j];
      }
    for (int i = 0; i < dim; ++i)
      for (int j = 0; j < dim; ++j)
      {
        growth[i][j] = 2.0 * right[i][j];
        for (int k = 0; k < dim; ++k)
          growth[i][j] += right[i][k] * h[j][k];
      }
    pack<dim>(growth, trial);
    for (int k = 0; k < m; ++k)
      trial[k] += old_c[k];
  }

  Matrix<dim> axes;
  const std::array<double, dim> principal = eigen<dim>(unpack<dim>(trial), axes);
  bool valid = det > 0.0 && std::isfinite(det);
  std::array<double, 3> strain{};
  for (int a = 0; a < dim; ++a)
  {
    valid = valid && principal[a] > -1.0 && std::isfinite(principal[a]);
    strain[a] = 0.5 * std::log1p(principal[a]);
  }
  if constexpr (dim == 2)
    strain[2] = 0.5 * std::log1p(trial[2]);
  if (!valid)
    return false;

  if (given == nullptr)
    law(strain, tolerance, r);
  else
  {
    constexpr std::size_t size = dim * dim;
    VolumeAtPressure volume;
    if (!volume.solve(law, strain, tolerance, given->pressure[point], given->augmentation(point),
                      r))
    {
      given->gap[point] = std::numeric_limits<double>::quiet_NaN();
      return false;
    }
    given->gap[point] = volume.gap;
    given->compliance[point] = volume.compliance;
    first_piola<dim>(volume.slope, axes, inverse_F, given->slope + point * size);
    first_piola<dim>(volume.by_pressure, axes, inverse_F, given->by_pressure + point * size);
  }
  first_piola<dim>(r.stress, axes, inverse_F, P);
  pack<dim>(from_principal<dim>(r.stress, axes), stress);
  if constexpr (dim == 2)
    stress[2] = r.stress[2];
  if (A != nullptr)
    tangent<dim>(r, principal, axes, inverse_F, A);
  if (c != nullptr)
  {
    for (int k = 0; k < m; ++k)
      c[k] = trial[k];
    if (r.plastic)
    {
      std::array<double, 3> returned{};
      for (int a = 0; a < 3; ++a)
        returned[a] = std::expm1(2.0 * r.elastic_strain[a]);
      pack<dim>(from_principal<dim>(returned, axes), c);
      if constexpr (dim == 2)
        c[2] = returned[2];
    }
  }
  return true;
}

// (One function of all laws would take compilers many times as long.)
template <int dim, typename Law>
HOT_LOOP std::vector<std::int64_t> update_all(const core::Update& u)
{
  constexpr int size = dim * dim, m = dim == 2 ? 4 : 6;
  std::vector<std::int64_t> invalid;
  const bool history = u.old_gradient != nullptr;
  const std::size_t parameters = core::num_parameters(u.law),
                    variables = core::num_variables(u.law);
  for (std::size_t p = 0; p < u.count; ++p)
  {
    double values[core::max_parameters];
    for (std::size_t k = 0; k < parameters; ++k)
      values[k] = u.parameters[k](p);
    const InTime<Law> law{Law(values), values[0], values[1], u.share(p)};
    Response r;
    for (std::size_t k = 0; k < variables; ++k)
      r.variables[k] = u.old_variables[k][p];
    const bool valid =
        update_point<dim>(u.gradient + p * size, history ? u.old_gradient + p * size : nullptr,
                          history ? u.old_c + p * m : nullptr, law, u.tolerance, r,
                          u.P + p * size, u.A == nullptr ? nullptr : u.A + p * size * size,
                          u.stress + p * m, history ? u.c + p * m : nullptr, u.given, p);
    for (std::size_t k = 0; k < variables; ++k)
      u.variables[k][p] = r.variables[k];
    if (!valid)
      invalid.push_back(static_cast<std::int64_t>(p));
  }
  return invalid;
}

template <typename Law>
std::vector<std::int64_t> update_all(const core::Update& u, int dim)
{
  return dim == 2 ? update_all<2, Law>(u) : update_all<3, Law>(u);
}
} // namespace

std::vector<std::int64_t> core::update_logarithmic(const Update& update, int dim)
{
  switch (update.law)
  {
  case Law::neo_hooke:
    return update_all<NeoHooke>(update, dim);
  case Law::von_mises:
    return update_all<VonMises>(update, dim);
  case Law::mohr_coulomb:
    return update_all<MohrCoulomb>(update, dim);
  case Law::drucker_prager:
    return update_all<DruckerPrager>(update, dim);
  case Law::mu_i:
    return update_all<MuIRheology>(update, dim);
  case Law::cam_clay:
    return update_all<CamClay>(update, dim);
  case Law::von_mises_averaged:
    return update_all<Averaged<VonMises>>(update, dim);
  case Law::mohr_coulomb_averaged:
    return update_all<Averaged<MohrCoulomb>>(update, dim);
  case Law::drucker_prager_averaged:
    return update_all<Averaged<DruckerPrager>>(update, dim);
  default:
    return update_all<Hencky>(update, dim);
  }
}
