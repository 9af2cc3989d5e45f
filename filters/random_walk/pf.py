"""Particle filter on the random-walk force model.

State [yaw_rate, beta, fxf, fxr, fyf, fyr] (Atheupe 2023, eq. 29, corrected); weights from yaw rate, ax and ay
(eq. 23) and from a dynamic EKF's beta as pseudo-measurement (eq. 17), which says less where the EKF itself is less
sure. The forces are free, so neither friction nor stiffness needs to be known; only the pseudo-measurement ties beta
down, and softly.

Particles may carry the whole state, as in the paper, or beta alone: see the two modules beside this one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from crosscomb.filters.algebra.resampling import RESAMPLING
from crosscomb.filters.base import KernelFilter
from crosscomb.filters.random_walk.plain_pf import Particles, particle_run, plain_state
from crosscomb.filters.random_walk.rao_blackwell_pf import blackwell_run, blackwell_state
from crosscomb.filters.random_walk.shared import ParticleNoise


def random_walk_run(state: Any, samples: np.ndarray, *given: Any) -> None:
    """All samples of the filter whose state it is."""
    run = particle_run if isinstance(state, Particles) else blackwell_run
    run(state, samples, *given)


@dataclass(frozen=True)
class RandomWalkPF(KernelFilter):
    """Random-walk particle filter of one vehicle.

    With `forces` solved only beta is carried by particles, and 200 of them come closer to the posterior than 10,000
    whose forces are drawn too (`benchmarks/speed_particles.py`). The paper's filter draws them, with 1,000, 10,000
    or 30,000 particles; in settings a number of `particles` alone means it. The same seed gives the same bits.
    """

    noise: ParticleNoise = ParticleNoise()
    particles: int = 200
    resampling: str = "systematic"
    seed: int = 0
    forces: str = "solved"

    divisors = (*KernelFilter.divisors, "pseudo")
    choices: ClassVar = {
        **KernelFilter.choices,
        "resampling": tuple(RESAMPLING),
        "forces": ("solved", "drawn"),
    }
    implied: ClassVar = {"particles": {"forces": "drawn"}}  # so do artefacts from before there was a choice
    extras = ("fyf [N]", "fyr [N]")
    # Not the EKF's, nor how far it is trusted: its beta is no measurement of the car.
    told_by_likelihood = ("force", "yaw_acceleration", "slip_rate", "yaw_rate", "accel")
    run_kernel = staticmethod(random_walk_run)

    def make_state(self) -> Any:
        """Make the particles before the first sample."""
        make = blackwell_state if self.forces == "solved" else plain_state
        return make(self.particles, self.resampling, self.seed)
