"""Windows: what the selector sees is what the sensors gave, up to now and no later."""

import numpy as np
import pytest
from pydantic import ValidationError

from crosscomb.selection.windows import WindowSettings, window_features

RAW = WindowSettings(features="raw")
STATISTICS = WindowSettings(features="statistics")
both = pytest.mark.parametrize("settings", [RAW, STATISTICS], ids=["raw", "statistics"])


@pytest.fixture(scope="module")
def channels() -> tuple[np.ndarray, np.ndarray]:
    """Lateral acceleration and yaw rate ``(400,)`` that never repeat."""
    rng = np.random.default_rng(3)
    return 4.0 * rng.standard_normal(400) + 1.0, 0.3 * rng.standard_normal(400) - 0.1


def test_raw_features_are_the_ten_samples(channels):
    ay, yaw_rate = channels
    features = window_features(ay, yaw_rate, RAW)
    assert features.shape == (400, 20)
    for k in range(9, 400):
        np.testing.assert_array_equal(features[k, :10], ay[k - 9 : k + 1].astype(np.float32))
        np.testing.assert_array_equal(features[k, 10:], yaw_rate[k - 9 : k + 1].astype(np.float32))


def test_before_a_log_stands_its_first_sample(channels):
    ay, yaw_rate = channels
    features = window_features(ay, yaw_rate, RAW)
    np.testing.assert_array_equal(features[0], np.repeat(np.float32([ay[0], yaw_rate[0]]), 10))
    np.testing.assert_array_equal(features[2, :10], np.float32([ay[0]] * 8 + [ay[1], ay[2]]))


def test_statistics_equal_numpy(channels):
    ay, yaw_rate = channels
    features = window_features(ay, yaw_rate, STATISTICS)
    for k in (0, 1, 5, 9, 10, 57, 99, 100, 399):
        expected = []
        for span in (10, 100):
            a, r = (channel[max(0, k + 1 - span) : k + 1] for channel in channels)
            expected += [
                statistic
                for x in (a, r)
                for statistic in (abs(x.mean()), abs(x).mean(), x.std(), abs(x).max())
            ]
            slope = np.sum(a * r) / np.sum(r * r)  # least squares through the origin
            expected += [np.mean(a * r), slope, np.sqrt(np.mean((a - slope * r) ** 2))]
        np.testing.assert_allclose(features[k], expected, rtol=1e-6, atol=1e-6)


@both
def test_features_are_as_many_as_their_names(channels, settings):
    features = window_features(*channels, settings)
    assert features.shape[1] == len(settings.names) == len(set(settings.names))
    assert features.dtype == np.float32
    assert all(name.endswith(("[m/s^2]", "[rad/s]", "[m rad/s^3]", "[m/s]")) for name in settings.names)


def test_names_say_what_stands_there(channels):
    ay, yaw_rate = channels
    now = dict(zip(RAW.names, window_features(ay, yaw_rate, RAW)[50], strict=True))
    assert now["ay[0] [m/s^2]"] == np.float32(ay[50])
    assert now["yaw_rate[-9] [rad/s]"] == np.float32(yaw_rate[41])
    now = dict(zip(STATISTICS.names, window_features(ay, yaw_rate, STATISTICS)[200], strict=True))
    assert now["max abs(ay, 10 samples) [m/s^2]"] == np.float32(abs(ay[191:201]).max())
    assert now["std(yaw_rate, 100 samples) [rad/s]"] == np.float32(yaw_rate[101:201].std())


@both
@pytest.mark.parametrize("k", [0, 8, 150, 398])
def test_later_samples_change_nothing(channels, settings, k):
    whole = window_features(*channels, settings)
    cut = window_features(*(channel[: k + 1] for channel in channels), settings)
    np.testing.assert_array_equal(cut, whole[: k + 1])
    for later in (1e9, np.nan):
        other = [np.concatenate([channel[: k + 1], np.full(399 - k, later)]) for channel in channels]
        np.testing.assert_array_equal(window_features(*other, settings)[: k + 1], whole[: k + 1])


@both
def test_a_window_does_not_know_where_in_the_log_it_is(channels, settings):
    whole = window_features(*channels, settings)
    late = window_features(*(channel[130:] for channel in channels), settings)
    first = 99 if settings is STATISTICS else 9  # from here on all samples of the window are in both
    np.testing.assert_array_equal(late[first:], whole[130 + first :])


@both
def test_a_missing_sample_counts_as_the_last_one(channels, settings):
    ay, yaw_rate = (channel.copy() for channel in channels)
    ay[20:27], yaw_rate[60], ay[0] = np.nan, np.nan, np.nan
    held_ay, held_yaw_rate = (channel.copy() for channel in channels)
    held_ay[20:27], held_yaw_rate[60], held_ay[0] = ay[19], yaw_rate[59], 0.0
    features = window_features(ay, yaw_rate, settings)
    assert np.isfinite(features).all()
    np.testing.assert_array_equal(features, window_features(held_ay, held_yaw_rate, settings))


def test_other_lengths_are_cut_as_asked(channels):
    ay, yaw_rate = channels
    features = window_features(ay, yaw_rate, WindowSettings(length=4, history=3))
    names = WindowSettings(length=4, history=3).names
    at = names.index("abs mean(ay, 12 samples) [m/s^2]")
    assert features[100, at] == pytest.approx(abs(ay[89:101].mean()), rel=1e-6)
    assert features[100, 0] == pytest.approx(abs(ay[97:101].mean()), rel=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"length": 1}, {"hop": 0}, {"history": 0}, {"features": "spectrum"}, {"lenght": 10}]
)
def test_settings_out_of_range_or_unknown_are_refused(wrong):
    with pytest.raises(ValidationError):
        WindowSettings(**wrong)


def test_a_mirrored_drive_looks_the_same(channels):
    mirrored = window_features(*(-channel for channel in channels), STATISTICS)
    np.testing.assert_array_equal(mirrored, window_features(*channels, STATISTICS))


def test_in_a_steady_turn_the_slope_is_the_speed():
    yaw_rate = 0.3 + 0.1 * np.sin(0.02 * np.arange(400))
    names = STATISTICS.names
    seen = dict(zip(names, window_features(17.0 * yaw_rate, yaw_rate, STATISTICS)[300], strict=True))
    assert seen["slope(ay over yaw_rate, 100 samples) [m/s]"] == pytest.approx(17.0)
    assert seen["rms(ay - slope yaw_rate, 100 samples) [m/s^2]"] == pytest.approx(0.0, abs=1e-3)
