// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later
//
// Numbers with their derivatives by a few others, and vectors of few of them.

#pragma once

#include <array>
#include <cmath>
#include <cstddef>

namespace core
{
// Derivatives by some numbers, as vectors of four. (Compilers would take lanes one by one in several
// times the time; vectors may lie anywhere in memory.)
template <int count>
struct Lanes
{
  static constexpr int vectors = (count + 3) / 4;
  typedef double Four __attribute__((vector_size(4 * sizeof(double)), aligned(sizeof(double))));
  Four parts[vectors] = {};

  double operator[](int i) const { return parts[i / 4][i % 4]; }
  void set(int i, double number) { parts[i / 4][i % 4] = number; }
};

template <>
struct Lanes<1>
{
  static constexpr int vectors = 1;
  double parts[1] = {};

  double operator[](int) const { return parts[0]; }
  void set(int, double number) { parts[0] = number; }
};

template <int count>
struct Dual;

// f(a), of a known derivative.
template <int count>
Dual<count> chain(const Dual<count>& a, double value, double slope)
{
  Dual<count> result(value);
  for (int i = 0; i < Lanes<count>::vectors; ++i)
    result.by.parts[i] = slope * a.by.parts[i];
  return result;
}

// A number with its derivatives by some others; it is compared by its value.
template <int count>
struct Dual
{
  using By = Lanes<count>;
  double value = 0.0;
  By by;

  Dual() = default;
  Dual(double number) : value(number) {}

  friend Dual operator+(const Dual& a, const Dual& b) { return Dual(a) += b; }
  friend Dual operator-(const Dual& a, const Dual& b) { return Dual(a) -= b; }
  friend Dual operator*(const Dual& a, const Dual& b)
  {
    Dual result(a.value * b.value);
    for (int i = 0; i < By::vectors; ++i)
      result.by.parts[i] = a.value * b.by.parts[i] + b.value * a.by.parts[i];
    return result;
  }
  friend Dual operator*(double a, const Dual& b) { return chain(b, a * b.value, a); }
  friend Dual operator*(const Dual& a, double b) { return b * a; }
  friend Dual operator/(const Dual& a, double b) { return 1.0 / b * a; }
  friend Dual operator/(const Dual& a, const Dual& b)
  {
    Dual result(a.value / b.value);
    for (int i = 0; i < By::vectors; ++i)
      result.by.parts[i] = (a.by.parts[i] - result.value * b.by.parts[i]) / b.value;
    return result;
  }
  friend Dual operator-(const Dual& a) { return -1.0 * a; }
  friend bool operator<(const Dual& a, const Dual& b) { return a.value < b.value; }
  friend bool operator>(const Dual& a, const Dual& b) { return a.value > b.value; }
  friend bool operator<=(const Dual& a, const Dual& b) { return a.value <= b.value; }
  friend bool operator>=(const Dual& a, const Dual& b) { return a.value >= b.value; }

  Dual& operator+=(const Dual& b)
  {
    value += b.value;
    for (int i = 0; i < By::vectors; ++i)
      by.parts[i] += b.by.parts[i];
    return *this;
  }
  Dual& operator-=(const Dual& b)
  {
    value -= b.value;
    for (int i = 0; i < By::vectors; ++i)
      by.parts[i] -= b.by.parts[i];
    return *this;
  }
  Dual& operator*=(const Dual& b) { return *this = *this * b; }
};

inline double value_of(double a) { return a; }
inline double inverse(double a) { return 1.0 / a; }
inline double root(double a) { return std::sqrt(a); }

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

template <int count>
Dual<count> abs(const Dual<count>& a)
{
  return a.value < 0.0 ? -a : a;
}

template <int count>
Dual<count> exp(const Dual<count>& a)
{
  const double value = std::exp(a.value);
  return chain(a, value, value);
}

template <int count>
Dual<count> expm1(const Dual<count>& a)
{
  const double value = std::expm1(a.value);
  return chain(a, value, value + 1.0);
}

template <int count>
Dual<count> log(const Dual<count>& a)
{
  return chain(a, std::log(a.value), 1.0 / a.value);
}

// Of sizes, which do not fall below zero: where they are zero, their derivative is that too.
template <int count>
Dual<count> sqrt(const Dual<count>& a)
{
  return a.value > 0.0 ? root(a) : Dual<count>(0.0);
}

template <typename T, std::size_t dim>
T dot(const std::array<T, dim>& a, const std::array<T, dim>& b)
{
  T sum = a[0] * b[0];
  for (std::size_t i = 1; i < dim; ++i)
    sum = sum + a[i] * b[i];
  return sum;
}

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
} // namespace core
