// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// What acts between points and facets of two bodies, and its derivative, point by point.
//
// Derivatives are carried along in the few vectors that all depends on: the way from the facet's
// place to the point, first and second derivatives of the facet there, and the way from the anchor.
// What acts on the nodes of a facet is made of as few vectors, by the same factors.

#include "contact.h"
#include "hot_loop.h"

#include <array>
#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

namespace
{
// A number with its derivatives by some others.
template <int count>
struct Dual
{
  double value = 0.0;
  std::array<double, count> by{};

  Dual() = default;
  Dual(double number) : value(number) {}
};

template <int count>
Dual<count> operator+(Dual<count> a, const Dual<count>& b)
{
  a.value += b.value;
  for (int i = 0; i < count; ++i)
    a.by[i] += b.by[i];
  return a;
}

template <int count>
Dual<count> operator-(Dual<count> a, const Dual<count>& b)
{
  a.value -= b.value;
  for (int i = 0; i < count; ++i)
    a.by[i] -= b.by[i];
  return a;
}

template <int count>
Dual<count> operator*(const Dual<count>& a, const Dual<count>& b)
{
  Dual<count> result(a.value * b.value);
  for (int i = 0; i < count; ++i)
    result.by[i] = a.value * b.by[i] + b.value * a.by[i];
  return result;
}

template <int count>
Dual<count> operator*(double a, Dual<count> b)
{
  b.value *= a;
  for (int i = 0; i < count; ++i)
    b.by[i] *= a;
  return b;
}

// f(a), of a known derivative.
template <int count>
Dual<count> chain(const Dual<count>& a, double value, double slope)
{
  Dual<count> result(value);
  for (int i = 0; i < count; ++i)
    result.by[i] = slope * a.by[i];
  return result;
}

double value_of(double a) { return a; }
double inverse(double a) { return 1.0 / a; }
double root(double a) { return std::sqrt(a); }

template <int count>
double value_of(const Dual<count>& a)
{
  return a.value;
}

template <int count>
Dual<count> inverse(const Dual<count>& a)
{
  return chain(a, 1.0 / a.value, -1.0 / (a.value * a.value));
}

template <int count>
Dual<count> root(const Dual<count>& a)
{
  const double size = std::sqrt(a.value);
  return chain(a, size, 0.5 / size);
}

template <typename T, std::size_t dim>
T dot(const std::array<T, dim>& a, const std::array<T, dim>& b)
{
  T sum = a[0] * b[0];
  for (std::size_t i = 1; i < dim; ++i)
    sum = sum + a[i] * b[i];
  return sum;
}

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
struct Foot
{
  std::array<T, dim - 1> moved, lag; // to the foot, and the shear along the slopes there
  std::array<T, dim> n, shear;
  T gap, pressure;
  bool inside, slips;
};

// Solve for a matrix of one or two rows.
template <typename T, typename G, std::size_t sides>
std::array<T, sides> solved(const std::array<std::array<G, sides>, sides>& matrix,
                            const std::array<T, sides>& b)
{
  if constexpr (sides == 1)
    return {inverse(matrix[0][0]) * b[0]};
  else
  {
    const G det = matrix[0][0] * matrix[1][1] - matrix[0][1] * matrix[1][0];
    const G factor = inverse(det);
    return {factor * (matrix[1][1] * b[0] - matrix[0][1] * b[1]),
            factor * (matrix[0][0] * b[1] - matrix[1][0] * b[0])};
  }
}

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
  const double gap = value_of(foot.gap);
  foot.inside = gap <= m.touch;
  foot.slips = false;
  foot.pressure = foot.inside ? T(-m.stiffness[p] * foot.gap) : T(0.0);
  if (m.smooth || !foot.inside)
    return foot;
  // The share of its way that a point has touched, and the shear where all stick.
  T share(1.0);
  if (m.touched[p] == 0 && m.gap[p] > 10.0 * m.touch)
    share = gap < 0.0 ? T(T(-1.0) * foot.gap * inverse(T(m.gap[p]) - foot.gap)) : T(0.0);
  const T normal = dot(foot.n, ways.delta), factor = -m.tangential[p] * share;
  for (int i = 0; i < dim; ++i)
    foot.shear[i] = factor * (ways.delta[i] - foot.n[i] * normal);
  const T square = dot(foot.shear, foot.shear);
  const bool pressed = value_of(foot.pressure) > 0.0;
  T bound = (pressed ? m.friction * foot.pressure : T(0.0)) + T(m.cohesion * m.stretch[p]);
  if (!(value_of(bound) < m.limit * m.stretch[p]))
    bound = T(m.limit * m.stretch[p]);
  foot.slips = std::sqrt(value_of(square)) > value_of(bound) + m.tangential[p] * m.touch;
  if (foot.slips)
  {
    const T less = bound * inverse(root(square));
    for (T& part : foot.shear)
      part = part * less;
  }
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
      if (!m.smooth)
        delta -= m.anchored[p * m.nodes + k] * x[(1 + m.nodes + k) * dim + i];
    }
    ways.r[i] = T(r);
    ways.delta[i] = m.smooth ? T(0.0) : T(delta);
    for (int e = 0; e < sides; ++e)
      ways.A[e][i] = T(A[e]);
    for (int b = 0; b < bends; ++b)
      ways.B[b][i] = T(B[b]);
  }
  return ways;
}

template <int dim, int bends>
void act_in(const core::Meeting& m, const core::Met& result)
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

template <int dim, int bends>
void add_tangents_in(const core::Meeting& m, const core::Sums& sums)
{
  constexpr int vectors = dim + bends;
  std::vector<double> D((1 + m.nodes) * dim * m.count * dim);
  std::vector<double> work(m.nodes * vectors + vectors * dim * m.count * dim);
  for (std::size_t p = 0; p < m.points; ++p)
  {
    if (m.smooth)
      differentiate_at<dim, bends, false>(m, p, D.data(), work);
    else
      differentiate_at<dim, bends, true>(m, p, D.data(), work);
    add_at<dim>(sums, p, m.nodes, m.count, D.data());
  }
}

// A facet of degree 1 at a place: the point there, its slopes, and its one mixed second derivative.
template <int dim>
struct Place
{
  std::array<double, dim> x{}, bend{};
  std::array<std::array<double, dim>, dim - 1> A{};

  Place(const double* corners, int nodes, const std::array<double, dim - 1>& s)
  {
    for (int i = 0; i < dim; ++i)
    {
      const auto X = [&](int node) { return corners[node * dim + i]; };
      if constexpr (dim == 3)
        if (nodes == 4)
        {
          bend[i] = X(0) - X(1) - X(2) + X(3);
          A[0][i] = X(1) - X(0) + bend[i] * s[1];
          A[1][i] = X(2) - X(0) + bend[i] * s[0];
          x[i] = X(0) + (X(1) - X(0)) * s[0] + A[1][i] * s[1];
          continue;
        }
      x[i] = X(0);
      for (int e = 0; e < dim - 1; ++e)
      {
        A[e][i] = X(1 + e) - X(0);
        x[i] += A[e][i] * s[e];
      }
    }
  }

  // The normal of the size of the area element, outwards.
  std::array<double, dim> area(double outward) const
  {
    std::array<double, dim> n;
    if constexpr (dim == 2)
      n = {A[0][1], -A[0][0]};
    else
      for (int i = 0; i < 3; ++i)
        n[i] = A[0][(i + 1) % 3] * A[1][(i + 2) % 3] - A[0][(i + 2) % 3] * A[1][(i + 1) % 3];
    for (double& part : n)
      part *= outward;
    return n;
  }

  // The unit normal, outwards.
  std::array<double, dim> normal(double outward) const
  {
    auto n = area(outward);
    const double factor = 1.0 / std::sqrt(dot(n, n));
    for (double& part : n)
      part *= factor;
    return n;
  }
};

template <int dim>
std::array<double, dim> difference(const double* a, const std::array<double, dim>& b)
{
  std::array<double, dim> result;
  for (int i = 0; i < dim; ++i)
    result[i] = a[i] - b[i];
  return result;
}

// Project a point on a facet, by Newton's method from its middle; false where the facet has no area.
template <int dim>
bool project(const core::Search& search, const double* x, const double* corners,
             std::array<double, dim - 1>& s)
{
  constexpr int sides = dim - 1;
  s.fill(search.nodes == 3 ? 1.0 / 3.0 : 0.5);
  const bool flat = search.nodes == dim;
  for (int step = 0; step < search.most; ++step)
  {
    const Place<dim> at(corners, search.nodes, s);
    const auto r = difference<dim>(x, at.x);
    std::array<std::array<double, sides>, sides> G;
    std::array<double, sides> along;
    for (int e = 0; e < sides; ++e)
    {
      along[e] = dot(at.A[e], r);
      for (int f = 0; f < sides; ++f)
        G[e][f] = dot(at.A[e], at.A[f]);
    }
    if constexpr (sides == 2)
    {
      // where a curved facet bends towards the point too much, its plane has to do
      const double det = G[0][0] * G[1][1] - G[0][1] * G[0][1], bend = dot(at.bend, r);
      const double bent = G[0][1] - bend;
      if (G[0][0] * G[1][1] - bent * bent > 0.1 * det)
        G[0][1] = G[1][0] = bent;
      else if (!(det > 0.0))
        return false;
    }
    else if (!(G[0][0] > 0.0))
      return false;
    const auto change = solved(G, along);
    double size = 0.0;
    for (int e = 0; e < sides; ++e)
    {
      const double moved = flat ? change[e] : std::min(std::max(change[e], -1.0), 1.0);
      size = std::max(size, std::abs(moved));
      s[e] = std::min(std::max(s[e] + moved, -3.0), 4.0);
    }
    if (flat || !(size > search.close))
      break;
  }
  return true;
}

// Boxes of facets in the tiles of a grid.
template <int dim>
class Tiles
{
public:
  using Vector = std::array<double, dim>;

  explicit Tiles(const core::Search& search)
      : low_(search.facets), high_(search.facets), normal_(search.facets),
        at_corners_(search.facets)
  {
    base_.fill(INFINITY);
    top_.fill(-INFINITY);
    std::vector<std::int64_t> there;
    for (std::size_t facet = 0; facet < search.facets; ++facet)
    {
      const double* corners = search.corners + facet * search.nodes * dim;
      Vector &low = low_[facet], &high = high_[facet];
      bool finite = search.present[facet] != 0;
      for (int i = 0; i < dim; ++i)
      {
        low[i] = high[i] = corners[i];
        for (int k = 0; k < search.nodes; ++k)
        {
          const double at = corners[k * dim + i];
          finite = finite && std::isfinite(at);
          low[i] = std::min(low[i], at);
          high[i] = std::max(high[i], at);
        }
      }
      if (!finite)
        continue;
      there.push_back(static_cast<std::int64_t>(facet));
      std::array<double, dim - 1> middle;
      middle.fill(search.nodes == 3 ? 1.0 / 3.0 : 0.5);
      normal_[facet] = Place<dim>(corners, search.nodes, middle).normal(search.outward[facet]);
      at_corners_[facet].fill(normal_[facet]);
      if constexpr (dim == 3)
        if (search.nodes == 4)
        {
          double least = INFINITY;
          for (int k = 0; k < 4; ++k)
          {
            const Place<dim> at(corners, 4, {static_cast<double>(k % 2), static_cast<double>(k / 2)});
            at_corners_[facet][k] = at.area(search.outward[facet]);
            least = std::min(least, dot(at_corners_[facet][k], normal_[facet]));
          }
          // (a facet that bends so much may face anything)
          const double factor = least > 0.0 ? 1.0 / least : NAN;
          for (Vector& corner : at_corners_[facet])
            for (double& part : corner)
              part *= factor;
        }
      double size = 0.0;
      for (int i = 0; i < dim; ++i)
      {
        base_[i] = std::min(base_[i], low[i]);
        top_[i] = std::max(top_[i], high[i]);
        size = std::max(size, high[i] - low[i]);
      }
      width_ += size;
    }
    if (there.empty())
      return;
    width_ /= static_cast<double>(there.size());
    double width = width_;
    for (double all = INFINITY; all > 1000.0 + 8.0 * static_cast<double>(there.size());)
    {
      all = 1.0;
      for (int i = 0; i < dim; ++i)
      {
        const double most = std::floor(std::min((top_[i] - base_[i]) / width, 1e6)) + 1.0;
        count_[i] = static_cast<std::int64_t>(most);
        all *= most;
      }
      width *= 1.5;
    }
    std::size_t whole = 1;
    for (int i = 0; i < dim; ++i)
      whole *= static_cast<std::size_t>(count_[i]);
    begin_.assign(whole + 1, 0);
    for (int round = 0; round < 2; ++round)
    {
      for (const std::int64_t facet : there)
      {
        for_each({tile(low_[facet].data()), tile(high_[facet].data())}, [&](std::size_t number) {
          if (round == 0)
            ++begin_[number + 1];
          else
            facets_[next_[number]++] = facet;
        });
      }
      if (round == 0)
      {
        for (std::size_t number = 0; number < whole; ++number)
          begin_[number + 1] += begin_[number];
        next_.assign(begin_.begin(), begin_.end() - 1);
        facets_.resize(begin_[whole]);
      }
    }
  }

  using Tile = std::array<std::int64_t, dim>;
  using Range = std::pair<Tile, Tile>; // the first and the last, both within

  // The tiles within some distance of a point.
  Range around(const double* x, double distance) const
  {
    Vector low, high;
    for (int i = 0; i < dim; ++i)
    {
      low[i] = x[i] - distance;
      high[i] = x[i] + distance;
    }
    return {tile(low.data()), tile(high.data())};
  }

  // Whether a facet may be within some distance of a point.
  bool reaches(const double* x, double distance) const
  {
    bool within = !begin_.empty();
    for (int i = 0; i < dim; ++i)
      within = within && x[i] >= base_[i] - distance && x[i] <= top_[i] + distance;
    return within;
  }

  // Call f(facet) for the facets of some tiles, for those in several of them several times.
  template <typename F>
  void facets(const Range& range, F&& f) const
  {
    for_each(range, [&](std::size_t number) {
      for (std::size_t k = begin_[number]; k < begin_[number + 1]; ++k)
        f(facets_[k]);
    });
  }

  // The mean size of a facet.
  double size() const { return width_; }

  // How far a point is from the box of a facet.
  double away(const double* x, std::int64_t facet) const
  {
    double sum = 0.0;
    for (int i = 0; i < dim; ++i)
    {
      const double out = std::max({low_[facet][i] - x[i], x[i] - high_[facet][i], 0.0});
      sum += out * out;
    }
    return std::sqrt(sum);
  }

  // Whether the cosine of a normal and that of a facet is above a negative bound anywhere on it, for
  // sure: a facet's normal is a mean of those at its corners, and no shorter than the least of their
  // parts along the one in the middle.
  bool turned_away(std::int64_t facet, const double* n, double bound) const
  {
    for (const Vector& corner : at_corners_[facet])
    {
      double sum = 0.0;
      for (int i = 0; i < dim; ++i)
        sum += corner[i] * n[i];
      if (!(sum > bound + 1e-9))
        return false;
    }
    return true;
  }

  // The normal in the middle of a facet.
  const Vector& normal(std::int64_t facet) const { return normal_[facet]; }

private:
  template <typename F>
  void for_each(const Range& range, F&& f) const
  {
    Tile at = range.first;
    for (bool more = true; more;)
    {
      f(number_of(at));
      more = false;
      for (int i = 0; i < dim && !more; ++i)
      {
        more = at[i] < range.second[i];
        at[i] = more ? at[i] + 1 : range.first[i];
      }
    }
  }

  Tile tile(const double* x) const
  {
    Tile at;
    for (int i = 0; i < dim; ++i)
    {
      const double share = (x[i] - base_[i]) / std::max(top_[i] - base_[i], 1e-300);
      const auto count = static_cast<double>(count_[i]);
      const double place = std::min(std::max(share * count, 0.0), count - 1.0);
      at[i] = static_cast<std::int64_t>(place);
    }
    return at;
  }

  std::size_t number_of(const Tile& at) const
  {
    std::size_t number = 0;
    for (int i = 0; i < dim; ++i)
      number = number * static_cast<std::size_t>(count_[i]) + static_cast<std::size_t>(at[i]);
    return number;
  }

  std::vector<Vector> low_, high_, normal_;
  std::vector<std::array<Vector, dim == 2 ? 1 : 4>> at_corners_; // see turned_away
  Vector base_, top_;
  double width_ = 0.0;
  std::array<std::int64_t, dim> count_{};
  std::vector<std::size_t> begin_, next_;
  std::vector<std::int64_t> facets_;
};

// A place on a facet, within its edges.
template <std::size_t sides>
std::array<double, sides> clamped(const std::array<double, sides>& s, int nodes)
{
  std::array<double, sides> inner;
  double sum = 0.0;
  for (std::size_t e = 0; e < sides; ++e)
    sum += inner[e] = std::min(std::max(s[e], 0.0), 1.0);
  if (nodes == 3 && sum > 1.0)
    for (double& part : inner)
      part /= sum;
  return inner;
}

template <int dim>
bool find_closest_in(const core::Search& search, const core::Found& found)
{
  constexpr int sides = dim - 1;
  const Tiles<dim> tiles(search);
  std::vector<std::pair<double, std::int64_t>> some;
  bool good = true;
  const auto look = [&](std::size_t p, const typename Tiles<dim>::Range& range, double& least,
                        double& nearest) {
    const double* x = search.x + p * dim;
    const auto cosine = [&](const std::array<double, dim>& n) {
      double sum = 0.0;
      for (int i = 0; i < dim; ++i)
        sum += search.normal[p * dim + i] * n[i];
      return sum;
    };
    // No facet is nearer than its box; one that faces the point is not farther than its nodes.
    some.clear();
    double most = INFINITY;
    tiles.facets(range, [&](std::int64_t facet) {
      const double turned = search.normal ? cosine(tiles.normal(facet)) : -1.0;
      if (!(turned < search.may))
        return;
      const double away = tiles.away(x, facet);
      if (!(away <= search.reach && away <= most))
        return;
      if (search.normal && tiles.turned_away(facet, search.normal + p * dim, search.facing))
        return;
      some.emplace_back(away, facet);
      if (turned < search.sure)
      {
        const double* corners = search.corners + facet * search.nodes * dim;
        for (int k = 0; k < search.nodes; ++k)
        {
          double sum = 0.0;
          for (int i = 0; i < dim; ++i)
            sum += (x[i] - corners[k * dim + i]) * (x[i] - corners[k * dim + i]);
          most = std::min(most, std::sqrt(sum) * (1.0 + 1e-9));
        }
      }
    });
    std::sort(some.begin(), some.end());
    std::int64_t before = -1;
    for (const auto& [away, facet] : some)
    {
      if (away > std::min(most, nearest + 1e-9 * search.reach))
        break;
      // (one that is in several tiles comes up several times)
      if (facet == found.facet[p] || facet == before)
        continue;
      before = facet;
      const double* corners = search.corners + facet * search.nodes * dim;
      std::array<double, sides> s;
      good = project<dim>(search, x, corners, s) && good;
      const auto inner = clamped(s, search.nodes);
      const Place<dim> border(corners, search.nodes, inner);
      const auto r = difference<dim>(x, border.x);
      const double far = std::sqrt(dot(r, r));
      if (!(far <= search.reach)
          || (search.normal && !(cosine(border.normal(search.outward[facet])) < search.facing)))
        continue;
      // the nearest, and among equals that with the lowest number
      const double rank = std::nearbyint(far / search.reach * 1e12);
      if (rank > least || (rank == least && facet > found.facet[p]))
        continue;
      least = rank;
      nearest = far;
      const Place<dim> foot(corners, search.nodes, s);
      const double gap = dot(difference<dim>(x, foot.x), foot.normal(search.outward[facet]));
      // A point behind the end of an open surface, or beside an edge, touches nothing; nor does one
      // beside the edge of a thin body that faces its far side.
      double size = 0.0, over = 0.0;
      for (int e = 0; e < sides; ++e)
      {
        size = std::max(size, dot(foot.A[e], foot.A[e]));
        over = std::max(over, std::abs(s[e] - inner[e]));
        found.place[p * sides + e] = s[e];
      }
      size = std::sqrt(size);
      over *= size;
      const double depth = std::abs(gap);
      const bool off = gap < 0.0 && over > std::max(1e-9 * size, 0.2 * std::min(depth, 0.1 * size))
                       && (far > 2.0 * depth + 1e-12 * size || gap < -0.5 * size);
      found.facet[p] = facet;
      found.gap[p] = gap;
      found.near[p] = !off;
      found.beside[p] = over / size;
    }
  };
  for (std::size_t p = 0; p < search.points; ++p)
  {
    found.facet[p] = -1;
    found.gap[p] = INFINITY;
    found.near[p] = 0;
    found.beside[p] = 0.0;
    std::fill_n(found.place + p * sides, sides, 0.0);
    const double* x = search.x + p * dim;
    if (!tiles.reaches(x, search.reach))
      continue;
    double least = INFINITY, nearest = INFINITY;
    auto range = tiles.around(x, 0.0);
    for (double within = 0.0;;)
    {
      look(p, range, least, nearest);
      // farther, as far as one may be that is nearer than what has been found
      typename Tiles<dim>::Range wider = range;
      bool found_all = false;
      while (!found_all && wider == range)
      {
        const bool seen = nearest < INFINITY;
        const double needed = seen ? nearest + 1e-9 * search.reach : 2.0 * within + tiles.size();
        found_all = within >= std::min(seen ? needed : INFINITY, search.reach);
        within = std::min(needed, search.reach);
        wider = tiles.around(x, within);
      }
      if (found_all)
        break;
      range = wider;
    }
  }
  return good;
}
} // namespace

HOT_LOOP bool core::find_closest(const Search& search, int dim, const Found& found)
{
  return dim == 2 ? find_closest_in<2>(search, found) : find_closest_in<3>(search, found);
}

HOT_LOOP void core::act(const Meeting& meeting, int dim, const Met& result)
{
  if (dim == 2 && meeting.nodes == 2)
    act_in<2, 0>(meeting, result);
  else if (dim == 2)
    act_in<2, 1>(meeting, result);
  else if (meeting.nodes == 3)
    act_in<3, 0>(meeting, result);
  else if (meeting.nodes == 4)
    act_in<3, 1>(meeting, result);
  else
    act_in<3, 3>(meeting, result);
}

HOT_LOOP void core::add_tangents(const Meeting& meeting, int dim, const Sums& sums)
{
  if (dim == 2 && meeting.nodes == 2)
    add_tangents_in<2, 0>(meeting, sums);
  else if (dim == 2)
    add_tangents_in<2, 1>(meeting, sums);
  else if (meeting.nodes == 3)
    add_tangents_in<3, 0>(meeting, sums);
  else if (meeting.nodes == 4)
    add_tangents_in<3, 1>(meeting, sums);
  else
    add_tangents_in<3, 3>(meeting, sums);
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
