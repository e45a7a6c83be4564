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

// Which of so many second derivatives is that by two directions, -1: it is zero. A line or a triangle
// of degree 1 has none, a quadrilateral the mixed one.
template <int dim, int bends>
constexpr int bend_of(int e, int f)
{
  if (bends == dim * (dim - 1) / 2)
    return e + f;
  return bends == 1 && e != f ? 0 : -1;
}

// What all depends on: r, slopes A, bends B, and the way from the anchor.
template <typename T, int dim, int bends>
struct Ways
{
  static constexpr int sides = dim - 1;
  using Vector = std::array<T, dim>;
  Vector r, delta;
  std::array<Vector, sides> A;
  std::array<Vector, bends> B;
};

template <typename T, int dim>
struct Foot : Traction<T, dim>
{
  std::array<T, dim - 1> moved, lag; // to the foot, and the shear along the slopes there
  std::array<T, dim> n;
  T gap;
};

template <typename T, int dim, int bends>
Foot<T, dim> foot_of(const Ways<T, dim, bends>& ways, const core::Meeting& m, std::size_t p)
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
  std::array<std::array<T, dim>, sides> A = ways.A;
  for (int i = 0; i < dim; ++i)
    for (int e = 0; e < sides; ++e)
    {
      r[i] = r[i] - ways.A[e][i] * foot.moved[e];
      if constexpr (bends > 0)
        for (int f = 0; f < sides; ++f)
          if (const int b = bend_of<dim, bends>(e, f); b >= 0)
            A[e][i] = A[e][i] + ways.B[b][i] * foot.moved[f];
    }
  std::array<T, dim> n;
  if constexpr (dim == 2)
    n = {A[0][1], T(-1.0) * A[0][0]};
  else
    for (int i = 0; i < 3; ++i)
      n[i] = A[0][(i + 1) % 3] * A[1][(i + 2) % 3] - A[0][(i + 2) % 3] * A[1][(i + 1) % 3];
  const T unit = m.outward[p] * inverse(root(dot(n, n)));
  for (int i = 0; i < dim; ++i)
    foot.n[i] = n[i] * unit;
  foot.gap = dot(r, foot.n);
  static_cast<Traction<T, dim>&>(foot)
      = traction_of(m.known, p, pressing(m.known, p, foot.gap, foot.n), foot.gap, foot.n, ways.delta);
  if (m.known.smooth || !foot.inside)
    return foot;
  std::array<std::array<T, sides>, sides> metric;
  std::array<T, sides> rubs;
  for (int e = 0; e < sides; ++e)
  {
    rubs[e] = dot(A[e], foot.shear);
    for (int f = 0; f < sides; ++f)
      metric[e][f] = dot(A[e], A[f]);
  }
  foot.lag = solved(metric, rubs);
  return foot;
}

// What acts on a node of the facet: by pressure, and by friction, whose arm turns with the facet.
template <int dim>
void on_node(const Foot<double, dim>& foot, const core::Meeting& m, std::size_t p, int node,
             double* push, double* rub)
{
  constexpr int sides = dim - 1;
  const double* slope = m.slope + p * sides * m.nodes;
  const double* bend = m.bend + p * sides * sides * m.nodes;
  double N = m.shape[p * m.nodes + node], turn = 0.0;
  for (int e = 0; e < sides; ++e)
  {
    N += slope[e * m.nodes + node] * foot.moved[e];
    double by = slope[e * m.nodes + node];
    for (int f = 0; f < sides; ++f)
      by += bend[(e * sides + f) * m.nodes + node] * foot.moved[f];
    turn += by * foot.lag[e];
  }
  const double arm = foot.gap * turn, pressed = N * foot.pressure;
  for (int i = 0; i < dim; ++i)
  {
    push[i] = -pressed * foot.n[i];
    rub[i] = arm * foot.n[i] - N * foot.shear[i];
  }
}

template <typename T, int dim, int bends>
Ways<T, dim, bends> ways_of(const core::Meeting& m, std::size_t p)
{
  constexpr int sides = dim - 1;
  Ways<T, dim, bends> ways{};
  const double* x = m.x + p * m.count * dim;
  const double* slope = m.slope + p * sides * m.nodes;
  const double* bend = m.bend + p * sides * sides * m.nodes;
  for (int i = 0; i < dim; ++i)
  {
    double r = x[i], delta = x[i];
    std::array<double, sides> A{};
    std::array<double, bends> B{};
    for (int k = 0; k < m.nodes; ++k)
    {
      const double X = x[(1 + k) * dim + i];
      r -= m.shape[p * m.nodes + k] * X;
      for (int e = 0; e < sides; ++e)
      {
        A[e] += slope[e * m.nodes + k] * X;
        if constexpr (bends > 0)
          for (int f = e; f < sides; ++f)
            if (const int b = bend_of<dim, bends>(e, f); b >= 0)
              B[b] += bend[(e * sides + f) * m.nodes + k] * X;
      }
      if (!m.known.smooth)
        delta -= m.anchored[p * m.nodes + k] * x[(1 + m.nodes + k) * dim + i];
    }
    ways.r[i] = T(r);
    ways.delta[i] = m.known.smooth ? T(0.0) : T(delta);
    for (int e = 0; e < sides; ++e)
      ways.A[e][i] = T(A[e]);
    for (int b = 0; b < bends; ++b)
      ways.B[b][i] = T(B[b]);
  }
  return ways;
}

// (One function of all kinds would take compilers twice as long.)
template <int dim, int bends>
HOT_LOOP void act_in(const core::Meeting& m, const core::Met& result)
{
  for (std::size_t p = 0; p < m.points; ++p)
  {
    const auto foot = foot_of(ways_of<double, dim, bends>(m, p), m, p);
    double* push = result.pushes + p * (1 + m.nodes) * dim;
    double* rub = result.rubs + p * (1 + m.nodes) * dim;
    for (int i = 0; i < dim; ++i)
    {
      push[i] = foot.pressure * foot.n[i];
      rub[i] = result.shear[p * dim + i] = foot.shear[i];
    }
    result.pressure[p] = foot.pressure;
    result.inside[p] = foot.inside;
    result.slips[p] = foot.slips;
    for (int k = 1; k <= m.nodes; ++k)
      on_node<dim>(foot, m, p, k - 1, push + k * dim, rub + k * dim);
  }
}

// Set the derivative of all forces at a point by the places of its stencil, (1 + nodes, dim, count,
// dim), by way of that of the vectors that they are made of.
template <int dim, int bends, bool rubs>
void differentiate_at(const core::Meeting& m, std::size_t p, double* D, std::vector<double>& work)
{
  constexpr int sides = dim - 1, vectors = 1 + sides + bends, lanes = dim * (vectors + rubs);
  using T = Dual<lanes>;
  auto ways = ways_of<T, dim, bends>(m, p);
  for (int i = 0; i < dim; ++i)
  {
    ways.r[i].by[i] = 1.0;
    for (int e = 0; e < sides; ++e)
      ways.A[e][i].by[(1 + e) * dim + i] = 1.0;
    for (int b = 0; b < bends; ++b)
      ways.B[b][i].by[(1 + sides + b) * dim + i] = 1.0;
    if constexpr (rubs)
      ways.delta[i].by[vectors * dim + i] = 1.0;
  }
  const auto foot = foot_of(ways, m, p);
  // What acts on a node is a sum of vectors: that on the point, and by each slope and bend.
  constexpr int parts = rubs ? vectors : 1 + sides;
  std::array<std::array<T, dim>, parts> made;
  for (int i = 0; i < dim; ++i)
  {
    const T force = foot.pressure * foot.n[i] + foot.shear[i];
    made[0][i] = force;
    if constexpr (rubs)
    {
      const T arm = foot.gap * foot.n[i];
      for (int e = 0; e < sides; ++e)
        made[1 + e][i] = foot.moved[e] * force - foot.lag[e] * arm;
      for (int b = 0; b < bends; ++b)
        made[1 + sides + b][i] = T(0.0);
      for (int e = 0; e < sides; ++e)
        for (int f = 0; f < sides; ++f)
          if (const int b = bend_of<dim, bends>(e, f); b >= 0)
            made[1 + sides + b][i] = made[1 + sides + b][i] + foot.lag[e] * foot.moved[f] * arm;
    }
    else
      for (int e = 0; e < sides; ++e)
        made[1 + e][i] = foot.moved[e] * force;
  }
  // How the vectors go with each node.
  const double* slope = m.slope + p * sides * m.nodes;
  const double* bend = m.bend + p * sides * sides * m.nodes;
  const int width = m.count * dim;
  double* factors = work.data();
  double* half = factors + m.nodes * vectors;
  for (int k = 0; k < m.nodes; ++k)
  {
    double* mine = factors + k * vectors;
    mine[0] = -m.shape[p * m.nodes + k];
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
      const double* by = made[part][i].by.data();
      double* row = half + (part * dim + i) * width;
      for (int j = 0; j < dim; ++j)
        row[j] = rubs ? by[j] + by[vectors * dim + j] : by[j];
      for (int k = 0; k < m.nodes; ++k)
        for (int j = 0; j < dim; ++j)
        {
          double sum = 0.0;
          for (int v = 0; v < vectors; ++v)
            sum += factors[k * vectors + v] * by[v * dim + j];
          row[(1 + k) * dim + j] = sum;
          if constexpr (rubs)
            row[(1 + m.nodes + k) * dim + j]
                = -m.anchored[p * m.nodes + k] * by[vectors * dim + j];
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

template <int dim, int bends, bool rubs>
HOT_LOOP void add_tangents_in(const core::Meeting& m, const core::Sums& sums)
{
  constexpr int vectors = dim + bends;
  std::vector<double> D((1 + m.nodes) * dim * m.count * dim);
  std::vector<double> work(m.nodes * vectors + vectors * dim * m.count * dim);
  for (std::size_t p = 0; p < m.points; ++p)
  {
    differentiate_at<dim, bends, rubs>(m, p, D.data(), work);
    add_at<dim>(sums, p, m.nodes, m.count, D.data());
  }
}

// How many dimensions there are, and how many second derivatives a facet has.
template <int dim_, int bends_>
struct Kind
{
  static constexpr int dim = dim_, bends = bends_;
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
    act_in<decltype(kind)::dim, decltype(kind)::bends>(meeting, result);
  });
}

void core::add_tangents(const Meeting& meeting, int dim, const Sums& sums)
{
  with_kind(dim, meeting.nodes, [&](auto kind) {
    constexpr int dimension = decltype(kind)::dim, bends = decltype(kind)::bends;
    if (meeting.known.smooth)
      add_tangents_in<dimension, bends, false>(meeting, sums);
    else
      add_tangents_in<dimension, bends, true>(meeting, sums);
  });
}

HOT_LOOP void core::add_derivatives(std::size_t points, int dim, int nodes, int count,
                                    const double* derivatives, const Sums& sums)
{
  const std::size_t size = static_cast<std::size_t>((1 + nodes) * dim * count * dim);
  for (std::size_t p = 0; p < points; ++p)
    if (dim == 2)
      add_at<2>(sums, p, nodes, count, derivatives + p * size);
    else
      add_at<3>(sums, p, nodes, count, derivatives + p * size);
}
