"""Pieces that are made ahead, and filters that run in threads: the same results as one after the other."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from crosscomb.logs.ahead import DEPTH, ahead
from crosscomb.run import drive
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.artefact import load_artefact


def test_pieces_come_in_order_and_only_a_few_ahead() -> None:
    made: list[int] = []

    def pieces():
        for number in range(20):
            made.append(number)
            yield number

    for number in ahead(pieces()):
        assert len(made) <= number + 1 + DEPTH
        assert made[number] == number
    assert made == list(range(20))
    assert list(ahead([])) == []


def test_what_making_a_piece_raises_comes_in_its_place() -> None:
    def pieces():
        yield 1
        raise ValueError("the second")

    given = []
    with pytest.raises(ValueError, match="the second"):
        given.extend(ahead(pieces()))
    assert given == [1]


def test_a_caller_that_stops_leaves_no_thread() -> None:
    before = threading.active_count()
    for number in ahead(iter(range(1000))):
        if number == 3:
            break
    assert threading.active_count() == before


def test_filters_in_threads_say_the_same(simulated, car, monkeypatch: pytest.MonkeyPatch) -> None:
    signals = simulated[0]
    assert len(signals) > drive.LONG
    names = ["kinematic_kf", "dynamic_ekf", "random_walk_pf"]
    threads = estimate_log(signals, car, load_artefact(), names)
    monkeypatch.setattr(drive, "LONG", len(signals) + 1)
    alone = estimate_log(signals, car, load_artefact(), names)
    for name in names:
        np.testing.assert_array_equal(threads.filters[name], alone.filters[name])
    np.testing.assert_array_equal(threads.beta, alone.beta)
