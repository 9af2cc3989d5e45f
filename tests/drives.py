"""Cars and drives that tests share."""

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.base import Inputs
from crosscomb.models.kinematic import slip_of_rolling_rear
from crosscomb.models.linear_single_track import linear_single_track_rates
from crosscomb.models.single_track import SingleTrack, single_track_rates, stable_substeps
from crosscomb.models.vehicle import Vehicle, load_vehicle

DT = 0.01
GOLF = load_vehicle("golf_gti_2018")

TEST_CAR = Vehicle(
    name='car "with" quotes',
    mass=1400.0,
    yaw_inertia=2200.0,
    cg_to_front_axle=1.1,
    cg_to_rear_axle=1.5,
    cg_height=0.53,
    track_front=1.52,
    track_rear=1.50,
    wheel_radius=0.31,
    steering_ratio=16.0,
    cornering_stiffness_front=95e3,
    cornering_stiffness_rear=120e3,
    roll_gradient=0.007,
)
"""A car of which only what a vehicle file must hold is given."""


def model_slalom(
    steps: int, car: SingleTrack, linear: bool = False, steer: float = 0.04, rear: float = 0.1
) -> tuple[Inputs, np.ndarray]:
    """Noiseless slalom of the single track at 12 to 24 m/s, and its beta ``(n,) [rad]``.

    Starts as the filters do: they take the first yaw rate as it is, and beta as of rolling.
    """
    t = DT * np.arange(steps)
    samples = np.zeros((steps, at.SAMPLE_WIDTH))
    samples[:, at.VX] = 18.0 + 6.0 * np.sin(0.3 * t)
    samples[:, at.AX] = 1.8 * np.cos(0.3 * t)
    samples[:, at.FXF] = samples[:, at.FXR] = 0.5 * car.mass * samples[:, at.AX]
    samples[:, at.STEER] = 0.02 + steer * np.sin(2.0 * t)
    samples[:, at.STEER_REAR] = rear * samples[:, at.STEER]
    state = np.array([0.1, slip_of_rolling_rear(*samples[0, [at.STEER, at.STEER_REAR]], car.a, car.b)])
    beta = np.empty(steps)

    def model(sample: np.ndarray) -> tuple[np.ndarray, float]:
        given = sample[[at.VX, at.STEER, at.STEER_REAR]]
        if linear:
            rates, ay, _ = linear_single_track_rates(*state, *given, car)
        else:
            rates, (_, ay), _ = single_track_rates(*state, *given, *sample[[at.FXF, at.FXR, at.AX]], 0.0, car)
        return np.array(rates), ay

    for k, sample in enumerate(samples):
        substeps = stable_substeps(sample[at.VX], DT, car) if k else 0
        for _ in range(substeps):
            state = state + DT / substeps * model(sample)[0]
        sample[at.YAW_RATE], beta[k] = state
        sample[at.AY] = model(sample)[1]
    return Inputs(DT, samples), beta
