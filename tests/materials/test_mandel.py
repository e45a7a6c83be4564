# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Mandel vectors and the algebra of many tensors against NumPy, tensor by tensor."""

import numpy as np
import pytest

from mpm_dolfinx.errors import MPMError
from mpm_dolfinx.materials import mandel, tensors


def symmetric(n, dim, seed=0):
    tensor = np.zeros((n, 3, 3))
    tensor[:, :dim, :dim] = np.random.default_rng(seed).normal(size=(n, dim, dim))
    tensor[:, 2, 2] += 1.0
    return tensor + tensor.swapaxes(1, 2)


@pytest.mark.parametrize("dim", [2, 3])
def test_vectors_keep_inner_products_and_come_back(dim):
    A, B = symmetric(20, dim, 1), symmetric(20, dim, 2)
    a, b = mandel.to_vector(A, dim), mandel.to_vector(B, dim)
    assert a.shape == (20, mandel.num_components(dim))
    np.testing.assert_allclose(np.sum(a * b, axis=1), np.sum(A * B, axis=(1, 2)), rtol=1e-13)
    np.testing.assert_allclose(mandel.to_tensor(a), A, rtol=1e-15)


@pytest.mark.parametrize("dim", [2, 3])
def test_invariants(dim):
    A = symmetric(20, dim)
    a = mandel.to_vector(A, dim)
    trace = np.trace(A, axis1=1, axis2=2)
    deviator = A - trace[:, None, None] * np.eye(3) / 3.0
    np.testing.assert_allclose(mandel.trace(a), trace, rtol=1e-14)
    np.testing.assert_allclose(mandel.to_tensor(mandel.deviator(a)), deviator, atol=1e-14)
    np.testing.assert_allclose(
        mandel.deviator(a), a @ mandel.deviatoric_projector(a.shape[1]), atol=1e-14
    )
    np.testing.assert_allclose(mandel.norm(a), np.linalg.norm(A, axis=(1, 2)), rtol=1e-14)
    np.testing.assert_array_equal(mandel.to_tensor(mandel.identity(4)[None])[0], np.eye(3))


def test_norm_is_analytic():
    a = mandel.to_vector(symmetric(5, 3), 3)
    slope = np.imag(mandel.norm(a + 1e-30j * np.eye(6)[2])) / 1e-30
    np.testing.assert_allclose(slope, a[:, 2] / mandel.norm(a), rtol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("scale", [1.0, 1e-9])
def test_eigen(dim, scale):
    A = scale * symmetric(200, dim)[:, :dim, :dim]
    A[0] = scale * np.eye(dim)
    A[1] = 0.0
    A[2] = np.diag([1.0, 2.0, 3.0][:dim])
    A[3] = np.diag([3.0, 2.0, 1.0][:dim])
    A[4, 0, 1] = A[4, 1, 0] = A[4, 0, 0] * 1e-20
    values, vectors = tensors.eigen(tensors.points_last(A))
    back = np.einsum("ian,an,jan->nij", vectors, values, vectors)
    assert np.abs(back - A).max() < 2e-15 * np.abs(A).max()
    eye = np.einsum("ian,ibn->nab", vectors, vectors)
    np.testing.assert_allclose(eye, np.broadcast_to(np.eye(dim), eye.shape), atol=1e-15)


@pytest.mark.parametrize("dim", [2, 3])
def test_inverse(dim):
    H = np.random.default_rng(0).normal(size=(50, dim, dim))
    inverse, det = tensors.inverse(tensors.points_last(H))
    F = np.eye(dim) + H
    np.testing.assert_allclose(det, np.linalg.det(F), rtol=1e-11)
    np.testing.assert_allclose(tensors.points_first(inverse), np.linalg.inv(F), rtol=1e-9)


@pytest.mark.parametrize("difference", [1e-3, 1e-8, 1e-13, 1e-20, 0.0])
def test_logarithm_quotient_of_close_arguments(difference):
    """The reference is the series of the quotient about the mean argument."""
    x, y = np.array([difference]), np.array([-0.0])
    series = 0.5 * (1.0 - difference / 2 + difference**2 / 3 - difference**3 / 4)
    np.testing.assert_allclose(tensors.logarithm_quotient(x, y), series, rtol=1e-12)
    np.testing.assert_allclose(tensors.logarithm_quotient(y, x), series, rtol=1e-12)


def test_other_dimensions_are_refused():
    with pytest.raises(MPMError, match=r"2 .* and 3 dimensions"):
        mandel.num_components(1)
