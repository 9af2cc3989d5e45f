"""Training: labels, splits and scores are right, no recording leaks into its verdict, the switch pays."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crosscomb.errors import UsageError
from crosscomb.models.vehicle import Vehicle, load_vehicle
from crosscomb.report.training import metrics_json
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.answer import select, start_selection
from crosscomb.selection.artefact import load_artefact, save_artefact
from crosscomb.selection.windows import WindowSettings
from crosscomb.signals import Signals, make_signals
from crosscomb.training import recordings as recordings_module
from crosscomb.training.folds import grouped_folds, split_recordings
from crosscomb.training.metrics import countable, coverage, score, score_log
from crosscomb.training.parallel import in_parallel
from crosscomb.training.recordings import Recording, common_vehicle, read_recordings, require_enough
from crosscomb.training.selectors import fit as fit_module
from crosscomb.training.selectors import fit_correction
from crosscomb.training.selectors import train as train_module
from crosscomb.training.selectors.bank import BankRun, run_bank
from crosscomb.training.selectors.evaluate import ORACLE, SWITCH, ZERO, confusion_of, evaluate
from crosscomb.training.selectors.fit import SELECTORS
from crosscomb.training.selectors.fit_correction import Size
from crosscomb.training.selectors.labels import label_run, oracle_beta
from crosscomb.training.selectors.train import (
    Training,
    default_filters,
    fit_and_judge,
    make_fitter,
    steps,
    train,
)
from crosscomb.training.simulation.presets import plan_jobs
from crosscomb.training.simulation.simulate import simulate_log

WINDOW = SELECTORS["tree"].window


@pytest.fixture(scope="module")
def banks(recordings: list[Recording]) -> list[BankRun]:
    """All filters on the simulated logs."""
    return run_bank(recordings, default_filters(recordings[0].vehicle), 100.0, WINDOW)


@pytest.fixture(scope="module")
def trained(recordings: list[Recording]) -> Training:
    """A training on the simulated logs."""
    return train(recordings, seed=2)


# Splits


@pytest.mark.parametrize("n", [7, 8, 13, 20, 40, 101])
def test_the_three_parts_cover_every_recording_once(n):
    for seed in range(5):
        parts = split_recordings(n, seed)
        assert sorted(parts.training + parts.validation + parts.test) == list(range(n))
        assert min(len(parts.validation), len(parts.test)) >= 1
        assert len(parts.training) >= 5
        assert abs(len(parts.training) - 0.75 * n) <= 1.5
        assert abs(len(parts.validation) - 0.15 * n) <= 1.0


def test_another_seed_splits_otherwise():
    splits = {tuple(split_recordings(20, seed).test) for seed in range(20)}
    assert len(splits) > 10
    assert split_recordings(20, 3) == split_recordings(20, 3)


@pytest.mark.parametrize("n", [5, 6, 15, 30])
@pytest.mark.parametrize("folds", [2, 5])
def test_folds_never_share_a_recording(n, folds):
    members = list(range(100, 100 + n))
    pairs = grouped_folds(members, folds, 0)
    assert len(pairs) == folds
    for fit, held_out in pairs:
        assert set(fit) & set(held_out) == set()
        assert sorted(fit + held_out) == members
        assert held_out
    assert sorted(index for _, held_out in pairs for index in held_out) == members


def test_more_folds_than_recordings_leaves_one_out():
    assert len(grouped_folds([4, 5, 6], 5, 0)) == 3


# Labels


def slow_windows(bank: BankRun, settings: WindowSettings) -> list[tuple[int, list[float]]]:
    """Last sample of each window and the RMSE of each filter in it, written out."""
    found = []
    for run in bank.runs:
        vx, truth = run.column("vx").tolist(), run.beta_ref.tolist()
        beta = run.beta.tolist()
        for end in range(settings.length - 1, len(vx), settings.hop):
            rows = range(end - settings.length + 1, end + 1)
            known = [row for row in rows if not math.isnan(truth[row])]
            if known and all(vx[row] > 3.0 for row in rows):
                errors = [[beta[row][i] - truth[row] for row in known] for i in range(len(beta[0]))]
                found.append((end, [math.sqrt(sum(e * e for e in each) / len(each)) for each in errors]))
    return found


def test_labels_are_the_filter_with_the_lowest_windowed_rmse(banks):
    labels = set()
    for bank in banks:
        windows = bank.windows(WINDOW)
        expected = slow_windows(bank, WINDOW)
        np.testing.assert_allclose(windows.rmse, [rmse for _, rmse in expected], rtol=1e-9)
        np.testing.assert_array_equal(windows.label, [int(np.argmin(rmse)) for _, rmse in expected])
        (run,) = bank.runs
        np.testing.assert_array_equal(windows.features, run.windows[[end for end, _ in expected]])
        labels |= set(windows.label)
    assert labels == {0, 1, 2}


@pytest.mark.parametrize("settings", [WindowSettings(length=25, hop=7), WindowSettings(length=5, hop=20)])
def test_other_window_lengths_and_hops_are_labelled_alike(banks, settings):
    for bank in banks[:3]:
        expected = slow_windows(bank, settings)
        np.testing.assert_allclose(bank.windows(settings).rmse, [rmse for _, rmse in expected], rtol=1e-9)


def with_truth(recording: Recording, keep: np.ndarray) -> Recording:
    """The recording with ground truth only where `keep` says."""
    frame = recording.signals.frame.copy()
    frame.loc[~keep, ["beta_ref", "vx_ref", "vy_ref"]] = np.nan
    return replace(recording, held=replace(recording.signals, frame=frame))


def test_rare_truth_still_labels_windows(recordings, banks):
    """A 20 Hz reference beside 100 Hz signals is common; its windows must not vanish."""
    n = len(recordings[2].signals)
    sparse = with_truth(recordings[2], np.arange(n) % 5 == 0)
    (bank,) = run_bank([sparse], default_filters(sparse.vehicle), 100.0, WINDOW)
    windows, full = bank.windows(WINDOW), banks[2].windows(WINDOW)
    assert len(windows.label) == len(full.label) > 50
    np.testing.assert_allclose(windows.rmse, [rmse for _, rmse in slow_windows(bank, WINDOW)], rtol=1e-9)
    assert np.mean(windows.label == full.label) > 0.9


def test_windows_without_truth_or_too_slow_are_left_out(recordings, banks):
    n = len(recordings[2].signals)
    half = with_truth(recordings[2], np.arange(n) < n // 2)
    (bank,) = run_bank([half], default_filters(half.vehicle), 100.0, WINDOW)
    assert len(bank.windows(WINDOW).label) == pytest.approx(0.5 * len(banks[2].windows(WINDOW).label), abs=1)
    (run,) = bank.runs
    slow = replace(run, points=run.points.copy())
    slow.column("vx")[:] = 2.9
    assert label_run(slow, WINDOW).rmse.shape == (0, 3)
    short = replace(run, points=run.points[:5], beta=run.beta[:5], windows=run.windows[:5])
    assert label_run(short, WINDOW).label.size == 0


def test_fifty_hertz_logs_can_be_trained_on(recordings):
    log = recordings[2].signals
    half = replace(recordings[2], held=make_signals(log.frame.iloc[::2].reset_index(drop=True), "50 Hz"))
    (bank,) = run_bank([half], default_filters(half.vehicle), 100.0, WINDOW)
    assert len(bank.windows(WINDOW).label) > 50


# Scores


def test_the_oracle_is_never_worse_than_a_filter_in_any_window(banks):
    for bank in banks:
        truth, counted = bank.beta_ref, bank.counted
        beta, each = bank.oracle(10), bank.joined(lambda run: run.beta)
        better = 0
        for start in range(0, len(truth), 10):
            rows = np.flatnonzero(counted[start : start + 10]) + start
            if rows.size:
                error = np.mean((beta[rows] - truth[rows]) ** 2)
                others = np.mean((each[rows] - truth[rows, None]) ** 2, axis=0)
                assert error <= others.min() * (1.0 + 1e-12)
                better += error < others.max()
        assert better > 10


def test_the_oracle_bounds_every_filter_over_a_recording(trained):
    for evaluation in trained.evaluations.values():
        rmse = evaluation.rmse
        for name in trained.artefact.filter_names:
            assert (rmse[ORACLE] <= rmse[name] + 1e-12).all()


def test_oracle_of_uneven_length_covers_every_sample(banks):
    (run,) = banks[0].runs
    assert len(oracle_beta(run, 7)) == len(run.beta)


def test_scores_by_hand():
    truth = np.array([0.0, 0.1, np.nan, 0.3, 0.0])
    beta = np.array([0.0, 0.2, 5.0, 0.1, 9.0])
    counted = countable(truth, np.array([5.0, 5.0, 5.0, 3.1, 3.0]))
    assert counted.tolist() == [True, True, False, True, False]
    result = score(beta, truth, counted)
    assert result.rmse == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 3))
    assert result.max_error == pytest.approx(0.2)
    assert result.samples == 3
    assert np.isnan(score(beta, truth, np.zeros(5, dtype=bool)).rmse)
    assert coverage(beta, np.full(5, 0.06), truth, counted) == pytest.approx(2 / 3)


def test_scores_of_a_log_are_those_of_its_columns(simulated, car):
    log = simulated[2]
    estimate = estimate_log(log, car, load_artefact())
    scores = score_log(estimate)
    counted = np.isfinite(log.beta_ref) & (log.column("vx") > 3.0)
    assert list(scores) == ["zero", "kinematic_kf", "dynamic_ekf", "random_walk_pf", "crosscomb"]
    error = (estimate.beta - log.beta_ref)[counted]
    assert scores["crosscomb"].rmse == pytest.approx(np.sqrt(np.mean(error**2)))
    assert scores["zero"].max_error == pytest.approx(np.abs(log.beta_ref[counted]).max())


def test_the_confusion_matrix_counts_windows(banks, trained):
    chosen, together = trained.artefact, np.zeros((3, 3), dtype=int)
    for bank in banks[:4]:
        windows = bank.windows(chosen.window)
        picked = chosen.tree.predict(windows.features)
        expected = np.zeros((3, 3), dtype=int)
        for best, selected in zip(windows.label, picked, strict=True):
            expected[best, selected] += 1
        answers = [select(start_selection(chosen), run) for run in bank.runs]
        counts, regret = confusion_of(bank, answers, chosen)
        np.testing.assert_array_equal(counts, expected)
        lost = windows.rmse[np.arange(len(picked)), picked] - windows.rmse.min(axis=1)
        assert regret == pytest.approx(np.degrees(lost.sum()))
        together += expected
    np.testing.assert_array_equal(evaluate(banks[:4], chosen).confusion, together)


def test_evaluation_scores_what_the_switch_gives_a_user(recordings, banks, trained):
    """The table of a training and the estimate of a log are made by the same code."""
    table = evaluate(banks, trained.artefact).rmse
    for recording in recordings[1:4]:
        scores = score_log(estimate_log(recording.signals, recording.vehicle, trained.artefact))
        assert table.at[recording.name, SWITCH] == pytest.approx(
            np.degrees(scores["crosscomb"].rmse), rel=1e-9
        )
        assert table.at[recording.name, "dynamic_ekf"] == pytest.approx(
            np.degrees(scores["dynamic_ekf"].rmse), rel=1e-9
        )
        assert table.at[recording.name, ZERO] == pytest.approx(np.degrees(scores["zero"].rmse), rel=1e-9)


def test_the_best_single_filter_has_the_lowest_mean_rmse(trained):
    for evaluation in trained.evaluations.values():
        means = evaluation.rmse[trained.artefact.filter_names].mean()
        assert evaluation.best_single == means.idxmin()
        assert evaluation.ratio == pytest.approx(evaluation.rmse[SWITCH].mean() / means.min())
        assert evaluation.overall.at[SWITCH, "max"] == evaluation.largest[SWITCH].max()


# The whole training


def test_every_recording_is_judged_once_and_by_its_part(recordings, banks, trained):
    names = np.array([recording.name for recording in recordings])
    for part, evaluation in trained.evaluations.items():
        members = names[getattr(trained.parts, "training" if part == "folds" else part)]
        assert sorted(evaluation.table.index) == sorted(members)
    assert trained.artefact.training["parts"]["test"] == names[trained.parts.test].tolist()
    counted = sum(evaluation.confusion.sum() for evaluation in trained.evaluations.values())
    assert counted == sum(len(bank.windows(WINDOW).label) for bank in banks)


def test_a_recording_has_no_part_in_its_own_verdict(recordings):
    """Turn the truth of one recording around: what is selected in it must stay, or its labels leaked."""
    plain = train(recordings, "paper", seed=1)
    index = plain.parts.training[0]
    frame = recordings[index].signals.frame
    other = frame.assign(beta_ref=-3.0 * frame["beta_ref"] + 0.05)
    poisoned = list(recordings)
    poisoned[index] = replace(recordings[index], held=replace(recordings[index].signals, frame=other))
    spoilt = train(poisoned, "paper", seed=1)

    name = recordings[index].name
    truthless = [(SWITCH, "switches_per_minute"), (SWITCH, "largest_jump")]
    assert plain.folds.table.loc[name, truthless].tolist() == spoilt.folds.table.loc[name, truthless].tolist()
    assert plain.folds.table.at[name, (ZERO, "rmse")] != spoilt.folds.table.at[name, (ZERO, "rmse")]
    # The other recordings do see it: their trees, and the tree of the artefact, are other ones.
    assert plain.artefact.tree != spoilt.artefact.tree


def test_the_artefact_is_refitted_on_all_recordings(recordings, banks, trained):
    artefact = trained.artefact
    features = np.concatenate([bank.windows(WINDOW).features for bank in banks])
    np.testing.assert_array_equal(np.float32(artefact.tree.lowest), features.min(axis=0))
    np.testing.assert_array_equal(np.float32(artefact.tree.highest), features.max(axis=0))
    assert sorted(artefact.training["data"]) == sorted(recording.name for recording in recordings)
    assert artefact.vehicle == recordings[0].vehicle
    assert trained.shape.depth in SELECTORS["tree"].depths


def files_of(training: Training, folder: Path) -> tuple[bytes, str]:
    save_artefact(training.artefact, folder / "a.json")
    return (folder / "a.json").read_bytes(), metrics_json(training)


def test_the_same_seed_gives_the_same_bytes_whatever_the_jobs(recordings, trained, tmp_path):
    ticks = []
    again = train(recordings, seed=2, jobs=2, progress=lambda: ticks.append(1))
    assert files_of(again, tmp_path) == files_of(trained, tmp_path)
    assert len(ticks) == steps(recordings, 5)


def test_another_process_fits_the_same_correction(recordings, tmp_path):
    """Networks and boosted trees, on files that processes share."""
    fitter = make_fitter(recordings[:4], "hybrid", default_filters(recordings[0].vehicle), tmp_path, 0)
    task = fitter, [0, 1, 2], [[3]]
    (here, _, (judged,)), (there, _, (also,)) = (
        in_parallel(fit_and_judge, [task] * jobs, jobs)[-1] for jobs in (1, 2)
    )
    assert here.model_dump_json() == there.model_dump_json()
    pd.testing.assert_frame_equal(judged.table, also.table, check_exact=True)


def test_another_seed_gives_another_split(recordings, trained, tmp_path):
    other = train(recordings, "paper", seed=5)
    assert other.parts != trained.parts
    assert files_of(other, tmp_path)[1] != files_of(trained, tmp_path)[1]


def test_a_slower_working_rate_is_kept(recordings):
    trained = train(recordings, "paper", rate=50.0)
    assert trained.artefact.rate == 50.0
    estimate = estimate_log(recordings[0].signals, recordings[0].vehicle, trained.artefact)
    assert len(estimate.beta) == len(recordings[0].signals)
    assert (np.diff(estimate.beta)[::2] == 0.0).all()


def test_one_class_only_is_refused_by_the_folder(recordings, banks, data_set):
    """The truth is what one filter says: it is the best in every window."""
    perfect = []
    for recording, bank in zip(recordings, banks, strict=True):
        frame = recording.signals.frame.assign(beta_ref=bank.joined(lambda run: run.beta)[:, 1])
        perfect.append(replace(recording, held=replace(recording.signals, frame=frame)))
    with pytest.raises(UsageError) as caught:
        train(perfect)
    for word in (str(data_set), "dynamic_ekf is best in every window", "add recordings"):
        assert word in str(caught.value)


def test_a_fold_with_one_class_is_no_obstacle(recordings, banks, monkeypatch):
    """One recording alone holds the second class: the folds without it have nothing to choose, and say so."""
    altered = []
    for index, (recording, bank) in enumerate(zip(recordings, banks, strict=True)):
        best = 0 if index == 3 else 1
        frame = recording.signals.frame.assign(beta_ref=bank.joined(lambda run: run.beta)[:, best])
        altered.append(replace(recording, held=replace(recording.signals, frame=frame)))
    for module, size in ((fit_module, "FULL"), (fit_module, "FEW"), (fit_correction, "DOUBT")):
        monkeypatch.setattr(module, size, Size(1, (8, 4), 40))
    for selector in ("tree", "paper", "hybrid"):
        trained = train(altered, selector, folds=2)
        assert trained.artefact.tree.n_classes == 3


def test_a_recording_without_a_whole_window_is_named(recordings):
    frame = recordings[1].signals.frame
    keep = np.arange(len(frame)) < 6
    stub = replace(recordings[1], held=replace(recordings[1].signals, frame=frame[keep]))
    with pytest.raises(UsageError) as caught:
        train([recordings[0], stub, *recordings[2:]])
    assert str(stub.path) in str(caught.value)


# Data folders


Write = Callable[[pd.DataFrame, Path], Path]


def fill(folder: Path, logs: list[Signals], write_log: Write) -> None:
    folder.mkdir(exist_ok=True)
    for log in logs:
        write_log(log.frame, folder / f"{log.name}.csv")


def test_sub_folders_have_each_their_vehicle(simulated, car, write_log, write_vehicle, tmp_path):
    for name, mass in (("a", 1400.0), ("b", 1500.0)):
        fill(tmp_path / name, simulated[:2], write_log)
        write_vehicle(tmp_path / name, car.model_copy(update={"mass": mass}))
    fill(tmp_path / "c", simulated[:1], write_log)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "read.me").write_text("no log")

    found, notes = read_recordings(tmp_path)
    assert [(r.name.split("/")[0], r.vehicle.mass) for r in found] == [("a", 1400.0)] * 2 + [
        ("b", 1500.0)
    ] * 2
    assert common_vehicle(found) is None
    (note,) = notes
    assert note.startswith("c: skipped")
    assert "vehicle.toml" in note

    found, notes = read_recordings(tmp_path, "volvo_v40")
    assert (len(found), notes) == (5, [])
    assert common_vehicle(found) == load_vehicle("volvo_v40")


def test_an_artefact_of_several_vehicles_holds_none(recordings, car):
    heavier = car.model_copy(update={"mass": 1.1 * car.mass})
    mixed = [replace(r, vehicle=heavier) if i % 2 else r for i, r in enumerate(recordings)]
    assert train(mixed, "paper").artefact.vehicle is None


def test_logs_beside_no_vehicle_file_are_refused(simulated, write_log, tmp_path):
    fill(tmp_path, simulated[:1], write_log)
    with pytest.raises(UsageError, match=r"vehicle\.toml") as caught:
        read_recordings(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_logs_without_truth_are_skipped_and_said(simulated, car, write_log, write_vehicle, tmp_path):
    fill(tmp_path, simulated[:2], write_log)
    write_vehicle(tmp_path, car)
    frame = simulated[2].frame
    write_log(frame.assign(beta_ref=np.nan, vx_ref=np.nan, vy_ref=np.nan), tmp_path / "blind.csv")
    write_log(frame.drop(columns=["beta_ref", "vx_ref", "vy_ref"]), tmp_path / "bare.csv")
    slow = frame.assign(beta_ref=frame["beta_ref"].where(frame["vx"] <= 3.0), vx_ref=np.nan, vy_ref=np.nan)
    write_log(slow, tmp_path / "slow.csv")
    found, notes = read_recordings(tmp_path)
    assert [r.name for r in found] == [log.name for log in simulated[:2]]
    assert [note.split(":")[0] for note in notes] == ["bare.csv", "blind.csv", "slow.csv"]
    assert all("no ground truth" in note for note in notes)


def test_only_logs_are_read(simulated, car, write_log, write_vehicle, tmp_path):
    """Hidden files and what crosscomb itself writes are no logs; a name in capitals is one."""
    write_vehicle(tmp_path, car)
    write_log(simulated[0].frame, tmp_path / "RUN.CSV")
    write_log(simulated[1].frame, tmp_path / "packed.csv.gz")
    for name in ("._RUN.csv", "RUN.estimate.csv", "confusion_matrix.csv", "notes.txt"):
        (tmp_path / name).write_bytes(b"\x00\x05")
    found, _ = read_recordings(tmp_path)
    assert [r.name for r in found] == ["RUN", "packed"]


def test_a_broken_log_is_named_before_anything_is_run(
    simulated, car, write_log, write_vehicle, tmp_path, monkeypatch
):
    fill(tmp_path, simulated, write_log)
    write_vehicle(tmp_path, car)
    spoilt = simulated[0].frame.copy()
    spoilt.loc[7, "t"] = np.nan
    write_log(spoilt, tmp_path / "zz_last.csv")

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("nothing may be run")

    monkeypatch.setattr(train_module, "fill_shelf", forbidden)
    monkeypatch.setattr("crosscomb.training.selectors.bank.run_filters", forbidden)
    with pytest.raises(UsageError) as caught:
        read_recordings(tmp_path)
    for word in ("zz_last.csv", "row 9", "column t"):
        assert word in str(caught.value)


@pytest.mark.parametrize("name", ["none", "empty"])
def test_a_folder_without_logs_is_refused(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError) as caught:
        read_recordings(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


def test_fewer_than_seven_recordings_are_refused(recordings, data_set):
    require_enough(recordings[:7], data_set)
    with pytest.raises(UsageError) as caught:
        require_enough(recordings[:6], data_set)
    for word in (str(data_set), "6 recordings", "at least 7", "crosscomb simulate"):
        assert word in str(caught.value)


def test_seven_recordings_are_enough(recordings):
    trained = train(recordings[:7], "paper")
    assert len(trained.folds.table) == 5
    assert [len(trained.validation.table), len(trained.test.table)] == [1, 1]
    assert recordings_module.LEAST_RECORDINGS == 7


# The bar


def unseen_logs(car: Vehicle) -> list[Recording]:
    """Logs that no training has seen."""
    logs = [
        simulate_log(
            car, job.manoeuvre, (271_828, job.number), surface=job.surface, duration=20.0, name=job.name
        )
        for job in plan_jobs(car, 24)
    ]
    return [Recording(log.name, Path(log.name), car, log) for log in logs]


def test_the_shipped_switch_is_better_than_the_best_single_filter_on_unseen_logs(car):
    """Which filter is the best is known only afterwards; the switch must beat even that one."""
    artefact = load_artefact()
    unseen = unseen_logs(car)
    banks = run_bank(unseen, artefact.filters, artefact.rate, artefact.window)
    evaluation = evaluate(banks, artefact)
    rmse = evaluation.overall["rmse"]
    print(rmse.round(3).to_dict())
    assert rmse[ORACLE] < rmse[SWITCH] < rmse[evaluation.best_single] < rmse[ZERO]
    assert (evaluation.table[SWITCH, "switches_per_minute"] > 0.0).any()


def test_the_shipped_hybrid_is_far_better_than_any_filter_on_unseen_logs(car):
    """It corrects what no filter has right, and its doubt holds, rather wide: filters that differ are doubted."""
    artefact = load_artefact("hybrid")
    banks = run_bank(unseen_logs(car), artefact.filters, artefact.rate, artefact.window)
    evaluation = evaluate(banks, artefact)
    rmse = evaluation.overall["rmse"]
    print(rmse.round(3).to_dict())
    assert rmse[SWITCH] < 0.6 * rmse[evaluation.best_single]
    assert 0.92 < evaluation.table[SWITCH, "coverage"].mean() < 0.995
