"""The run of a manoeuvre: plant, driver and road together."""

from __future__ import annotations

from math import atan2, cos, hypot, sin

import numpy as np
from numba import njit

from crosscomb.models.plant import (
    BANK,
    BRAKE,
    DIP,
    DRIVE_COMMAND,
    FRICTION,
    HANDBRAKE,
    HEADING,
    HEAVE,
    INPUTS,
    SLOPE,
    SPIN,
    STATES,
    STEER_COMMAND,
    STEER_REAR_COMMAND,
    VX,
    VY,
    PlantParameters,
    X,
    Y,
)
from crosscomb.models.plant_motion import derivatives, step
from crosscomb.signals import GRAVITY
from crosscomb.training.simulation.driver_control import (
    drift_pedals,
    grip_of,
    nearest,
    path_curvature,
    pedals,
    steer,
)
from crosscomb.training.simulation.schedule import (
    ASKED_STEER,
    ASKED_STEER_REAR,
    AX,
    AY,
    CONTROL_PERIOD,
    DRIFT,
    FOLLOW_PATH,
    FRICTION_LEFT,
    FRICTION_RIGHT,
    MODE,
    PATH_HEADING,
    PATH_SPEED,
    PATH_X,
    PATH_Y,
    PROFILE_REAR,
    ROAD_BANK,
    ROAD_DIP,
    ROAD_SLOPE,
    SPEED,
)

SPUN = 1.2
"""Sideslip [rad] from which the driver gives up, brakes and waits for the car to stop."""

RESTART_SPEED = 0.5  # [m/s]


@njit(cache=True)
def run_manoeuvre(x, schedule, path, d, p, dt, record):
    """Simulate a manoeuvre with the driver in the loop.

    Parameters
    ----------
    x : ndarray
        ``(STATES,)`` initial states, SI; holds the final ones afterwards.
    schedule : ndarray
        ``(n, COLUMNS)``, one row per `CONTROL_PERIOD`.
    path : ndarray
        ``(m, 4)`` x, y [m], heading [rad] and speed [m/s] at every metre; one row where no path is followed.
    d : Driver
    p : PlantParameters
    dt : float
        Integration step [s], a whole part of `CONTROL_PERIOD`.
    record : ndarray
        ``(n, RECORD)``, receives states, felt ax, ay [m/s^2] and steering asked for [rad] at each row.
    """
    work = np.zeros((4, STATES))
    u = np.zeros(INPUTS)
    substeps = round(CONTROL_PERIOD / dt)
    near, spun, ay = 0, False, 0.0
    for k in range(schedule.shape[0]):
        row = schedule[k]
        speed = hypot(x[VX], x[VY])
        target, curvature = row[SPEED], 0.0
        if row[MODE] == FOLLOW_PATH:
            near = nearest(x, path, near)
            curvature = path_curvature(x, path, near, d.preview, grip_of(row))
            target = min(target, path[min(near + int(0.4 * speed), path.shape[0] - 1), PATH_SPEED])
        _meet_road(x, schedule, k, path[near, PATH_HEADING], speed, p, u)
        if speed > 3.0 and abs(atan2(x[VY], x[VX])) > SPUN and not target < 0.0:
            spun = True
        if spun and speed < RESTART_SPEED:
            spun = False
            # The course goes on from where the car came to rest: no log holds the position.
            x[X], x[Y], x[HEADING] = path[near, PATH_X], path[near, PATH_Y], path[near, PATH_HEADING]
        if spun:
            u[DRIVE_COMMAND], u[HANDBRAKE] = 0.0, 0.0
            u[BRAKE] = 0.8 * grip_of(row) * p.mass * GRAVITY * p.wheel_radius
            wish = 0.0
        else:
            if row[MODE] == DRIFT:
                drift_pedals(x, ay, row, d, p, u)
            else:
                pedals(x, ay, row, target, d, p, u)
            wish = steer(x, ay, row, curvature, p)
        wish = min(max(wish, -p.max_steer), p.max_steer)
        turn = d.steer_rate * CONTROL_PERIOD
        u[STEER_COMMAND] += min(max(wish - u[STEER_COMMAND], -turn), turn)
        rear = min(max(row[PROFILE_REAR], -p.max_steer_rear), p.max_steer_rear)
        u[STEER_REAR_COMMAND] += min(max(rear - u[STEER_REAR_COMMAND], -turn), turn)

        ax, ay = derivatives(x, u, p, work[0])
        for i in range(STATES):
            record[k, i] = x[i]
        record[k, AX] = ax
        record[k, AY] = ay
        record[k, ASKED_STEER] = u[STEER_COMMAND]
        record[k, ASKED_STEER_REAR] = u[STEER_REAR_COMMAND]
        for _ in range(substeps):
            step(x, u, p, dt, work)


@njit(cache=True)
def _meet_road(x, schedule, k, road_heading, speed, p, u):
    """Write the road under the car: the rear wheels meet what the front wheels met a wheelbase ago."""
    row = schedule[k]
    ago = int((p.front + p.rear) / max(speed, 1.0) / CONTROL_PERIOD)
    past = schedule[max(k - ago, 0)]
    u[FRICTION], u[FRICTION + 1] = row[FRICTION_LEFT], row[FRICTION_RIGHT]
    u[FRICTION + 2], u[FRICTION + 3] = past[FRICTION_LEFT], past[FRICTION_RIGHT]
    across = x[HEADING] - road_heading
    cs, sn = cos(across), sin(across)
    u[SLOPE] = row[ROAD_SLOPE] * cs + row[ROAD_BANK] * sn
    u[BANK] = row[ROAD_BANK] * cs - row[ROAD_SLOPE] * sn
    u[DIP] = row[ROAD_DIP]


def start(speed: float, p: PlantParameters) -> np.ndarray:
    """States ``(STATES,)`` of the car rolling straight ahead at a speed [m/s]."""
    x = np.zeros(STATES)
    x[VX] = speed
    x[SPIN : SPIN + 4] = speed / p.wheel_radius
    x[HEAVE] = GRAVITY
    return x
