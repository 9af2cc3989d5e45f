"""Steps of Kalman filters whose last states are constants: tyre parameters, or forces that only noise drives.

Only the leading rows of their transition matrix differ from the identity, so propagation costs a fraction of
the dense product; and the constants may be left alone by an update while they cannot be told.
"""

from __future__ import annotations

from numba import njit


@njit(cache=True)
def propagate_leading(cov, rows, work):
    """Propagate a covariance in place: F P F' with F = [rows; 0 I].

    Parameters
    ----------
    cov : (n, n)
    rows : (m, n)
        The first m rows of the transition matrix.
    work : (m, n)
        Scratch.
    """
    m, n = rows.shape
    for i in range(m):
        for j in range(n):
            work[i, j] = 0.0
        for k in range(n):
            factor = rows[i, k]
            if factor != 0.0:
                for j in range(n):
                    work[i, j] += factor * cov[k, j]
    for i in range(m):
        for j in range(i, m):
            total = 0.0
            for k in range(n):
                total += work[i, k] * rows[j, k]
            cov[i, j] = cov[j, i] = total
        for j in range(m, n):
            cov[i, j] = cov[j, i] = work[i, j]


@njit(cache=True)
def consider_update(mean, cov, row, innovation, variance, free, gain, crossed):
    """Update with one scalar measurement that may change the first `free` states only, in Joseph form.

    The states behind keep their value and variance but their uncertainty counts (Schmidt-Kalman filter); with
    all states free this is the Kalman update. (I - K H) P (I - K H)' + K R K' is written out for a scalar.

    Parameters
    ----------
    mean, cov : (>= n,), (n, n)
        Changed in place.
    row : (n,)
        Row of the measurement matrix.
    innovation : float
        Measured minus predicted.
    variance : float
        Of the measurement noise.
    free : int
    gain, crossed : (n,)
        Scratch.

    Returns
    -------
    nis : float
        innovation^2 over its variance.
    """
    n = row.shape[0]
    s = variance
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += cov[i, j] * row[j]
        crossed[i] = total
        s += row[i] * total
    for i in range(n):
        gain[i] = crossed[i] / s if i < free else 0.0
        mean[i] += gain[i] * innovation
    for i in range(n):
        for j in range(i, n):
            part = cov[i, j] - gain[i] * crossed[j] - crossed[i] * gain[j] + gain[i] * gain[j] * s
            cov[i, j] = cov[j, i] = part
    return innovation * innovation / s
