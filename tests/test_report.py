"""What people read: pages, pictures, tables."""

import csv
import io
import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from crosscomb.report import terminal
from crosscomb.report.markdown import TITLE, markdown_table, row_shares, score_rows, write_section
from crosscomb.report.page import training_page
from crosscomb.report.pictures import confusion_figure, estimate_figure, save_figure
from crosscomb.report.training import beside_artefact, confusion_table, metrics_json, write_training
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.artefact import load_artefact
from crosscomb.signals import make_signals
from crosscomb.training.selectors.train import Training, train

NAMES = ["kinematic_kf", "dynamic_ekf", "random_walk_pf"]
COUNTS = np.array([[6, 2, 0], [1, 0, 3], [0, 0, 0]])


@pytest.fixture(scope="module")
def trained(recordings) -> Training:
    return train(recordings, "paper")


def pixels(picture: bytes) -> tuple[int, int]:
    assert picture[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(picture[16:20]), int.from_bytes(picture[20:24])


def test_shares_are_of_the_row_and_empty_rows_have_none():
    np.testing.assert_allclose(row_shares(COUNTS), [[0.75, 0.25, 0.0], [0.25, 0.0, 0.75], [0.0, 0.0, 0.0]])


def test_the_confusion_table_holds_counts_and_row_shares():
    table = confusion_table(COUNTS, NAMES)
    assert list(table) == [f"selected_{name}" for name in NAMES] + [f"share_{name}" for name in NAMES]
    rows = list(csv.reader(io.StringIO(table.to_csv())))
    assert rows[0][0] == "best"
    assert rows[1][:4] == ["kinematic_kf", "6", "2", "0"]
    assert [float(cell) for cell in rows[2][4:]] == [0.25, 0.0, 0.75]


def test_the_confusion_picture_shows_counts_and_shares():
    axis = confusion_figure(COUNTS, NAMES).axes[0]
    texts = [text.get_text() for text in axis.texts]
    assert texts == [
        "6\n75 %",
        "2\n25 %",
        "0\n0 %",
        "1\n25 %",
        "0\n0 %",
        "3\n75 %",
        "0\n0 %",
        "0\n0 %",
        "0\n0 %",
    ]
    assert [label.get_text() for label in axis.get_yticklabels()] == NAMES


def test_a_training_is_written_whole(trained, tmp_path):
    artefact = tmp_path / "mine.json"
    paths = write_training(trained, artefact, ["x.csv: skipped"])
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [
            "report.html",
            "confusion_matrix.csv",
            "confusion_matrix.png",
            "metrics.json",
            "tree.txt",
            "tree.png",
        ]
    )
    assert paths == beside_artefact(artefact)
    table = pd.read_csv(tmp_path / "confusion_matrix.csv", index_col="best")
    np.testing.assert_array_equal(table.iloc[:, :3], trained.folds.confusion)
    assert min(pixels((tmp_path / "confusion_matrix.png").read_bytes())) > 300
    again = tmp_path / "again"
    write_training(trained, again / "mine.json", ["x.csv: skipped"])
    for path in paths:
        assert path.read_bytes() == (again / path.name).read_bytes()


def test_metrics_are_those_of_the_evaluations(trained):
    content = json.loads(metrics_json(trained), parse_constant=pytest.fail)
    assert list(content["parts"]) == ["folds", "validation", "test"]
    for part, evaluation in trained.evaluations.items():
        found = content["parts"][part]
        assert found["recordings"] == list(evaluation.table.index)
        assert found["confusion"] == evaluation.confusion.tolist()
        for name in ("zero", *NAMES, "switch", "oracle"):
            assert found["overall_deg"][name]["rmse"] == pytest.approx(evaluation.rmse[name].mean(), abs=1e-5)
            for recording in evaluation.table.index:
                for measure in ("rmse", "max"):
                    expected = evaluation.table.at[recording, (name, measure)]
                    assert found["per_recording_deg"][recording][f"{name}_{measure}"] == pytest.approx(
                        expected, abs=1e-5
                    )


def test_the_page_stands_alone_and_says_every_error(trained):
    page = training_page(trained, "mine.json", ["a <b>.csv: skipped"])
    assert re.findall(r"(?:src|href)=\"(?!data:)", page) == []
    assert "http" not in page
    assert "a &lt;b&gt;.csv: skipped" in page
    for evaluation in trained.evaluations.values():
        for recording in evaluation.table.index:
            rmse, largest = (
                evaluation.rmse.at[recording, "switch"],
                evaluation.largest.at[recording, "switch"],
            )
            row = re.search(rf"<tr><th>{recording}</th>(.*?)</tr>", page)
            assert row is not None
            assert f"{rmse:.2f} / {largest:.1f}<" in row[1]
    assert page.count("<table>") == 6


def test_a_name_cannot_break_the_page(trained):
    evil = "<script>alert(1)</script>"
    renamed = replace(trained.folds, table=trained.folds.table.rename(index=lambda name: evil + name))
    assert evil not in training_page(replace(trained, folds=renamed), evil, [evil])


def lines_of(figure: Figure) -> dict[str, np.ndarray]:
    return {str(line.get_label()): np.asarray(line.get_ydata()) for line in figure.axes[0].lines}


def test_the_picture_shows_beta_every_filter_and_the_reference(simulated, car, tmp_path):
    estimate = estimate_log(simulated[2], car, load_artefact())
    lines = lines_of(estimate_figure(estimate, "log"))
    np.testing.assert_allclose(lines["crosscomb"], np.degrees(estimate.beta))
    for name in NAMES:
        np.testing.assert_allclose(lines[name], np.degrees(estimate.filters[name]))
    moving = simulated[2].column("vx") > 3.0
    np.testing.assert_allclose(lines["reference"][moving], np.degrees(simulated[2].beta_ref[moving]))
    save_figure(estimate_figure(estimate, "log"), tmp_path / "a.png")
    save_figure(estimate_figure(estimate, "log"), tmp_path / "b.png")
    assert pixels((tmp_path / "a.png").read_bytes())[0] > 800
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("change", [{"vx": 0.0}, {"ay": np.nan}, {"vx": np.nan}], ids=str)
def test_any_log_can_be_drawn_without_a_reference(simulated, car, tmp_path, change):
    frame = simulated[2].frame.drop(columns=["beta_ref", "vx_ref", "vy_ref"])
    frame = frame.assign(
        **{name: np.where(frame["t"] > 0.5, value, frame[name]) for name, value in change.items()}
    )
    estimate = estimate_log(make_signals(frame, "log"), car, load_artefact())
    figure = estimate_figure(estimate, "log")
    assert "reference" not in lines_of(figure)
    save_figure(estimate_figure(estimate, "log"), tmp_path / "a.png")


def test_a_section_is_kept_in_its_place(tmp_path):
    path = tmp_path / "results.md"
    write_section(path, "real", "first")
    assert path.read_text().startswith(TITLE)
    write_section(path, "simulated", "second")
    write_section(path, "real", "third")
    text = path.read_text()
    assert "first" not in text
    assert text.index("third") < text.index("second")
    before = text
    write_section(path, "real", "third")
    assert path.read_text() == before


def test_score_rows_and_their_summary():
    rmse = pd.DataFrame({"zero": [1.0, 3.0], "switch": [0.5, 0.7]}, index=["a", "b"])
    largest = pd.DataFrame({"zero": [2.0, 9.0], "switch": [4.0, 1.0]}, index=["a", "b"])
    rows = score_rows(rmse, largest, {"both": ["a", "b"], "one": ["b"]})
    assert rows == [
        ["a", "1.00 / 2.0", "0.50 / 4.0"],
        ["b", "3.00 / 9.0", "0.70 / 1.0"],
        ["both", "2.00 / 9.0", "0.60 / 4.0"],
        ["one", "3.00 / 9.0", "0.70 / 1.0"],
    ]
    text = markdown_table(["recording", "zero", "switch"], rows)
    assert text.splitlines()[1] == "|---|---:|---:|"
    assert len({line.count("|") for line in text.splitlines()}) == 1


def test_the_terminal_shows_brackets_as_they_are(capsys):
    terminal.show("Title [x]", ["RMSE [deg]", "[b]n[/b]"], [["run[1]", "[red]"]])
    terminal.say("log[2]: [i]done")
    terminal.warn("log[3]")
    out, err = capsys.readouterr()
    for word in ("Title [x]", "RMSE [deg]", "[b]n[/b]", "run[1]", "[red]", "log[2]: [i]done"):
        assert word in out
    assert err == "warning: log[3]\n"


def test_a_bar_that_nobody_sees_writes_nothing(capsys):
    with terminal.progress("working", 3) as advance:
        for _ in range(3):
            advance()
    assert capsys.readouterr() == ("", "")


def test_a_terminal_shows_the_worst_of_many_recordings(capsys):
    rmse = pd.DataFrame(
        {"zero": 1.0, "switch": np.linspace(0.1, 2.0, 90)}, index=[f"log_{i:02}" for i in range(90)]
    )
    terminal.show_scores("folds: 90 recordings", rmse, 3.0 * rmse)
    said = capsys.readouterr().out
    shown = [f"log_{i:02}" in said for i in range(90)]
    assert shown == [False] * 50 + [True] * 40
    assert said.index("log_89") < said.index("log_50")
    assert "1.05 / 6.0" in said  # of all of them
