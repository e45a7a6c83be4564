// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Loops over domains: gradients, forces, and T^T K T domain by domain.

#include "domains.h"
#include "hot_loop.h"

#include <algorithm>
#include <cmath>
#include <type_traits>

namespace
{
using core::Domains;
using core::Groups;
using core::Rows;
using core::Support;
using core::Target;

// Call f with the dimension as a constant.
template <typename F>
void with_dimension(int dim, F&& f)
{
  if (dim == 2)
    f(std::integral_constant<int, 2>());
  else
    f(std::integral_constant<int, 3>());
}

// Call f(group, domain) group by group.
template <typename F>
void for_each_domain(const Groups& groups, F&& f)
{
  for (std::size_t g = 0; g < groups.count; ++g)
    for (std::int64_t n = groups.first[g]; n < groups.first[g + 1]; ++n)
      f(g, static_cast<std::size_t>(groups.order[n]));
}

// Call f(domain) for the domains of a group.
template <typename F>
void for_each_domain_of(const Groups& groups, std::size_t g, F&& f)
{
  for (std::int64_t n = groups.first[g]; n < groups.first[g + 1]; ++n)
    f(static_cast<std::size_t>(groups.order[n]));
}

// The number of nodes that a domain sees.
inline std::size_t size_of(const Support& support, std::size_t p)
{
  return static_cast<std::size_t>(support.offsets[p + 1] - support.offsets[p]);
}

// The number of nodes that a group sees.
inline std::size_t width_of(const Support& support, std::size_t g)
{
  return static_cast<std::size_t>(support.ends[g + 1] - support.ends[g]);
}

// Where a node stands among those that a domain of a group sees.
inline std::size_t place_of(const Support& support, std::size_t g, std::size_t p, std::int32_t node)
{
  const std::int32_t* nodes = support.nodes + support.ends[g];
  const std::uint16_t* begin = support.slots + support.offsets[p];
  return static_cast<std::size_t>(
      std::lower_bound(begin, support.slots + support.offsets[p + 1], node,
                       [&](std::uint16_t slot, std::int32_t other) { return nodes[slot] < other; })
      - begin);
}

// The lines of a block as the processor adds them up: of two, and of three with one to spare.
template <int dim>
struct Line
{
  static constexpr int length = dim == 2 ? 2 : 4;
  typedef double type __attribute__((vector_size(8 * length), aligned(8), may_alias));
};

// A tangent A_iJjL at a point, times a factor, whose blocks gradient_J A_iJjL gradient_L are made
// line by line, over j.
template <int dim>
class PointTangent
{
public:
  using V = typename Line<dim>::type;

  PointTangent(const double* A, double factor)
  {
    for (int J = 0; J < dim; ++J)
      for (int i = 0; i < dim; ++i)
        for (int L = 0; L < dim; ++L)
        {
          double line[Line<dim>::length] = {};
          for (int j = 0; j < dim; ++j)
            line[j] = factor * A[((i * dim + J) * dim + j) * dim + L];
          lines_[J][i][L] = *reinterpret_cast<const V*>(line);
        }
  }

  // Take the first gradient.
  void contract(const double* gradient)
  {
    for (int i = 0; i < dim; ++i)
      for (int L = 0; L < dim; ++L)
      {
        left_[i][L] = gradient[0] * lines_[0][i][L];
        for (int J = 1; J < dim; ++J)
          left_[i][L] += gradient[J] * lines_[J][i][L];
      }
  }

  // A line of the block with this gradient as the second.
  V line(int i, const double* gradient) const
  {
    V sum = gradient[0] * left_[i][0];
    for (int L = 1; L < dim; ++L)
      sum += gradient[L] * left_[i][L];
    return sum;
  }

private:
  V lines_[dim][dim][dim], left_[dim][dim];
};

// The blocks of a tangent (3, 3, 3, 3) of a body of revolution: in the plane, and with the hoop.
struct Revolution
{
  double plane[16], plane_hoop[4], hoop_plane[4], hoop;

  explicit Revolution(const double* A)
  {
    for (int i = 0; i < 2; ++i)
      for (int J = 0; J < 2; ++J)
      {
        const double* row = A + (i * 3 + J) * 9;
        for (int k = 0; k < 2; ++k)
          for (int L = 0; L < 2; ++L)
            plane[((i * 2 + J) * 2 + k) * 2 + L] = row[k * 3 + L];
        plane_hoop[i * 2 + J] = row[8];
        hoop_plane[i * 2 + J] = A[8 * 9 + i * 3 + J];
      }
    hoop = A[80];
  }

  // Add what hoop strains have to the tangent K of a domain at one point.
  void add(const double* gradients, const double* h, double weight, int nodes, double* K) const
  {
    const int width = 2 * nodes;
    for (int c = 0; c < nodes; ++c)
      for (int e = 0; e < nodes; ++e)
        for (int i = 0; i < 2; ++i)
        {
          double left = 0.0, right = 0.0;
          for (int J = 0; J < 2; ++J)
          {
            left += gradients[c * 2 + J] * plane_hoop[i * 2 + J];
            right += hoop_plane[i * 2 + J] * gradients[e * 2 + J];
          }
          K[(2 * c + i) * width + 2 * e] += weight * left * h[e];
          K[2 * c * width + 2 * e + i] += weight * h[c] * right;
          if (i == 0)
            K[2 * c * width + 2 * e] += weight * h[c] * hoop * h[e];
        }
  }
};

// Add a block, whose lines follow each other at a stride, to that between two nodes: in the rows of
// the first at a position, with a mask of the dofs of the second that have numbers.
template <int height, int width, int stride>
inline void add_block(const Target& target, std::int32_t node, std::int32_t position,
                      std::uint8_t mask, const double* block)
{
  const std::int32_t place = target.places[target.rows[node] + position];
  double* values = target.values[place & 3] + (place >> 2);
  const std::int64_t* starts = target.starts + node * height * 2 + (place & 1);
  for (int i = 0; i < height; ++i)
  {
    if (starts[2 * i] < 0)
      continue;
    double* out = values + starts[2 * i];
    if (mask == (1 << width) - 1)
      for (int j = 0; j < width; ++j)
        out[j] += block[i * stride + j];
    else
      for (int j = 0; j < width; ++j)
        if (mask >> j & 1)
          *out++ += block[i * stride + j];
  }
}

// The tangents of the domains of one group: blocks between its nodes, with lines at a stride.
template <int height, int width, int stride = width>
class GroupBlocks
{
public:
  static constexpr int size = height * stride;

  explicit GroupBlocks(const Target& target) : target_(target) {}

  void begin(std::size_t group)
  {
    group_ = group;
    rows_ = width_of(target_.row, group);
    columns_ = width_of(target_.column, group);
    blocks_.assign(rows_ * columns_ * size, 0.0);
  }

  double* operator()(std::size_t row, std::size_t column)
  {
    return blocks_.data() + (row * columns_ + column) * size;
  }

  // Call f(node, node, position, block) for the blocks that domains have.
  template <typename F>
  void for_each(F&& f)
  {
    const std::int32_t *nodes = target_.row.nodes + target_.row.ends[group_],
                       *others = target_.column.nodes + target_.column.ends[group_];
    const std::int32_t none = target_.positions.none();
    std::size_t pair = target_.pairs[group_];
    const double* block = blocks_.data();
    for (std::size_t a = 0; a < rows_; ++a)
      for (std::size_t b = 0; b < columns_; ++b, ++pair, block += size)
        if (const std::int32_t position = target_.positions[pair]; position != none)
          f(nodes[a], others[b], position, block);
  }

  // Add the blocks where they go.
  void end()
  {
    for_each([&](std::int32_t node, std::int32_t other, std::int32_t position, const double* block) {
      add_block<height, width, stride>(target_, node, position, target_.masks[other], block);
    });
  }

  // Make blocks below the diagonal of those above it.
  void mirror()
  {
    for (std::size_t a = 0; a < rows_; ++a)
      for (std::size_t b = 0; b < a; ++b)
        for (int i = 0; i < height; ++i)
          for (int j = 0; j < width; ++j)
            (*this)(a, b)[i * stride + j] = (*this)(b, a)[j * stride + i];
  }

private:
  const Target& target_;
  std::size_t group_ = 0, rows_ = 0, columns_ = 0;
  std::vector<double> blocks_;
};

// The gradients of the background basis that the single points of a group's domains see: made for
// the whole group, as rows of T are far from each other in memory and are fetched ahead this way.
template <int dim>
class BackgroundGradients
{
public:
  static constexpr int stride = Line<dim>::length;

  BackgroundGradients(const Domains& domains, const Rows& rows, const Groups& groups,
                      const Support& support)
      : domains_(domains), rows_(rows), groups_(groups), support_(support), place_(rows.num_nodes)
  {
  }

  void begin(std::size_t group)
  {
    using V = typename Line<dim>::type;
    std::size_t size = 0;
    for_each_domain_of(groups_, group, [&](std::size_t p) { size += size_of(support_, p); });
    sums_.assign(size * stride, 0.0);
    next_ = sums_.data();
    const std::int32_t* nodes = support_.nodes + support_.ends[group];
    std::uint16_t* const place = place_.data();
    double* out = sums_.data();
    for_each_domain_of(groups_, group, [&](std::size_t p) {
      const std::uint16_t* slots = support_.slots + support_.offsets[p];
      const std::size_t its = size_of(support_, p);
      for (std::size_t a = 0; a < its; ++a)
        place[nodes[slots[a]]] = static_cast<std::uint16_t>(a);
      for (int c = 0; c < domains_.nodes; ++c)
      {
        V gradient = {};
        for (int J = 0; J < dim; ++J)
          gradient[J] = domains_.gradients[(p * domains_.nodes + c) * dim + J];
        const std::int32_t row = domains_.dofmap[p * domains_.nodes + c];
        const std::int64_t end = rows_.offsets[row + 1];
        for (std::int64_t e = rows_.offsets[row]; e < end; ++e)
          *reinterpret_cast<V*>(out + place[rows_.nodes[e]] * stride) += rows_.values[e] * gradient;
      }
      out += its * stride;
    });
  }

  // Those of the group's next domain, one for each node that it sees, at a stride.
  const double* next(std::size_t p)
  {
    const double* its = next_;
    next_ += size_of(support_, p) * stride;
    return its;
  }

private:
  const Domains& domains_;
  const Rows& rows_;
  const Groups& groups_;
  const Support& support_;
  std::vector<std::uint16_t> place_; // of nodes among those that a domain sees
  std::vector<double> sums_;
  const double* next_ = nullptr;
};

// Room for the products of one domain.
struct Work
{
  std::vector<double> blocks, line, weights;
  std::vector<int> places, ends;
};

// Call f(a, line) with the rows of blocks of T^T K T of one domain, between the nodes that it sees; K
// is (nodes dim, nodes dim). T is sparse: zeros are passed over.
template <int dim, typename F>
void for_each_row(const double* K, int nodes, const double* transfer, std::size_t size, Work& work,
                  F&& f)
{
  constexpr int block = dim * dim;
  const int width = nodes * dim, column = nodes * block;
  const std::size_t length = size * block;
  work.blocks.resize((nodes + 1) * column + nodes * length);
  work.line.resize(length);
  work.weights.resize(size * nodes + 1);
  work.places.resize(size * nodes + 1);
  work.ends.resize(size);
  double* columns = work.blocks.data(); // K in blocks, column by column
  double* out = columns + nodes * column;
  double* right = out + column; // K T in blocks, row by row
  for (int c = 0; c < nodes; ++c)
    for (int i = 0; i < dim; ++i)
      for (int e = 0; e < nodes; ++e)
        for (int j = 0; j < dim; ++j)
          columns[e * column + c * block + i * dim + j] = K[(c * dim + i) * width + e * dim + j];
  int end = 0;
  for (std::size_t b = 0; b < size; ++b)
  {
    std::fill(out, out + column, 0.0);
    const int start = end;
    for (int e = 0; e < nodes; ++e)
    {
      work.weights[end] = transfer[b * nodes + e];
      work.places[end] = e;
      end += transfer[b * nodes + e] != 0.0;
    }
    work.ends[b] = end;
    for (int n = start; n < end; ++n)
      for (int k = 0; k < column; ++k)
        out[k] += work.weights[n] * columns[work.places[n] * column + k];
    for (int c = 0; c < nodes; ++c)
      for (int k = 0; k < block; ++k)
        right[c * length + b * block + k] = out[c * block + k];
  }
  double* line = work.line.data();
  for (std::size_t a = 0; a < size; ++a)
  {
    std::fill(line, line + length, 0.0);
    for (int n = a == 0 ? 0 : work.ends[a - 1]; n < work.ends[a]; ++n)
    {
      const double weight = work.weights[n];
      const double* row = right + work.places[n] * length;
      for (std::size_t k = 0; k < length; ++k)
        line[k] += weight * row[k];
    }
    f(a, line);
  }
}

// Add a row of blocks of a domain where it goes.
template <int dim>
void add_row(const Target& target, std::size_t g, std::size_t p, std::size_t a, const double* line)
{
  const Support& support = target.row;
  const std::int32_t* nodes = support.nodes + support.ends[g];
  const std::uint16_t* slots = support.slots + support.offsets[p];
  const std::size_t pair = target.pairs[g] + slots[a] * width_of(support, g);
  for (std::size_t b = 0; b < size_of(support, p); ++b)
    add_block<dim, dim, dim>(target, nodes[slots[a]], target.positions[pair + slots[b]],
                             target.masks[nodes[slots[b]]], line + b * dim * dim);
}

// Set strains (nodes, dim) to w S : G at one point, with the hoop's part where there is one.
template <int dim>
inline void point_strains(const Domains& domains, const double* slope, std::size_t point,
                          double* strains)
{
  const int strain = domains.strain();
  const double* S = slope + point * strain * strain;
  const double* gradients = domains.gradients + point * domains.nodes * dim;
  for (int c = 0; c < domains.nodes; ++c)
    for (int i = 0; i < dim; ++i)
    {
      double sum = 0.0;
      for (int J = 0; J < dim; ++J)
        sum += S[i * strain + J] * gradients[c * dim + J];
      if (domains.hoop != nullptr && i == 0)
        sum += S[8] * domains.hoop[point * domains.nodes + c];
      strains[c * dim + i] = domains.weights[point] * sum;
    }
}
} // namespace

void core::displacement_gradient(const Domains& domains, const double* u, double* H)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    for (std::size_t p = 0; p < domains.count; ++p)
    {
      const std::int32_t* nodes = domains.dofmap + p * domains.nodes;
      for (int q = 0; q < domains.points; ++q)
      {
        const double* gradients =
            domains.gradients + (p * domains.points + q) * domains.nodes * dim;
        double sum[dim * dim] = {};
        for (int c = 0; c < domains.nodes; ++c)
          for (int i = 0; i < dim; ++i)
            for (int j = 0; j < dim; ++j)
              sum[i * dim + j] += u[nodes[c] * dim + i] * gradients[c * dim + j];
        std::copy(sum, sum + dim * dim, H + (p * domains.points + q) * dim * dim);
      }
    }
  });
}

void core::internal_force(const Domains& domains, const double* P, double* force)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    const int strain = domains.strain();
    for (std::size_t p = 0; p < domains.count; ++p)
    {
      const std::int32_t* nodes = domains.dofmap + p * domains.nodes;
      for (int q = 0; q < domains.points; ++q)
      {
        const std::size_t point = p * domains.points + q;
        const double* gradients = domains.gradients + point * domains.nodes * dim;
        const double* stress = P + point * strain * strain;
        for (int c = 0; c < domains.nodes; ++c)
          for (int i = 0; i < dim; ++i)
          {
            double sum = 0.0;
            for (int J = 0; J < dim; ++J)
              sum += stress[i * strain + J] * gradients[c * dim + J];
            if (domains.hoop != nullptr && i == 0)
              sum += stress[8] * domains.hoop[point * domains.nodes + c];
            force[nodes[c] * dim + i] += domains.weights[point] * sum;
          }
      }
    }
  });
}

namespace
{
// Call f(node) for the background nodes of a domain, as often as its own nodes have them.
template <typename F>
void for_each_node(const core::Dofmap& dofmap, const Rows& rows, std::size_t p, F&& f)
{
  for (int c = 0; c < dofmap.nodes; ++c)
  {
    const std::int32_t row = dofmap.values[p * dofmap.nodes + c];
    for (std::int64_t e = rows.offsets[row]; e < rows.offsets[row + 1]; ++e)
      f(rows.nodes[e]);
  }
}

// Where groups begin that see at most so many nodes, and no more pairs of nodes than their domains
// do one by one; other domains are alone.
std::vector<std::int64_t> make_groups(const core::Dofmap& dofmap, const Rows& rows,
                                      const std::int32_t* order, std::size_t most)
{
  const auto count = static_cast<std::int64_t>(dofmap.count);
  std::vector<std::int64_t> first(1, 0);
  std::vector<std::int64_t> group(rows.num_nodes, -1), domain(rows.num_nodes, -1); // seen by last
  std::int64_t number = 0;
  std::size_t nodes = 0, pairs = 0;
  const auto close = [&](std::int64_t end) {
    if (nodes * nodes > pairs)
      for (std::int64_t n = first.back() + 1; n < end; ++n)
        first.push_back(n);
    first.push_back(end);
    nodes = pairs = 0;
    ++number;
  };
  for (std::int64_t n = 0; n < count; ++n)
  {
    std::size_t size = 0, more = 0;
    for_each_node(dofmap, rows, order[n], [&](std::int32_t node) {
      size += domain[node] != n;
      more += domain[node] != n && group[node] != number;
      domain[node] = n;
    });
    if (nodes > 0 && nodes + more > most)
    {
      close(n);
      more = size;
    }
    for_each_node(dofmap, rows, order[n], [&](std::int32_t node) { group[node] = number; });
    nodes += more;
    pairs += size * size;
  }
  if (count > 0)
    close(count);
  return first;
}
} // namespace

core::Supports core::supports(const Dofmap& dofmap, const Rows& rows, const std::int32_t* order,
                              std::vector<std::int64_t> first, std::size_t most)
{
  const auto count = static_cast<std::int32_t>(dofmap.count);
  Supports result;
  result.first = first.empty() ? make_groups(dofmap, rows, order, most) : std::move(first);
  result.offsets.assign(dofmap.count + 1, 0);
  result.ends.assign(1, 0);
  const Groups groups{result.first.size() - 1, result.first.data(), order};
  std::vector<std::int32_t> seen(rows.num_nodes, -1); // the group or domain that has seen a node last
  for (std::size_t g = 0; g < groups.count; ++g)
  {
    for_each_domain_of(groups, g, [&](std::size_t p) {
      for_each_node(dofmap, rows, p, [&](std::int32_t node) {
        if (seen[node] != static_cast<std::int32_t>(g))
          result.nodes.push_back(node);
        seen[node] = static_cast<std::int32_t>(g);
      });
    });
    std::sort(result.nodes.begin() + result.ends.back(), result.nodes.end());
    result.ends.push_back(static_cast<std::int64_t>(result.nodes.size()));
  }

  // The slots of domains.
  std::fill(seen.begin(), seen.end(), -1);
  for (std::int32_t p = 0; p < count; ++p)
  {
    result.offsets[p + 1] = result.offsets[p];
    for_each_node(dofmap, rows, p, [&](std::int32_t node) {
      result.offsets[p + 1] += seen[node] != p;
      seen[node] = p;
    });
  }
  result.slots.resize(result.offsets.back());
  std::fill(seen.begin(), seen.end(), -1);
  std::vector<std::uint16_t> slot(rows.num_nodes);
  for (std::size_t g = 0; g < groups.count; ++g)
  {
    for (std::int64_t e = result.ends[g]; e < result.ends[g + 1]; ++e)
      slot[result.nodes[e]] = static_cast<std::uint16_t>(e - result.ends[g]);
    for_each_domain_of(groups, g, [&](std::size_t p) {
      std::uint16_t* const out = result.slots.data() + result.offsets[p];
      std::uint16_t* last = out;
      for_each_node(dofmap, rows, p, [&](std::int32_t node) {
        if (seen[node] != static_cast<std::int32_t>(p))
          *last++ = slot[node];
        seen[node] = static_cast<std::int32_t>(p);
      });
      std::sort(out, last);
    });
  }
  return result;
}

void core::local_transfers(const Dofmap& dofmap, const Rows& rows, const Groups& groups,
                           const Support& support, double* transfers)
{
  std::fill(transfers, transfers + support.offsets[dofmap.count] * dofmap.nodes, 0.0);
  for_each_domain(groups, [&](std::size_t g, std::size_t p) {
    double* transfer = transfers + support.offsets[p] * dofmap.nodes;
    for (int c = 0; c < dofmap.nodes; ++c)
    {
      const std::int32_t row = dofmap.values[p * dofmap.nodes + c];
      for (std::int64_t e = rows.offsets[row]; e < rows.offsets[row + 1]; ++e)
        transfer[place_of(support, g, p, rows.nodes[e]) * dofmap.nodes + c] = rows.values[e];
    }
  });
}

std::vector<std::uint8_t> core::seen_pairs(const Groups& groups, const Support& rows,
                                           const Support& columns)
{
  std::vector<std::int64_t> begin(1, 0);
  for (std::size_t g = 0; g < groups.count; ++g)
    begin.push_back(begin.back() + width_of(rows, g) * width_of(columns, g));
  std::vector<std::uint8_t> result(begin.back(), 0);
  for_each_domain(groups, [&](std::size_t g, std::size_t p) {
    const std::size_t width = width_of(columns, g);
    for (std::int64_t a = rows.offsets[p]; a < rows.offsets[p + 1]; ++a)
      for (std::int64_t b = columns.offsets[p]; b < columns.offsets[p + 1]; ++b)
        result[begin[g] + rows.slots[a] * width + columns.slots[b]] = 1;
  });
  return result;
}

void core::support_gradients(const Domains& domains, const Rows& rows, const Groups& groups,
                             const Support& support, double* gradients)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    BackgroundGradients<dim> made(domains, rows, groups, support);
    for (std::size_t g = 0; g < groups.count; ++g)
    {
      made.begin(g);
      for_each_domain_of(groups, g, [&](std::size_t p) {
        std::copy_n(made.next(p), size_of(support, p) * made.stride,
                    gradients + support.offsets[p] * made.stride);
      });
    }
  });
}

HOT_LOOP void core::assemble_points(const Domains& domains, const Rows& rows,
                                    const double* support_gradients, const double* A,
                                    bool symmetric, const Target& target)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    constexpr int stride = Line<dim>::length;
    const Support& support = target.row;
    GroupBlocks<dim, dim, stride> blocks(target);
    BackgroundGradients<dim> made(domains, rows, target.groups, support);
    for (std::size_t g = 0; g < target.groups.count; ++g)
    {
      blocks.begin(g);
      if (support_gradients == nullptr)
        made.begin(g);
      for_each_domain_of(target.groups, g, [&](std::size_t p) {
        PointTangent<dim> tangent(A + p * dim * dim * dim * dim, domains.weights[p]);
        const std::size_t size = size_of(support, p);
        const std::uint16_t* slots = support.slots + support.offsets[p];
        const double* S = support_gradients == nullptr
                              ? made.next(p)
                              : support_gradients + support.offsets[p] * stride;
        for (std::size_t a = 0; a < size; ++a)
        {
          tangent.contract(S + a * stride);
          for (std::size_t b = symmetric ? a : 0; b < size; ++b)
          {
            double* out = blocks(slots[a], slots[b]);
            for (int i = 0; i < dim; ++i)
              *reinterpret_cast<typename Line<dim>::type*>(out + i * stride)
                  += tangent.line(i, S + b * stride);
          }
        }
      });
      if (symmetric)
        blocks.mirror();
      blocks.end();
    }
  });
}

HOT_LOOP void core::assemble_domains(const Domains& domains, const double* transfers,
                                     const double* A, const double* vectors, int pairs,
                                     const Target& target)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    constexpr int block = dim * dim;
    const int width = domains.nodes * dim;
    std::vector<double> K(width * width);
    Work work;
    GroupBlocks<dim, dim> blocks(target);
    const auto set_tangent = [&](std::size_t p) {
      std::fill(K.begin(), K.end(), 0.0);
      for (int q = 0; q < domains.points; ++q)
      {
        const std::size_t point = p * domains.points + q;
        const double* gradients = domains.gradients + point * domains.nodes * dim;
        const auto add = [&](const double* values) {
          PointTangent<dim> tangent(values, domains.weights[point]);
          for (int c = 0; c < domains.nodes; ++c)
          {
            tangent.contract(gradients + c * dim);
            for (int e = 0; e < domains.nodes; ++e)
              for (int i = 0; i < dim; ++i)
              {
                const auto line = tangent.line(i, gradients + e * dim);
                double* out = K.data() + (c * dim + i) * width + e * dim;
                for (int j = 0; j < dim; ++j)
                  out[j] += line[j];
              }
          }
        };
        if (domains.hoop == nullptr)
          add(A + point * block * block);
        else if constexpr (dim == 2)
        {
          const Revolution parts(A + point * 81);
          add(parts.plane);
          parts.add(gradients, domains.hoop + point * domains.nodes, domains.weights[point],
                    domains.nodes, K.data());
        }
      }
      for (int m = 0; m < pairs; ++m)
      {
        const double* left = vectors + (p * pairs + m) * 2 * width;
        const double* right = left + width;
        for (int r = 0; r < width; ++r)
          for (int s = 0; s < width; ++s)
            K[r * width + s] += left[r] * right[s];
      }
    };
    for (std::size_t g = 0; g < target.groups.count; ++g)
    {
      const bool alone = target.groups.first[g + 1] == target.groups.first[g] + 1;
      if (!alone)
        blocks.begin(g);
      for_each_domain_of(target.groups, g, [&](std::size_t p) {
        const Support& support = target.row;
        const std::uint16_t* slots = support.slots + support.offsets[p];
        const std::size_t size = size_of(support, p);
        set_tangent(p);
        for_each_row<dim>(K.data(), domains.nodes, transfers + support.offsets[p] * domains.nodes,
                          size, work, [&](std::size_t a, const double* line) {
          if (alone)
            add_row<dim>(target, g, p, a, line);
          else
            for (std::size_t b = 0; b < size; ++b)
            {
              double* out = blocks(slots[a], slots[b]);
              for (int k = 0; k < block; ++k)
                out[k] += line[b * block + k];
            }
        });
      });
      if (!alone)
        blocks.end();
    }
  });
}

HOT_LOOP void core::assemble_masses(const Domains& domains, const double* transfers,
                                    const double* M, const Target& target, double* values)
{
  const int nodes = domains.nodes;
  std::vector<double> weights, product(nodes);
  std::vector<int> places, ends;
  const Support& support = target.row;
  GroupBlocks<1, 1> blocks(target);
  for (std::size_t g = 0; g < target.groups.count; ++g)
  {
    blocks.begin(g);
    for_each_domain_of(target.groups, g, [&](std::size_t p) {
      const std::size_t size = size_of(support, p);
      const std::uint16_t* slots = support.slots + support.offsets[p];
      const double* transfer = transfers + support.offsets[p] * nodes;
      const double* mass = M + p * nodes * nodes;
      weights.resize(size * nodes);
      places.resize(size * nodes);
      ends.assign(1, 0);
      int end = 0;
      for (std::size_t a = 0; a < size; ++a) // T is sparse: zeros are passed over
      {
        for (int c = 0; c < nodes; ++c)
          if (transfer[a * nodes + c] != 0.0)
          {
            weights[end] = transfer[a * nodes + c];
            places[end++] = c;
          }
        ends.push_back(end);
      }
      for (std::size_t a = 0; a < size; ++a)
      {
        std::fill(product.begin(), product.end(), 0.0);
        for (int n = ends[a]; n < ends[a + 1]; ++n)
          for (int c = 0; c < nodes; ++c)
            product[c] += weights[n] * mass[places[n] * nodes + c];
        for (std::size_t b = a; b < size; ++b)
        {
          double sum = 0.0;
          for (int n = ends[b]; n < ends[b + 1]; ++n)
            sum += weights[n] * product[places[n]];
          *blocks(slots[a], slots[b]) += sum;
        }
      }
    });
    blocks.mirror();
    blocks.for_each([&](std::int32_t node, std::int32_t, std::int32_t position, const double* sum) {
      values[target.rows[node] + position] += *sum;
    });
  }
}

void core::add_diagonals(std::size_t num_nodes, int dim, const std::int32_t* nodes,
                         const double* numbers, double factor, const Target& target)
{
  with_dimension(dim, [&](auto constant) {
    constexpr int size = constant;
    for (std::size_t node = 0; node < num_nodes; ++node)
      for (std::int32_t e = target.rows[node]; e < target.rows[node + 1]; ++e)
      {
        double K[size * size] = {};
        for (int i = 0; i < size; ++i)
          K[i * size + i] = factor * numbers[e];
        add_block<size, size, size>(target, static_cast<std::int32_t>(node), e - target.rows[node],
                                    target.masks[nodes[e]], K);
      }
  });
}

HOT_LOOP void core::assemble_slopes(const Domains& domains, const double* slope,
                                    const double* displacement, const double* pressure,
                                    const std::optional<Target>& of_pressure,
                                    const std::optional<Target>& of_displacement)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    const int nodes = domains.nodes, points = domains.points;
    std::vector<double> strains(nodes * dim), reduced, line; // strains of nodes of W; of V
    std::vector<double> weights;                             // T without its zeros
    std::vector<int> places, ends;
    const Groups& groups = (of_pressure ? *of_pressure : *of_displacement).groups;
    const Support& seen = of_pressure ? of_pressure->column : of_displacement->row;
    const Support& values = of_pressure ? of_pressure->row : of_displacement->column;
    std::optional<GroupBlocks<1, dim>> for_pressure;
    std::optional<GroupBlocks<dim, 1>> for_displacement;
    if (of_pressure)
      for_pressure.emplace(*of_pressure);
    if (of_displacement)
      for_displacement.emplace(*of_displacement);
    const auto add_domain = [&](std::size_t p) {
      const std::size_t size = size_of(seen, p), rows = size_of(values, p);
      const std::uint16_t *slots = seen.slots + seen.offsets[p],
                          *its = values.slots + values.offsets[p];
      const double* T = displacement + seen.offsets[p] * nodes;
      const double* T_p = pressure + values.offsets[p] * points;
      const std::size_t width = size * dim;
      weights.resize(size * nodes);
      places.resize(size * nodes);
      ends.assign(1, 0);
      int end = 0;
      for (std::size_t b = 0; b < size; ++b)
      {
        for (int c = 0; c < nodes; ++c)
          if (T[b * nodes + c] != 0.0)
          {
            weights[end] = T[b * nodes + c];
            places[end++] = c * dim;
          }
        ends.push_back(end);
      }
      reduced.assign(points * width, 0.0);
      for (int q = 0; q < points; ++q)
      {
        const std::size_t point = p * points + q;
        if (domains.weights[point] <= 0.0)
          continue;
        point_strains<dim>(domains, slope, point, strains.data());
        double* out = reduced.data() + q * width;
        for (std::size_t b = 0; b < size; ++b)
          for (int n = ends[b]; n < ends[b + 1]; ++n)
            for (int i = 0; i < dim; ++i)
              out[b * dim + i] += weights[n] * strains[places[n] + i];
      }
      for (std::size_t a = 0; a < rows; ++a)
      {
        line.assign(width, 0.0);
        for (int q = 0; q < points; ++q)
          if (const double t = T_p[a * points + q]; t != 0.0)
            for (std::size_t k = 0; k < width; ++k)
              line[k] += t * reduced[q * width + k];
        for (std::size_t b = 0; b < size; ++b)
          for (int i = 0; i < dim; ++i)
          {
            if (for_pressure)
              (*for_pressure)(its[a], slots[b])[i] += line[b * dim + i];
            if (for_displacement)
              (*for_displacement)(slots[b], its[a])[i] += line[b * dim + i];
          }
      }
    };
    for (std::size_t g = 0; g < groups.count; ++g)
    {
      if (for_pressure)
        for_pressure->begin(g);
      if (for_displacement)
        for_displacement->begin(g);
      for_each_domain_of(groups, g, add_domain);
      if (for_pressure)
        for_pressure->end();
      if (for_displacement)
        for_displacement->end();
    }
  });
}

void core::assemble_diagonal(int points, const double* factors, const double* pressure,
                             const Target& target)
{
  const Support& support = target.row;
  GroupBlocks<1, 1> blocks(target);
  for (std::size_t g = 0; g < target.groups.count; ++g)
  {
    blocks.begin(g);
    for_each_domain_of(target.groups, g, [&](std::size_t p) {
      const std::uint16_t* slots = support.slots + support.offsets[p];
      const double* T = pressure + support.offsets[p] * points;
      for (std::size_t a = 0; a < size_of(support, p); ++a)
        for (std::size_t b = 0; b < size_of(support, p); ++b)
        {
          double sum = 0.0;
          for (int q = 0; q < points; ++q)
            sum += factors[p * points + q] * T[a * points + q] * T[b * points + q];
          *blocks(slots[a], slots[b]) += sum;
        }
    });
    blocks.end();
  }
}

void core::slope_sizes(const Domains& domains, const double* slope, const double* u, double* sizes)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    std::vector<double> strains(domains.nodes * dim);
    for (std::size_t point = 0; point < domains.count * domains.points; ++point)
    {
      sizes[point] = 0.0;
      if (domains.weights[point] <= 0.0)
        continue;
      const std::int32_t* nodes = domains.dofmap + point / domains.points * domains.nodes;
      point_strains<dim>(domains, slope, point, strains.data());
      for (int c = 0; c < domains.nodes; ++c)
        for (int i = 0; i < dim; ++i)
          sizes[point] += std::abs(strains[c * dim + i] * u[nodes[c] * dim + i]);
    }
  });
}

namespace
{
// Call f(cell, K) with the element tensors of a form, of so many numbers each.
template <typename F>
void for_each_tensor(const core::Form& form, std::size_t size, F&& f)
{
  std::vector<double> K(size), x(form.geometry_nodes * 3);
  for (std::size_t e = 0; e < form.count; ++e)
  {
    const std::int32_t cell = form.entities[form.facets ? 2 * e : e];
    const int facet = form.facets ? form.entities[2 * e + 1] : 0;
    for (int c = 0; c < form.geometry_nodes; ++c)
      for (int i = 0; i < 3; ++i)
        x[3 * c + i] = form.x[3 * form.geometry[cell * form.geometry_nodes + c] + i];
    std::fill(K.begin(), K.end(), 0.0);
    form.kernel(K.data(), form.coefficients + e * form.stride, form.constants, x.data(), &facet,
                nullptr, nullptr);
    f(cell, K);
  }
}
} // namespace

HOT_LOOP void core::assemble_form(const Form& form, const Domains& domains, const double* transfers,
                                  double factor, const Target& target)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    Work work;
    const Support& support = target.row;
    std::vector<std::int32_t> group(domains.count);
    for_each_domain(target.groups, [&](std::size_t g, std::size_t p) {
      group[p] = static_cast<std::int32_t>(g);
    });
    const std::size_t width = domains.nodes * dim;
    for_each_tensor(form, width * width, [&](std::int32_t cell, std::vector<double>& K) {
      for (double& entry : K)
        entry *= factor;
      for_each_row<dim>(K.data(), domains.nodes, transfers + support.offsets[cell] * domains.nodes,
                        size_of(support, cell), work, [&](std::size_t a, const double* line) {
        add_row<dim>(target, group[cell], cell, a, line);
      });
    });
  });
}

void core::multiply_form(const Form& form, const Domains& domains, const double* u, double* force)
{
  const int dim = domains.dim, width = domains.nodes * dim;
  for_each_tensor(form, width * width, [&](std::int32_t cell, const std::vector<double>& K) {
    const std::int32_t* nodes = domains.dofmap + static_cast<std::size_t>(cell) * domains.nodes;
    for (int r = 0; r < width; ++r)
    {
      double sum = 0.0;
      for (int s = 0; s < width; ++s)
        sum += K[r * width + s] * u[nodes[s / dim] * dim + s % dim];
      force[nodes[r / dim] * dim + r % dim] += sum;
    }
  });
}

void core::domain_forces(const Form& form, std::size_t width, std::int32_t first, double* forces)
{
  for_each_tensor(form, width, [&](std::int32_t cell, const std::vector<double>& F) {
    for (std::size_t r = 0; r < width; ++r)
      forces[(cell - first) * width + r] += F[r];
  });
}
