"""The texts under the rebuilt tables say what the numbers say, whoever wins."""

import pandas as pd
import pytest

from crosscomb.training.suites.papers import (
    D_INVERNO,
    _accuracy_verdict,
    _pace_verdict,
    _snow_verdict,
)
from crosscomb.training.suites.speed import timed

KALMAN = [name for name in D_INVERNO if "PF" not in name]


def means(**changed: float) -> pd.Series:
    """Ten filters as in the paper, some of them changed."""
    values = {name: 1.0 if name in KALMAN else 3.0 for name in D_INVERNO}
    values |= {"S-UKF": 0.9, "SYSTres-PF": 2.8} | changed
    return pd.Series(values)


def test_the_verdict_on_accuracy_follows_the_means():
    agreeing = _accuracy_verdict(means())
    assert agreeing.count("agrees") == 3
    assert "not agree" not in agreeing
    assert "EKFs 1.000" in agreeing
    other = _accuracy_verdict(means(**{"I-EKF": 0.5, "MULTIres-PF": 0.8}))
    assert "worst does not agree" in other
    assert "best does not agree (here I-EKF)" in other
    assert "particle filter does not agree (here MULTIres-PF)" in other


def test_the_verdict_on_pace_follows_the_means():
    agreeing = _pace_verdict(means(**{"FO-EKF": 0.5, "G-UKF": 2.0}))
    assert "not agree" not in agreeing
    assert "1 times the dearest" in agreeing
    other = _pace_verdict(means(**{"I-EKF": 0.5, "S-UKF": 2.0}))
    assert "here I-EKF" in other
    assert "here S-UKF" in other


@pytest.mark.parametrize(
    ("rmse_b", "words"),
    [(1.0, "lowest RMSE agrees,"), (9.0, "lowest RMSE agrees on snow A only,")],
)
def test_the_verdict_on_snow_tells_the_places_apart(rmse_b, words):
    columns = ["KF", "PF", "cross-combination"]
    rows = {
        "ME snow A": [5.0, 7.0, 4.0],
        "RMSE snow A": [2.0, 1.8, 1.0],
        "ME snow B": [5.0, 7.0, 6.0],
        "RMSE snow B": [2.0, 2.8, rmse_b],
    }
    verdict = _snow_verdict(pd.DataFrame.from_dict(rows, orient="index", columns=columns))
    assert words in verdict
    assert "lowest largest error agrees on snow A only," in verdict
    assert "PF beats the KF in RMSE agrees on snow A only" in verdict
    assert "KF the PF in largest error agrees." in verdict


def test_time_is_that_of_one_run():
    answer, seconds = timed(lambda: sum(range(100_000)))
    assert answer == sum(range(100_000))
    assert 0.0 < seconds < 1.0
