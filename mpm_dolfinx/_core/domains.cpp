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
using core::Rows;
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

// The number of a node in a sorted support.
inline std::size_t slot(const std::int32_t* begin, const std::int32_t* end, std::int32_t node)
{
  return static_cast<std::size_t>(std::lower_bound(begin, end, node) - begin);
}

// left[i][j][L] = factor sum_J gradient_J A_iJjL
template <int dim>
inline void contract(const double* A, const double* gradient, double factor, double* left)
{
  for (int i = 0; i < dim; ++i)
    for (int jL = 0; jL < dim * dim; ++jL)
    {
      double sum = 0.0;
      for (int J = 0; J < dim; ++J)
        sum += gradient[J] * A[(i * dim + J) * dim * dim + jL];
      left[i * dim * dim + jL] = factor * sum;
    }
}

// block[i][j] += sum_L left[i][j][L] gradient_L
template <int dim>
inline void add_block(const double* left, const double* gradient, double* block, int stride)
{
  for (int i = 0; i < dim; ++i)
    for (int j = 0; j < dim; ++j)
    {
      double sum = 0.0;
      for (int L = 0; L < dim; ++L)
        sum += left[(i * dim + j) * dim + L] * gradient[L];
      block[i * stride + j] += sum;
    }
}

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

// Add K (rows x columns of dofs, line by line) to a block: that of a node with the one at a position
// in its row, of whose dofs those of a mask have numbers.
template <int height, int width>
inline void add_to(const Target& target, std::int32_t node, std::int32_t position,
                   std::uint8_t mask, const double* K)
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
        out[j] += K[i * width + j];
    else
      for (int j = 0; j < width; ++j)
        if (mask >> j & 1)
          *out++ += K[i * width + j];
  }
}

// Go through domains with their pairs.
template <typename F>
void for_each_domain(const Target& target, F&& f)
{
  for (std::size_t n = 0; n < target.count; ++n)
  {
    const std::size_t p = target.order[n];
    f(p, static_cast<std::size_t>(target.offsets[p + 1] - target.offsets[p]), target.pairs[p]);
  }
}

// Room for the products of one domain.
struct Work
{
  std::vector<double> blocks, weights;
  std::vector<int> places, ends;
};

// Add T^T K T of one domain; K is (nodes dim, nodes dim). T is sparse: zeros are passed over.
template <int dim>
void add_element(const double* K, int nodes, const double* transfers, std::size_t p,
                 const Target& target, Work& work)
{
  constexpr int block = dim * dim;
  const std::size_t size = target.offsets[p + 1] - target.offsets[p];
  const double* transfer = transfers + target.offsets[p] * nodes;
  const std::int32_t* seen = target.nodes + target.offsets[p];
  const std::int64_t pairs = target.pairs[p];
  const int width = nodes * dim, column = nodes * block;
  work.blocks.resize((nodes + size) * column);
  work.weights.resize(size * nodes + 1);
  work.places.resize(size * nodes + 1);
  work.ends.resize(size);
  double* columns = work.blocks.data();     // K in blocks, column by column
  double* right = columns + nodes * column; // K T, the same way
  for (int c = 0; c < nodes; ++c)
    for (int i = 0; i < dim; ++i)
      for (int e = 0; e < nodes; ++e)
        for (int j = 0; j < dim; ++j)
          columns[e * column + c * block + i * dim + j] = K[(c * dim + i) * width + e * dim + j];
  int end = 0;
  for (std::size_t b = 0; b < size; ++b)
  {
    double* out = right + b * column;
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
  }
  for (std::size_t a = 0; a < size; ++a)
    for (std::size_t b = 0; b < size; ++b)
    {
      double sum[block] = {};
      for (int n = a == 0 ? 0 : work.ends[a - 1]; n < work.ends[a]; ++n)
        for (int k = 0; k < block; ++k)
          sum[k] += work.weights[n] * right[b * column + work.places[n] * block + k];
      add_to<dim, dim>(target, seen[a], target.positions[pairs + a * size + b], target.masks[seen[b]], sum);
    }
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

core::Supports core::supports(const Dofmap& dofmap, const Rows& rows)
{
  Supports result;
  result.offsets.reserve(dofmap.count + 1);
  result.offsets.push_back(0);
  std::vector<std::int32_t> support;
  for (std::size_t p = 0; p < dofmap.count; ++p)
  {
    support.clear();
    for (int c = 0; c < dofmap.nodes; ++c)
    {
      const std::int32_t row = dofmap.values[p * dofmap.nodes + c];
      support.insert(support.end(), rows.nodes + rows.offsets[row],
                     rows.nodes + rows.offsets[row + 1]);
    }
    std::sort(support.begin(), support.end());
    const auto end = std::unique(support.begin(), support.end());
    result.nodes.insert(result.nodes.end(), support.begin(), end);
    result.offsets.push_back(static_cast<std::int64_t>(result.nodes.size()));
  }
  return result;
}

void core::local_transfers(const Dofmap& dofmap, const Rows& rows, const std::int64_t* offsets,
                           const std::int32_t* nodes, double* transfers)
{
  std::fill(transfers, transfers + offsets[dofmap.count] * dofmap.nodes, 0.0);
  for (std::size_t p = 0; p < dofmap.count; ++p)
  {
    double* transfer = transfers + offsets[p] * dofmap.nodes;
    for (int c = 0; c < dofmap.nodes; ++c)
    {
      const std::int32_t row = dofmap.values[p * dofmap.nodes + c];
      for (std::int64_t e = rows.offsets[row]; e < rows.offsets[row + 1]; ++e)
        transfer[slot(nodes + offsets[p], nodes + offsets[p + 1], rows.nodes[e]) * dofmap.nodes
                 + c] = rows.values[e];
    }
  }
}

void core::support_gradients(const Domains& domains, const Rows& rows, const std::int64_t* offsets,
                             const std::int32_t* nodes, double* gradients)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    std::fill(gradients, gradients + offsets[domains.count] * dim, 0.0);
    for (std::size_t p = 0; p < domains.count; ++p)
      for (int c = 0; c < domains.nodes; ++c)
      {
        const std::int32_t row = domains.dofmap[p * domains.nodes + c];
        const double* gradient = domains.gradients + (p * domains.nodes + c) * dim;
        for (std::int64_t e = rows.offsets[row]; e < rows.offsets[row + 1]; ++e)
        {
          const std::size_t a = slot(nodes + offsets[p], nodes + offsets[p + 1], rows.nodes[e]);
          for (int J = 0; J < dim; ++J)
            gradients[(offsets[p] + a) * dim + J] += rows.values[e] * gradient[J];
        }
      }
  });
}

HOT_LOOP void core::assemble_points(const Domains& domains, const double* support_gradients,
                                    const double* A, bool symmetric, const Target& target)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    constexpr int block = dim * dim;
    for_each_domain(target, [&](std::size_t p, std::size_t size, std::int64_t pairs) {
      const double* S = support_gradients + target.offsets[p] * dim;
      const std::int32_t* seen = target.nodes + target.offsets[p];
      double left[dim * block];
      for (std::size_t a = 0; a < size; ++a)
      {
        const std::uint8_t mask = target.masks[seen[a]];
        contract<dim>(A + p * block * block, S + a * dim, domains.weights[p], left);
        for (std::size_t b = symmetric ? a : 0; b < size; ++b)
        {
          double K[block] = {};
          add_block<dim>(left, S + b * dim, K, dim);
          add_to<dim, dim>(target, seen[a], target.positions[pairs + a * size + b], target.masks[seen[b]], K);
          if (symmetric && b != a)
          {
            double mirror[block];
            for (int i = 0; i < dim; ++i)
              for (int j = 0; j < dim; ++j)
                mirror[j * dim + i] = K[i * dim + j];
            add_to<dim, dim>(target, seen[b], target.positions[pairs + b * size + a], mask, mirror);
          }
        }
      }
    });
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
    for_each_domain(target, [&](std::size_t p, std::size_t, std::int64_t) {
      std::fill(K.begin(), K.end(), 0.0);
      for (int q = 0; q < domains.points; ++q)
      {
        const std::size_t point = p * domains.points + q;
        const double* gradients = domains.gradients + point * domains.nodes * dim;
        const auto add = [&](const double* tangent) {
          double left[dim * block];
          for (int c = 0; c < domains.nodes; ++c)
          {
            contract<dim>(tangent, gradients + c * dim, domains.weights[point], left);
            for (int e = 0; e < domains.nodes; ++e)
              add_block<dim>(left, gradients + e * dim, K.data() + c * dim * width + e * dim,
                             width);
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
      add_element<dim>(K.data(), domains.nodes, transfers, p, target, work);
    });
  });
}

HOT_LOOP void core::assemble_masses(const Domains& domains, const double* transfers,
                                    const double* M, const Target& target, double* values)
{
  const int nodes = domains.nodes;
  std::vector<double> weights, product(nodes);
  std::vector<int> places, ends;
  for_each_domain(target, [&](std::size_t p, std::size_t size, std::int64_t pairs) {
    const std::int32_t* seen = target.nodes + target.offsets[p];
    const double* transfer = transfers + target.offsets[p] * nodes;
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
        values[target.rows[seen[a]] + target.positions[pairs + a * size + b]] += sum;
        if (b != a)
          values[target.rows[seen[b]] + target.positions[pairs + b * size + a]] += sum;
      }
    }
  });
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
        add_to<size, size>(target, static_cast<std::int32_t>(node),
                           e - target.rows[node],
                           target.masks[nodes[e]], K);
      }
  });
}

HOT_LOOP void core::assemble_slopes(const Domains& domains, const double* slope,
                                    const Transfers& displacement, const Transfers& pressure,
                                    const std::optional<Target>& of_pressure,
                                    const std::optional<Target>& of_displacement)
{
  with_dimension(domains.dim, [&](auto constant) {
    constexpr int dim = constant;
    const int nodes = domains.nodes, points = domains.points;
    std::vector<double> strains(nodes * dim), reduced, line; // strains of nodes of W; of V
    std::vector<double> weights;                             // T without its zeros
    std::vector<int> places, ends;
    const Target& some = of_pressure ? *of_pressure : *of_displacement;
    for (std::size_t n = 0; n < some.count; ++n)
    {
      const std::size_t p = some.order[n];
      const std::size_t size = displacement.offsets[p + 1] - displacement.offsets[p];
      const std::size_t rows = pressure.offsets[p + 1] - pressure.offsets[p];
      const double* T = displacement.values + displacement.offsets[p] * nodes;
      const double* T_p = pressure.values + pressure.offsets[p] * points;
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
        if (of_pressure)
        {
          const Target& to = *of_pressure;
          const std::int32_t* seen = to.column_nodes + to.column_offsets[p];
          for (std::size_t b = 0; b < size; ++b)
            add_to<1, dim>(to, to.nodes[to.offsets[p] + a],
                           to.positions[to.pairs[p] + a * size + b], to.masks[seen[b]],
                           line.data() + b * dim);
        }
        if (of_displacement)
        {
          const Target& to = *of_displacement;
          const std::int32_t* seen = to.nodes + to.offsets[p];
          const std::uint8_t mask = to.masks[to.column_nodes[to.column_offsets[p] + a]];
          for (std::size_t b = 0; b < size; ++b)
            add_to<dim, 1>(to, seen[b], to.positions[to.pairs[p] + b * rows + a], mask,
                           line.data() + b * dim);
        }
      }
    }
  });
}

void core::assemble_diagonal(int points, const double* factors, const Transfers& pressure,
                             const Target& target)
{
  for_each_domain(target, [&](std::size_t p, std::size_t size, std::int64_t pairs) {
    const std::int32_t* seen = target.nodes + target.offsets[p];
    const double* T = pressure.values + pressure.offsets[p] * points;
    for (std::size_t a = 0; a < size; ++a)
      for (std::size_t b = 0; b < size; ++b)
      {
        double sum = 0.0;
        for (int q = 0; q < points; ++q)
          sum += factors[p * points + q] * T[a * points + q] * T[b * points + q];
        add_to<1, 1>(target, seen[a], target.positions[pairs + a * size + b], target.masks[seen[b]], &sum);
      }
  });
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
// Call f(cell, K) with the element tensors of a form.
template <typename F>
void for_each_tensor(const core::Form& form, std::size_t width, F&& f)
{
  std::vector<double> K(width * width), x(form.geometry_nodes * 3);
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
    for_each_tensor(form, domains.nodes * dim, [&](std::int32_t cell, std::vector<double>& K) {
      for (double& entry : K)
        entry *= factor;
      add_element<dim>(K.data(), domains.nodes, transfers, cell, target, work);
    });
  });
}

void core::multiply_form(const Form& form, const Domains& domains, const double* u, double* force)
{
  const int dim = domains.dim, width = domains.nodes * dim;
  for_each_tensor(form, width, [&](std::int32_t cell, const std::vector<double>& K) {
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
