"""The tables between manoeuvre, driver and record: their columns; and the habits of a driver."""

from __future__ import annotations

from typing import NamedTuple

from crosscomb.models.plant import STATES

CONTROL_PERIOD = 0.01
"""Time between two looks of the driver [s], also the period of the log."""

# Columns of the schedule, one row per control period.
SPEED = 0  # speed to hold [m/s], negative: backwards; NaN: neither drive nor brake
PROFILE = 1  # road-wheel angle in the mode OPEN_LOOP [rad]
PROFILE_REAR = 2  # rear road-wheel angle [rad]
MODE = 3
SLIDE = 4  # sideslip to hold in the mode DRIFT [rad]
EXTRA_DRIVE = 5  # drive force asked for beside the speed controller [g]
EXTRA_BRAKE = 6  # braking asked for beside the speed controller [g]
EXTRA_HANDBRAKE = 7  # handbrake [g of the rear axle's load]
FRICTION_LEFT, FRICTION_RIGHT = 8, 9
ROAD_SLOPE, ROAD_BANK = 10, 11  # sines of the road's angles along and across the course
ROAD_DIP = 12  # curvature of dips, negative of crests [1/m]
COLUMNS = 13

OPEN_LOOP, FOLLOW_PATH, DRIFT, STRAIGHTEN = 0.0, 1.0, 2.0, 3.0

# Columns of the path, one row per metre.
PATH_X, PATH_Y, PATH_HEADING, PATH_SPEED = 0, 1, 2, 3

# Columns of the recorded truth behind the states: felt accelerations [m/s^2], hand-side angles [rad].
AX, AY, ASKED_STEER, ASKED_STEER_REAR = STATES, STATES + 1, STATES + 2, STATES + 3
RECORD = STATES + 4


class Driver(NamedTuple):
    """How one driver drives.

    Attributes
    ----------
    preview : float
        Time ahead at which the driver aims on a path [s].
    steer_rate : float
        Fastest turn of the road wheels [rad/s].
    acceleration, deceleration : float
        What the speed controller takes at most [m/s^2].
    wheel_spin : float
        Rear slip the driver takes to hold a drift, over its sideslip [1/rad].
    """

    preview: float
    steer_rate: float
    acceleration: float
    deceleration: float
    wheel_spin: float
