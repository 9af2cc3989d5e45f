"""Resampling of weighted particles: which particle each new one is a copy of.

Multinomial, stratified and systematic as D'Inverno 2021, section 2.2; residual as Liu and Chen 1998. All are
unbiased: particle i is drawn n times its weight on average. They differ in the scatter of that number: multinomial
draws scatter most, systematic ones least, by less than one copy.
"""

from __future__ import annotations

import math

from crosscomb.models.compiled import kernel

RESAMPLING = {"systematic": 0, "stratified": 1, "multinomial": 2, "residual": 3}
"""Number of each scheme, as kernels take it."""

SYSTEMATIC, STRATIFIED, MULTINOMIAL, RESIDUAL = range(4)


@kernel
def sorted_uniforms(rng, positions):
    """Fill with independent uniform numbers in ascending order, without sorting.

    The gaps between sorted uniform numbers are distributed as exponential ones over their sum.
    """
    total = 0.0
    for i in range(positions.size):
        total += rng.standard_exponential()
        positions[i] = total
    total += rng.standard_exponential()
    for i in range(positions.size):
        positions[i] /= total


@kernel
def pick(weights, positions, source):
    """Find the particle whose share of the cumulated weights holds each of the ascending positions."""
    last, cumulative = 0, weights[0]
    for i in range(positions.size):
        while cumulative < positions[i] and last < weights.size - 1:
            last += 1
            cumulative += weights[last]
        source[i] = last


@kernel
def copy_whole(weights, rest, source):
    """Copy each particle as often as its weight says in whole numbers; give the number of copies.

    The fractions left over, as weights that sum to one, go to `rest`.
    """
    n, filled, total = source.size, 0, 0.0
    for i in range(weights.size):
        whole = math.floor(n * weights[i])
        rest[i] = n * weights[i] - whole
        total += rest[i]
        for _ in range(min(int(whole), n - filled)):
            source[filled] = i
            filled += 1
    for i in range(weights.size):
        rest[i] /= max(total, 1e-300)
    return filled


@kernel
def draw_sources(scheme, weights, rng, positions, rest, source):
    """Choose which particle each new one copies.

    Parameters
    ----------
    scheme : int
        Value of `RESAMPLING`.
    weights : (n,)
        Sum to one.
    rng : numpy.random.Generator
    positions : (m,)
        Filled with the positions on the cumulated weights.
    rest : (n,)
        Scratch for the weights that whole copies leave over.
    source : (m,) int64
        Filled with the index of the particle to copy, in ascending order but for the residual scheme.
    """
    n = source.size
    if scheme == RESIDUAL:
        filled = copy_whole(weights, rest, source)
        sorted_uniforms(rng, positions[: n - filled])
        pick(rest, positions[: n - filled], source[filled:])
        return
    if scheme == MULTINOMIAL:
        sorted_uniforms(rng, positions)
    elif scheme == STRATIFIED:
        for i in range(n):
            positions[i] = (i + rng.random()) / n
    else:
        offset = rng.random()  # one for all
        for i in range(n):
            positions[i] = (i + offset) / n
    pick(weights, positions, source)


@kernel
def resample(particles):
    """Draw the particles anew by their weights, with the scheme in their state.

    Parameters
    ----------
    particles : NamedTuple
        x, scratch (states of at least 2, n), weights, log_weights (n,), source (n,) int64, rng, scheme.
    """
    x, source, scratch = particles.x, particles.source, particles.scratch
    draw_sources(particles.scheme, particles.weights, particles.rng, scratch[0], scratch[1], source)
    for row in range(x.shape[0]):
        for i in range(source.size):
            scratch[row, i] = x[row, source[i]]
    for row in range(x.shape[0]):  # as x[:, :] = scratch it takes 5 s to compile
        for i in range(x.shape[1]):
            x[row, i] = scratch[row, i]
    particles.log_weights[:] = 0.0
