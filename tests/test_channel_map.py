"""The channel map: units, signs, offsets, delays and the accelerometer's place, and what it refuses."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crosscomb.errors import UsageError
from crosscomb.logs.channel_map import FACTORS, Channel, ChannelMap, apply_map, load_map
from crosscomb.logs.read import read_log
from crosscomb.signals import UNITS


def make_map(tmp_path: Path, text: str) -> ChannelMap:
    path = tmp_path / "map.toml"
    path.write_text(text, encoding="utf-8")
    return load_map(path)


def table(n: int = 200, rate: float = 100.0, **columns: np.ndarray) -> pd.DataFrame:
    t = np.arange(n) / rate
    base = {
        "t": t,
        "vx": np.full(n, 20.0),
        "ay": np.sin(t),
        "yaw_rate": 0.1 * np.sin(t),
        "steer": 0.01 * np.sin(t),
    }
    return pd.DataFrame({**base, **columns})


def test_foreign_log_becomes_si(tmp_path: Path) -> None:
    channel_map = make_map(
        tmp_path,
        """
        [reader]
        separator = ";"
        decimal = ","
        header_row = 3
        first_data_row = 5
        time_from_zero = true
        [channels.t]
        column = "Zeit"
        unit = "ms"
        [channels.vx]
        column = "Speed"
        unit = "km/h"
        [channels.ay]
        column = "LatAcc"
        unit = "g"
        sign = -1
        offset = 0.2
        [channels.yaw_rate]
        unit = "°/s"
        scale = 2.0
        [channels.steer_wheel]
        unit = "deg"
        """,
    )
    text = "logger\n1,5\nZeit;Speed;LatAcc;yaw_rate;steer_wheel\nms;km/h;g;°/s;deg\n"
    (tmp_path / "log.csv").write_text(text + "5000;36;0,5;9;-180\n5010;72;0,5;9;-180\n", encoding="utf-8")
    log = read_log(tmp_path / "log.csv", channel_map)
    expected = [
        [0.0, 10.0, -0.5 * 9.81 - 0.2, np.radians(18.0), -np.pi],
        [0.01, 20.0, -5.105, np.pi / 10, -np.pi],
    ]
    assert log.frame.columns.tolist() == ["t", "vx", "ay", "yaw_rate", "steer_wheel"]
    np.testing.assert_allclose(log.frame.to_numpy(), expected, rtol=1e-14)


def test_rows_are_still_numbered_as_in_the_file(tmp_path: Path) -> None:
    channel_map = make_map(tmp_path, "[reader]\nheader_row = 3\n")
    (tmp_path / "log.csv").write_text("a\nb\nt,vx,ay,yaw_rate,steer\n0,1,1,1,1\n1,1,bad,1,1\n")
    with pytest.raises(UsageError, match=r"row 5, column ay: 'bad'"):
        read_log(tmp_path / "log.csv", channel_map)


def test_every_si_unit_has_its_own_factor_one() -> None:
    assert set(FACTORS) == set(UNITS.values())
    for unit, factors in FACTORS.items():
        assert factors[unit.lower()] == 1.0


def test_a_column_given_to_one_channel_is_not_taken_for_another() -> None:
    channel_map = ChannelMap(channels={"steer_wheel": Channel(column="steer")})
    log = apply_map(
        table()[channel_map.columns(["t", "vx", "ay", "yaw_rate", "steer"], "x")], channel_map, "x"
    )
    assert log.has("steer_wheel")
    assert not log.has("steer")


def test_truth_may_be_missing_but_no_other_mapped_column(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t,vx,ay,yaw_rate,steer\n0,1,1,1,1\n1,1,1,1,1\n")
    with_truth = ChannelMap(channels={"beta_ref": Channel(column="Slip")})
    assert not read_log(tmp_path / "log.csv", with_truth).has_reference
    with pytest.raises(
        UsageError, match=r"'yaw_rat', which .* for yaw_rate, is missing: did you mean 'yaw_rate'"
    ):
        read_log(tmp_path / "log.csv", ChannelMap(channels={"yaw_rate": Channel(column="yaw_rat")}))


def test_channels_are_held_back_to_the_latest_one() -> None:
    # The car does sin(t); yaw rate arrives 40 ms late, ay 10 ms, the others at once.
    t = np.arange(400) / 100.0
    frame = table(
        400, yaw_rate=np.sin(t - 0.04), ay=np.sin(t - 0.01), vx=5.0 + np.sin(t), beta_ref=0.1 * np.sin(t)
    )
    channel_map = ChannelMap(channels={"yaw_rate": Channel(delay=0.04), "ay": Channel(delay=0.01)})
    log = apply_map(frame, channel_map, "x")
    instant = np.sin(t - 0.04)
    rows = slice(4, None)
    np.testing.assert_allclose(log.column("yaw_rate"), instant, atol=1e-12)
    np.testing.assert_allclose(log.column("ay")[rows], instant[rows], atol=1e-12)
    np.testing.assert_allclose(log.column("vx")[rows] - 5.0, instant[rows], atol=1e-12)
    np.testing.assert_allclose(log.column("beta_ref")[rows], 0.1 * instant[rows], atol=1e-12)
    assert np.all(np.isnan(log.column("vx")[:4]))
    assert np.array_equal(log.t, t)
    assert "0.04 s before" in log.notes[-1]


@pytest.mark.parametrize("start", [0.0, 1_700_000_000.0], ids=["from zero", "Unix time"])
def test_a_delayed_channel_crosses_no_silence(start: float) -> None:
    """A step of 0.1 s is bridged, a longer one is not; a late value on a row is that row's, whatever is beside it."""
    t = np.cumsum([0.0] + [0.01] * 19 + [0.1] + [0.01] * 19 + [0.11] + [0.01] * 19)
    vx = 20.0 + 10.0 * t
    vx[[5, 7]] = np.nan
    channel_map = ChannelMap(channels={"yaw_rate": Channel(delay=0.03)})
    held = apply_map(table(60, t=start + t, vx=vx), channel_map, "x").column("vx")
    expected = 20.0 + 10.0 * (t - 0.03)
    expected[[0, 1, 2, 8, 10, 40, 41, 42]] = np.nan  # before the log, the missing ones, and in the silence
    np.testing.assert_allclose(held, expected, rtol=0.0, atol=1e-5)


def test_alignment_and_lever_arm_look_at_no_later_row_and_bridge_no_gap() -> None:
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.005, 0.03, 300))
    t[150:] += 5.0
    frame = table(300, t=t, ay=rng.normal(size=300), yaw_rate=rng.normal(size=300), ax=rng.normal(size=300))
    frame.loc[rng.choice(300, 40, replace=False), "ay"] = np.nan
    channel_map = ChannelMap.model_validate(
        {"channels": {"yaw_rate": {"delay": 0.033}}, "accelerometer": {"position": [-1.0, 0.3]}}
    )
    whole = apply_map(frame, channel_map, "x").frame
    assert np.isnan(whole["ay"][150])  # 33 ms before it lies in the silence
    assert whole["ay"].notna().mean() > 0.5
    for row in (20, 149, 151, 222):
        changed = frame.copy()
        changed.loc[row + 1 :, ["vx", "ax", "ay", "yaw_rate", "steer"]] = 99.0
        pd.testing.assert_frame_equal(apply_map(changed, channel_map, "x").frame[: row + 1], whole[: row + 1])


def test_lever_arm_is_the_rigid_body_formula() -> None:
    # Yaw rate 0.2 + 0.5 t: the slope is found exactly from any samples.
    t = np.cumsum(np.random.default_rng(5).uniform(0.004, 0.012, 300))
    x, y, spin, spin_rate = -1.4, 0.4, 0.2 + 0.5 * t, 0.5
    at_cg = {"ax": np.cos(t), "ay": 3.0 * np.sin(t)}
    sensor = {
        "ax": at_cg["ax"] - y * spin_rate - x * spin**2,
        "ay": at_cg["ay"] + x * spin_rate - y * spin**2,
    }
    channel_map = ChannelMap.model_validate({"accelerometer": {"position": [x, y]}})
    log = apply_map(table(300, t=t, yaw_rate=spin, **sensor), channel_map, "x")
    np.testing.assert_allclose(log.column("ax")[2:], at_cg["ax"][2:], atol=1e-9)
    np.testing.assert_allclose(log.column("ay")[2:], at_cg["ay"][2:], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[channels.yawrate]\n", ("channels.yawrate", "did you mean yaw_rate")),
        ('[channels.vx]\nunit = "deg"\n', ("channels.vx", "'deg'", "km/h")),
        ("[channels.vx]\nsign = 2\n", ("channels.vx.sign",)),
        ("[channels.vx]\nscale = 0\n", ("channels.vx.scale",)),
        ("[channels.vx]\ndelay = -0.1\n", ("channels.vx.delay",)),
        ("[channels.vx]\nlag = 0.1\n", ("unknown key channels.vx.lag",)),
        ("[channels.t]\ndelay = 0.1\n", ("channels.t", "delay")),
        ("[accelerometer]\nposition = [1.0]\n", ("accelerometer.position",)),
        ("[accelerometer]\nposition = [-1420.0, 0.0]\n", ("accelerometer.position", "metres")),
        ('[reader]\nseparator = ", "\n', ("reader.separator",)),
        ("[reader]\nheader_row = 4\nfirst_data_row = 3\n", ("first_data_row", "below header_row")),
        ("[channels", ("no valid TOML",)),
    ],
)
def test_wrong_maps_are_refused_in_one_line(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    with pytest.raises(UsageError) as error:
        make_map(tmp_path, text)
    assert "map.toml" in str(error.value)
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)


def test_missing_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such channel map"):
        load_map(tmp_path / "map.toml")


def test_audi_accelerometer_moved_to_the_centre_of_gravity_fits_the_motion(data_dir: Path) -> None:
    # Measured 1.42 m behind the centre of gravity: taken as it is, ay is 0.45 to 0.57 m/s^2 off.
    for run in "ab":
        path = data_dir / "stanford_audi_tts_2011" / f"run_{run}_part1.csv"
        channel_map = ChannelMap.model_validate({"accelerometer": {"position": [-1.42, 0.0]}})
        assert _misfit(path, channel_map) < 0.15
        assert _misfit(path, None) > 0.4


def _misfit(path: Path, channel_map: ChannelMap | None) -> float:
    log = read_log(path, channel_map)
    box = np.ones(40) / 40.0  # 0.2 s

    def low_pass(values: np.ndarray) -> np.ndarray:
        return np.convolve(np.nan_to_num(values), box, "same")

    beta = log.beta_ref
    vx, vy = log.column("vx") * np.cos(beta), log.column("vx") * np.sin(beta)
    error = log.column("ay") - np.gradient(low_pass(vy), log.t) - vx * log.column("yaw_rate")
    known = np.isfinite(error) & (log.column("vx") > 2.5)
    inside = np.convolve(known, np.ones(120), "same") == 120.0
    return float(np.std(low_pass(error)[inside]))


def test_microcar_needs_its_steering_ratio_and_maps_its_hand_wheel(data_dir: Path, tmp_path: Path) -> None:
    path = data_dir / "uahl_revsted" / "obd_sample.csv"
    log = read_log(path)
    assert log.has("steer_wheel")
    assert not log.has("steer")
    # L * ratio is 34.6 m: with a wheelbase of 1.7 m a ratio of 20.4, given as a scale.
    mapped = read_log(
        path, make_map(tmp_path, f'[channels.steer]\ncolumn = "steer_wheel"\nscale = {1 / 20.4}\n')
    )
    np.testing.assert_allclose(mapped.column("steer"), log.column("steer_wheel") / 20.4)
