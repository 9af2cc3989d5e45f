"""Which settings of a filter are noise that can be tuned, and the space a search walks through."""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

RANGE = 100.0
"""A setting is searched from its value over this to its value times this."""

DESIGN = (
    "adapt_ay", "adapt_speed", "parameter_range", "turning", "turning_width", "moving", "moving_width",
    "steer_calm", "steer_lively", "ay_calm", "ay_lively", "yaw_calm", "yaw_lively", "yaw_weight",
    "low_share", "kinematic_share", "floor", "share", "stay", "correlation", "memory", "outage", "bias_time",
    "disturbance_time", "outside", "missing", "demand", "disagreement",
)  # fmt: skip
"""Thresholds, shares and times: part of a filter's design, not noise. Or, in networks, of no effect on beta."""

MISSING = "missing_"
"""Noise of what only counts while a channel is missing: whole logs say nothing about it."""


@dataclass(frozen=True)
class NoiseSpace:
    """Positive noise settings on a log scale around their values: -1 is a hundredth of it, 1 a hundred times it.

    Attributes
    ----------
    noise : dict
        All noise settings, as `crosscomb.filters.catalogue.settings_of` gives them.
    paths : list of tuple of str
        Keys of each setting that is tuned.
    """

    noise: Mapping[str, Any]
    paths: list[tuple[str, ...]]

    @property
    def dimensions(self) -> int:
        """Number of settings that are tuned."""
        return len(self.paths)

    def noise_at(self, point: np.ndarray) -> dict[str, Any]:
        """All noise settings at a point ``(d,)``; rounded to what a person would write."""
        changed: dict[str, Any] = copy.deepcopy(dict(self.noise))
        for path, factor in zip(self.paths, RANGE**point, strict=True):
            table = changed
            for key in path[:-1]:
                table = table[key]
            if factor != 1.0:
                table[path[-1]] = float(f"{table[path[-1]] * factor:.4g}")
        return changed

    def factors_at(self, point: np.ndarray) -> dict[str, float]:
        """Factor of each tuned setting at a point ``(d,)``, by its dotted name."""
        factors = RANGE**point
        return {".".join(path): float(factor) for path, factor in zip(self.paths, factors, strict=True)}


def noise_space(noise: Mapping[str, Any], only: Collection[str] | None = None) -> NoiseSpace:
    """Find what can be tuned: positive numbers that are noise; of the outer table only some where these are named."""
    paths = [path for path in _paths(noise) if only is None or path[0] in only]
    return NoiseSpace(noise, paths)


def _paths(table: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _paths(value, (*above, key))
        elif isinstance(value, float) and value > 0.0 and not key.startswith(MISSING) and key not in DESIGN:
            yield (*above, key)
