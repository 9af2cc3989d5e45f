"""The vehicle file: every parameter of a car that the models need, checked."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from crosscomb.checked import FileKind, Record, parse_checked, read_checked
from crosscomb.errors import UsageError

Positive = Field(gt=0.0)


class Tyre(Record):
    """Tyre law and the shape of its curve; the stiffness and friction stand in the vehicle itself.

    `shape` and `curvature` are C and E of the Magic Formula.
    """

    model: Literal["linear", "dugoff", "pacejka"] = "dugoff"
    shape: float = Field(default=1.4, gt=1.0, lt=2.0)
    curvature: float = Field(default=-0.5, le=1.0, ge=-10.0)
    relaxation_length: float = Field(default=0.3, gt=0.05, le=3.0, description="lateral [m]")
    load_sensitivity: float = Field(
        default=0.05, ge=0.0, le=0.4, description="friction lost per static load added"
    )
    stiffness_peak_load: float = Field(
        default=4.0, ge=1.2, le=100.0, description="load of the highest stiffness, in static loads"
    )


class Plant(Record):
    """What only the simulation needs."""

    drive: Literal["front", "rear", "all"] = "front"
    drive_share_front: float = Field(default=0.45, gt=0.0, lt=1.0, description="of the torque, drive = all")
    power: float = Field(default=90e3, gt=0.0, le=1e7, description="largest drive power [W]")
    top_speed: float = Field(default=50.0, ge=5.0, le=100.0, description="never passed in simulation [m/s]")
    differential_lock: float = Field(default=5.0, ge=0.0, le=150.0, description="per driven axle [N m s/rad]")
    traction_control: bool = Field(default=True, description="drive lets go of a wheel that spins")
    brake_share_front: float = Field(default=0.75, ge=0.0, lt=1.0)
    anti_lock: bool = Field(default=True, description="brakes let go of a wheel that slips too much")
    wheel_inertia: float = Field(
        default=1.2, gt=0.0, le=1e3, description="spin inertia of one wheel [kg m^2]"
    )
    drag_area: float = Field(default=0.65, ge=0.0, le=100.0, description="drag coefficient times area [m^2]")
    lift_area: float = Field(default=0.1, ge=-10.0, le=2.0, description="the same for lift [m^2]")
    roll_share_front: float = Field(default=0.55, gt=0.0, lt=1.0, description="of the roll stiffness")
    pitch_gradient: float = Field(default=0.003, ge=0.0, lt=0.1, description="[rad per m/s^2]")
    body_frequency: float = Field(default=1.6, ge=0.3, le=8.0, description="of roll, pitch and heave [Hz]")
    body_damping: float = Field(default=0.4, ge=0.1, le=2.0, description="damping ratio of the same")
    max_steer: float = Field(default=0.6, gt=0.0, lt=1.2, description="road-wheel angle [rad]")
    max_steer_rear: float = Field(default=0.0, ge=0.0, lt=0.6, description="0: no rear steering [rad]")
    steer_lag: float = Field(default=0.02, ge=0.005, lt=1.0, description="hand wheel to road wheel [s]")
    steer_free_play: float = Field(default=0.0, ge=0.0, lt=0.1, description="at the road wheel [rad]")
    compliance_front: float = Field(default=5e-7, ge=0.0, le=1e-4, description="lost per side force [rad/N]")
    compliance_rear: float = Field(default=0.0, ge=0.0, le=1e-4, description="lost per side force [rad/N]")
    roll_steer_front: float = Field(default=0.0, ge=-1.0, le=1.0, description="out of the turn [rad/rad]")
    roll_steer_rear: float = Field(default=0.0, ge=-1.0, le=1.0, description="into the turn [rad/rad]")


class Vehicle(Record):
    """One car in SI units, as read from a vehicle file (TOML)."""

    name: str = Field(min_length=1)
    mass: float = Positive
    yaw_inertia: float = Positive
    cg_to_front_axle: float = Positive
    cg_to_rear_axle: float = Positive
    cg_height: float = Positive
    track_front: float = Positive
    track_rear: float = Positive
    wheel_radius: float = Positive
    steering_ratio: float = Positive
    cornering_stiffness_front: float = Positive
    cornering_stiffness_rear: float = Positive
    friction: float = Field(default=0.9, gt=0.0, le=3.0)
    roll_gradient: float = Field(default=0.0, ge=0.0, lt=0.1, description="[rad per m/s^2]")
    tyre: Tyre = Tyre()
    plant: Plant = Plant()

    @model_validator(mode="after")
    def _plausible(self) -> Vehicle:
        # Wrong units (mm, t, N/deg) are the usual mistake; no road vehicle is outside these bounds.
        bounds = {
            "mass": (50.0, 60_000.0),
            "yaw_inertia": (10.0, 1e6),
            "cg_to_front_axle": (0.2, 8.0),
            "cg_to_rear_axle": (0.2, 8.0),
            "cg_height": (0.05, 3.0),
            "track_front": (0.5, 3.0),
            "track_rear": (0.5, 3.0),
            "wheel_radius": (0.08, 0.8),
            "steering_ratio": (0.5, 40.0),
            "cornering_stiffness_front": (3e3, 3e6),
            "cornering_stiffness_rear": (3e3, 3e6),
        }
        for key, (low, high) in bounds.items():
            value = getattr(self, key)
            if not low <= value <= high:
                raise ValueError(
                    f"{key}: {value:g} is outside {low:g} to {high:g} (SI units; stiffness per axle)"
                )
        return self

    @property
    def wheelbase(self) -> float:
        """Distance between the axles [m]."""
        return self.cg_to_front_axle + self.cg_to_rear_axle


FILE = FileKind("vehicle file", Vehicle, "TOML", "write one with `crosscomb vehicle`")


def load_vehicle(path: str | Path) -> Vehicle:
    """Read and check a vehicle file.

    Parameters
    ----------
    path : str or Path
        A TOML file, or the name of a shipped vehicle such as ``generic_compact``.

    Raises
    ------
    UsageError
        The file is missing or no TOML, a key is unknown or missing, or a value is out of range.
    """
    path = Path(path)
    if path.suffix == "" and not os.path.exists(path):
        return _load_shipped(str(path))
    return read_checked(path, FILE)


def parse_vehicle(text: str, source: str) -> Vehicle:
    """Make a vehicle from the text of a vehicle file; `source` names it in messages."""
    return parse_checked(text, source, FILE)


def vehicle_text(vehicle: Vehicle, remarks: Mapping[str, str] | None = None) -> str:
    """The vehicle as the text of a vehicle file.

    Parameters
    ----------
    vehicle : Vehicle
    remarks : mapping of str to str, optional
        Comments behind the lines of some keys; those of the table ``[tyre]`` as ``tyre.shape``.
    """
    remarks = remarks or {}
    values = vehicle.model_dump()
    tables = {key: values.pop(key) for key in ("tyre", "plant")}

    def line(key: str, value: object, name: str) -> str:
        # A JSON string, number or truth value is a valid TOML one.
        remark = f"  # {remarks[name]}" if name in remarks else ""
        return f"{key} = {json.dumps(value, ensure_ascii=False)}{remark}"

    lines = [line(key, value, key) for key, value in values.items()]
    for table, content in tables.items():
        lines += ["", f"[{table}]", *(line(key, value, f"{table}.{key}") for key, value in content.items())]
    return "\n".join(lines) + "\n"


def shipped_vehicles() -> list[str]:
    """Names of the vehicle files that come with the package."""
    folder = resources.files("crosscomb") / "data" / "vehicles"
    return sorted(
        entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")
    )


def _load_shipped(name: str) -> Vehicle:
    if name not in shipped_vehicles():
        raise UsageError(
            f"{name}: no such vehicle file, and no shipped vehicle of that name: "
            f"take one of {', '.join(shipped_vehicles())}"
        )
    entry = resources.files("crosscomb") / "data" / "vehicles" / f"{name}.toml"
    return parse_vehicle(entry.read_text(encoding="utf-8"), name)
