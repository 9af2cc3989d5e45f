"""The campaign of faults for the terminal, and kept in docs/reliability.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from crosscomb.report import terminal
from crosscomb.report.markdown import markdown_table, write_section
from crosscomb.training.suites.fault_criteria import CRITERIA
from crosscomb.training.suites.fault_results import Campaign, Figures, Outcome
from crosscomb.training.suites.faults import CHANNELS, WHEELS

TITLE = (
    "# Reliability\n\nWhat faults do to the answer, and whether the status tells of them. "
    "Nothing in the sections below is typed by hand.\n"
)
WORDS = (
    "Share of the runs that pass, and how many were judged. A run is one fault from the middle of one log on, beside "
    "the same log without it. It fails where an answer is not finite, where rows before the fault change, where the "
    "log is refused, or where the criterion of its kind (`training/suites/fault_criteria.py`) does not hold. A log "
    "that does not hold what a criterion asks about is not judged. Neither is a wheel speed that no answer needs."
)
SHARES_HEADER = ("fault", "simulated", "real")
FIGURES_HEADER = (
    "", "logs or runs", "seconds over 3 deg while ok", "of seconds", "share", "truth inside 1.96 beta_std",
    "false alarms in 10 min",
)  # fmt: skip


def share_cell(outcomes: Sequence[Outcome]) -> str:
    """Share of runs that pass, of those that are judged."""
    judged = [outcome for outcome in outcomes if outcome.judged]
    if not judged:
        return ""
    return f"{sum(outcome.passed for outcome in judged) / len(judged):.2f} ({len(judged)})"


def share_rows(campaign: Campaign) -> list[list[str]]:
    """Rows of `SHARES_HEADER`, one per kind of fault, and over all."""
    rows = []
    for kind in ("all faults", *CRITERIA):
        members = [outcome for outcome in campaign.outcomes if kind in ("all faults", outcome.kind)]
        if members:
            apart = [[each for each in members if each.simulated is simulated] for simulated in (True, False)]
            rows.append([kind, *map(share_cell, apart)])
    return rows


def rule_of(kind: str) -> str:
    """What a kind of fault must hold, in the words of its criterion."""
    rule = CRITERIA.get(kind)
    return (rule.__doc__ or "").splitlines()[0].rstrip(".") if rule else ""


def channel_table(campaign: Campaign) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the shares by kind and channel, simulated and real together."""
    channels = (*CHANNELS, *WHEELS)
    rows = []
    for kind in CRITERIA:
        members = [outcome for outcome in campaign.outcomes if outcome.kind == kind]
        if any(outcome.channel in channels for outcome in members):
            apart = [[each for each in members if each.channel == channel] for channel in channels]
            rows.append([kind, *map(share_cell, apart)])
    return ["fault", *channels], rows


def figure_rows(campaign: Campaign) -> list[list[str]]:
    """Rows of `FIGURES_HEADER`: with faults and without, simulated and real apart, and drifts."""
    parts: dict[str, list[Figures]] = {}
    for simulated, word in ((True, "simulated"), (False, "real")):
        parts[f"{word}, with faults"] = [
            each.figures for each in campaign.outcomes if each.simulated is simulated
        ]
        parts[f"{word}, without"] = [
            figures for name, figures in campaign.sound.items() if (name in campaign.simulated) is simulated
        ]
    parts |= {f"drift {name}": [figures] for name, figures in campaign.drifts.items()}
    return [
        [text, *_figure_cells(figures, "with faults" in text)] for text, figures in parts.items() if figures
    ]


def _figure_cells(parts: Sequence[Figures], with_faults: bool) -> list[str]:
    total = sum(parts, Figures())
    share = total.wrong / total.seconds if total.seconds else 0.0
    return [
        str(len(parts)), f"{total.wrong:.1f}", f"{total.seconds:.0f}", f"{share:.2%}",
        f"{total.inside / max(total.rows, 1):.3f}",
        "" if with_faults else f"{600.0 * total.alarms / max(total.length, 1e-9):.2f}",
    ]  # fmt: skip


def worst_lines(campaign: Campaign, most: int) -> list[str]:
    """The failed runs that say ok for the longest while they are wrong, and why they failed."""
    failed = [each for each in campaign.outcomes if each.judged and not each.passed]
    failed.sort(key=lambda each: -each.figures.wrong)
    return [
        f"{each.log}: {each.kind}{f' on {each.channel}' if each.channel else ''}: {each.failure} "
        f"({each.figures.wrong:.1f} s over 3 deg while ok)"
        for each in failed[:most]
    ]


def show_campaign(campaign: Campaign, worst: int = 0) -> None:
    """Print the tables of a campaign and its worst runs."""
    for note in campaign.notes:
        terminal.warn(note)
    terminal.show("Share of runs that pass (runs judged)", SHARES_HEADER, share_rows(campaign))
    terminal.show("By channel, simulated and real", *channel_table(campaign))
    terminal.show("Honesty", FIGURES_HEADER, figure_rows(campaign))
    for line in worst_lines(campaign, worst):
        terminal.say(line)


def write_campaign(path: Path, campaign: Campaign, name: str, command: str) -> None:
    """Keep the tables of a campaign in a Markdown file, in a section of the selector's name."""
    lines = [
        f"## {name}",
        f"Made by `{command}`.",
        WORDS,
        markdown_table(
            [*SHARES_HEADER, "passes where"], [[*row, rule_of(row[0])] for row in share_rows(campaign)]
        ),
        "By channel, simulated and real together:",
        markdown_table(*channel_table(campaign)),
        "Over rows with ground truth above 3 m/s, with faults from the onset on; false alarms are onsets of degraded, "
        "invalid or extrapolating where no channel of the log lacks a sample, over all rows:",
        markdown_table(FIGURES_HEADER, figure_rows(campaign)),
        *(f"- {note}" for note in campaign.notes),
    ]
    write_section(path, name, "\n\n".join(lines), TITLE)
