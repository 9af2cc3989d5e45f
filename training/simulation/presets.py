"""What a data set consists of: presets, and the share-out of logs among manoeuvres and surfaces."""

from __future__ import annotations

from typing import NamedTuple

from crosscomb.errors import UsageError
from crosscomb.models.vehicle import Vehicle
from crosscomb.training.simulation.manoeuvres import KINDS, REAR


class Preset(NamedTuple):
    """A kind of data set.

    Attributes
    ----------
    kinds : tuple of str
        Kinds of manoeuvres in turn: their shares.
    surfaces : tuple of str
        Surfaces in turn.
    profiles : tuple of str
        Sensor profiles in turn.
    duration : float
        Length of a log [s].
    manoeuvres : tuple of str
        Only these; all where empty.
    """

    kinds: tuple[str, ...]
    surfaces: tuple[str, ...]
    profiles: tuple[str, ...]
    duration: float
    manoeuvres: tuple[str, ...] = ()


PRESETS = {
    "full": Preset(
        kinds=("normal", "limit", "sliding", "normal", "limit"),
        surfaces=("dry", "snow", "wet", "dry", "jump", "snow", "dry", "wet", "dry", "ice", "split"),
        profiles=("production", "production", "test"),
        duration=40.0,
    ),
    "quick": Preset(
        kinds=("normal", "limit", "sliding"),
        surfaces=("dry", "snow", "wet", "dry"),
        profiles=("production", "production", "test"),
        duration=20.0,
        manoeuvres=(
            "country_road", "slalom", "oval", "stop_and_go",
            "road_limit", "double_lane_change", "step_steer", "sine_with_dwell",
            "drift", "road_slide",
        ),
    ),
    "paper": Preset(
        kinds=("normal", "limit", "limit"),
        surfaces=("snow",),
        profiles=("test",),
        duration=40.0,
        manoeuvres=(
            "circle", "slalom", "u_turn", "lap",
            "lap_limit", "constant_speed_circles", "j_turn", "lane_change", "double_lane_change",
            "slalom_limit", "pulse_steer", "pedals_in_turn", "rear_steer", "front_and_rear_steer",
        ),
    ),
}  # fmt: skip
"""`full`: everything, mostly on hard road. `quick`: short logs of the most telling manoeuvres. `paper`: the
handling manoeuvres of Atheupe 2023, section 6.4, on snow, with test-grade sensors."""


class Job(NamedTuple):
    """One log of a data set: its place, manoeuvre, surface and sensors."""

    number: int
    kind: str
    manoeuvre: str
    surface: str
    profile: str
    duration: float

    @property
    def name(self) -> str:
        """Name of the log."""
        return f"{self.number:03d}_{self.manoeuvre}_{self.surface}"


def plan_jobs(vehicle: Vehicle, logs: int, preset: str = "full") -> list[Job]:
    """Share out a number of logs: kinds in turn, each through its manoeuvres, over changing surfaces.

    Raises
    ------
    UsageError
        No such preset.
    """
    if preset not in PRESETS:
        raise UsageError(f"{preset}: no such preset: take one of {', '.join(PRESETS)}")
    chosen = PRESETS[preset]
    names = {kind: _manoeuvres(vehicle, kind, chosen) for kind in KINDS}
    turns = dict.fromkeys(KINDS, 0)
    jobs = []
    for number in range(logs):
        kind = chosen.kinds[number % len(chosen.kinds)]
        turn, available = turns[kind], names[kind]
        turns[kind] += 1
        # Each round through the manoeuvres starts at another surface, so that all pairs come up.
        place = turn + turn // len(available) + list(KINDS).index(kind)
        jobs.append(
            Job(
                number,
                kind,
                available[turn % len(available)],
                chosen.surfaces[place % len(chosen.surfaces)],
                chosen.profiles[(number + number // len(chosen.kinds)) % len(chosen.profiles)],
                chosen.duration,
            )
        )
    return jobs


def _manoeuvres(vehicle: Vehicle, kind: str, preset: Preset) -> list[str]:
    steered = vehicle.plant.max_steer_rear > 0.0
    names = [name for name in KINDS[kind] if steered or name not in REAR]
    return [name for name in names if not preset.manoeuvres or name in preset.manoeuvres]
