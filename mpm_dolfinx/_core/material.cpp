// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Hencky elasticity and von Mises plasticity in logarithmic strain, point by point.
//
// The same algorithm as mpm_dolfinx.materials (kinematics, von_mises), which is its oracle. The
// law is isotropic, so stress and strain share the axes of the trial elastic b, and its tangent
// has 8 (plane) or 21 (space) entries other than zero in that frame.

#include "material.h"
#include "hot_loop.h"

#include <array>
#include <cmath>
#include <limits>
#include <vector>

namespace
{
constexpr double root_half = 0.70710678118654752440;
constexpr double root_two_thirds = 0.81649658092772603273;

template <int dim>
using Matrix = std::array<std::array<double, dim>, dim>;

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

// The inverse of I + H; returns its determinant.
template <int dim>
double inverse(const Matrix<dim>& H, Matrix<dim>& result)
{
  Matrix<dim> F = H;
  for (int i = 0; i < dim; ++i)
    F[i][i] += 1.0;
  double det;
  if constexpr (dim == 2)
  {
    det = F[0][0] * F[1][1] - F[0][1] * F[1][0];
    result = {{{F[1][1] / det, -F[0][1] / det}, {-F[1][0] / det, F[0][0] / det}}};
  }
  else
  {
    for (int k = 0; k < 3; ++k)
    {
      const auto &a = F[(k + 1) % 3], &b = F[(k + 2) % 3];
      result[0][k] = a[1] * b[2] - a[2] * b[1];
      result[1][k] = a[2] * b[0] - a[0] * b[2];
      result[2][k] = a[0] * b[1] - a[1] * b[0];
    }
    det = F[0][0] * result[0][0] + F[0][1] * result[1][0] + F[0][2] * result[2][0];
    for (auto& row : result)
      for (double& entry : row)
        entry /= det;
  }
  return det;
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

struct Parameters
{
  double bulk, shear, rho_y, hardening;
};

// Answer of the law in the principal frame; the shear response is that of all off-diagonal
// entries, `normal` that of the principal strains.
struct Response
{
  std::array<double, 3> stress, elastic_strain;
  double plastic_strain;
  bool plastic;
  double shear;
  double normal[3][3];
};

// Radial return (Wilkins 1964) with the consistent tangent of Simo & Taylor (1985).
Response integrate(const std::array<double, 3>& strain, double plastic_strain,
                   const Parameters& parameters, double tolerance)
{
  const auto [bulk, shear, rho_y, h] = parameters;
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
  Response r;
  r.plastic = 2.0 * shear * size / rho - 1.0 > tolerance;
  r.plastic_strain = plastic_strain;
  r.elastic_strain = strain;
  r.shear = 2.0 * shear;
  double along = 0.0;
  if (r.plastic)
  {
    const double slope = 2.0 / 3.0 * h;
    const double flow = (2.0 * shear * size - rho) / (2.0 * shear + slope);
    const double strength = rho + slope * flow;
    r.shear = strength / size;
    along = 2.0 * shear * slope / (2.0 * shear + slope) - r.shear;
    for (int a = 0; a < 3; ++a)
    {
      const double direction = deviator[a] / size;
      r.stress[a] = bulk * trace + strength * direction;
      r.elastic_strain[a] -= flow * direction;
    }
    r.plastic_strain += root_two_thirds * flow;
  }
  else
    for (int a = 0; a < 3; ++a)
      r.stress[a] = bulk * trace + 2.0 * shear * deviator[a];
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b)
    {
      r.normal[a][b] = bulk - r.shear / 3.0 + (a == b ? r.shear : 0.0);
      if (r.plastic)
        r.normal[a][b] += along * (deviator[a] / size) * (deviator[b] / size);
    }
  return r;
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
        const double rate = r.shear * logarithm_quotient(principal[a], principal[b]);
        add(rate * (1.0 + principal[b]), dyad[a][b], dyad[a][b]);
        add(rate * (1.0 + principal[a]) - r.stress[a], dyad[a][b], dyad[b][a]);
      }
    }
}

template <int dim>
bool update_point(const double* gradient, const double* old_gradient, const double* old_c,
                  double plastic_strain, const Parameters& parameters, double tolerance, double* P,
                  double* A, double* stress, double* c, double* new_plastic_strain)
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

  const Response r = integrate(strain, plastic_strain, parameters, tolerance);
  const Matrix<dim> tau = from_principal<dim>(r.stress, axes);
  for (int i = 0; i < dim; ++i)
    for (int J = 0; J < dim; ++J)
    {
      P[i * dim + J] = 0.0;
      for (int j = 0; j < dim; ++j)
        P[i * dim + J] += tau[i][j] * inverse_F[J][j];
    }
  pack<dim>(tau, stress);
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
    *new_plastic_strain = r.plastic_strain;
  }
  return true;
}

template <int dim>
std::vector<std::int64_t> update_all(const core::Update& u)
{
  constexpr int size = dim * dim, m = dim == 2 ? 4 : 6;
  std::vector<std::int64_t> invalid;
  const bool history = u.old_gradient != nullptr;
  for (std::size_t p = 0; p < u.count; ++p)
  {
    const Parameters parameters{u.bulk(p), u.shear(p),
                                history ? u.rho_y(p) : std::numeric_limits<double>::infinity(),
                                history ? u.hardening(p) : 0.0};
    const bool valid = update_point<dim>(
        u.gradient + p * size, history ? u.old_gradient + p * size : nullptr,
        history ? u.old_c + p * m : nullptr, history ? u.old_plastic_strain[p] : 0.0, parameters,
        u.tolerance, u.P + p * size, u.A == nullptr ? nullptr : u.A + p * size * size,
        u.stress + p * m, history ? u.c + p * m : nullptr,
        history ? u.plastic_strain + p : nullptr);
    if (!valid)
      invalid.push_back(static_cast<std::int64_t>(p));
  }
  return invalid;
}
} // namespace

HOT_LOOP std::vector<std::int64_t> core::update_logarithmic(const Update& update, int dim)
{
  return dim == 2 ? update_all<2>(update) : update_all<3>(update);
}
