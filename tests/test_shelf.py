"""Recordings on the shelf: what comes back is what went there, and nothing of it stays in memory."""

from __future__ import annotations

import errno
import os
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from crosscomb.errors import UsageError
from crosscomb.selection.seen import Seen
from crosscomb.training.recordings import Recording, read_recordings
from crosscomb.training.selectors.bank import run_one, with_windows
from crosscomb.training.selectors.compare import KINDS
from crosscomb.training.selectors.labels import WINDOW_COLUMNS
from crosscomb.training.selectors.shelf import banks_of, fill_shelf, windows_of
from crosscomb.training.selectors.train import default_filters


def same_runs(one: Seen, other: Seen) -> None:
    for name in ("points", "beta", "beta_std", "nis", "windows"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.inputs.samples, other.inputs.samples)
    assert one.inputs.dt == other.inputs.dt
    for mine, theirs in zip(one.innovations, other.innovations, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("jobs", [1, 2])
def test_runs_and_windows_come_back_as_they_were(recordings: list[Recording], tmp_path, jobs):
    entries = default_filters(recordings[0].vehicle)
    kept = fill_shelf(recordings[:3], entries, 100.0, KINDS, tmp_path, jobs)
    for kind, (settings, everything) in enumerate(KINDS):
        banks, windows = banks_of(kept, settings), windows_of(kept, kind)
        assert len(banks) == len(windows) == 3
        for i, recording in enumerate(recordings[:3]):
            fresh = with_windows(run_one(recording, entries, 100.0, settings), settings)
            assert banks[i].name == fresh.name
            np.testing.assert_array_equal(banks[i].beta_ref, fresh.beta_ref)
            np.testing.assert_array_equal(banks[i].counted, fresh.counted)
            for one, other in zip(banks[i].runs, fresh.runs, strict=True):
                same_runs(one, other)
            labelled = fresh.windows(settings, everything)
            for name in WINDOW_COLUMNS:
                np.testing.assert_array_equal(getattr(windows[i], name), getattr(labelled, name))
            np.testing.assert_array_equal(kept[i].rmse[kind], labelled.rmse)


def test_filters_beside_are_scored_and_not_kept(recordings: list[Recording], tmp_path):
    car = recordings[0].vehicle
    beside = default_filters(car, ["imm"])
    (kept,) = fill_shelf(recordings[:1], default_filters(car), 100.0, KINDS, tmp_path, beside=beside)
    assert len(kept.scores) == 2 * 4
    assert all(run.beta.shape[1] == 3 for run in banks_of([kept], KINDS[0][0])[0].runs)


def test_a_recording_that_is_not_held_reads_its_log_again(data_set):
    held, said = read_recordings(data_set, jobs=1)
    loose, also = read_recordings(data_set, jobs=2, hold=False)
    assert said == also
    assert [one.name for one in held] == [one.name for one in loose]
    assert all(one.held is None for one in loose)
    for one, other in zip(held[:2], loose[:2], strict=True):
        np.testing.assert_array_equal(one.signals.rows(), other.signals.rows())


def test_every_part_of_a_run_is_kept():
    """Who adds to `Seen` must say whether the shelf keeps it."""
    assert {field.name for field in fields(Seen)} == {
        "vehicle", "points", "inputs", "beta", "beta_std", "nis", "innovations", "extras", "windows",
    }  # fmt: skip


def test_a_full_temporary_folder_is_named(recordings: list[Recording], tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(UsageError, match="TMPDIR") as told:
        fill_shelf(recordings[:1], default_filters(recordings[0].vehicle), 100.0, KINDS, tmp_path)
    assert str(tmp_path) in str(told.value)
