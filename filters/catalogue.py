"""Every estimator by its name: one line each, and how it is made from settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from crosscomb.errors import UsageError
from crosscomb.filters.base import KernelFilter
from crosscomb.filters.dynamic_ekf import DynamicEKF
from crosscomb.filters.kinematic_kf import KinematicKF
from crosscomb.filters.random_walk_pf import RandomWalkPF
from crosscomb.models.vehicle import Vehicle


@dataclass(frozen=True)
class Entry:
    """One line of the catalogue."""

    make: type[KernelFilter]
    summary: str
    source: str


CATALOGUE: dict[str, Entry] = {
    "kinematic_kf": Entry(
        KinematicKF,
        "Kalman filter that integrates the accelerometers; right in slides, drifts on straights",
        "Atheupe 2023, eq. 18 to 21",
    ),
    "dynamic_ekf": Entry(
        DynamicEKF,
        "extended Kalman filter on the single track with Dugoff tyres; right while the friction is",
        "Atheupe 2023, eq. 22 to 25",
    ),
    "random_walk_pf": Entry(
        RandomWalkPF,
        "particle filter with free axle forces, softly tied to the EKF; needs no friction, costs most",
        "Atheupe 2023, eq. 17 and 29",
    ),
}

DEFAULT_FILTERS = ("kinematic_kf", "dynamic_ekf", "random_walk_pf")


def make_filter(name: str, vehicle: Vehicle, settings: Mapping[str, Any] | None = None) -> KernelFilter:
    """Make an estimator of the catalogue for one vehicle.

    Parameters
    ----------
    name : str
        Key of `CATALOGUE`.
    vehicle : Vehicle
    settings : mapping, optional
        As `settings_of` gives them; what is left out keeps its default.

    Raises
    ------
    UsageError
        The name or a setting is unknown, or a value is out of range.
    """
    if name not in CATALOGUE:
        raise UsageError(f"filter {name}: not in the catalogue: take of {', '.join(CATALOGUE)}")
    cls = CATALOGUE[name].make
    defaults = {field.name: field.default for field in fields(cls) if field.name != "vehicle"}
    chosen: dict[str, Any] = {}
    for key, value in (settings or {}).items():
        if key not in defaults:
            raise UsageError(f"filter {name}: unknown setting {key}: take of {', '.join(defaults)}")
        chosen[key] = _checked(f"filter {name}: {key}", value, defaults[key], cls.choices.get(key, ()))
    return cls(vehicle, **chosen)


def settings_of(estimator: KernelFilter) -> dict[str, Any]:
    """Settings of an estimator as plain numbers and words, for a JSON file."""
    values = {f.name: getattr(estimator, f.name) for f in fields(estimator) if f.name != "vehicle"}
    return {key: _plain(value) for key, value in values.items()}


def _plain(value: Any) -> Any:
    if hasattr(value, "_asdict"):
        return {key: _plain(part) for key, part in value._asdict().items()}
    return value


def _checked(where: str, value: Any, default: Any, words: tuple[str, ...] = ()) -> Any:
    """Check a setting against the kind of its default and give it that kind."""
    if hasattr(default, "_asdict"):
        return _checked_noise(where, value, default)
    if isinstance(default, str):
        if value not in words:
            raise UsageError(f"{where}: {value!r} is unknown: take one of {', '.join(words)}")
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UsageError(f"{where}: {value!r} is no number")
    if isinstance(default, int):
        least = 0 if where.endswith("seed") else 1
        if int(value) != value or value < least:
            raise UsageError(f"{where}: {value!r} must be a whole number of at least {least}")
        return int(value)
    if not 0.0 <= value < float("inf"):
        raise UsageError(f"{where}: {value!r} must be finite and not negative")
    return float(value)


def _checked_noise(where: str, value: Any, default: Any) -> Any:
    if not isinstance(value, Mapping):
        raise UsageError(f"{where}: must be a table of {', '.join(default._fields)}")
    for key in value:
        if key not in default._fields:
            raise UsageError(f"{where}: unknown setting {key}: take of {', '.join(default._fields)}")
    return default._replace(
        **{key: _checked(f"{where}.{key}", part, getattr(default, key)) for key, part in value.items()}
    )
