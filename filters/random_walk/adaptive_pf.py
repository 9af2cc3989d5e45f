"""Random-walk particle filter that takes as many particles as it needs just now.

Atheupe 2023, section 7.3, finds that many particles help in some stretches only and proposes to adapt their number.
Here the rule goes by the effective sample size ``1 / sum(w^2)``: when particles are drawn anew, their new number is

    n_new = n * effective / (1 / sum(w^2))

between two limits, so that the effective ones would have been as many as asked for; it grows at once and shrinks by a
tenth at most. Where the measurements come as expected, resampling happens at half of n and n settles at twice the
effective number; in sudden manoeuvres few particles fit, and n grows. All else is
`crosscomb.filters.random_walk.plain_pf`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.filters.algebra.particles import RESAMPLE_BELOW
from crosscomb.filters.algebra.resampling import RESAMPLING, draw_sources
from crosscomb.filters.base import KernelFilter
from crosscomb.filters.random_walk.plain_pf import Particles, particle_answer, plain_state
from crosscomb.filters.random_walk.shared import ParticleNoise
from crosscomb.models.compiled import allocating

SHRINK = 0.9
"""The number of particles falls no faster than by this factor at a time."""


class ParticleStore(NamedTuple):
    """Room for the most particles; the first `number` of them are in use. Changed in place by the kernel."""

    particles: Particles  # x and scratch (6, most), of which the first 6 times `number` values are in use
    number: np.ndarray  # (1,) int64, particles in use
    least: int
    most: int
    effective: float  # wanted effective sample size


@allocating
def block(array, n):
    """The first numbers of a ``(6, most)`` array as ``(6, n)``."""
    return array.reshape(array.size)[: 6 * n].reshape((6, n))


@allocating
def in_use(particles, n):
    """The first n particles, as the kernels of `random_walk_pf` take them."""
    return Particles(
        x=block(particles.x, n),
        log_weights=particles.log_weights[:n],
        weights=particles.weights[:n],
        scratch=block(particles.scratch, n),
        running=particles.running,
        ekf=particles.ekf,
        ekf_out=particles.ekf_out,
        rng=particles.rng,
        source=particles.source[:n],
        scheme=particles.scheme,
        evidence=particles.evidence,
    )


@allocating
def wanted(store, effective):
    """Number of particles that the effective sample size asks for."""
    n = store.number[0]
    asked = max(n * store.effective / effective, SHRINK * n)
    return int(min(max(asked, store.least), store.most))


@allocating
def resample_to(store, used, n):
    """Draw n particles from those used, by their weights."""
    room = store.particles
    positions, rest = np.empty(n), np.empty(used.weights.size)
    draw_sources(room.scheme, used.weights, room.rng, positions, rest, room.source[:n])
    drawn = block(room.scratch, n)
    for row in range(6):
        for i in range(n):
            drawn[row, i] = used.x[row, room.source[i]]
    block(room.x, n)[:, :] = drawn
    room.log_weights[:n] = 0.0
    store.number[0] = n


@allocating
def adaptive_step(store, sample, car, noise, dt, out):
    """One sample; `out` ``(4,)`` gets beta, its standard deviation, NaN and the number of particles used."""
    if store.particles.running[0] == 0:
        store.number[0] = store.most  # the first ones are spread wide
    used = in_use(store.particles, store.number[0])
    effective = particle_answer(used, sample, car, noise, dt, out)
    out[3] = used.weights.size
    if effective < RESAMPLE_BELOW * used.weights.size:
        resample_to(store, used, wanted(store, effective))


@allocating
def adaptive_run(store, samples, car, noise, dt, out):
    """All samples of the filter."""
    for k in range(samples.shape[0]):
        adaptive_step(store, samples[k], car, noise, dt, out[k])


@dataclass(frozen=True)
class AdaptivePF(KernelFilter):
    """Random-walk particle filter of one vehicle with an adaptive number of particles.

    `effective` is the wanted effective sample size; there are never fewer than `least_particles` and never more
    than `most_particles`.
    """

    noise: ParticleNoise = ParticleNoise()
    effective: int = 500
    least_particles: int = 500
    most_particles: int = 10_000
    resampling: str = "systematic"
    seed: int = 0

    divisors = (*KernelFilter.divisors, "pseudo")
    choices: ClassVar = {**KernelFilter.choices, "resampling": tuple(RESAMPLING)}
    extras = ("particles [1]",)
    run_kernel = staticmethod(adaptive_run)

    def __post_init__(self) -> None:
        """Refuse limits the wrong way round."""
        if self.least_particles > self.most_particles:
            raise UsageError(
                f"adaptive_pf: least_particles {self.least_particles} is more than most_particles "
                f"{self.most_particles}: exchange them"
            )

    def make_state(self) -> Any:
        """Make the particles before the first sample."""
        return ParticleStore(
            particles=plain_state(self.most_particles, self.resampling, self.seed),
            number=np.full(1, self.most_particles),
            least=self.least_particles,
            most=self.most_particles,
            effective=float(self.effective),
        )
