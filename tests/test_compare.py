"""The comparison of selectors: nothing judged has been seen, and what leaks is shown as leaking."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from crosscomb.report.tree_view import tree_figure, tree_text
from crosscomb.run.estimate import estimate_log
from crosscomb.run.stream import StreamingEstimator
from crosscomb.selection.answer import select, start_selection
from crosscomb.selection.artefact import Artefact, load_artefact, save_artefact
from crosscomb.training.recordings import Recording
from crosscomb.training.selectors import compare as compare_module
from crosscomb.training.selectors import fit, fit_boosted, fit_correction
from crosscomb.training.selectors.bank import BankRun, run_bank, with_windows
from crosscomb.training.selectors.compare import (
    Comparison,
    bootstrap_ratio,
    compare,
    comparison_steps,
    driving_of,
    leave_one_out,
)
from crosscomb.training.selectors.evaluate import BANDS, evaluate
from crosscomb.training.selectors.fit import SELECTORS, STATISTICS
from crosscomb.training.selectors.fit_tree import keep_what_is_sure
from crosscomb.training.selectors.shelf import fill_shelf
from crosscomb.training.selectors.train import default_filters


@pytest.fixture(scope="module")
def small_trees():
    """Few boosting rounds and steps: the rules are tested here, not the accuracy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_boosted, "ITERATIONS", 8)
        patch.setattr(fit, "FULL", fit_correction.Size(2, (16, 8), 40, 8))
        patch.setattr(fit, "FEW", fit_correction.Size(1, (16, 8), 40))
        patch.setattr(fit_correction, "DOUBT", fit_correction.Size(1, (8, 4), 40))
        yield


@pytest.fixture(scope="module")
def two_cars(recordings: list[Recording], tmp_path_factory) -> list[Recording]:
    """The simulated logs as those of two cars, on two surfaces that a card beside them names."""
    folder = tmp_path_factory.mktemp("cars")
    logs = [
        {"log": one.name, "manoeuvre": ("turn", "slide")[i % 2], "surface": ("dry", "snow")[i // 2 % 2]}
        for i, one in enumerate(recordings)
    ]
    (folder / "dataset.json").write_text(json.dumps({"logs": logs}))
    return [
        replace(
            one,
            path=folder / one.path.name,
            vehicle=one.vehicle.model_copy(update={"name": ("first", "second")[i % 2]}),
        )
        for i, one in enumerate(recordings)
    ]


@pytest.fixture(scope="module")
def compared(two_cars, small_trees) -> tuple[Comparison, int]:
    """All selectors on the simulated logs, and how often progress was told."""
    ticks: list[int] = []
    return compare(two_cars, folds=2, seed=1, progress=lambda: ticks.append(1)), len(ticks)


def test_every_selector_is_judged_in_every_way(two_cars, compared):
    comparison, ticks = compared
    schemes = {"2 folds", "leave one vehicle out", "leave one surface out"}
    assert set(comparison.summary.index) == {(one, scheme) for one in SELECTORS for scheme in schemes}
    assert ticks == comparison_steps(two_cars, 2, 1)
    summary = comparison.summary
    assert np.isfinite(summary.to_numpy()).all()
    assert (summary["ratio low"] <= summary["ratio"] + 1e-9).all()
    assert (summary["ratio"] <= summary["ratio high"] + 1e-9).all()
    assert (summary["regret [deg]"] >= 0.0).all()
    assert summary["accuracy"].between(0.0, 1.0).all()
    assert {"imm", "mmae", "dynamic_ekf"} <= set(comparison.references.index)


def test_driving_and_ranges_of_beta_are_told_apart(compared):
    comparison, _ = compared
    assert set(comparison.by_manoeuvre.index) == {"turn", "slide"}
    assert len(comparison.by_band) == len(BANDS) - 1
    for table in (comparison.by_manoeuvre, comparison.by_band):
        assert {"zero", "oracle", *SELECTORS} <= set(table.columns)
    # beta = 0 errs by beta itself.
    zero = comparison.by_band["zero"].to_numpy()
    for low, high, rmse in zip(BANDS[:-1], BANDS[1:], zero, strict=True):
        assert low <= rmse <= high


def test_the_comparison_is_plain_json(compared):
    content = json.loads(compared[0].to_json())
    assert set(content) == {"summary", "references", "by_manoeuvre", "by_band", "leakage"}


def test_one_is_left_out_at_a_time():
    pairs = leave_one_out(["a", "b", "a", "c"])
    assert pairs == [([1, 3], [0, 2]), ([0, 2, 3], [1]), ([0, 1, 2], [3])]
    assert leave_one_out(["a", "a"]) == []
    assert leave_one_out(["a", ""]) == []  # a log whose surface nobody knows


def test_a_log_without_a_card_has_no_driving(recordings):
    assert driving_of(recordings[0]) == ("", "")


def test_random_folds_flatter(two_cars, compared):
    leakage = compared[0].leakage
    assert list(leakage.index) == ["windows at random (leaks)", "by recording"]
    assert leakage["RMSE [deg]"].iloc[0] < leakage["RMSE [deg]"].iloc[1]


def test_the_interval_holds_the_ratio_of_other_draws():
    rng = np.random.default_rng(0)
    columns = pd.MultiIndex.from_product([["zero", "one", "two", "switch", "oracle"], ["rmse", "max"]])
    scale = np.repeat([3.0, 1.0, 2.0, 0.8, 0.5], 2)
    table = pd.DataFrame(scale * rng.uniform(0.5, 1.5, (40, 10)), columns=columns)
    judged = compare_module.Evaluation(table, np.eye(2, dtype=int), 0.0, np.ones((4, 6)))
    low, high = bootstrap_ratio(judged, 0)
    assert low < judged.ratio < high
    assert 0.65 < low < 0.8 < high < 0.95
    assert bootstrap_ratio(judged, 0) == (low, high)


# Fits


@pytest.fixture(scope="module")
def banks(recordings) -> list[BankRun]:
    """The default filters on the simulated logs."""
    return run_bank(recordings, default_filters(recordings[0].vehicle), 100.0, STATISTICS)


@pytest.fixture(scope="module")
def artefacts(recordings, small_trees, car, tmp_path_factory) -> dict[str, Artefact]:
    """One of each selector."""
    entries, folder = default_filters(car), tmp_path_factory.mktemp("shelf")
    kept = fill_shelf(recordings, entries, 100.0, compare_module.KINDS, folder)
    fitters = compare_module.fitters_of(kept, entries, 100.0, None, 0)
    return {fitter.selector: fitter.fit(range(len(kept)))[0] for fitter in fitters}


@pytest.mark.parametrize("name", list(SELECTORS))
def test_every_selector_comes_back_from_its_file_and_estimates_the_same(
    artefacts, name, tmp_path, simulated, car
):
    save_artefact(artefacts[name], tmp_path / "a.json")
    again = load_artefact(tmp_path / "a.json")
    assert again == artefacts[name]
    one, other = (estimate_log(simulated[3], car, artefact) for artefact in (artefacts[name], again))
    pd.testing.assert_frame_equal(one.table(), other.table(), check_exact=True)
    assert np.isfinite(one.beta).all()
    assert (one.beta_std > 0.0).all()


@pytest.mark.parametrize("name", list(SELECTORS))
@pytest.mark.parametrize("size", [1, 13])
def test_every_selector_works_in_pieces(artefacts, banks, name, size):
    bank = with_windows(banks[2], artefacts[name].window)
    (run,) = bank.runs
    whole = select(start_selection(artefacts[name]), run)
    selection, parts = start_selection(artefacts[name]), []
    for start in range(0, len(run.beta), size):
        cut = slice(start, start + size)
        piece = replace(
            run,
            inputs=replace(run.inputs, samples=run.inputs.samples[cut]),
            beta=run.beta[cut],
            beta_std=run.beta_std[cut],
            nis=run.nis[cut],
            innovations=[innovations[cut] for innovations in run.innovations],
            windows=run.windows[cut],
        )
        parts.append(select(selection, piece))
    for one, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        np.testing.assert_array_equal(one, np.concatenate(pieces))


@pytest.mark.parametrize("name", list(SELECTORS))
def test_every_selector_works_live(artefacts, simulated, car, name):
    log = replace(simulated[3], frame=simulated[3].frame.iloc[:400])
    live = StreamingEstimator(car, artefacts[name])
    betas = [live.step(sample).beta for sample in log.frame.to_dict("records")]
    np.testing.assert_array_equal(betas, estimate_log(log, car, artefacts[name]).beta)


@pytest.mark.parametrize("name", ["tree", "hybrid"])
def test_a_mirrored_drive_gets_the_mirrored_answer(artefacts, simulated, car, name):
    """Left and right are alike to the car, so they must be to what was learned."""
    artefact = artefacts[name]
    frame = simulated[4].frame
    odd = ["ay", "yaw_rate", "steer", "steer_wheel", "beta_ref", "vy_ref"]
    swapped = {"vfl": "vfr", "vfr": "vfl", "vrl": "vrr", "vrr": "vrl"}
    mirrored = frame.assign(**{key: -frame[key] for key in odd if key in frame}).rename(columns=swapped)
    names = ["kinematic_kf", "dynamic_ekf"]
    log = replace(simulated[4], frame=mirrored[list(frame.columns)])
    plain, other = (estimate_log(one, car, artefact) for one in (simulated[4], log))
    for filter_name in names:
        np.testing.assert_allclose(other.filters[filter_name], -plain.filters[filter_name], atol=1e-9)
    # The particle filter draws other numbers; what is left of that is its noise.
    assert np.sqrt(np.mean((other.beta + plain.beta) ** 2)) < np.radians(0.3)


def test_doubt_covers_what_it_was_calibrated_for(artefacts, banks):
    """On the logs of the fit; on new ones it is reported, as 95 % of them cannot be promised with ten logs."""
    for name in ("tree", "boosted", "soft", "hybrid"):
        seen = [with_windows(bank, artefacts[name].window) for bank in banks]
        covered = evaluate(seen, artefacts[name]).table["switch", "coverage"].mean()
        assert 0.85 < covered <= 1.0


def test_a_leaf_needs_several_recordings_to_leave_the_safe_filter(banks, artefacts):
    tree = artefacts["tree"].tree
    windows = banks[0].windows(STATISTICS)
    n = len(windows.rmse)
    rmse = np.tile([0.1, 0.2, 0.3], (n, 1))  # filter 0 is better than the safe filter 1 everywhere
    windows = replace(windows, rmse=rmse)
    leaves = np.full(n, int(np.flatnonzero(np.array(tree.left) < 0)[0]))
    owner = np.arange(n) % 5
    assert keep_what_is_sure(tree, leaves, windows, owner, 1).picks[leaves[0]] == 0
    assert keep_what_is_sure(tree, leaves, windows, np.zeros(n, dtype=int), 1).picks[leaves[0]] == 1
    # Better in one recording of five only: not beyond doubt.
    rmse[owner != 2] = [0.21, 0.2, 0.3]
    assert keep_what_is_sure(tree, leaves, windows, owner, 1).picks[leaves[0]] == 1


# The tree to read


@pytest.mark.parametrize("name", ["tree", "tree_all", "paper"])
def test_the_tree_can_be_read(artefacts, name):
    artefact = artefacts[name]
    text = tree_text(artefact)
    inner, leaves = np.array(artefact.tree.left) >= 0, np.array(artefact.tree.left) < 0
    assert text.count("<=") == text.count("else:") == inner.sum()
    assert sum(text.count(f"-> {one}") for one in artefact.filter_names) == leaves.sum()
    assert inner.sum() == 0 or any(unit in text for unit in ("m/s^2", "rad/s", "rad"))
    assert tree_figure(artefact).axes
