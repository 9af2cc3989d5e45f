"""Small dense linear algebra for kernels: plain loops on preallocated arrays, for some two to ten states.

Covariances are symmetric: one triangle is computed and mirrored. Arrays may be larger than what is used:
sizes come from the state (`mean`) or from an argument. For three states update and propagation are also
written out in scalars, which is four times as fast.
"""

from __future__ import annotations

import math

from crosscomb.models.compiled import inlined

PIVOT_FLOOR = 1e-12
"""Least pivot of the guarded Cholesky factor, over the largest entry of the diagonal."""


@inlined
def copy_into(target, source):
    """Copy a vector to the beginning of another; numba's own assignment would make a copy in between."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@inlined
def joseph_update(mean, cov, row, innovation, variance, work):
    """Update a filter with one scalar measurement, in Joseph form (I - K H) P (I - K H)' + K R K'.

    Parameters
    ----------
    mean, cov : (n,), (n, n)
        Changed in place.
    row : (n,)
        Row of the measurement matrix.
    innovation : float
        Measured minus predicted.
    variance : float
        Of the measurement noise; positive.
    work : (2, n)
        Scratch.

    Returns
    -------
    nis : float
        innovation^2 over its variance.
    """
    return joseph_first(mean.size, mean, cov, row, innovation, variance, work)


@inlined
def joseph_first(n, mean, cov, row, innovation, variance, work):
    """`joseph_update` of the first n states; with n a literal its loops are unrolled."""
    s = variance
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += cov[i, j] * row[j]
        work[0, i] = total
        s += row[i] * total
    for i in range(n):
        work[1, i] = work[0, i] / s
        mean[i] += work[1, i] * innovation
    for i in range(n):
        # Row i of (I - K H) P times H', as H P H' = s - R.
        kept = work[0, i] - work[1, i] * (s - variance)
        for j in range(i + 1):
            cov[i, j] += work[1, j] * (work[1, i] * variance - kept) - work[1, i] * work[0, j]
            cov[j, i] = cov[i, j]
    return innovation * innovation / s


@inlined
def propagate_cov(cov, f, q, work):
    """Propagate a covariance in place: F P F' + Q.

    Parameters
    ----------
    cov, f, q : (n, n)
    work : (n, n)
        Scratch.
    """
    n = cov.shape[0]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += f[i, k] * cov[k, j]
            work[i, j] = total
    for i in range(n):
        for j in range(i + 1):
            total = q[i, j]
            for k in range(n):
                total += work[i, k] * f[j, k]
            cov[i, j] = total
            cov[j, i] = total


@inlined
def joseph_update_3(mean, cov, h0, h1, h2, innovation, variance):
    """`joseph_update` of three states with the row (h0, h1, h2), in scalars."""
    p00, p10, p11, p20, p21, p22 = cov[0, 0], cov[1, 0], cov[1, 1], cov[2, 0], cov[2, 1], cov[2, 2]
    g0 = p00 * h0 + p10 * h1 + p20 * h2
    g1 = p10 * h0 + p11 * h1 + p21 * h2
    g2 = p20 * h0 + p21 * h1 + p22 * h2
    projected = h0 * g0 + h1 * g1 + h2 * g2
    inverse = 1.0 / (projected + variance)
    k0, k1, k2 = g0 * inverse, g1 * inverse, g2 * inverse
    mean[0] += k0 * innovation
    mean[1] += k1 * innovation
    mean[2] += k2 * innovation
    # K R - (I - K H) P H', the factor of K' in the Joseph form
    e0 = k0 * variance - g0 + k0 * projected
    e1 = k1 * variance - g1 + k1 * projected
    e2 = k2 * variance - g2 + k2 * projected
    cov[0, 0] = p00 - k0 * g0 + e0 * k0
    cov[1, 1] = p11 - k1 * g1 + e1 * k1
    cov[2, 2] = p22 - k2 * g2 + e2 * k2
    cov[0, 1] = cov[1, 0] = p10 - k1 * g0 + e1 * k0
    cov[0, 2] = cov[2, 0] = p20 - k2 * g0 + e2 * k0
    cov[1, 2] = cov[2, 1] = p21 - k2 * g1 + e2 * k1
    return innovation * innovation * inverse


@inlined
def propagate_3(cov, jacobian, h, q):
    """Propagate a covariance ``(3, 3)`` over an Euler step in place: F P F' + Q with F = I + h J, in scalars.

    Parameters
    ----------
    cov, q : (3, 3)
    jacobian : (>=3, 3)
        J, in its first three rows.
    h : float [s]
    """
    p00, p10, p11, p20, p21, p22 = cov[0, 0], cov[1, 0], cov[1, 1], cov[2, 0], cov[2, 1], cov[2, 2]
    f00, f01, f02 = 1.0 + h * jacobian[0, 0], h * jacobian[0, 1], h * jacobian[0, 2]
    f10, f11, f12 = h * jacobian[1, 0], 1.0 + h * jacobian[1, 1], h * jacobian[1, 2]
    f20, f21, f22 = h * jacobian[2, 0], h * jacobian[2, 1], 1.0 + h * jacobian[2, 2]
    b0, b1, b2 = (
        f00 * p00 + f01 * p10 + f02 * p20,
        f00 * p10 + f01 * p11 + f02 * p21,
        f00 * p20 + f01 * p21 + f02 * p22,
    )
    c0, c1, c2 = (
        f10 * p00 + f11 * p10 + f12 * p20,
        f10 * p10 + f11 * p11 + f12 * p21,
        f10 * p20 + f11 * p21 + f12 * p22,
    )
    d0, d1, d2 = (
        f20 * p00 + f21 * p10 + f22 * p20,
        f20 * p10 + f21 * p11 + f22 * p21,
        f20 * p20 + f21 * p21 + f22 * p22,
    )
    cov[0, 0] = b0 * f00 + b1 * f01 + b2 * f02 + q[0, 0]
    cov[1, 1] = c0 * f10 + c1 * f11 + c2 * f12 + q[1, 1]
    cov[2, 2] = d0 * f20 + d1 * f21 + d2 * f22 + q[2, 2]
    cov[0, 1] = cov[1, 0] = c0 * f00 + c1 * f01 + c2 * f02 + q[1, 0]
    cov[0, 2] = cov[2, 0] = d0 * f00 + d1 * f01 + d2 * f02 + q[2, 0]
    cov[1, 2] = cov[2, 1] = d0 * f10 + d1 * f11 + d2 * f12 + q[2, 1]


@inlined
def guarded_cholesky(a, n, factor):
    """Lower Cholesky factor L of the leading n x n block, L L' = A; never fails.

    A pivot that is not clearly positive (A indefinite by rounding or by negative sigma-point weights) is
    replaced by `PIVOT_FLOOR` times the largest diagonal entry, which adds variance where there was too
    little.

    Parameters
    ----------
    a : (>=n, >=n)
        Symmetric; the lower triangle is read.
    factor : (>=n, >=n)
        Gets L, zeros above the diagonal.
    """
    largest = 0.0
    for i in range(n):
        largest = max(largest, a[i, i])
    floor = PIVOT_FLOOR * largest + 1e-300
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= factor[j, k] * factor[j, k]
        root = math.sqrt(max(pivot, floor))
        factor[j, j] = root
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = total / root
            factor[j, i] = 0.0


@inlined
def solve_lower(factor, b, m):
    """Solve L x = b in place for a lower-triangular L ``(>=m, >=m)`` and b ``(>=m,)``."""
    for i in range(m):
        total = b[i]
        for k in range(i):
            total -= factor[i, k] * b[k]
        b[i] = total / factor[i, i]


@inlined
def joint_update(mean, cov, cross, s, innovation, m, factor):
    """Update a filter with m measurements at once: K = Pxz S^-1, x += K y, P -= K S K'.

    Parameters
    ----------
    mean, cov : (n,), (n, n)
        Changed in place.
    cross : (>=m, n)
        Covariance of measurements and state, Pzx; overwritten.
    s : (>=m, >=m)
        Covariance of the innovation.
    innovation : (>=m,)
        Measured minus predicted; overwritten.
    m : int
        Number of measurements.
    factor : (>=m, >=m)
        Scratch.

    Returns
    -------
    nis : float
    """
    n = mean.size
    guarded_cholesky(s, m, factor)
    solve_lower(factor, innovation, m)
    # With S = L L', W = L^-1 Pzx and e = L^-1 y: K y = W' e and K S K' = W' W.
    for i in range(n):
        solve_lower(factor, cross[:, i], m)
    nis = 0.0
    for k in range(m):
        nis += innovation[k] * innovation[k]
        for i in range(n):
            mean[i] += cross[k, i] * innovation[k]
            for j in range(i + 1):
                cov[i, j] -= cross[k, i] * cross[k, j]
    for i in range(n):
        for j in range(i):
            cov[j, i] = cov[i, j]
    return nis


@inlined
def triangular_factor(a, n, columns, factor):
    """Lower-triangular S with S S' = A A', by modified Gram-Schmidt on the rows of A.

    This is the "Tria" of square-root filters: the transposed R of a QR decomposition of A'.

    Parameters
    ----------
    a : (>=n, >=columns)
        Overwritten.
    factor : (>=n, >=n)
        Gets S with a non-negative diagonal, zeros above it.
    """
    for i in range(n):
        total = 0.0
        for k in range(columns):
            total += a[i, k] * a[i, k]
        length = math.sqrt(total)
        factor[i, i] = length
        inverse = 1.0 / max(length, 1e-150)
        for j in range(i + 1, n):
            dot = 0.0
            for k in range(columns):
                dot += a[j, k] * a[i, k]
            dot *= inverse
            factor[j, i] = dot
            factor[i, j] = 0.0
            for k in range(columns):
                a[j, k] -= dot * inverse * a[i, k]
