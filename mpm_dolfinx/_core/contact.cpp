// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// What acts between points and facets of two bodies, and its derivative, point by point.
//
// Derivatives are carried along in the few vectors that all depends on: the way from the facet's
// place to the point, first and second derivatives of the facet there, and the way from the anchor.
// What acts on the nodes of a facet is made of as few vectors, by the same factors.

#include "contact.h"
#include "dual.h"
#include "hot_loop.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

namespace
{
using namespace core;

// How many derivatives are carried along together.
constexpr int together = 4;

// Which of so many second derivatives is that by two directions, -1: it is zero. A line or a triangle
// of degree 1 has none, a quadrilateral the mixed one.
template <int dim, int bends>
constexpr int bend_of(int e, int f)
{
  if (bends == dim * (dim - 1) / 2)
    return e + f;
  return bends == 1 && e != f ? 0 : -1;
}

// What a projection depends on: r, slopes A and bends B.
template <typename T, int dim, int bends>
struct Ways
{
  static constexpr int sides = dim - 1;
  using Vector = std::array<T, dim>;
  Vector r;
  std::array<Vector, sides> A;
  std::array<Vector, bends> B;
};

// A point projected on its facet: how far the foot has moved, the slopes and the normal there.
template <typename T, int dim>
struct Foot
{
  std::array<T, dim - 1> moved;
  std::array<std::array<T, dim>, dim - 1> A;
  std::array<T, dim> n;
  T gap;
};

template <typename T, int dim, int bends>
HOT_PART Foot<T, dim> foot_of(const Ways<T, dim, bends>& ways, double outward)
{
  constexpr int sides = dim - 1;
  Foot<T, dim> foot{};
  // One step of Newton's method has the derivative of the projection exactly.
  std::array<std::array<double, sides>, sides> G;
  std::array<T, sides> along;
  for (int e = 0; e < sides; ++e)
  {
    along[e] = dot(ways.A[e], ways.r);
    for (int f = 0; f < sides; ++f)
    {
      double sum = 0.0;
      for (int i = 0; i < dim; ++i)
      {
        sum += value_of(ways.A[e][i]) * value_of(ways.A[f][i]);
        if constexpr (bends > 0)
          if (const int b = bend_of<dim, bends>(e, f); b >= 0)
            sum -= value_of(ways.B[b][i]) * value_of(ways.r[i]);
      }
      G[e][f] = sum;
    }
  }
  foot.moved = solved(G, along);
  std::array<T, dim> r = ways.r;
  foot.A = ways.A;
  for (int i = 0; i < dim; ++i)
    for (int e = 0; e < sides; ++e)
    {
      r[i] = r[i] - ways.A[e][i] * foot.moved[e];
      if constexpr (bends > 0)
        for (int f = 0; f < sides; ++f)
          if (const int b = bend_of<dim, bends>(e, f); b >= 0)
            foot.A[e][i] = foot.A[e][i] + ways.B[b][i] * foot.moved[f];
    }
  const auto& A = foot.A;
  std::array<T, dim> n;
  if constexpr (dim == 2)
    n = {A[0][1], T(-1.0) * A[0][0]};
  else
    for (int i = 0; i < 3; ++i)
      n[i] = A[0][(i + 1) % 3] * A[1][(i + 2) % 3] - A[0][(i + 2) % 3] * A[1][(i + 1) % 3];
  const T unit = outward * inverse(root(dot(n, n)));
  for (int i = 0; i < dim; ++i)
    foot.n[i] = n[i] * unit;
  foot.gap = dot(r, foot.n);
  return foot;
}

// The shear along the slopes at the foot.
template <typename T, int dim>
std::array<T, dim - 1> lag_of(const Foot<T, dim>& foot, const std::array<T, dim>& shear)
{
  constexpr int sides = dim - 1;
  std::array<std::array<T, sides>, sides> metric;
  std::array<T, sides> rubs;
  for (int e = 0; e < sides; ++e)
  {
    rubs[e] = dot(foot.A[e], shear);
    for (int f = 0; f < sides; ++f)
      metric[e][f] = dot(foot.A[e], foot.A[f]);
  }
  return solved(metric, rubs);
}

// Shape functions of a facet's nodes where a point is projected, and their derivatives.
template <int dim>
struct Shapes
{
  static constexpr int sides = dim - 1;
  const double *shape, *slope, *bend;
  int nodes;

  Shapes(const core::Table& table, std::size_t p, int count)
      : shape(table.shape + p * count), slope(table.slope + p * sides * count),
        bend(table.bend + p * sides * sides * count), nodes(count)
  {
  }

  // That of a node where the foot has moved to.
  template <typename T>
  T at(int node, const std::array<T, sides>& moved) const
  {
    T N(shape[node]);
    for (int e = 0; e < sides; ++e)
      N = N + slope[e * nodes + node] * moved[e];
    return N;
  }

  // The sum of its derivatives there, times some factors.
  template <typename T>
  T along(int node, const std::array<T, sides>& moved, const std::array<T, sides>& factors) const
  {
    T sum(0.0);
    for (int e = 0; e < sides; ++e)
    {
      T by(slope[e * nodes + node]);
      for (int f = 0; f < sides; ++f)
        by = by + bend[(e * sides + f) * nodes + node] * moved[f];
      sum = sum + by * factors[e];
    }
    return sum;
  }
};

// What a point's projection depends on, by places of the point and of the nodes of its facet.
template <typename T, int dim, int bends>
Ways<T, dim, bends> ways_of(const Shapes<dim>& shapes, const std::array<T, dim>* x)
{
  constexpr int sides = dim - 1;
  Ways<T, dim, bends> ways{};
  for (int i = 0; i < dim; ++i)
  {
    T r = x[0][i];
    std::array<T, sides> A{};
    std::array<T, bends> B{};
    for (int k = 0; k < shapes.nodes; ++k)
    {
      const T& X = x[1 + k][i];
      r = r - shapes.shape[k] * X;
      for (int e = 0; e < sides; ++e)
      {
        A[e] = A[e] + shapes.slope[e * shapes.nodes + k] * X;
        if constexpr (bends > 0)
          for (int f = e; f < sides; ++f)
            if (const int b = bend_of<dim, bends>(e, f); b >= 0)
              B[b] = B[b] + shapes.bend[(e * sides + f) * shapes.nodes + k] * X;
      }
    }
    ways.r[i] = r;
    for (int e = 0; e < sides; ++e)
      ways.A[e][i] = A[e];
    for (int b = 0; b < bends; ++b)
      ways.B[b][i] = B[b];
  }
  return ways;
}

// Where a point's foot is, by places of its stencil: the one thing that goes with the kind of facets.
template <typename T, int dim>
using FootAt = Foot<T, dim> (*)(const Shapes<dim>& shapes, const std::array<T, dim>* x,
                                double outward);

template <typename T, int dim, int bends>
HOT_PART Foot<T, dim> foot_at(const Shapes<dim>& shapes, const std::array<T, dim>* x,
                              double outward)
{
  return foot_of(ways_of<T, dim, bends>(shapes, x), outward);
}

// The way of a point from its anchor, by places of its stencil.
template <typename T, int dim>
std::array<T, dim> delta_of(const core::Meeting& m, std::size_t p, const std::array<T, dim>* x)
{
  std::array<T, dim> delta{};
  if (m.known.smooth)
    return delta;
  delta = x[0];
  for (int k = 0; k < m.nodes; ++k)
    for (int i = 0; i < dim; ++i)
      delta[i] = delta[i] - m.anchored[p * m.nodes + k] * x[1 + m.nodes + k][i];
  return delta;
}

// The places of a point's stencil. (An array of doubles is one of vectors of these.)
template <int dim>
const std::array<double, dim>* places_of(const double* x, std::size_t p, int count)
{
  static_assert(sizeof(std::array<double, dim>) == dim * sizeof(double));
  return reinterpret_cast<const std::array<double, dim>*>(x) + p * count;
}

// Changes of some places less their rigid motion about where these are in the middle of a step.
template <typename T>
HOT_PART void take_rigid_motion(const std::vector<std::array<T, 2>>& arm,
                                std::vector<std::array<T, 2>>& v)
{
  T moment(0.0), inertia(0.0);
  for (std::size_t k = 0; k < v.size(); ++k)
  {
    moment = moment + arm[k][0] * v[k][1] - arm[k][1] * v[k][0];
    inertia = inertia + dot(arm[k], arm[k]);
  }
  const T turn = moment * inverse(inertia);
  for (std::size_t k = 0; k < v.size(); ++k)
    v[k] = {v[k][0] + turn * arm[k][1], v[k][1] - turn * arm[k][0]};
}

template <typename T>
std::array<T, 3> cross(const std::array<T, 3>& a, const std::array<T, 3>& b)
{
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

template <typename T>
HOT_PART void take_rigid_motion(const std::vector<std::array<T, 3>>& arm,
                                std::vector<std::array<T, 3>>& v)
{
  std::array<T, 3> moment{}, turn{};
  std::array<std::array<T, 3>, 3> J{};
  for (std::size_t k = 0; k < v.size(); ++k)
  {
    const auto part = cross(arm[k], v[k]);
    const T square = dot(arm[k], arm[k]);
    for (int i = 0; i < 3; ++i)
    {
      moment[i] = moment[i] + part[i];
      J[i][i] = J[i][i] + square;
      for (int j = 0; j < 3; ++j)
        J[i][j] = J[i][j] - arm[k][i] * arm[k][j];
    }
  }
  const T factor = inverse(dot(J[0], cross(J[1], J[2])));
  for (int i = 0; i < 3; ++i)
  {
    const auto row = cross(J[(i + 1) % 3], J[(i + 2) % 3]);
    turn[i] = factor * dot(row, moment);
  }
  for (std::size_t k = 0; k < v.size(); ++k)
  {
    const auto part = cross(turn, arm[k]);
    for (int i = 0; i < 3; ++i)
      v[k][i] = v[k][i] - part[i];
  }
}

template <typename T, int dim>
void centre(std::vector<std::array<T, dim>>& x)
{
  for (int i = 0; i < dim; ++i)
  {
    T mean(0.0);
    for (const auto& at : x)
      mean = mean + at[i];
    mean = (1.0 / static_cast<double>(x.size())) * mean;
    for (auto& at : x)
      at[i] = at[i] - mean;
  }
}

// What acts at a point, and on it and the nodes of its facet.
template <typename T, int dim>
struct Acting
{
  using Vectors = std::vector<std::array<T, dim>>;
  Traction<T, dim> acts;
  Vectors pushes, rubs, middle, change, along;

  explicit Acting(int nodes) : pushes(1 + nodes), rubs(1 + nodes) {}

  // By friction, whose arm turns with the facet.
  void rub(const Foot<T, dim>& foot, const Shapes<dim>& shapes)
  {
    std::array<T, dim - 1> lag{};
    if (acts.inside)
      lag = lag_of<T, dim>(foot, acts.shear);
    rubs[0] = acts.shear;
    for (int k = 0; k < shapes.nodes; ++k)
    {
      const T N = shapes.at(k, foot.moved), arm = foot.gap * shapes.along(k, foot.moved, lag);
      for (int i = 0; i < dim; ++i)
        rubs[1 + k][i] = arm * foot.n[i] - N * acts.shear[i];
    }
  }

  // Set the gradient of the gap.
  void point(const Foot<T, dim>& foot, const Shapes<dim>& shapes)
  {
    pushes[0] = foot.n;
    for (int k = 0; k < shapes.nodes; ++k)
    {
      const T N = shapes.at(k, foot.moved);
      for (int i = 0; i < dim; ++i)
        pushes[1 + k][i] = T(-1.0) * N * foot.n[i];
    }
  }

  // Go from the gradient to what the pressure does.
  void push()
  {
    for (auto& by : pushes)
      for (T& part : by)
        part = acts.pressure * part;
  }
};

template <typename T, int dim>
HOT_PART Traction<T, dim> traction_at(const core::Touching& known, std::size_t p,
                                      const Press<T>& press, const T& gap,
                                      const std::array<T, dim>& n, const std::array<T, dim>& delta)
{
  return traction_of(known, p, press, gap, n, delta);
}

// Set what acts at a point by places of its stencil, with a pressure on top where one acts.
template <int dim, typename T>
HOT_PART void act_at(const core::Meeting& m, FootAt<T, dim> project, std::size_t p,
                     const std::array<T, dim>* x, Acting<T, dim>& found, const T* top = nullptr)
{
  const Shapes<dim> shapes(m.table, p, m.nodes);
  const auto foot = project(shapes, x, m.outward[p]);
  const auto delta = delta_of<T, dim>(m, p, x);
  if (!m.start)
  {
    const auto press = pressing(m.known, p, foot.gap, foot.n, top);
    found.acts = traction_at<T, dim>(m.known, p, press, foot.gap, foot.n, delta);
    found.point(foot, shapes);
    found.rub(foot, shapes);
    found.push();
    return;
  }
  // By the energy at both ends, with the gradient of the middle.
  const auto* start = places_of<dim>(m.start, p, 1 + m.nodes);
  auto &middle = found.middle, &change = found.change, &along = found.along;
  middle.resize(1 + m.nodes);
  change.resize(1 + m.nodes);
  for (int k = 0; k <= m.nodes; ++k)
    for (int i = 0; i < dim; ++i)
    {
      middle[k][i] = 0.5 * (T(start[k][i]) + x[k][i]);
      change[k][i] = x[k][i] - T(start[k][i]);
    }
  const Shapes<dim> there(m.middle, p, m.nodes);
  const auto half = project(there, middle.data(), m.outward[p]);
  const auto press = mean_pressing(m.known, p, m.before[p] - m.offset[p],
                                   T(foot.gap - T(m.offset[p])));
  found.acts = traction_at<T, dim>(m.known, p, press, foot.gap, half.n, delta);
  found.point(half, there);
  found.rub(half, there);
  // (what corrects the gradient has no sum nor moment in the middle)
  along = change;
  centre<T, dim>(along);
  centre<T, dim>(middle);
  take_rigid_motion(middle, along);
  correct(found.pushes.data(), change.data(), along.data(), along.size(),
          T(foot.gap - T(m.before[p])), m.known.still);
  found.push();
}

template <int dim>
void act_in(const core::Meeting& m, FootAt<double, dim> project, const core::Met& result)
{
  Acting<double, dim> found(m.nodes);
  const std::size_t width = (1 + m.nodes) * dim;
  for (std::size_t p = 0; p < m.points; ++p)
  {
    act_at<dim>(m, project, p, places_of<dim>(m.x, p, m.count), found);
    std::copy_n(found.pushes[0].data(), width, result.pushes + p * width);
    std::copy_n(found.rubs[0].data(), width, result.rubs + p * width);
    result.pressure[p] = found.acts.pressure;
    result.inside[p] = found.acts.inside;
    result.slips[p] = found.acts.slips;
  }
}

template <int dim>
void differentiate_by_pressure_in(const core::Meeting& m, FootAt<Dual<together>, dim> project,
                                  double* slopes)
{
  using T = Dual<together>;
  T top;
  top.by.set(0, 1.0);
  Acting<T, dim> found(m.nodes);
  std::vector<std::array<T, dim>> x(m.count);
  for (std::size_t p = 0; p < m.points; ++p)
  {
    const auto* places = places_of<dim>(m.x, p, m.count);
    for (int k = 0; k < m.count; ++k)
      std::copy_n(places[k].begin(), dim, x[k].begin());
    act_at<dim>(m, project, p, x.data(), found, &top);
    for (int k = 0; k <= m.nodes; ++k)
      for (int i = 0; i < dim; ++i)
        *slopes++ = (found.pushes[k][i] + found.rubs[k][i]).by[0];
  }
}

template <int dim>
void see_in(const core::Meeting& m, FootAt<double, dim> project, double* gap, double* n,
            double* delta)
{
  for (std::size_t p = 0; p < m.points; ++p)
  {
    const auto* x = places_of<dim>(m.x, p, m.count);
    auto foot = project({m.table, p, m.nodes}, x, m.outward[p]);
    gap[p] = foot.gap;
    if (m.start)
    {
      std::vector<std::array<double, dim>> middle(x, x + 1 + m.nodes);
      const auto* start = places_of<dim>(m.start, p, 1 + m.nodes);
      for (int k = 0; k <= m.nodes; ++k)
        for (int i = 0; i < dim; ++i)
          middle[k][i] = 0.5 * (start[k][i] + x[k][i]);
      const Shapes<dim> there(m.middle, p, m.nodes);
      foot = project(there, middle.data(), m.outward[p]);
    }
    const auto way = delta_of<double, dim>(m, p, x);
    std::copy_n(foot.n.data(), dim, n + p * dim);
    std::copy_n(way.data(), dim, delta + p * dim);
  }
}

// Set the derivative of all forces at a point by the places of its stencil, (1 + nodes, dim, count,
// dim), by way of that of the vectors that they are made of.
template <int dim, int bends>
HOT_PART void differentiate_at(const core::Meeting& m, std::size_t p, double* D,
                               std::vector<double>& work)
{
  constexpr int sides = dim - 1, vectors = 1 + sides + bends, most = (vectors + 1) * dim + together;
  using T = Dual<together>;
  const bool rubs = !m.known.smooth;
  const auto* x = places_of<dim>(m.x, p, m.count);
  const auto given = ways_of<double, dim, bends>({m.table, p, m.nodes}, x);
  const auto way = delta_of<double, dim>(m, p, x);
  // What acts on a node is a sum of vectors: that on the point, and by each slope and bend.
  const int parts = rubs ? vectors : 1 + sides, numbers = (vectors + rubs) * dim;
  double by[vectors][dim][most];
  for (int first = 0; first < numbers; first += together)
  {
    std::array<std::array<T, dim>, vectors + 1> all;
    for (int i = 0; i < dim; ++i)
    {
      all[0][i] = T(given.r[i]);
      for (int e = 0; e < sides; ++e)
        all[1 + e][i] = T(given.A[e][i]);
      for (int b = 0; b < bends; ++b)
        all[1 + sides + b][i] = T(given.B[b][i]);
      all[vectors][i] = T(way[i]);
    }
    for (int k = 0; k < std::min(together, numbers - first); ++k)
      all[(first + k) / dim][(first + k) % dim].by.set(k, 1.0);
    Ways<T, dim, bends> ways;
    ways.r = all[0];
    for (int e = 0; e < sides; ++e)
      ways.A[e] = all[1 + e];
    for (int b = 0; b < bends; ++b)
      ways.B[b] = all[1 + sides + b];
    const auto foot = foot_of(ways, m.outward[p]);
    const auto acts = traction_at<T, dim>(m.known, p, pressing(m.known, p, foot.gap, foot.n),
                                          foot.gap, foot.n, all[vectors]);
    std::array<T, sides> lag{};
    if (rubs && acts.inside)
      lag = lag_of<T, dim>(foot, acts.shear);
    std::array<std::array<T, dim>, vectors> made{};
    for (int i = 0; i < dim; ++i)
    {
      const T force = acts.pressure * foot.n[i] + acts.shear[i];
      made[0][i] = force;
      for (int e = 0; e < sides; ++e)
        made[1 + e][i] = foot.moved[e] * force;
      if (!rubs)
        continue;
      const T arm = foot.gap * foot.n[i];
      for (int e = 0; e < sides; ++e)
        made[1 + e][i] -= lag[e] * arm;
      for (int e = 0; e < sides; ++e)
        for (int f = 0; f < sides; ++f)
          if (const int b = bend_of<dim, bends>(e, f); b >= 0)
            made[1 + sides + b][i] = made[1 + sides + b][i] + lag[e] * foot.moved[f] * arm;
    }
    for (int part = 0; part < parts; ++part)
      for (int i = 0; i < dim; ++i)
        for (int k = 0; k < together; ++k)
          by[part][i][first + k] = made[part][i].by[k];
  }
  // How the vectors go with each node.
  const double* slope = m.table.slope + p * sides * m.nodes;
  const double* bend = m.table.bend + p * sides * sides * m.nodes;
  const int width = m.count * dim;
  double* factors = work.data();
  double* half = factors + m.nodes * vectors;
  for (int k = 0; k < m.nodes; ++k)
  {
    double* mine = factors + k * vectors;
    mine[0] = -m.table.shape[p * m.nodes + k];
    for (int e = 0; e < sides; ++e)
    {
      mine[1 + e] = slope[e * m.nodes + k];
      for (int f = e; f < sides; ++f)
        if (const int b = bend_of<dim, bends>(e, f); b >= 0)
          mine[1 + sides + b] = bend[(e * sides + f) * m.nodes + k];
    }
  }
  for (int part = 0; part < parts; ++part)
    for (int i = 0; i < dim; ++i)
    {
      const double* mine = by[part][i];
      double* row = half + (part * dim + i) * width;
      for (int j = 0; j < dim; ++j)
        row[j] = rubs ? mine[j] + mine[vectors * dim + j] : mine[j];
      for (int k = 0; k < m.nodes; ++k)
        for (int j = 0; j < dim; ++j)
        {
          double sum = 0.0;
          for (int v = 0; v < vectors; ++v)
            sum += factors[k * vectors + v] * mine[v * dim + j];
          row[(1 + k) * dim + j] = sum;
          if (rubs)
            row[(1 + m.nodes + k) * dim + j]
                = -m.anchored[p * m.nodes + k] * mine[vectors * dim + j];
        }
    }
  std::copy_n(half, dim * width, D);
  for (int k = 0; k < m.nodes; ++k)
  {
    double* rows = D + (1 + k) * dim * width;
    for (int c = 0; c < dim * width; ++c)
      rows[c] = factors[k * vectors] * half[c];
    for (int part = 1; part < parts; ++part)
    {
      // (by slopes the other way, as these go with what is taken from the shape functions)
      const double factor = (part <= sides ? -1.0 : 1.0) * factors[k * vectors + part];
      const double* from = half + part * dim * width;
      for (int c = 0; c < dim * width; ++c)
        rows[c] += factor * from[c];
    }
  }
}

// Set the same of a step of a motion, by the places of all nodes.
template <int dim>
HOT_PART void differentiate_step_at(const core::Meeting& m, FootAt<Dual<together>, dim> project,
                                    std::size_t p, double* D)
{
  using T = Dual<together>;
  Acting<T, dim> found(m.nodes);
  std::vector<std::array<T, dim>> x(m.count);
  const auto* places = places_of<dim>(m.x, p, m.count);
  for (int k = 0; k < m.count; ++k)
    std::copy_n(places[k].begin(), dim, x[k].begin());
  const int width = m.count * dim, rows = (1 + m.nodes) * dim;
  for (int row = 0; row < rows; ++row)
    std::fill_n(D + row * width, dim, 0.0);
  for (int first = dim; first < width; first += together)
  {
    const int here = std::min(together, width - first);
    for (int k = 0; k < here; ++k)
      x[(first + k) / dim][(first + k) % dim].by.set(k, 1.0);
    act_at<dim>(m, project, p, x.data(), found);
    for (int k = 0; k < here; ++k)
      x[(first + k) / dim][(first + k) % dim].by.set(k, 0.0);
    for (int row = 0; row < rows; ++row)
    {
      const T force = found.pushes[row / dim][row % dim] + found.rubs[row / dim][row % dim];
      for (int k = 0; k < here; ++k)
      {
        D[row * width + first + k] = force.by[k];
        // (nothing acts where all are shifted)
        D[row * width + (first + k) % dim] -= force.by[k];
      }
    }
  }
}

// Add the derivative at a point to blocks between nodes.
template <int dim>
void add_at(const core::Sums& sums, std::size_t p, int nodes, int count, const double* D)
{
  const int rows = sums.sources + nodes, columns = sums.sources + count - 1;
  const std::int32_t* positions = sums.positions + sums.group[p] * rows * columns;
  const double* shapes = sums.shapes + p * sums.sources;
  const auto spread = [&](int node) { return node < sums.sources ? shapes[node] : 1.0; };
  const auto place = [&](int node) { return std::max(node - sums.sources + 1, 0); };
  for (int a = 0; a < rows; ++a)
  {
    const double left = sums.weights[p] * spread(a);
    const double* row = D + place(a) * dim * count * dim;
    for (int b = 0; b < columns; ++b)
    {
      const double factor = left * spread(b);
      const double* from = row + place(b) * dim;
      double* block = sums.values + static_cast<std::size_t>(positions[a * columns + b]) * dim * dim;
      for (int i = 0; i < dim; ++i)
        for (int j = 0; j < dim; ++j)
          block[i * dim + j] += factor * from[i * count * dim + j];
    }
  }
}

template <int dim, int bends>
HOT_LOOP void add_tangents_in(const core::Meeting& m, const core::Sums& sums)
{
  constexpr int vectors = dim + bends;
  std::vector<double> D((1 + m.nodes) * dim * m.count * dim);
  std::vector<double> work(m.nodes * vectors + vectors * dim * m.count * dim);
  for (std::size_t p = 0; p < m.points; ++p)
  {
    if (m.start)
      differentiate_step_at<dim>(m, foot_at<Dual<together>, dim, bends>, p, D.data());
    else
      differentiate_at<dim, bends>(m, p, D.data(), work);
    add_at<dim>(sums, p, m.nodes, m.count, D.data());
  }
}

// How many dimensions there are, and how many second derivatives a facet has.
template <int dim_, int bends_>
struct Kind
{
  static constexpr int dim = dim_, bends = bends_;
  template <typename T>
  static constexpr FootAt<T, dim> project = foot_at<T, dim, bends>;
};

// Call a function with the kind of the facets.
template <typename F>
void with_kind(int dim, int nodes, F&& f)
{
  if (dim == 2 && nodes == 2)
    f(Kind<2, 0>{});
  else if (dim == 2)
    f(Kind<2, 1>{});
  else if (nodes == 3)
    f(Kind<3, 0>{});
  else if (nodes == 4)
    f(Kind<3, 1>{});
  else
    f(Kind<3, 3>{});
}
} // namespace

void core::act(const Meeting& meeting, int dim, const Met& result)
{
  with_kind(dim, meeting.nodes, [&](auto kind) {
    act_in<decltype(kind)::dim>(meeting, decltype(kind)::template project<double>, result);
  });
}

void core::differentiate_by_pressure(const Meeting& meeting, int dim, double* slopes)
{
  with_kind(dim, meeting.nodes, [&](auto kind) {
    differentiate_by_pressure_in<decltype(kind)::dim>(
        meeting, decltype(kind)::template project<Dual<together>>, slopes);
  });
}

void core::see(const Meeting& meeting, int dim, double* gap, double* n, double* delta)
{
  with_kind(dim, meeting.nodes, [&](auto kind) {
    see_in<decltype(kind)::dim>(meeting, decltype(kind)::template project<double>, gap, n, delta);
  });
}

void core::add_tangents(const Meeting& meeting, int dim, const Sums& sums)
{
  with_kind(dim, meeting.nodes, [&](auto kind) {
    add_tangents_in<decltype(kind)::dim, decltype(kind)::bends>(meeting, sums);
  });
}

void core::add_slopes(std::size_t points, int dim, const double* slopes, const Sums& sums)
{
  for (std::size_t p = 0; p < points; ++p)
    if (dim == 2)
      add_at<2>(sums, p, 0, 1, slopes + p * 4);
    else
      add_at<3>(sums, p, 0, 1, slopes + p * 9);
}
