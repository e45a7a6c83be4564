// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

namespace core
{
// Domains with k nodes and nq points each, in dim dimensions.
struct Domains
{
  std::size_t count;
  int nodes, points, dim;
  const std::int32_t* dofmap; // (count, nodes)
  const double* gradients;    // (count, points, nodes, dim)
  const double* weights;      // (count, points)
  // Of a body of revolution N / r, (count, points, nodes): stresses are 3 x 3 then, and the
  // displacement in direction 0 strains (2, 2) by it. Otherwise null.
  const double* hoop = nullptr;

  // Dimension of stress and strain.
  int strain() const { return hoop == nullptr ? dim : 3; }
};

// H = grad u at the points, (count, points, dim, dim), of u at the nodes.
void displacement_gradient(const Domains& domains, const double* u, double* H);

// Add int P : grad v to the force at the nodes.
void internal_force(const Domains& domains, const double* P, double* force);

// Rows of T (one for each node of W) in compressed rows of background nodes.
struct Rows
{
  const std::int64_t* offsets;
  const std::int32_t* nodes;
  const double* values;
};

// The nodes of W of each domain: (count, nodes).
struct Dofmap
{
  std::size_t count;
  int nodes;
  const std::int32_t* values;
};

// The background nodes of each domain, sorted, in compressed rows.
struct Supports
{
  std::vector<std::int64_t> offsets;
  std::vector<std::int32_t> nodes;
};
Supports supports(const Dofmap& dofmap, const Rows& rows);

// T of each domain: (support size, nodes) one domain after the other.
void local_transfers(const Dofmap& dofmap, const Rows& rows, const std::int64_t* offsets,
                     const std::int32_t* nodes, double* transfers);

// The gradients of the background basis that a domain's single point sees: (support size, dim).
void support_gradients(const Domains& domains, const Rows& rows, const std::int64_t* offsets,
                       const std::int32_t* nodes, double* gradients);

// The place of each pair of nodes that a domain sees in the row of the first, in one byte or in two.
class Positions
{
public:
  Positions(const void* values, bool wide) : values_(values), wide_(wide) {}
  std::int32_t operator[](std::size_t pair) const
  {
    return wide_ ? static_cast<const std::uint16_t*>(values_)[pair]
                 : static_cast<const std::uint8_t*>(values_)[pair];
  }

private:
  const void* values_;
  bool wide_;
};

// Where the tangents of domains go: blocks between the nodes that they see, of one field's rows and
// of one field's columns (sparsity.h).
struct Target
{
  std::size_t count;           // of domains
  const std::int32_t* order;   // in which they are visited
  const std::int64_t* pairs;   // where those of a domain begin
  const std::int64_t* offsets; // of the supports
  const std::int32_t* nodes;   // of the rows
  const std::int64_t* column_offsets;
  const std::int32_t* column_nodes;
  Positions positions;
  const std::int32_t* rows;   // of blocks
  const std::int32_t* places; // of these
  const std::int64_t* starts; // of rows of scalars
  const std::uint8_t* masks;  // which dofs of the columns' nodes have a number
  double* values[3];          // inside, outside, of rows of other ranks
};

// Add w S^T A S for domains of one point.
void assemble_points(const Domains& domains, const double* support_gradients, const double* A,
                     bool symmetric, const Target& target);

// Add T^T (sum_q w_q G^T A G + sum_m a_m b_m^T) T with the vectors a_1, b_1, a_2, ... of each
// domain in vectors, (count, 2 pairs, nodes, dim).
void assemble_domains(const Domains& domains, const double* transfers, const double* A,
                      const double* vectors, int pairs, const Target& target);

// Add T^T M T with matrices M between the nodes of each domain, (count, nodes, nodes) and symmetric,
// that are the same for all components: one number for each of the pattern's blocks.
void assemble_masses(const Domains& domains, const double* transfers, const double* M,
                     const Target& target, double* values);

// Add numbers for each of the pattern's blocks to the diagonals of the blocks, dim x dim.
void add_diagonals(std::size_t num_nodes, int dim, const std::int32_t* nodes, const double* numbers,
                   double factor, const Target& target);

// T of a field on each domain, and its supports: (support size, nodes) one after the other.
struct Transfers
{
  const std::int64_t* offsets;
  const double* values;
};

// Add w T_p^T (S : G) T for a slope S at the points (count, points, strain, strain), what a pressure
// at the points does with the displacement, to blocks with rows of the pressure, and its transpose to
// blocks with rows of the displacement; either may be none.
void assemble_slopes(const Domains& domains, const double* slope, const Transfers& displacement,
                     const Transfers& pressure, const std::optional<Target>& of_pressure,
                     const std::optional<Target>& of_displacement);

// Add T_p^T diag(factors) T_p with factors at the points, (count, points).
void assemble_diagonal(int points, const double* factors, const Transfers& pressure,
                       const Target& target);

// Set sizes at the points to w |S : G| |u|, term by term, with u at the nodes.
void slope_sizes(const Domains& domains, const double* slope, const double* u, double* sizes);

using Kernel = void (*)(double*, const double*, const double*, const double*, const int*,
                        const std::uint8_t*, void*);

// A compiled form on some cells, or facets of cells.
struct Form
{
  Kernel kernel;
  std::size_t count;
  const std::int32_t* entities; // cell, or cell and local facet
  bool facets;
  const double* coefficients;
  std::size_t stride;
  const double* constants;
  const double* x;              // geometry, three columns
  const std::int32_t* geometry; // its dofmap
  int geometry_nodes;
};

// Add T^T K T with the element tensors K of a compiled form, times a factor.
void assemble_form(const Form& form, const Domains& domains, const double* transfers, double factor,
                   const Target& target);

// Add K u to the force at the nodes.
void multiply_form(const Form& form, const Domains& domains, const double* u, double* force);
} // namespace core
