"""The neural network: scikit-learn's numbers, honest feedback, and settings that are checked."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from crosscomb.errors import UsageError
from crosscomb.filters import columns as at
from crosscomb.filters.base import Inputs, make_inputs
from crosscomb.filters.catalogue import make_filter, settings_of
from crosscomb.filters.learned import (
    COLUMNS,
    FEEDBACK_DELAY,
    FeedbackNetwork,
    NetworkNoise,
    NeuralNetwork,
    Neurons,
    shipped_network,
)
from crosscomb.models.vehicle import load_vehicle
from crosscomb.training.recordings import Recording
from crosscomb.training.selectors.fit_network import (
    FEEDBACK_NOISE,
    fit_network,
    fit_regressor,
    rms_error,
    simulated_recordings,
    training_rows,
)

DT = 0.01
GOLF = load_vehicle("golf_gti_2018")


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return simulated_recordings(["golf_gti_2018"], 4, seed=3, duration=12.0)


def samples_of(rows: np.ndarray) -> np.ndarray:
    samples = np.zeros((len(rows), at.SAMPLE_WIDTH))
    samples[:, COLUMNS] = rows[:, :4]
    return samples


def test_kernel_gives_what_scikit_learn_predicts(recordings) -> None:
    inputs, beta = training_rows(recordings, feedback=False)
    network = fit_network(recordings, hidden=7)
    mean, scale = np.array(network.mean), np.array(network.scale)
    regressor = fit_regressor((inputs - mean) / scale, beta / network.beta_scale, hidden=7)
    expected = network.beta_scale * regressor.predict((inputs - mean) / scale)
    assert np.abs(expected).max() < network.largest, "else the answer is held"
    estimate = NeuralNetwork(GOLF, network=network).run(Inputs(DT, samples_of(inputs)))
    # The first sample above the gate gets the answer of rolling.
    np.testing.assert_allclose(estimate.beta[1:], expected[1:], rtol=0.0, atol=1e-12)
    assert np.isnan(estimate.nis).all()


@pytest.mark.parametrize("dt", [0.01, 0.02, 0.05])
def test_feedback_is_the_own_answer_of_a_fixed_time_ago(dt: float) -> None:
    network = shipped_network("network_feedback")
    rng, n = np.random.default_rng(2), 300
    rows = np.column_stack(
        [
            rng.normal(0.0, 2.0, n),
            rng.normal(0.0, 0.1, n),
            rng.normal(0.0, 0.02, n),
            rng.uniform(10.0, 30.0, n),
        ]
    )
    estimate = FeedbackNetwork(GOLF).run(Inputs(dt, samples_of(rows)))
    hidden, back = np.array(network.hidden), round(FEEDBACK_DELAY / dt)
    for k in range(back + 1, n):
        z = (np.array([*rows[k], estimate.beta[k - back]]) - network.mean) / network.scale
        activation = 1.0 / (1.0 + np.exp(-(hidden @ z + network.hidden_bias)))
        beta = network.beta_scale * (network.output @ activation + network.output_bias)
        assert estimate.beta[k] == pytest.approx(beta, abs=1e-12)


def test_training_rows_are_mirrored_and_the_fed_back_beta_is_late(recordings) -> None:
    plain, beta = training_rows(recordings, feedback=False)
    rows, same = training_rows(recordings, feedback=True, seed=1)
    half = len(beta) // 2
    np.testing.assert_array_equal(plain[half:], plain[:half] * [-1.0, -1.0, -1.0, 1.0])
    np.testing.assert_array_equal(beta[half:], -beta[:half])
    assert rows.shape == (len(same), 5)
    # The first rows of a recording have no beta of 0.08 s ago, so there are fewer.
    assert len(beta) - 2 * len(recordings) <= len(same) <= len(beta)
    late = rows[:, 4] - same
    assert 0.8 * FEEDBACK_NOISE < np.std(late) < 2.0 * FEEDBACK_NOISE


def test_same_seed_same_network_and_the_error_is_that_of_running_alone(recordings) -> None:
    one, again, other = (fit_network(recordings, True, 4, seed) for seed in (0, 0, 1))
    assert one == again != other
    assert one.error == rms_error(one, recordings)
    assert one.delay == FEEDBACK_DELAY


@pytest.mark.parametrize("name", ["network", "network_feedback"])
def test_shipped_network_beats_beta_zero_on_a_car_it_has_not_seen(name: str) -> None:
    vehicle = load_vehicle("golf_liu")
    errors, zero = [], []
    for recording in simulated_recordings(["golf_liu"], 3, seed=77, duration=20.0):
        inputs = make_inputs(recording.signals, vehicle, DT)
        truth = recording.signals.beta_ref
        good = np.isfinite(truth) & (inputs.samples[:, at.VX] > 3.0) & (np.abs(truth) < 0.8)
        estimate = make_filter(name, vehicle).run(inputs)
        errors.append((estimate.beta - truth)[good])
        zero.append(truth[good])
    rmse, nothing = (np.sqrt(np.mean(np.concatenate(part) ** 2)) for part in (errors, zero))
    assert rmse < np.radians(3.0)
    assert rmse < 0.6 * nothing


def test_missing_inputs_are_held_and_make_it_less_sure() -> None:
    rows = np.tile([2.0, 0.1, 0.01, 20.0], (300, 1))
    whole = NeuralNetwork(GOLF).run(Inputs(DT, samples_of(rows)))
    for column in (at.AY, at.YAW_RATE):
        samples = samples_of(rows)
        samples[100:200, column] = np.nan
        broken = NeuralNetwork(GOLF).run(Inputs(DT, samples))
        np.testing.assert_array_equal(broken.beta, whole.beta)
        assert broken.beta_std[199] == pytest.approx(
            np.hypot(whole.beta_std[199], NetworkNoise().missing * 1.0)
        )
        assert broken.beta_std[200] == whole.beta_std[200]


def test_far_from_the_training_it_is_less_sure_and_held() -> None:
    rows = np.tile([2.0, 0.1, 0.01, 20.0], (50, 1))
    rows[25:, 1] = 5.0
    estimate = NeuralNetwork(GOLF).run(Inputs(DT, samples_of(rows)))
    assert estimate.beta_std[30] > 5.0 * estimate.beta_std[20]
    assert np.abs(estimate.beta).max() <= shipped_network("network").largest


@pytest.mark.parametrize("name", ["network", "network_feedback"])
def test_settings_survive_a_json_file(name: str) -> None:
    estimator = make_filter(name, GOLF)
    settings = json.loads(json.dumps(settings_of(estimator)))
    again = make_filter(name, GOLF, settings)
    assert again == estimator
    assert set(settings["network"]) == set(Neurons._fields)


def broken(**change: object) -> dict[str, object]:
    return {**settings_of(make_filter("network", GOLF))["network"], **change}


@pytest.mark.parametrize(
    ("network", "word"),
    [
        (3.0, "table of mean"),
        ({"mean": [0.0]}, "table of mean"),
        (broken(extra=1.0), "table of mean"),
        (broken(hidden=[[1.0, 2.0], [3.0]]), "no number"),
        (broken(hidden_bias=["a"] * 10), "no number"),
        (broken(mean=[0.0, 0.0]), "mean"),
        (broken(output_bias=float("nan")), "output_bias"),
        (broken(scale=[1.0, 1.0, 0.0, 1.0]), "positive"),
        (broken(delay=0.08), "delay"),
    ],
)
def test_a_broken_network_is_refused_in_one_line(network: object, word: str) -> None:
    with pytest.raises(UsageError, match=word) as error:
        make_filter("network", GOLF, {"network": network})
    assert str(error.value).startswith("filter network: network")
    assert "\n" not in str(error.value)


def test_a_feedback_network_is_refused_where_it_does_not_belong() -> None:
    settings = settings_of(make_filter("network_feedback", GOLF))["network"]
    with pytest.raises(UsageError, match="network"):
        make_filter("network", GOLF, {"network": settings})


def test_too_little_data_is_refused(recordings) -> None:
    short = replace(
        recordings[0], held=replace(recordings[0].signals, frame=recordings[0].signals.frame[:300])
    )
    with pytest.raises(UsageError, match="too few"):
        fit_network([short])


def test_shipped_file_is_small() -> None:
    import crosscomb

    assert (Path(crosscomb.__file__).parent / "data" / "network.json").stat().st_size < 10_000
    assert at.STEER in COLUMNS
