"""When tyre parameters may adapt, and how far: what the adaptive filters share.

Straight driving says nothing about tyres, yet noise there moves their estimates. They adapt only while the
car corners fast enough, stay in a range around the vehicle file's, and get no less certain than at the start.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.models.compiled import inlined
from crosscomb.models.parameter_track import RATIONAL, first_parameters
from crosscomb.models.single_track import SingleTrack


class TyreCar(NamedTuple):
    """The car and its tyre law (`crosscomb.models.parameter_track`)."""

    track: SingleTrack
    law: int


class Limits(NamedTuple):
    """What adaptation may do to the p parameters of a tyre law."""

    first: np.ndarray  # (p,) parameters of the vehicle file
    spread: np.ndarray  # (p,) standard deviation at the start, and the largest
    walk: np.ndarray  # (p,) density of their change
    least: np.ndarray  # (p,)
    most: np.ndarray  # (p,)


def parameter_limits(law: int, track: SingleTrack, noise: Any) -> Limits:
    """Turn the settings that begin with parameter into limits; c1, a squared angle, varies twice as much."""
    first = first_parameters(law, track)
    power = np.array([2.0, 1.0, 2.0, 1.0]) if law == RATIONAL else np.ones(len(first))
    factor = noise.parameter_range**power
    size = power * first
    return Limits(
        first, noise.parameter_spread * size, noise.parameter_walk * size, first / factor, first * factor
    )


@inlined
def excited(sample, noise):
    """Tell whether the car corners so that its motion says something about its tyres.

    The yaw rate must agree: straight ahead, vibration or a banked road alone fill ay.
    """
    return (
        abs(sample[at.AY]) > noise.adapt_ay  # False for a missing one
        and sample[at.YAW_RATE] * sample[at.AY] > 0.0
        and abs(sample[at.YAW_RATE]) * sample[at.VX] > 0.5 * noise.adapt_ay
        and sample[at.VX] > noise.adapt_speed
        and sample[at.STEER_HELD] == 0.0
    )


@inlined
def growth(variance, walk, spread, dt):
    """Variance that a parameter's walk adds over dt, up to the variance at the start."""
    return min(walk * walk * dt, max(spread * spread - variance, 0.0))
