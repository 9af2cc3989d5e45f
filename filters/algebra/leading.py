"""Steps of Kalman filters whose last states are constants: tyre parameters, or forces that only noise drives.

Only the leading rows of their transition matrix differ from the identity, so propagation costs a fraction of
the dense product; and the constants may be left alone by an update while they cannot be told.
"""

from __future__ import annotations

from crosscomb.models.compiled import inlined


@inlined
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


@inlined
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
        crossed[i] = 0.0
    for j in range(n):  # most rows are mostly zero
        weight = row[j]
        if weight != 0.0:
            for i in range(n):
                crossed[i] += weight * cov[j, i]
    for i in range(n):
        s += row[i] * crossed[i]
    for i in range(n):
        gain[i] = crossed[i] / s if i < free else 0.0
        mean[i] += gain[i] * innovation
    for i in range(n):
        g, c = gain[i], crossed[i]
        for j in range(n):  # in this order of sums the result is symmetric to the last bit
            cov[i, j] = cov[i, j] - (g * crossed[j] + c * gain[j]) + s * (g * gain[j])
    return innovation * innovation / s
