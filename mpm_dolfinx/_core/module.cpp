// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// The compiled loops as Python functions: arrays and addresses of kernels, nothing else.

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "arrays.h"
#include "background.h"
#include "closest.h"
#include "contact.h"
#include "domains.h"
#include "material.h"
#include "mean_stress.h"
#include "products.h"
#include "sparsity.h"
#include "step_stress.h"

namespace
{
using namespace core;
using namespace nb::literals;

// Hand a vector over to NumPy.
template <typename T>
auto to_numpy(std::vector<T>&& values)
{
  auto* kept = new std::vector<T>(std::move(values));
  nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::ndarray<nb::numpy, T, nb::ndim<1>>(kept->data(), {kept->size()}, owner);
}

auto to_numpy(Entries&& entries)
{
  return std::make_pair(to_numpy(std::move(entries.offsets)), to_numpy(std::move(entries.columns)));
}

// Rows of a field: numbers of its dofs, dofs a node, and starts to be set.
using FieldRows = std::tuple<Indices, int, OffsetsOut>;

// Blocks beside each other: offsets and nodes, dofs of these and their numbers, places to be set.
using FieldColumns = std::tuple<Indices, Indices, int, Indices, IndicesOut>;

Numbered numbered(const FieldRows& rows, const std::vector<FieldColumns>& parts)
{
  const auto& [numbers, dim, starts] = rows;
  Numbered result{numbers.size() / dim, dim, numbers.data(), starts.data(), {}};
  require(starts.size() == 2 * numbers.size(), "starts of all rows (n, 2)");
  for (const auto& [offsets, nodes, columns, their_numbers, places] : parts)
  {
    require(numbers.size() == (offsets.size() - 1) * dim, "numbers of all rows");
    require(places.size() == nodes.size(), "places of all blocks");
    result.parts.push_back(
        {offsets.data(), nodes.data(), columns, their_numbers.data(), places.data()});
  }
  return result;
}

// Add entries to a matrix, of which columns of this rank and others are given with their values, if
// it has places for all of them and this is what is asked for; return whether it has.
template <typename Index>
bool add_entries(const std::tuple<Array<const Index>, Array<const Index>, Reals>& entries,
                 const std::tuple<Array<const Index>, Array<const Index>, RealsOut>& inside,
                 const std::tuple<Array<const Index>, Array<const Index>, RealsOut>& outside,
                 std::pair<Index, Index> own, bool add)
{
  const auto rows = [](const auto& matrix) {
    return Compressed<Index>{std::get<0>(matrix).data(), std::get<1>(matrix).data()};
  };
  const std::size_t count = std::get<0>(entries).size();
  require(count > 0 && std::get<0>(inside).size() == count && std::get<0>(outside).size() == count,
          "as many rows of both");
  const double* values = std::get<2>(entries).data();
  double* const to[] = {std::get<2>(outside).data(), std::get<2>(inside).data()};
  return for_each_place(count - 1, rows(entries), rows(inside), rows(outside), own.first,
                        own.second, [&](Index e, bool within, Index place) {
    if (add)
      to[within][place] += values[e];
  });
}

// A matrix: offsets, columns and values of its rows.
using RowArrays = std::tuple<Indices, Indices, Reals>;

SparseRows sparse_rows(const RowArrays& arrays)
{
  const auto& [offsets, columns, values] = arrays;
  require(offsets.size() > 0 && columns.size() == values.size()
              && columns.size() == static_cast<std::size_t>(offsets.data()[offsets.size() - 1]),
          "rows with columns and values");
  return {offsets.size() - 1, offsets.data(), columns.data(), values.data()};
}

// The groups of domains: their order, and where groups begin in it.
using GroupArrays = std::tuple<Indices, Offsets>;

Groups groups_of(const GroupArrays& groups)
{
  const auto& [order, first] = groups;
  require(first.size() > 0 && first.data()[first.size() - 1] == static_cast<std::int64_t>(order.size()),
          "groups of all domains");
  return {first.size() - 1, first.data(), order.data()};
}

// Offsets and slots of domains, ends and nodes of groups.
using Shorts = Array<const std::uint16_t>;
using SupportArrays = std::tuple<Offsets, Shorts, Offsets, Indices>;

Support support_of(const GroupArrays& groups, const SupportArrays& support)
{
  const auto& [offsets, slots, ends, nodes] = support;
  require(offsets.size() == std::get<0>(groups).size() + 1, "offsets of supports (n + 1)");
  require(ends.size() == std::get<1>(groups).size(), "ends of the nodes of all groups");
  return {offsets.data(), slots.data(), ends.data(), nodes.data()};
}

// Groups with the supports of rows and columns; pairs and positions; rows, places, starts and masks
// of a pattern; values inside, outside, of rows of other ranks.
using Bytes = Array<const std::uint8_t>;
using Where = std::tuple<GroupArrays, SupportArrays, SupportArrays, Offsets, Bytes, Indices, Indices,
                         Offsets, Bytes, RealsOut, RealsOut, RealsOut>;

Target target_of(const Where& where)
{
  const auto& [groups, row, column, pairs, positions, rows, places, starts, masks, inside, outside,
               sent]
      = where;
  const Groups all = groups_of(groups);
  require(pairs.size() == all.count + 1, "pairs of all groups");
  const auto num_pairs = static_cast<std::size_t>(pairs.data()[all.count]);
  require(positions.size() == num_pairs || positions.size() == 2 * num_pairs,
          "positions of all pairs");
  return {all,
          support_of(groups, row),
          support_of(groups, column),
          pairs.data(),
          Positions(positions.data(), positions.size() > num_pairs),
          rows.data(),
          places.data(),
          starts.data(),
          masks.data(),
          {inside.data(), outside.data(), sent.data()}};
}

// Points that may touch: what is known of them, and the law of friction.
Touching touching_of(std::size_t n, std::size_t dim, const std::vector<Reals>& points,
                     const Array<const std::uint8_t>& touched, const std::vector<double>& law,
                     bool smooth)
{
  require(dim == 2 || dim == 3, "two or three dimensions");
  require(points.size() == 6 && law.size() == 5, "points and law");
  for (std::size_t i = 0; i < 4; ++i)
    require(points[i].size() == n, "values (n,)");
  const Reals &behind = points[4], &bounds = points[5];
  require(behind.size() == 0 || behind.size() == n * dim, "tractions (n, dim) or none");
  require(bounds.size() == 0 || bounds.size() == n * 5, "bounds (n, 5) or none");
  require(touched.size() == n, "touched (n,)");
  return {points[0].data(),
          points[1].data(),
          touched.data(),
          points[2].data(),
          points[3].data(),
          behind.size() == 0 ? nullptr : behind.data(),
          bounds.size() == 0 ? nullptr : bounds.data(),
          law[0],
          law[1],
          law[2],
          law[3],
          law[4],
          smooth};
}

// Points of which gaps, normals and ways from anchors are given, and, or not, how a step began.
Separation separation_of(const std::vector<Reals>& given)
{
  require(given.size() == 6 && given[1].ndim() == 2, "gaps, normals, ways, and a step");
  const std::size_t n = given[0].size();
  require(given[1].shape(0) == n && given[2].size() == given[1].size(), "vectors (n, dim)");
  const bool moves = given[5].size() > 0;
  require(!moves || (given[3].size() == n && given[4].size() == n
                     && given[5].size() == given[1].size()),
          "gaps and changes of a step, or none");
  const auto data = [&](std::size_t i) { return moves ? given[i].data() : nullptr; };
  return {n, given[0].data(), given[1].data(), given[2].data(), data(3), data(4), data(5)};
}

// Points that meet facets: places, tables of the facets, and what is known of the points.
Meeting meeting_of(const Reals& x, const std::vector<Reals>& tables,
                   const std::vector<Reals>& start, const std::vector<Reals>& points,
                   const Array<const std::uint8_t>& touched, const std::vector<double>& law,
                   bool smooth)
{
  require(x.ndim() == 3 && (x.shape(2) == 2 || x.shape(2) == 3), "places (n, count, 2 or 3)");
  require(tables.size() == 5, "tables");
  const std::size_t n = x.shape(0), sides = x.shape(2) - 1;
  require(tables[0].ndim() == 2, "shape functions (n, nodes)");
  const std::size_t nodes = tables[0].shape(1);
  require(tables[0].shape(0) == n && tables[1].size() == n * sides * nodes
              && tables[2].size() == n * sides * sides * nodes && tables[3].size() == n * nodes,
          "shape functions with first and second derivatives, and those of anchors");
  require(tables[4].size() == n, "signs of normals (n,)");
  require(x.shape(1) == 1 + (smooth ? nodes : 2 * nodes), "places of a point, nodes and anchors");
  const bool moves = !start.empty();
  require(!moves
              || (start.size() == 6 && start[0].size() == n * (1 + nodes) * x.shape(2)
                  && start[1].size() == tables[0].size() && start[2].size() == tables[1].size()
                  && start[3].size() == tables[2].size() && start[4].size() == n
                  && start[5].size() == n),
          "places, shape functions and gaps where a step begins");
  const auto data = [&](std::size_t i) { return moves ? start[i].data() : nullptr; };
  return {n,
          static_cast<int>(x.shape(1)),
          static_cast<int>(nodes),
          x.data(),
          {tables[0].data(), tables[1].data(), tables[2].data()},
          tables[3].data(),
          tables[4].data(),
          touching_of(n, x.shape(2), points, touched, law, smooth),
          data(0),
          {data(1), data(2), data(3)},
          data(4),
          data(5)};
}

// Facets by their nodes and shape functions: degree, and whether they are triangles or lines.
Shape shape_of(std::size_t dim, const Reals& coefficients, const std::tuple<int, bool>& kind,
               double close, int most)
{
  const auto [degree, simplex] = kind;
  require(dim == 2 || dim == 3, "two or three dimensions");
  require(degree > 0 && degree <= 7, "degrees from 1 to 7");
  const int row = degree + 1, count = dim == 2 ? row : simplex ? row * (row + 1) / 2 : row * row;
  const auto size = static_cast<std::size_t>(count);
  require(coefficients.ndim() == 2 && coefficients.shape(0) == size
              && coefficients.shape(1) == size,
          "coefficients (monomials, nodes)");
  return {degree, count, count, simplex, coefficients.data(), close, most};
}

Shape shape_of(const Reals& corners, const Reals& coefficients, const std::tuple<int, bool>& kind,
               double close, int most)
{
  require(corners.ndim() == 3, "nodes (facets, nodes, dim)");
  const Shape shape = shape_of(corners.shape(2), coefficients, kind, close, most);
  require(corners.shape(1) == static_cast<std::size_t>(shape.nodes), "nodes of a facet");
  return shape;
}

// Where derivatives at points add up.
Sums sums_of(std::size_t points, int dim, int nodes, int count, const Reals& weights,
             const Reals& shapes, const Offsets& group, const Indices& positions,
             const RealsOut& values)
{
  require(weights.size() == points && group.size() == points && shapes.ndim() == 2
              && shapes.shape(0) == points,
          "weights, shape functions and groups of points");
  const auto sources = static_cast<int>(shapes.shape(1));
  require(positions.ndim() == 3
              && positions.shape(1) == static_cast<std::size_t>(sources + nodes)
              && positions.shape(2) == static_cast<std::size_t>(sources + count - 1),
          "positions (groups, rows, columns)");
  for (std::size_t p = 0; p < points; ++p)
    require(group.data()[p] >= 0
                && group.data()[p] < static_cast<std::int64_t>(positions.shape(0)),
            "numbers of groups");
  const std::size_t blocks = values.size() / static_cast<std::size_t>(dim * dim);
  for (std::size_t k = 0; k < positions.size(); ++k)
    require(positions.data()[k] >= 0
                && static_cast<std::size_t>(positions.data()[k]) < blocks,
            "positions of blocks");
  return {sources, weights.data(), shapes.data(), group.data(), positions.data(), values.data()};
}

Dofmap dofmap_of(const Indices& dofmap)
{
  require(dofmap.ndim() == 2, "dofmap (n, k)");
  return {dofmap.shape(0), static_cast<int>(dofmap.shape(1)), dofmap.data()};
}

Domains domains_of(const Indices& dofmap, const Reals& gradients, const Reals* weights)
{
  require(dofmap.ndim() == 2 && gradients.ndim() == 4, "dofmap (n, k), gradients (n, nq, k, dim)");
  require(gradients.shape(0) == dofmap.shape(0) && gradients.shape(2) == dofmap.shape(1),
          "gradients and dofmap");
  const auto dim = static_cast<int>(gradients.shape(3));
  require(dim == 2 || dim == 3, "two or three dimensions");
  Domains domains{dofmap.shape(0),
                  static_cast<int>(dofmap.shape(1)),
                  static_cast<int>(gradients.shape(1)),
                  dim,
                  dofmap.data(),
                  gradients.data(),
                  nullptr};
  if (weights != nullptr)
  {
    require(weights->size() == domains.count * gradients.shape(1), "weights (n, nq)");
    domains.weights = weights->data();
  }
  return domains;
}

// Hand over what makes domains those of a body of revolution, or nothing.
void revolve(Domains& domains, const Reals& hoop)
{
  if (hoop.size() == 0)
    return;
  const std::size_t count = domains.count * domains.points * domains.nodes;
  require(domains.dim == 2 && hoop.size() == count, "hoop (n, nq, k) in the plane, or none");
  domains.hoop = hoop.data();
}

std::size_t num_points(const Domains& domains)
{
  return domains.count * domains.points;
}

Rows rows_of(const Offsets& offsets, const Indices& nodes, const Reals& values)
{
  require(nodes.size() == values.size() && offsets.size() > 0
              && static_cast<std::size_t>(offsets.data()[offsets.size() - 1]) == nodes.size(),
          "offsets, nodes and values of rows");
  const std::int32_t *begin = nodes.data(), *end = begin + nodes.size();
  const std::size_t count = begin == end ? 0 : 1 + *std::max_element(begin, end);
  return {offsets.data(), begin, values.data(), count};
}

Parameter parameter_of(const Reals& values, std::size_t count)
{
  require(values.size() == 1 || values.size() == count, "one parameter, or one for each point");
  return {values.data(), values.size() == 1 ? std::size_t{0} : std::size_t{1}};
}

Law law_of(const std::string& name)
{
  if (name == "hencky")
    return Law::hencky;
  if (name == "neo_hooke")
    return Law::neo_hooke;
  if (name == "cam_clay")
    return Law::cam_clay;
  if (name == "von_mises")
    return Law::von_mises;
  if (name == "mohr_coulomb")
    return Law::mohr_coulomb;
  if (name == "drucker_prager")
    return Law::drucker_prager;
  if (name == "mu_i")
    return Law::mu_i;
  if (name == "von_mises_averaged")
    return Law::von_mises_averaged;
  if (name == "mohr_coulomb_averaged")
    return Law::mohr_coulomb_averaged;
  if (name == "drucker_prager_averaged")
    return Law::drucker_prager_averaged;
  throw std::invalid_argument("there is no compiled law " + name);
}

// The step of a law at a number of points, but for what they are strained by.
Update update_of(Law law, std::size_t count, const std::vector<Reals>& old_variables,
                 const std::vector<Reals>& parameters, std::vector<RealsOut>& variables)
{
  Update u{};
  u.law = law;
  u.count = count;
  require(parameters.size() == num_parameters(law), "the parameters of the law");
  require(old_variables.size() == num_variables(law) && variables.size() == num_variables(law),
          "the internal variables of the law");
  for (std::size_t k = 0; k < parameters.size(); ++k)
    u.parameters[k] = parameter_of(parameters[k], count);
  for (std::size_t k = 0; k < variables.size(); ++k)
  {
    require(old_variables[k].size() == count && variables[k].size() == count,
            "internal variables (n,)");
    u.old_variables[k] = old_variables[k].data();
    u.variables[k] = variables[k].data();
  }
  return u;
}

// Update a law with a history, from arrays of which the shapes are looked at.
auto update_with_history(Law law, const Reals& gradient, const Reals& old_gradient,
                         const Reals& old_c, const std::vector<Reals>& old_variables,
                         const std::vector<Reals>& parameters, const Reals& share,
                         double tolerance, RealsOut& P, RealsOut& A, RealsOut& stress, RealsOut& c,
                         std::vector<RealsOut>& variables, const GivenPressure* given = nullptr)
{
  require(gradient.ndim() == 3 && old_gradient.size() == gradient.size()
              && old_c.shape(0) == gradient.shape(0),
          "displacement gradients (n, dim, dim) and states (n, ...)");
  Update u = update_of(law, gradient.shape(0), old_variables, parameters, variables);
  u.share = parameter_of(share, u.count);
  u.tolerance = tolerance;
  u.gradient = gradient.data();
  u.old_gradient = old_gradient.data();
  u.old_c = old_c.data();
  u.P = P.data();
  u.A = A.size() > 0 ? A.data() : nullptr;
  u.stress = stress.data();
  u.c = c.data();
  u.given = given;
  return to_numpy(update_logarithmic(u, static_cast<int>(gradient.shape(2))));
}

// A step of a law and derivatives by what goes into it (gradient, old gradient, old c, old variables,
// parameters with the share) and by what comes out of it (P, stress, c, variables), from arrays of
// which the sizes are looked at. Arrays are empty where there is no history.
Change change_of(const std::string& name, const std::vector<Reals>& before,
                 const std::vector<Reals>& variables, const std::vector<Reals>& parameters,
                 const Reals& share, double tolerance, const std::vector<RealsOut>& in,
                 const std::vector<RealsOut>& out)
{
  Change u{};
  u.law = law_of(name);
  require(has_derivatives(u.law) && before.size() == 3 && in.size() == 5 && out.size() == 4,
          "a law with derivatives, and all that it takes and gives");
  const Reals& gradient = before[0];
  require(gradient.ndim() == 3 && (gradient.shape(2) == 2 || gradient.shape(2) == 3),
          "displacement gradients (n, dim, dim)");
  const std::size_t count = u.count = gradient.shape(0);
  const std::size_t own = num_variables(u.law), m = gradient.shape(2) == 2 ? 4 : 6;
  const bool history = before[1].size() > 0;
  const std::size_t old = history ? count * m : 0, seen = history ? gradient.size() : 0;
  require(variables.size() == own && parameters.size() == num_parameters(u.law),
          "the variables and the parameters of the law");
  require(before[1].size() == seen && before[2].size() == old
              && (history || own == 0) && in[0].size() == gradient.size() && in[1].size() == seen
              && in[2].size() == old && in[3].size() == count * own
              && in[4].size() == count * num_numbers(u.law) && out[0].size() == gradient.size()
              && out[1].size() == count * m && out[2].size() == old
              && out[3].size() == count * own,
          "numbers for all points");
  u.gradient = gradient.data();
  u.old_gradient = history ? before[1].data() : nullptr;
  u.old_c = history ? before[2].data() : nullptr;
  for (std::size_t k = 0; k < own; ++k)
  {
    require(variables[k].size() == count, "internal variables (n,)");
    u.old_variables[k] = variables[k].data();
  }
  for (std::size_t k = 0; k < parameters.size(); ++k)
    u.parameters[k] = parameter_of(parameters[k], count);
  u.share = parameter_of(share, count);
  u.tolerance = tolerance;
  u.of_gradient = in[0].data();
  u.of_old_gradient = in[1].data();
  u.of_old_c = in[2].data();
  u.of_old_variables = in[3].data();
  u.of_numbers = in[4].data();
  u.of_P = out[0].data();
  u.of_stress = out[1].data();
  u.of_c = out[2].data();
  u.of_variables = out[3].data();
  return u;
}

// The rows of T by the background's basis at points, with offsets of PETSc's kind of integer.
template <typename Index>
auto rows_of_transfer(Offsets nodes, Reals values, int bs, Array<Index> offsets)
{
  require(nodes.ndim() == 2 && values.size() == nodes.size(), "nodes and values (n, k)");
  require(offsets.size() == nodes.shape(0) * bs + 1, "offsets of rows (n bs + 1)");
  RowEntries<Index> found = transfer_rows(nodes.shape(0), nodes.shape(1), bs, nodes.data(),
                                          values.data(), offsets.data());
  return std::make_pair(to_numpy(std::move(found.columns)), to_numpy(std::move(found.values)));
}

// T as it is found at points, with vectors of points and of the background.
Basis basis_of(Offsets nodes, Reals values, std::size_t points, std::size_t background)
{
  require(nodes.ndim() == 2 && values.size() == nodes.size(), "nodes and values (n, k)");
  const std::size_t count = nodes.shape(0), dim = count == 0 ? 2 : points / count;
  require(points == count * dim && (dim == 2 || dim == 3) && background % dim == 0,
          "components of points and nodes");
  return {count, nodes.shape(1), static_cast<int>(dim), nodes.data(), values.data()};
}

// A compiled form by the address of its kernel, with what it is given on its cells.
using Compiled = std::tuple<std::uintptr_t, Indices, Reals, Reals, Reals, Indices>;

Form form_of(const Compiled& compiled)
{
  const auto& [kernel, entities, coefficients, constants, x, geometry] = compiled;
  require(x.ndim() == 2 && x.shape(1) == 3 && geometry.ndim() == 2, "geometry");
  require(coefficients.ndim() == 2
              && (coefficients.size() == 0 || coefficients.shape(0) == entities.shape(0)),
          "coefficients of each entity");
  return {reinterpret_cast<Kernel>(kernel),
          entities.shape(0),
          entities.data(),
          entities.ndim() == 2,
          coefficients.data(),
          coefficients.shape(1),
          constants.data(),
          x.data(),
          geometry.data(),
          static_cast<int>(geometry.shape(1))};
}
} // namespace

NB_MODULE(_loops, m)
{
#ifdef __AVX2__
  if (!__builtin_cpu_supports("avx2"))
    throw std::runtime_error("mpm_dolfinx was compiled for processors with AVX2, which this one does "
                             "not have: install it again on this machine, or a wheel.");
#endif
  m.attr("sources") = LOOPS_SOURCES;
  m.doc() = "Compiled loops over particle domains.";

  m.def("displacement_gradient", [](Reals u, Indices dofmap, Reals gradients, RealsOut H) {
    const Domains domains = domains_of(dofmap, gradients, nullptr);
    require(H.size() == num_points(domains) * domains.dim * domains.dim, "H (n, nq, dim, dim)");
    displacement_gradient(domains, u.data(), H.data());
  }, "u"_a, "dofmap"_a, "gradients"_a, "H"_a.noconvert(), "Set H to grad u at the points.");

  m.def("internal_force",
        [](Reals P, Indices dofmap, Reals gradients, Reals weights, Reals hoop, RealsOut force) {
    Domains domains = domains_of(dofmap, gradients, &weights);
    revolve(domains, hoop);
    const int strain = domains.strain();
    require(P.size() == num_points(domains) * strain * strain, "P (n, nq, dim, dim)");
    internal_force(domains, P.data(), force.data());
  }, "P"_a, "dofmap"_a, "gradients"_a, "weights"_a, "hoop"_a, "force"_a.noconvert(),
        "Add the integral of P : grad v to the force at the nodes.");

  m.def("supports",
        [](Indices dofmap, Offsets offsets, Indices nodes, Reals values, Indices order,
           Offsets first, std::size_t most) {
    const Dofmap domains = dofmap_of(dofmap);
    require(order.size() == domains.count, "an order of all domains");
    Supports result
        = supports(domains, rows_of(offsets, nodes, values), order.data(),
                   std::vector<std::int64_t>(first.data(), first.data() + first.size()), most);
    return std::make_pair(to_numpy(std::move(result.first)),
                          std::make_tuple(to_numpy(std::move(result.offsets)),
                                          to_numpy(std::move(result.slots)),
                                          to_numpy(std::move(result.ends)),
                                          to_numpy(std::move(result.nodes))));
  },
        "dofmap"_a, "offsets"_a, "nodes"_a, "values"_a, "order"_a, "first"_a, "most"_a,
        "Return where groups of domains begin that see at most so many nodes together (or one domain), "
        "if they are not given; and offsets and slots of domains, ends and nodes of groups.");

  m.def("local_transfers",
        [](Indices dofmap, Offsets offsets, Indices nodes, Reals values, const GroupArrays& groups,
           const SupportArrays& support, RealsOut transfers) {
    const Dofmap domains = dofmap_of(dofmap);
    require(transfers.size() == std::get<1>(support).size() * domains.nodes, "transfers");
    local_transfers(domains, rows_of(offsets, nodes, values), groups_of(groups),
                    support_of(groups, support), transfers.data());
  },
        "dofmap"_a, "offsets"_a, "nodes"_a, "values"_a, "groups"_a, "support"_a,
        "transfers"_a.noconvert(), "Set the values of T of each domain's nodes.");

  m.def("support_gradients",
        [](Indices dofmap, Reals gradients, Offsets offsets, Indices nodes, Reals values,
           const GroupArrays& groups, const SupportArrays& support, RealsOut result) {
    const Domains domains = domains_of(dofmap, gradients, nullptr);
    require(domains.points == 1 && domains.dim == 2
                && result.size() == std::get<1>(support).size() * 2,
            "gradients of domains with one point in the plane");
    support_gradients(domains, rows_of(offsets, nodes, values), groups_of(groups),
                      support_of(groups, support), result.data());
  },
        "dofmap"_a, "gradients"_a, "offsets"_a, "nodes"_a, "values"_a, "groups"_a, "support"_a,
        "result"_a.noconvert(),
        "Set the gradients of the background basis at each domain's single point.");

  m.def("seen_pairs",
        [](const GroupArrays& groups, const SupportArrays& rows, const SupportArrays& columns) {
    return to_numpy(
        seen_pairs(groups_of(groups), support_of(groups, rows), support_of(groups, columns)));
  },
        "groups"_a, "rows"_a, "columns"_a,
        "Return whether a domain of a group sees both nodes, for each pair of them.");

  m.def("locate",
        [](const std::vector<std::pair<Reals, double>>& lines, Offsets table, Offsets first,
           Reals slopes, Reals centres, Reals middle, Reals slack, std::pair<double, double> small,
           Reals points, OffsetsOut cells, RealsOut reference, RealsOut outside) {
    const std::size_t dim = lines.size(), n = first.size(), count = cells.size();
    require((dim == 2 || dim == 3) && table.ndim() == dim, "lines and a table of boxes");
    require(slopes.size() == n * dim * dim && centres.size() == n * dim && middle.size() == dim
                && slack.size() == n,
            "maps of cells");
    require(points.size() == count * dim && reference.size() == points.size()
                && outside.size() == count,
            "points (n, dim)");
    Boxes boxes{static_cast<int>(dim), {}, table.data(), first.data(), slopes.data(),
                centres.data(), middle.data(), slack.data()};
    for (std::size_t i = 0; i < dim; ++i)
    {
      const auto& [values, size] = lines[i];
      require(values.size() == table.shape(i) + 1, "lines around boxes");
      boxes.lines[i] = {values.size(), values.data(), size};
    }
    locate(boxes, {small.first, small.second}, points.data(), count, cells.data(),
           reference.data(), outside.data());
  },
        "lines"_a, "table"_a, "first"_a, "slopes"_a, "centres"_a, "middle"_a, "slack"_a, "small"_a,
        "points"_a, "cells"_a.noconvert(), "reference"_a.noconvert(), "outside"_a.noconvert(),
        "Set the cells of points among the boxes of a grid, their reference coordinates and how "
        "far these lie outside.");

  const char* of_transfer = "Set the offsets of the rows of T; return their columns and values.";
  m.def("transfer_rows", rows_of_transfer<std::int32_t>, "nodes"_a, "values"_a, "bs"_a,
        "offsets"_a.noconvert(), of_transfer);
  m.def("transfer_rows", rows_of_transfer<std::int64_t>, "nodes"_a, "values"_a, "bs"_a,
        "offsets"_a.noconvert(), of_transfer);

  m.def("apply_basis", [](Offsets nodes, Reals values, Reals x, RealsOut y) {
    apply(basis_of(nodes, values, y.size(), x.size()), x.data(), y.data());
  }, "nodes"_a, "values"_a, "x"_a, "y"_a.noconvert(), "Set y to T x.");
  m.def("add_transposed_basis", [](Offsets nodes, Reals values, Reals y, RealsOut x) {
    add_transposed(basis_of(nodes, values, y.size(), x.size()), y.data(), x.data());
  }, "nodes"_a, "values"_a, "y"_a, "x"_a.noconvert(), "Add T^T y to x.");

  m.def("pattern",
        [](Offsets row_offsets, Indices row_nodes, std::size_t num_rows, Offsets column_offsets,
           Indices column_nodes, std::size_t num_columns, Bytes has) {
    require(row_offsets.size() > 0 && row_offsets.size() == column_offsets.size(),
            "nodes of as many groups");
    Pattern result = pattern({row_offsets.data(), row_nodes.data(), num_rows},
                             {column_offsets.data(), column_nodes.data(), num_columns},
                             row_offsets.size() - 1,
                             std::vector<std::uint8_t>(has.data(), has.data() + has.size()));
    return std::make_tuple(to_numpy(std::move(result.offsets)), to_numpy(std::move(result.nodes)),
                           to_numpy(std::move(result.pairs)),
                           to_numpy(std::move(result.positions)), result.bytes);
  },
        "row_offsets"_a, "row_nodes"_a, "num_rows"_a, "column_offsets"_a, "column_nodes"_a,
        "num_columns"_a, "has"_a,
        "Return the sparsity of a sum over groups of domains; where the pairs of nodes of two fields "
        "that each group sees begin, and the place of each that has a block in the row of its first "
        "node, with the bytes that it takes.");

  m.def("foreign_rows",
        [](const FieldRows& rows, const std::vector<FieldColumns>& parts, std::pair<int, int> own) {
    auto [blocks, values] = foreign_rows(numbered(rows, parts), {own.first, own.second});
    std::vector<std::int32_t> flat;
    flat.reserve(4 * blocks.size());
    for (const Block& block : blocks)
      flat.insert(flat.end(), {block.row, block.height, block.column, block.width});
    return std::make_pair(to_numpy(std::move(flat)), values);
  }, "rows"_a, "parts"_a, "own"_a,
        "Set starts and places of rows that are numbered outside a range; return their blocks (row, "
        "height, column, width), by rows, and the number of their values.");

  m.def("reduce",
        [](const FieldRows& rows, const std::vector<FieldColumns>& parts, std::pair<int, int> own,
           std::pair<int, int> rank, Indices further, Offsets runs) {
    std::vector<Block> blocks(further.size() / 4);
    for (std::size_t k = 0; k < blocks.size(); ++k)
    {
      const std::int32_t* values = further.data() + 4 * k;
      blocks[k] = {values[0], values[1], values[2], values[3]};
    }
    Reduced result = reduce(numbered(rows, parts), {own.first, own.second},
                            {rank.first, rank.second}, blocks,
                            {runs.data(), runs.data() + runs.size()});
    return std::make_tuple(to_numpy(std::move(result.inside)), to_numpy(std::move(result.outside)),
                           to_numpy(std::move(result.places)));
  },
        "rows"_a, "parts"_a, "own"_a, "rank"_a, "further"_a, "runs"_a,
        "Set starts and places of rows that are numbered in a range; return their columns of the "
        "rank, the other columns, and the places of the values of further blocks among both.");

  const char* of_entries = "Add entries to a matrix if it has places for all; return whether.";
  m.def("add_entries", add_entries<std::int32_t>, "entries"_a, "inside"_a, "outside"_a, "own"_a,
        "add"_a, of_entries);
  m.def("add_entries", add_entries<std::int64_t>, "entries"_a, "inside"_a, "outside"_a, "own"_a,
        "add"_a, of_entries);

  m.def("equal_rows", [](const RowArrays& A) { return to_numpy(equal_rows(sparse_rows(A))); }, "A"_a,
        "Return where rows begin that have the same columns, and the number of all rows.");

  m.def("multiply", [](const RowArrays& A, Indices first, Reals x, RealsOut y) {
    const SparseRows rows = sparse_rows(A);
    require(y.size() == rows.count, "y of each row");
    multiply(rows, first.data(), first.size(), x.data(), y.data());
  }, "A"_a, "first"_a, "x"_a, "y"_a.noconvert(), "Set y to A x; first is what equal_rows returns.");

  m.def("galerkin_pattern", [](const RowArrays& A, const RowArrays& P, std::size_t count) {
    const SparseRows rows = sparse_rows(A), from = sparse_rows(P);
    require(rows.count == from.count, "as many rows of A and P");
    auto [offsets, columns] = galerkin_pattern(rows, from, count);
    return std::make_pair(to_numpy(std::move(offsets)), to_numpy(std::move(columns)));
  }, "A"_a, "P"_a, "count"_a, "Return offsets and columns of the rows of P^T A P.");

  m.def("galerkin",
        [](const RowArrays& A, const RowArrays& P, Indices offsets, Indices columns, RealsOut values) {
    const SparseRows rows = sparse_rows(A), from = sparse_rows(P);
    require(rows.count == from.count && columns.size() == values.size(), "A, P and their product");
    galerkin(rows, from, {offsets.size() - 1, offsets.data(), columns.data(), nullptr},
             values.data());
  }, "A"_a, "P"_a, "offsets"_a, "columns"_a, "values"_a.noconvert(),
        "Set the values of P^T A P, with the pattern that galerkin_pattern returns.");

  m.def("assemble_points",
        [](Indices dofmap, Reals gradients, Reals weights, Offsets offsets, Indices nodes,
           Reals values, Reals support_gradients, Reals A, bool symmetric, const Where& where) {
    const Domains domains = domains_of(dofmap, gradients, &weights);
    const int square = domains.dim * domains.dim;
    require(domains.points == 1 && A.size() == domains.count * square * square,
            "A (n, dim, dim, dim, dim) of domains with one point");
    const Target target = target_of(where);
    const auto size = static_cast<std::size_t>(target.row.offsets[domains.count]) * 2;
    const bool given = support_gradients.size() > 0;
    require(!given || (domains.dim == 2 && support_gradients.size() == size),
            "gradients of the background basis in the plane, or none");
    assemble_points(domains, rows_of(offsets, nodes, values),
                    given ? support_gradients.data() : nullptr, A.data(), symmetric, target);
  },
        "dofmap"_a, "gradients"_a, "weights"_a, "offsets"_a, "nodes"_a, "values"_a,
        "support_gradients"_a, "A"_a, "symmetric"_a, "where"_a,
        "Add the reduced tangents of domains with one point.");

  m.def("assemble_domains",
        [](Indices dofmap, Reals gradients, Reals weights, Reals hoop, Reals transfers, Reals A,
           Reals vectors, const Where& where) {
    Domains domains = domains_of(dofmap, gradients, &weights);
    revolve(domains, hoop);
    const int square = domains.strain() * domains.strain();
    require(A.size() == num_points(domains) * square * square, "A (n, nq, dim, dim, dim, dim)");
    require(vectors.size() == 0 || vectors.ndim() == 4, "vectors (n, 2 m, k, dim), or none");
    const std::size_t pairs = vectors.size() == 0 ? 0 : vectors.shape(1) / 2;
    require(vectors.size() == domains.count * 2 * pairs * domains.nodes * domains.dim,
            "vectors (n, 2 m, k, dim), or none");
    assemble_domains(domains, transfers.data(), A.data(), vectors.data(), static_cast<int>(pairs),
                     target_of(where));
  },
        "dofmap"_a, "gradients"_a, "weights"_a, "hoop"_a, "transfers"_a, "A"_a, "vectors"_a,
        "where"_a, "Add the reduced tangents of domains with any number of points.");

  m.def("assemble_masses",
        [](Indices dofmap, Reals gradients, Reals transfers, Reals M, const Where& where,
           RealsOut values) {
    const Domains domains = domains_of(dofmap, gradients, nullptr);
    require(M.size() == domains.count * domains.nodes * domains.nodes, "M (n, k, k)");
    assemble_masses(domains, transfers.data(), M.data(), target_of(where), values.data());
  },
        "dofmap"_a, "gradients"_a, "transfers"_a, "M"_a, "where"_a, "values"_a.noconvert(),
        "Add the reduced masses of domains to numbers, one for each block.");

  m.def("add_diagonals",
        [](int dim, Indices nodes, Reals numbers, double factor, const Where& where) {
    const Indices& rows = std::get<5>(where);
    require(nodes.size() == numbers.size() && rows.size() > 0, "numbers of all blocks");
    add_diagonals(rows.size() - 1, dim, nodes.data(), numbers.data(), factor, target_of(where));
  },
        "dim"_a, "nodes"_a, "numbers"_a, "factor"_a, "where"_a,
        "Add a number for each block to its diagonal.");

  m.def("assemble_slopes",
        [](Indices dofmap, Reals gradients, Reals weights, Reals hoop, Reals slope,
           Reals displacement, Reals pressure, const std::optional<Where>& of_pressure, const std::optional<Where>& of_displacement) {
    Domains domains = domains_of(dofmap, gradients, &weights);
    revolve(domains, hoop);
    const int strain = domains.strain();
    require(slope.size() == num_points(domains) * strain * strain, "slopes (n, nq, dim, dim)");
    require(of_pressure || of_displacement, "somewhere to go");
    assemble_slopes(domains, slope.data(), displacement.data(), pressure.data(),
                    of_pressure ? std::optional(target_of(*of_pressure)) : std::nullopt,
                    of_displacement ? std::optional(target_of(*of_displacement)) : std::nullopt);
  },
        "dofmap"_a, "gradients"_a, "weights"_a, "hoop"_a, "slope"_a,
        "displacement"_a, "pressure"_a, "of_pressure"_a.none(),
        "of_displacement"_a.none(),
        "Add the blocks between a pressure at the points and the displacement.");

  m.def("assemble_diagonal",
        [](Reals factors, Reals transfers, const Where& where) {
    require(factors.ndim() == 2 && factors.shape(0) == std::get<0>(std::get<0>(where)).size(),
            "factors (n, nq)");
    assemble_diagonal(static_cast<int>(factors.shape(1)), factors.data(), transfers.data(),
                      target_of(where));
  },
        "factors"_a, "transfers"_a, "where"_a,
        "Add the block of a pressure with factors at the points.");

  m.def("slope_sizes",
        [](Indices dofmap, Reals gradients, Reals weights, Reals hoop, Reals slope, Reals u,
           RealsOut sizes) {
    Domains domains = domains_of(dofmap, gradients, &weights);
    revolve(domains, hoop);
    const int strain = domains.strain();
    require(slope.size() == num_points(domains) * strain * strain
                && sizes.size() == num_points(domains),
            "slopes (n, nq, dim, dim) and sizes (n, nq)");
    slope_sizes(domains, slope.data(), u.data(), sizes.data());
  },
        "dofmap"_a, "gradients"_a, "weights"_a, "hoop"_a, "slope"_a, "u"_a, "sizes"_a.noconvert(),
        "Set sizes to those of slopes times strains at the points, summed up without signs.");

  m.def("assemble_form",
        [](const Compiled& form, Indices dofmap, Reals gradients, Reals transfers, double factor,
           const Where& where) {
    assemble_form(form_of(form), domains_of(dofmap, gradients, nullptr), transfers.data(), factor,
                  target_of(where));
  },
        "form"_a, "dofmap"_a, "gradients"_a, "transfers"_a, "factor"_a, "where"_a,
        "Add the reduced element tensors of a compiled form on cells or (cell, local facet).");

  m.def("multiply_form",
        [](const Compiled& form, Indices dofmap, Reals gradients, Reals u, RealsOut force) {
    require(u.size() == force.size(), "displacement and force at the nodes");
    multiply_form(form_of(form), domains_of(dofmap, gradients, nullptr), u.data(), force.data());
  },
        "form"_a, "dofmap"_a, "gradients"_a, "u"_a, "force"_a.noconvert(),
        "Add the product of the tensors of a compiled form and a displacement to the force.");

  m.def("domain_forces", [](const Compiled& form, std::int32_t first, RealsOut forces) {
    const Indices& entities = std::get<1>(form);
    const auto last = first + static_cast<std::int32_t>(forces.shape(0));
    require(forces.ndim() == 3, "forces (n, k, dim)");
    for (std::size_t e = 0; e < entities.shape(0); ++e)
    {
      const std::int32_t cell = entities.data()[entities.ndim() * e];
      require(cell >= first && cell < last, "entities of these domains alone");
    }
    domain_forces(form_of(form), forces.shape(1) * forces.shape(2), first, forces.data());
  },
        "form"_a, "first"_a, "forces"_a.noconvert(),
        "Add the vectors of a compiled form to the forces (n, k, dim) of domains from the first on.");

  m.def("update_elastic",
        [](const std::string& law, Reals gradient, const std::vector<Reals>& parameters, RealsOut P,
           RealsOut A, RealsOut stress) {
    require(gradient.ndim() == 3, "displacement gradients (n, dim, dim)");
    std::vector<RealsOut> none;
    Update u = update_of(law_of(law), gradient.shape(0), {}, parameters, none);
    u.gradient = gradient.data();
    u.P = P.data();
    u.A = A.size() > 0 ? A.data() : nullptr;
    u.stress = stress.data();
    return to_numpy(update_logarithmic(u, static_cast<int>(gradient.shape(2))));
  }, "law"_a, "gradient"_a, "parameters"_a, "P"_a.noconvert(), "A"_a.noconvert(),
        "stress"_a.noconvert(),
        "Update an elastic law; return the points whose domains are inverted.");

  m.def("update_plastic",
        [](const std::string& law, Reals gradient, Reals old_gradient, Reals old_c,
           const std::vector<Reals>& old_variables, const std::vector<Reals>& parameters,
           Reals share, double tolerance, RealsOut P, RealsOut A, RealsOut stress, RealsOut c,
           std::vector<RealsOut> variables) {
    return update_with_history(law_of(law), gradient, old_gradient, old_c, old_variables,
                               parameters, share, tolerance, P, A, stress, c, variables);
  },
        "law"_a, "gradient"_a, "old_gradient"_a, "old_c"_a, "old_variables"_a, "parameters"_a,
        "share"_a, "tolerance"_a, "P"_a.noconvert(), "A"_a.noconvert(), "stress"_a.noconvert(),
        "c"_a.noconvert(), "variables"_a.noconvert(),
        "Update a law with a history; return the points whose domains are inverted.");

  m.def("integrate",
        [](const std::string& law, Reals trial, const std::vector<Reals>& old_variables,
           const std::vector<Reals>& parameters, Reals share, double tolerance, RealsOut stress,
           RealsOut tangent, RealsOut elastic, std::vector<RealsOut> variables) {
    require(trial.ndim() == 2 && (trial.shape(1) == 4 || trial.shape(1) == 6)
                && stress.size() == trial.size() && elastic.size() == trial.size()
                && (tangent.size() == 0 || tangent.size() == trial.size() * trial.shape(1)),
            "strains and stresses (n, m), tangents (n, m, m)");
    Update u = update_of(law_of(law), trial.shape(0), old_variables, parameters, variables);
    u.share = parameter_of(share, u.count);
    u.tolerance = tolerance;
    u.trial = trial.data();
    u.A = tangent.size() > 0 ? tangent.data() : nullptr;
    u.stress = stress.data();
    u.c = elastic.data();
    update_logarithmic(u, trial.shape(1) == 4 ? 2 : 3);
  },
        "law"_a, "trial"_a, "old_variables"_a, "parameters"_a, "share"_a, "tolerance"_a,
        "stress"_a.noconvert(), "tangent"_a.noconvert(), "elastic"_a.noconvert(),
        "variables"_a.noconvert(), "Set the answers of a law to strains of its own.");

  m.def("pull",
        [](const std::string& law, const std::vector<Reals>& before,
           const std::vector<Reals>& variables, const std::vector<Reals>& parameters,
           const Reals& share, double tolerance, const std::vector<RealsOut>& in,
           const std::vector<RealsOut>& out) {
    pull_logarithmic(change_of(law, before, variables, parameters, share, tolerance, in, out),
                     static_cast<int>(before[0].shape(2)));
  },
        "law"_a, "before"_a, "variables"_a, "parameters"_a, "share"_a, "tolerance"_a, "out"_a,
        "weights"_a,
        "Set derivatives by what a step of a law takes from those by what it gives.");

  m.def("replace_mean_stress",
        [](Reals gradient, Reals P, Reals A, Reals stress, Reals pressure, Reals bulk,
           Array<const std::uint8_t> small, RealsOut new_P, RealsOut new_A, RealsOut new_stress,
           RealsOut volume, RealsOut slope) {
    require(gradient.ndim() == 3 && stress.ndim() == 2,
            "displacement gradients (n, dim, dim) and stresses (n, components)");
    const std::size_t count = gradient.shape(0);
    const auto dim = static_cast<int>(gradient.shape(2));
    require(dim == 2 || dim == 3, "two or three dimensions");
    require(P.size() == gradient.size() && A.size() == count * dim * dim * dim * dim
                && new_P.size() == P.size() && new_A.size() == A.size()
                && slope.size() == P.size(),
            "stresses and slopes (n, dim, dim), tangents (n, dim, dim, dim, dim)");
    require(stress.shape(0) == count && stress.shape(1) >= 3 && new_stress.size() == stress.size()
                && pressure.size() == count && bulk.size() == count && small.size() == count
                && volume.size() == count,
            "values (n,)");
    replace_mean_stress({count, gradient.data(), P.data(), A.data(), stress.data(),
                         static_cast<int>(stress.shape(1)), pressure.data(), bulk.data(),
                         small.data()},
                        dim,
                        {new_P.data(), new_A.data(), new_stress.data(), volume.data(),
                         slope.data()});
  },
        "gradient"_a, "P"_a, "A"_a, "stress"_a, "pressure"_a, "bulk"_a, "small"_a,
        "new_P"_a.noconvert(), "new_A"_a.noconvert(), "new_stress"_a.noconvert(),
        "volume"_a.noconvert(), "slope"_a.noconvert(),
        "Let a pressure take the place of the mean stress of a law.");

  m.def("update_at_pressure",
        [](const std::string& law, Reals gradient, Reals old_gradient, Reals old_c,
           const std::vector<Reals>& old_variables, const std::vector<Reals>& parameters,
           Reals share, double tolerance, Reals pressure, Reals augmentation, RealsOut P, RealsOut A,
           RealsOut stress, RealsOut c, std::vector<RealsOut> variables, RealsOut gap,
           RealsOut compliance, RealsOut slope, RealsOut by_pressure) {
    const std::size_t count = gradient.shape(0);
    require(pressure.size() == count && gap.size() == count && compliance.size() == count
                && slope.size() == gradient.size() && by_pressure.size() == gradient.size(),
            "pressures and volumes (n,), and their derivatives (n, dim, dim)");
    const GivenPressure given{pressure.data(),   parameter_of(augmentation, count),
                              gap.data(),        compliance.data(),
                              slope.data(),      by_pressure.data()};
    return update_with_history(law_of(law), gradient, old_gradient, old_c, old_variables,
                               parameters, share, tolerance, P, A, stress, c, variables, &given);
  },
        "law"_a, "gradient"_a, "old_gradient"_a, "old_c"_a, "old_variables"_a, "parameters"_a,
        "share"_a, "tolerance"_a, "pressure"_a, "augmentation"_a, "P"_a.noconvert(), "A"_a.noconvert(),
        "stress"_a.noconvert(), "c"_a.noconvert(), "variables"_a.noconvert(), "gap"_a.noconvert(),
        "compliance"_a.noconvert(), "slope"_a.noconvert(), "by_pressure"_a.noconvert(),
        "Update a law with a history at given pressures; return the points where it fails.");

  m.def("step_stress",
        [](Reals gradient, Reals old_gradient, Reals P, Reals old_P, Reals A, Reals energy,
           Reals old_energy, Array<const std::uint8_t> kind, double small, double factor,
           RealsOut stress, RealsOut tangent) {
    require(gradient.ndim() == 3 && old_gradient.size() == gradient.size()
                && P.size() == gradient.size() && old_P.size() == gradient.size()
                && stress.size() == gradient.size(),
            "gradients and stresses (n, dim, dim)");
    const auto dim = static_cast<int>(gradient.shape(2));
    require(dim == 2 || dim == 3, "two or three dimensions");
    const std::size_t count = gradient.shape(0), square = static_cast<std::size_t>(dim * dim);
    require(A.size() == count * square * square && tangent.size() == A.size(),
            "tangents (n, dim, dim, dim, dim)");
    require(kind.size() == count || kind.size() == 1, "one kind, or one for each point");
    const bool known = energy.size() == count && old_energy.size() == count;
    for (std::size_t p = 0; p < kind.size(); ++p)
      require(kind.data()[p] <= static_cast<std::uint8_t>(Step::dissipative)
                  && (known || kind.data()[p] < static_cast<std::uint8_t>(Step::gonzalez)),
              "kinds, and energies (n,) where they are asked for");
    const StepEnds ends{count,
                        gradient.data(),
                        old_gradient.data(),
                        P.data(),
                        old_P.data(),
                        A.data(),
                        known ? energy.data() : nullptr,
                        known ? old_energy.data() : nullptr,
                        kind.data(),
                        kind.size() == 1 ? std::size_t{0} : std::size_t{1},
                        small,
                        factor};
    return to_numpy(step_stress(ends, dim, stress.data(), tangent.data()));
  },
        "gradient"_a, "old_gradient"_a, "P"_a, "old_P"_a, "A"_a, "energy"_a, "old_energy"_a,
        "kind"_a, "small"_a, "factor"_a, "stress"_a.noconvert(), "tangent"_a.noconvert(),
        "Set stress and tangent of a whole step; return the points whose F is singular.");

  m.def("damping",
        [](Reals gradient, Reals old_gradient, Reals stiffness, Array<const bool> small,
           double factor, RealsOut stress, RealsOut tangent) {
    require(gradient.ndim() == 3 && old_gradient.size() == gradient.size()
                && stress.size() == gradient.size(),
            "gradients and stresses (n, dim, dim)");
    const auto dim = static_cast<int>(gradient.shape(2));
    require(dim == 2 || dim == 3, "two or three dimensions");
    const std::size_t count = gradient.shape(0), square = static_cast<std::size_t>(dim * dim);
    require(stiffness.size() == count * square * square && tangent.size() == stiffness.size(),
            "stiffnesses and tangents (n, dim, dim, dim, dim)");
    require(small.size() == count, "one kind for each point");
    const Damping given{count,        gradient.data(), old_gradient.data(), stiffness.data(),
                        small.data(), factor};
    damping(given, dim, stress.data(), tangent.data());
  },
        "gradient"_a, "old_gradient"_a, "stiffness"_a, "small"_a, "factor"_a,
        "stress"_a.noconvert(), "tangent"_a.noconvert(), "Set stress and tangent of damping.");

  m.def("traction",
        [](const std::vector<Reals>& given, const std::vector<Reals>& points,
           Array<const std::uint8_t> touched, const std::vector<double>& law, bool smooth,
           RealsOut pressure, RealsOut normal, RealsOut shear, Array<std::uint8_t> inside,
           Array<std::uint8_t> slips) {
    const auto seen = separation_of(given);
    const std::size_t n = seen.points, dim = given[1].shape(1);
    require(pressure.size() == n && normal.size() == n * dim && shear.size() == n * dim
                && inside.size() == n && slips.size() == n,
            "pressures (n,), vectors (n, dim), values (n,)");
    act(touching_of(n, dim, points, touched, law, smooth), seen, static_cast<int>(dim),
        pressure.data(), normal.data(), shear.data(), inside.data(), slips.data());
  },
        "given"_a, "points"_a, "touched"_a, "law"_a, "smooth"_a, "pressure"_a.noconvert(),
        "normal"_a.noconvert(), "shear"_a.noconvert(), "inside"_a.noconvert(),
        "slips"_a.noconvert(), "Set tractions of contact at points.");

  m.def("traction_by_pressure",
        [](const std::vector<Reals>& given, const std::vector<Reals>& points,
           Array<const std::uint8_t> touched, const std::vector<double>& law, bool smooth,
           RealsOut slopes) {
    const auto seen = separation_of(given);
    const std::size_t dim = given[1].shape(1);
    require(slopes.size() == seen.points * dim, "slopes (n, dim)");
    differentiate_by_pressure(touching_of(seen.points, dim, points, touched, law, smooth), seen,
                              static_cast<int>(dim), slopes.data());
  },
        "given"_a, "points"_a, "touched"_a, "law"_a, "smooth"_a, "slopes"_a.noconvert(),
        "Set derivatives of tractions by pressures on top.");

  m.def("traction_slopes",
        [](const std::vector<Reals>& given, const std::vector<Reals>& points,
           Array<const std::uint8_t> touched, const std::vector<double>& law, bool smooth,
           Reals of_gap, Reals of_normal, RealsOut slopes) {
    const auto seen = separation_of(given);
    const std::size_t n = seen.points, dim = given[1].shape(1);
    require(of_gap.size() == n * dim && of_normal.size() == n * dim * dim
                && slopes.size() == n * dim * dim,
            "derivatives of gaps (n, dim), of normals and tractions (n, dim, dim)");
    differentiate(touching_of(n, dim, points, touched, law, smooth), seen, static_cast<int>(dim),
                  of_gap.data(), of_normal.data(), slopes.data());
  },
        "given"_a, "points"_a, "touched"_a, "law"_a, "smooth"_a, "of_gap"_a, "of_normal"_a,
        "slopes"_a.noconvert(), "Set derivatives of tractions by positions.");

  m.def("coulomb",
        [](Reals pressure, Reals stretch, double friction, double cohesion, double limit) {
    require(stretch.size() == pressure.size(), "pressures and stretches (n,)");
    std::vector<double> bounds(pressure.size());
    for (std::size_t p = 0; p < bounds.size(); ++p)
      bounds[p] = coulomb(pressure.data()[p], stretch.data()[p], friction, cohesion, limit);
    return to_numpy(std::move(bounds));
  },
        "pressure"_a, "stretch"_a, "friction"_a, "cohesion"_a, "limit"_a,
        "Return the largest shears by Coulomb's law.");

  m.def("act",
        [](Reals x, const std::vector<Reals>& tables, const std::vector<Reals>& start,
           const std::vector<Reals>& points, Array<const std::uint8_t> touched,
           const std::vector<double>& law, bool smooth,
           RealsOut pushes, RealsOut rubs, RealsOut pressure, Array<std::uint8_t> inside,
           Array<std::uint8_t> slips) {
    const Meeting meeting = meeting_of(x, tables, start, points, touched, law, smooth);
    const std::size_t n = meeting.points, dim = x.shape(2);
    require(pushes.size() == n * (1 + meeting.nodes) * dim && rubs.size() == pushes.size()
                && pressure.size() == n && inside.size() == n && slips.size() == n,
            "forces (n, 1 + nodes, dim), values (n,)");
    act(meeting, static_cast<int>(dim),
        {pushes.data(), rubs.data(), pressure.data(), inside.data(), slips.data()});
  },
        "x"_a, "tables"_a, "start"_a, "points"_a, "touched"_a, "law"_a, "smooth"_a, "pushes"_a.noconvert(),
        "rubs"_a.noconvert(), "pressure"_a.noconvert(), "inside"_a.noconvert(),
        "slips"_a.noconvert(), "Set what acts between points and facets.");

  m.def("act_by_pressure",
        [](Reals x, const std::vector<Reals>& tables, const std::vector<Reals>& start,
           const std::vector<Reals>& points, Array<const std::uint8_t> touched,
           const std::vector<double>& law, bool smooth, RealsOut slopes) {
    const Meeting meeting = meeting_of(x, tables, start, points, touched, law, smooth);
    const std::size_t dim = x.shape(2);
    require(slopes.size() == meeting.points * (1 + meeting.nodes) * dim, "forces (n, 1 + nodes, dim)");
    differentiate_by_pressure(meeting, static_cast<int>(dim), slopes.data());
  },
        "x"_a, "tables"_a, "start"_a, "points"_a, "touched"_a, "law"_a, "smooth"_a,
        "slopes"_a.noconvert(), "Set derivatives of forces on points and nodes by pressures on top.");

  m.def("see",
        [](Reals x, const std::vector<Reals>& tables, const std::vector<Reals>& start,
           const std::vector<Reals>& points, Array<const std::uint8_t> touched,
           const std::vector<double>& law, bool smooth, RealsOut gap, RealsOut normal,
           RealsOut way) {
    const Meeting meeting = meeting_of(x, tables, start, points, touched, law, smooth);
    const std::size_t n = meeting.points, dim = x.shape(2);
    require(gap.size() == n && normal.size() == n * dim && way.size() == n * dim,
            "gaps (n,), vectors (n, dim)");
    see(meeting, static_cast<int>(dim), gap.data(), normal.data(), way.data());
  },
        "x"_a, "tables"_a, "start"_a, "points"_a, "touched"_a, "law"_a, "smooth"_a,
        "gap"_a.noconvert(), "normal"_a.noconvert(), "way"_a.noconvert(),
        "Set gaps, normals and ways from anchors of points at their facets.");

  m.def("add_tangents",
        [](Reals x, const std::vector<Reals>& tables, const std::vector<Reals>& start,
           const std::vector<Reals>& points, Array<const std::uint8_t> touched,
           const std::vector<double>& law, bool smooth,
           Reals weights, Reals shapes, Offsets group, Indices positions, RealsOut values) {
    const Meeting meeting = meeting_of(x, tables, start, points, touched, law, smooth);
    const auto dim = static_cast<int>(x.shape(2));
    add_tangents(meeting, dim,
                 sums_of(meeting.points, dim, meeting.nodes, meeting.count, weights, shapes, group,
                         positions, values));
  },
        "x"_a, "tables"_a, "start"_a, "points"_a, "touched"_a, "law"_a, "smooth"_a, "weights"_a, "shapes"_a,
        "group"_a, "positions"_a, "values"_a.noconvert(),
        "Add the derivatives of what acts between points and facets to blocks between nodes.");

  m.def("add_slopes",
        [](Reals slopes, Reals weights, Reals shapes, Offsets group, Indices positions,
           RealsOut values) {
    require(slopes.ndim() == 3 && slopes.shape(1) == slopes.shape(2)
                && (slopes.shape(1) == 2 || slopes.shape(1) == 3),
            "derivatives (n, dim, dim)");
    const auto dim = static_cast<int>(slopes.shape(1));
    add_slopes(slopes.shape(0), dim, slopes.data(),
               sums_of(slopes.shape(0), dim, 0, 1, weights, shapes, group, positions, values));
  },
        "slopes"_a, "weights"_a, "shapes"_a, "group"_a, "positions"_a, "values"_a.noconvert(),
        "Add derivatives of tractions at points to blocks between nodes.");

  m.def("tabulate",
        [](Reals place, Reals coefficients, const std::tuple<int, bool>& kind, double close, int most,
           RealsOut shape, RealsOut slope, RealsOut bend) {
    require(place.ndim() == 2, "places (n, sides)");
    const std::size_t n = place.shape(0), sides = place.shape(1);
    const Shape facet = shape_of(sides + 1, coefficients, kind, close, most);
    const std::size_t size = n * static_cast<std::size_t>(facet.nodes);
    require(shape.size() == size && slope.size() == size * sides
                && bend.size() == size * sides * sides,
            "shape functions and derivatives (n, ..., nodes)");
    tabulate(n, static_cast<int>(sides) + 1, facet, place.data(),
             {shape.data(), slope.data(), bend.data()});
  },
        "place"_a, "coefficients"_a, "kind"_a, "close"_a, "most"_a, "shape"_a.noconvert(),
        "slope"_a.noconvert(), "bend"_a.noconvert(),
        "Set shape functions of facets with first and second derivatives.");

  m.def("project",
        [](Reals x, Reals corners, Reals coefficients, const std::tuple<int, bool>& kind,
           double close, int most, RealsOut place) {
    const Shape shape = shape_of(corners, coefficients, kind, close, most);
    const std::size_t n = corners.shape(0), dim = corners.shape(2);
    require(x.size() == n * dim && place.size() == n * (dim - 1), "points and places (n,)");
    return project(n, static_cast<int>(dim), shape, x.data(), corners.data(), place.data());
  },
        "x"_a, "corners"_a, "coefficients"_a, "kind"_a, "close"_a, "most"_a, "place"_a.noconvert(),
        "Project points on facets, from some places; return whether all have an area.");

  m.def("find_closest",
        [](Reals x, Reals normal, Reals corners, Reals coefficients,
           const std::tuple<int, bool>& kind, double close, int most, Reals outward,
           Array<const std::uint8_t> present, const std::vector<double>& bounds, OffsetsOut found,
           RealsOut place, RealsOut gap, Array<std::uint8_t> near, RealsOut beside) {
    const Shape shape = shape_of(corners, coefficients, kind, close, most);
    const std::size_t dim = corners.shape(2), n = found.size(), facets = corners.shape(0);
    require(x.size() == n * dim && (normal.size() == 0 || normal.size() == n * dim)
                && outward.size() == facets && present.size() == facets,
            "points and normals (n, dim), signs of facets");
    require(place.size() == n * (dim - 1) && gap.size() == n && near.size() == n
                && beside.size() == n,
            "results (n,)");
    require(bounds.size() == 4, "reach and three cosines");
    return find_closest({n, facets, shape, x.data(), normal.size() == 0 ? nullptr : normal.data(),
                         corners.data(), outward.data(), present.data(), bounds[0], bounds[1],
                         bounds[2], bounds[3]},
                        static_cast<int>(dim),
                        {found.data(), place.data(), gap.data(), near.data(), beside.data()});
  },
        "x"_a, "normal"_a, "corners"_a, "coefficients"_a, "kind"_a, "close"_a, "most"_a,
        "outward"_a, "present"_a, "bounds"_a, "found"_a.noconvert(), "place"_a.noconvert(),
        "gap"_a.noconvert(), "near"_a.noconvert(), "beside"_a.noconvert(),
        "Find the closest facets of points; return whether all that were tried have an area.");
}
