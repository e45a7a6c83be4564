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
  std::size_t num_nodes; // of the background
};

// The nodes of W of each domain: (count, nodes).
struct Dofmap
{
  std::size_t count;
  int nodes;
  const std::int32_t* values;
};

// Domains in groups: those that are visited one after the other and see few nodes together. Their
// tangents add up in a small dense matrix first.
struct Groups
{
  std::size_t count;
  const std::int64_t* first; // where they begin in the order, (count + 1)
  const std::int32_t* order; // in which domains are visited
};

// The nodes that groups see, sorted, in compressed rows, and which of them each domain sees.
struct Support
{
  const std::int64_t* offsets; // of the slots of domains, (number of domains + 1)
  const std::uint16_t* slots;  // among the nodes of the group, sorted
  const std::int64_t* ends;    // of the nodes of groups, (number of groups + 1)
  const std::int32_t* nodes;
};

struct Supports
{
  std::vector<std::int64_t> first, offsets, ends;
  std::vector<std::uint16_t> slots;
  std::vector<std::int32_t> nodes;
};

// The supports of domains that are visited in an order, in groups that see no more than `most` nodes
// and fewer pairs of these than their domains one by one; or in those that begin at `first`, if there
// are any.
Supports supports(const Dofmap& dofmap, const Rows& rows, const std::int32_t* order,
                  std::vector<std::int64_t> first, std::size_t most);

// T of each domain: (support size, nodes) one domain after the other.
void local_transfers(const Dofmap& dofmap, const Rows& rows, const Groups& groups,
                     const Support& support, double* transfers);

// The gradients of the background basis that a domain's single point sees: (support size, 2) in the
// plane, (support size, 4) in space.
void support_gradients(const Domains& domains, const Rows& rows, const Groups& groups,
                       const Support& support, double* gradients);

// Whether a domain of a group sees both nodes, for each pair of a node of its rows and one of its
// columns.
std::vector<std::uint8_t> seen_pairs(const Groups& groups, const Support& rows,
                                     const Support& columns);

// The place of each pair of nodes that a group sees in the row of the first, in one byte or in two;
// pairs that no domain sees have none.
class Positions
{
public:
  Positions(const void* values, bool wide) : values_(values), wide_(wide) {}
  std::int32_t operator[](std::size_t pair) const
  {
    return wide_ ? static_cast<const std::uint16_t*>(values_)[pair]
                 : static_cast<const std::uint8_t*>(values_)[pair];
  }
  std::int32_t none() const { return wide_ ? UINT16_MAX : UINT8_MAX; }

private:
  const void* values_;
  bool wide_;
};

// Where the tangents of domains go: blocks between the nodes that they see, of one field's rows and
// of one field's columns (sparsity.h).
struct Target
{
  Groups groups;
  Support row, column;
  const std::int64_t* pairs; // where those of a group begin
  Positions positions;
  const std::int32_t* rows;   // of blocks
  const std::int32_t* places; // of these
  const std::int64_t* starts; // of rows of scalars
  const std::uint8_t* masks;  // which dofs of the columns' nodes have a number
  double* values[3];          // inside, outside, of rows of other ranks
};

// Add w S^T A S for domains of one point, with the gradients S of the background basis, which are
// made on the way where they are not given.
void assemble_points(const Domains& domains, const Rows& rows, const double* support_gradients,
                     const double* A, bool symmetric, const Target& target);

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

// Add w T_p^T (S : G) T for a slope S at the points (count, points, strain, strain), what a pressure
// at the points does with the displacement, to blocks with rows of the pressure, and its transpose to
// blocks with rows of the displacement; either may be none. T of both are (support size, nodes), and
// (support size, points), one domain after the other.
void assemble_slopes(const Domains& domains, const double* slope, const double* displacement,
                     const double* pressure, const std::optional<Target>& of_pressure,
                     const std::optional<Target>& of_displacement);

// Add T_p^T diag(factors) T_p with factors at the points, (count, points).
void assemble_diagonal(int points, const double* factors, const double* pressure,
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

// Add the element vectors of a compiled form to the forces of domains from the first on, (domain,
// width).
void domain_forces(const Form& form, std::size_t width, std::int32_t first, double* forces);
} // namespace core
