// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// The closest facet of points, among those whose boxes are in the tiles of a grid near them. (Nothing
// here is long enough for wider vectors: compiled for them too, it takes compilers three times as
// long and runs no faster.)

#include "closest.h"
#include "dual.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <type_traits>
#include <utility>
#include <vector>

namespace
{
using core::dot;
using core::solved;

constexpr int most_degree = 7;

// Call f(number, a, b) for the powers of monomials.
template <int dim, typename F>
void for_monomials(const core::Shape& shape, F&& f)
{
  int number = 0;
  for (int a = 0; a <= shape.degree; ++a)
    for (int b = 0; b <= (dim == 2 ? 0 : shape.simplex ? shape.degree - a : shape.degree); ++b)
      f(number++, a, b);
}

// The factors of monomials, (count, dim), of facets by their nodes.
template <int dim>
void expand(const core::Shape& shape, const double* corners, double* factors)
{
  for (int m = 0; m < shape.count; ++m)
    for (int i = 0; i < dim; ++i)
    {
      double sum = 0.0;
      for (int k = 0; k < shape.nodes; ++k)
        sum += shape.coefficients[m * shape.nodes + k] * corners[k * dim + i];
      factors[m * dim + i] = sum;
    }
}

// The powers of a coordinate, and their first and second derivatives.
struct Powers
{
  std::array<double, most_degree + 1> of, first, second;

  Powers(double s, int degree)
  {
    of[0] = 1.0;
    first[0] = second[0] = 0.0;
    for (int k = 1; k <= degree; ++k)
    {
      of[k] = of[k - 1] * s;
      first[k] = k * of[k - 1];
      second[k] = k * first[k - 1];
    }
  }
};

// A facet at a place: the point there, its slopes, and where asked for its second derivatives.
template <int dim>
struct Place
{
  static constexpr int sides = dim - 1;
  using Vector = std::array<double, dim>;
  Vector x{};
  std::array<Vector, sides> A{};
  std::array<std::array<Vector, sides>, sides> B{};

  Place(const core::Shape& shape, const double* factors, const std::array<double, sides>& s,
        bool bends = false)
  {
    if (shape.degree == 1)
    {
      of_degree_1(shape, factors, s);
      return;
    }
    const Powers one(s[0], shape.degree), two(s[sides - 1], dim == 2 ? 0 : shape.degree);
    for_monomials<dim>(shape, [&](int m, int a, int b) {
      const double* by = factors + m * dim;
      const auto add = [&](Vector& to, double factor) {
        for (int i = 0; i < dim; ++i)
          to[i] += factor * by[i];
      };
      add(x, one.of[a] * two.of[b]);
      add(A[0], one.first[a] * two.of[b]);
      if constexpr (dim == 3)
        add(A[1], one.of[a] * two.first[b]);
      if (!bends)
        return;
      add(B[0][0], one.second[a] * two.of[b]);
      if constexpr (dim == 3)
      {
        add(B[0][1], one.first[a] * two.first[b]);
        add(B[1][1], one.of[a] * two.second[b]);
      }
    });
    if constexpr (dim == 3)
      B[1][0] = B[0][1];
  }

  // The same, faster.
  void of_degree_1(const core::Shape& shape, const double* factors,
                   const std::array<double, sides>& s)
  {
    for (int i = 0; i < dim; ++i)
    {
      A[0][i] = factors[sides * dim + i];
      if constexpr (dim == 3)
      {
        A[1][i] = factors[dim + i];
        if (!shape.simplex)
        {
          B[0][1][i] = B[1][0][i] = factors[3 * dim + i];
          A[0][i] += B[0][1][i] * s[1];
          A[1][i] += B[0][1][i] * s[0];
        }
      }
      x[i] = factors[i] + factors[sides * dim + i] * s[0];
      if constexpr (dim == 3)
        x[i] += A[1][i] * s[1];
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

template <int dim>
std::array<double, dim - 1> middle_of(const core::Shape& shape)
{
  std::array<double, dim - 1> s;
  s.fill(dim == 3 && shape.simplex ? 1.0 / 3.0 : 0.5);
  return s;
}

// Project a point on a facet, by Newton's method from a place; false where the facet has no area.
template <int dim>
bool project_on(const core::Shape& shape, const double* x, const double* factors,
                std::array<double, dim - 1>& s)
{
  constexpr int sides = dim - 1;
  using Matrix = std::array<std::array<double, sides>, sides>;
  const bool flat = shape.nodes == dim;
  const auto determinant = [](const Matrix& G) {
    if constexpr (sides == 1)
      return G[0][0];
    else
      return G[0][0] * G[1][1] - G[0][1] * G[1][0];
  };
  for (int step = 0; step < shape.most; ++step)
  {
    const Place<dim> at(shape, factors, s, !flat);
    const auto r = difference<dim>(x, at.x);
    Matrix G, bent;
    std::array<double, sides> along;
    for (int e = 0; e < sides; ++e)
    {
      along[e] = dot(at.A[e], r);
      for (int f = 0; f < sides; ++f)
      {
        G[e][f] = dot(at.A[e], at.A[f]);
        bent[e][f] = G[e][f] - dot(at.B[e][f], r);
      }
    }
    // where a curved facet bends towards the point too much, its plane has to do
    const double det = determinant(G);
    if (determinant(bent) > 0.1 * det)
      G = bent;
    if (!(determinant(G) > 0.0))
      return false;
    const auto change = solved(G, along);
    double size = 0.0;
    for (int e = 0; e < sides; ++e)
    {
      const double moved = flat ? change[e] : std::min(std::max(change[e], -1.0), 1.0);
      size = std::max(size, std::abs(moved));
      s[e] = std::min(std::max(s[e] + moved, -3.0), 4.0);
    }
    if (flat || !(size > shape.close))
      break;
  }
  return true;
}

template <int dim>
bool project_in(std::size_t points, const core::Shape& shape, const double* x,
                const double* corners, double* place)
{
  std::vector<double> factors(shape.count * dim);
  std::array<double, dim - 1> s;
  bool good = true;
  for (std::size_t p = 0; p < points; ++p)
  {
    expand<dim>(shape, corners + p * shape.nodes * dim, factors.data());
    std::copy_n(place + p * (dim - 1), dim - 1, s.begin());
    good = project_on<dim>(shape, x + p * dim, factors.data(), s) && good;
    std::copy_n(s.begin(), dim - 1, place + p * (dim - 1));
  }
  return good;
}

// Boxes of facets in the tiles of a grid.
template <int dim>
class Tiles
{
public:
  using Vector = std::array<double, dim>;

  explicit Tiles(const core::Search& search)
      : low_(search.facets), high_(search.facets), normal_(search.facets),
        at_corners_(search.facets), step_(search.shape.count * dim),
        factors_(search.facets * search.shape.count * dim)
  {
    const core::Shape& shape = search.shape;
    const bool curved = shape.degree > 1;
    base_.fill(INFINITY);
    top_.fill(-INFINITY);
    std::vector<std::int64_t> there;
    for (std::size_t facet = 0; facet < search.facets; ++facet)
    {
      const double* corners = search.corners + facet * shape.nodes * dim;
      Vector &low = low_[facet], &high = high_[facet];
      bool finite = search.present[facet] != 0;
      for (int i = 0; i < dim; ++i)
      {
        low[i] = high[i] = corners[i];
        for (int k = 0; k < shape.nodes; ++k)
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
      if (curved) // which goes beyond its nodes
        for (int i = 0; i < dim; ++i)
        {
          const double more = 0.5 * (high[i] - low[i]);
          low[i] -= more;
          high[i] += more;
        }
      double* factors = factors_.data() + facet * step_;
      expand<dim>(shape, corners, factors);
      const Place<dim> middle(shape, factors, middle_of<dim>(shape));
      normal_[facet] = middle.normal(search.outward[facet]);
      // (a curved one may face anything)
      at_corners_[facet].fill(curved ? Vector{NAN} : normal_[facet]);
      if constexpr (dim == 3)
        if (shape.nodes == 4)
        {
          double least = INFINITY;
          for (int k = 0; k < 4; ++k)
          {
            const Place<dim> at(shape, factors,
                                {static_cast<double>(k % 2), static_cast<double>(k / 2)});
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

  // The factors of monomials of a facet.
  const double* factors(std::int64_t facet) const { return factors_.data() + facet * step_; }

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
  std::size_t step_;
  std::vector<double> factors_;
  Vector base_, top_;
  double width_ = 0.0;
  std::array<std::int64_t, dim> count_{};
  std::vector<std::size_t> begin_, next_;
  std::vector<std::int64_t> facets_;
};

// A place on a facet, within its edges.
template <std::size_t sides>
std::array<double, sides> clamped(const std::array<double, sides>& s, bool simplex)
{
  std::array<double, sides> inner;
  double sum = 0.0;
  for (std::size_t e = 0; e < sides; ++e)
    sum += inner[e] = std::min(std::max(s[e], 0.0), 1.0);
  if (sides == 2 && simplex && sum > 1.0)
    for (double& part : inner)
      part /= sum;
  return inner;
}

template <int dim>
bool find_closest_in(const core::Search& search, const core::Found& found)
{
  constexpr int sides = dim - 1;
  const core::Shape& shape = search.shape;
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
        const double* corners = search.corners + facet * shape.nodes * dim;
        for (int k = 0; k < shape.nodes; ++k)
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
      const double* factors = tiles.factors(facet);
      auto s = middle_of<dim>(shape);
      good = project_on<dim>(shape, x, factors, s) && good;
      const auto inner = clamped(s, shape.simplex);
      const Place<dim> border(shape, factors, inner);
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
      const Place<dim> foot(shape, factors, s);
      const double gap = dot(difference<dim>(x, foot.x), foot.normal(search.outward[facet]));
      // A point beside the end of an open surface, or beside an edge, touches nothing, behind the
      // plane of the facet nor at a gap; nor does one beside the edge of a thin body that faces its
      // far side.
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
      const bool off = over > std::max(1e-9 * size, 0.2 * std::min(depth, 0.1 * size))
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

void core::tabulate(std::size_t points, int dim, const Shape& shape, const double* place,
                    const Tables& tables)
{
  const int sides = dim - 1, nodes = shape.nodes;
  const auto work = [&](auto constant) {
    constexpr int space = decltype(constant)::value;
    std::fill_n(tables.shape, points * nodes, 0.0);
    std::fill_n(tables.slope, points * sides * nodes, 0.0);
    std::fill_n(tables.bend, points * sides * sides * nodes, 0.0);
    for (std::size_t p = 0; p < points; ++p)
    {
      const double* s = place + p * sides;
      const Powers one(s[0], shape.degree), two(s[sides - 1], space == 2 ? 0 : shape.degree);
      double* N = tables.shape + p * nodes;
      double* dN = tables.slope + p * sides * nodes;
      double* ddN = tables.bend + p * sides * sides * nodes;
      for_monomials<space>(shape, [&](int m, int a, int b) {
        const double* by = shape.coefficients + m * nodes;
        const auto add = [&](double* to, double factor) {
          for (int k = 0; k < nodes; ++k)
            to[k] += factor * by[k];
        };
        add(N, one.of[a] * two.of[b]);
        add(dN, one.first[a] * two.of[b]);
        if constexpr (space == 3)
          add(dN + nodes, one.of[a] * two.first[b]);
        if (shape.nodes == space)
          return;
        add(ddN, one.second[a] * two.of[b]);
        if constexpr (space == 3)
        {
          add(ddN + nodes, one.first[a] * two.first[b]);
          add(ddN + 2 * nodes, one.first[a] * two.first[b]);
          add(ddN + 3 * nodes, one.of[a] * two.second[b]);
        }
      });
    }
  };
  if (dim == 2)
    work(std::integral_constant<int, 2>{});
  else
    work(std::integral_constant<int, 3>{});
}

bool core::project(std::size_t points, int dim, const Shape& shape, const double* x,
                   const double* corners, double* place)
{
  return dim == 2 ? project_in<2>(points, shape, x, corners, place)
                  : project_in<3>(points, shape, x, corners, place);
}

bool core::find_closest(const Search& search, int dim, const Found& found)
{
  return dim == 2 ? find_closest_in<2>(search, found) : find_closest_in<3>(search, found);
}
