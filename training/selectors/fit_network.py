"""Training of the neural network: from recordings to its weights as plain numbers.

One hidden layer of logistic neurons and a linear output (Chindamo 2018, section 3), fitted by scikit-learn's
`MLPRegressor`. Every recording is used mirrored as well, as a car does not tell left from right.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor

from crosscomb.errors import UsageError
from crosscomb.filters.base import MAX_BETA
from crosscomb.filters.learned import COLUMNS, FEEDBACK_DELAY, FeedbackNetwork, NeuralNetwork, Neurons
from crosscomb.models.vehicle import load_vehicle
from crosscomb.training.metrics import rms
from crosscomb.training.recordings import Recording
from crosscomb.training.simulation.presets import plan_jobs
from crosscomb.training.simulation.simulate import simulate_recording

HIDDEN = 10
"""Neurons of the hidden layer, as in Chindamo et al. 2018."""

STRIDE = 10
"""Every so many samples train: neighbours are near copies."""

FEEDBACK_NOISE = math.radians(2.0)
"""Noise on the true beta that stands for the fed-back one in training [rad].

With the truth itself as an input the network learns to copy it, and drifts when it is fed its own answer.
"""

LARGEST_BETA = math.radians(50.0)
"""Samples beyond are spins and not learnt."""

DEFAULT_VEHICLES = ("generic_compact", "golf_gti_2018", "volvo_s90", "volvo_v40", "audi_tts")
"""Shipped vehicles whose simulated logs train the default networks."""

LOGS = 12
"""Simulated logs of each of them."""


def training_rows(
    recordings: Sequence[Recording], feedback: bool, seed: int = 0, rate: float = 100.0
) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and true beta of the samples that train.

    Parameters
    ----------
    recordings : sequence of Recording
    feedback : bool
        Add the true beta of `FEEDBACK_DELAY` ago, with `FEEDBACK_NOISE`, as the last input.
    seed : int
        Of that noise.
    rate : float [Hz]

    Returns
    -------
    inputs : (n, 4) or (n, 5)
        ay, yaw rate, steering angle, speed in SI units, and beta [rad]; the second half is mirrored.
    beta : (n,) [rad]
    """
    rng, back = np.random.default_rng(seed), max(round(FEEDBACK_DELAY * rate), 1)
    rows: list[np.ndarray] = []
    truth: list[np.ndarray] = []
    for recording in recordings:
        for run, beta, counted in recording.stretches(rate):
            table = run.samples[:, COLUMNS]
            if feedback:
                before = np.concatenate([np.full(back, np.nan), beta])[: len(beta)]
                table = np.column_stack([table, before + rng.normal(0.0, FEEDBACK_NOISE, len(beta))])
            good = counted & np.isfinite(table).all(axis=1) & (np.abs(beta) < LARGEST_BETA)
            rows.append(table[good][::STRIDE])
            truth.append(beta[good][::STRIDE])
    table, beta = np.concatenate(rows), np.concatenate(truth)
    mirror = np.array([-1.0, -1.0, -1.0, 1.0, -1.0])[: table.shape[1]]
    return np.concatenate([table, mirror * table]), np.concatenate([beta, -beta])


def fit_regressor(inputs: np.ndarray, beta: np.ndarray, hidden: int = HIDDEN, seed: int = 0) -> MLPRegressor:
    """Fit scikit-learn's network to standardised inputs ``(n, i)`` and beta ``(n,)``."""
    regressor = MLPRegressor(
        hidden_layer_sizes=(hidden,), activation="logistic", solver="lbfgs",
        alpha=1e-4, max_iter=400, random_state=seed,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # 400 steps are meant to be the end
        return regressor.fit(inputs, beta)


def fit_network(
    recordings: Sequence[Recording],
    feedback: bool = False,
    hidden: int = HIDDEN,
    seed: int = 0,
    rate: float = 100.0,
) -> Neurons:
    """Train a network on recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        With ground truth.
    feedback : bool
        Train the network with delayed feedback.
    hidden : int
        Neurons of the hidden layer.
    seed : int
        The same seed gives the same network.
    rate : float [Hz]
        Working rate of the samples.

    Raises
    ------
    UsageError
        There are fewer samples that count than the network has weights.
    """
    inputs, beta = training_rows(recordings, feedback, seed, rate)
    if len(beta) < 20 * hidden:
        raise UsageError(
            f"training: {len(beta)} samples with truth are too few for {hidden} neurons: add recordings"
        )
    mean, scale = inputs.mean(axis=0), np.maximum(inputs.std(axis=0), 1e-3)
    beta_scale = max(float(beta.std()), 1e-3)
    regressor = fit_regressor((inputs - mean) / scale, beta / beta_scale, hidden, seed)
    network = Neurons(
        mean=tuple(mean.tolist()),
        scale=tuple(scale.tolist()),
        hidden=tuple(tuple(row) for row in regressor.coefs_[0].T.tolist()),
        hidden_bias=tuple(regressor.intercepts_[0].tolist()),
        output=tuple(regressor.coefs_[1][:, 0].tolist()),
        output_bias=float(regressor.intercepts_[1][0]),
        beta_scale=beta_scale,
        largest=min(max(float(np.abs(beta).max()), math.radians(5.0)), MAX_BETA),
        error=1.0,
        delay=FEEDBACK_DELAY if feedback else 0.0,
    )
    return network._replace(error=max(rms_error(network, recordings, rate), math.radians(0.1)))


def rms_error(network: Neurons, recordings: Sequence[Recording], rate: float = 100.0) -> float:
    """RMS error [rad] over recordings of the network on its own, fed with its own answers."""
    errors: list[np.ndarray] = []
    kind = FeedbackNetwork if network.delay > 0.0 else NeuralNetwork
    for recording in recordings:
        estimator = kind(recording.vehicle, network=network)
        for inputs, beta, counted in recording.stretches(rate):
            good = counted & (np.abs(beta) < LARGEST_BETA)
            errors.append((estimator.run(inputs).beta - beta)[good])
    return rms(np.concatenate(errors))


def simulated_recordings(
    vehicles: Sequence[str], logs: int, seed: int, duration: float = 30.0
) -> list[Recording]:
    """Simulate recordings of shipped vehicles; a log follows from seed, vehicle and its number alone."""
    recordings = []
    for number, name in enumerate(vehicles):
        vehicle = load_vehicle(name)
        for job in plan_jobs(vehicle, logs):
            options = {"surface": job.surface, "duration": duration, "name": f"{name}/{job.name}"}
            seeds = seed, number, job.number
            recordings.append(simulate_recording(vehicle, job.manoeuvre, seeds, **options))
    return recordings


def write_default_networks(path: Path, seed: int = 0) -> None:
    """Train the networks that come with the package and write them as ``network.json``.

    Parameters
    ----------
    path : Path
    seed : int
        The shipped file is that of seed 0.
    """
    recordings = simulated_recordings(DEFAULT_VEHICLES, LOGS, seed)
    networks = {
        name: fit_network(recordings, name == "network_feedback", seed=seed)._asdict()
        for name in ("network", "network_feedback")
    }
    path.write_text(json.dumps(networks) + "\n", encoding="utf-8", newline="\n")
