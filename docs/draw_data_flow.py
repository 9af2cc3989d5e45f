"""Draw docs/images/data_flow.svg from the folders and the imports of the code.

    python docs/draw_data_flow.py

Where a box stands is laid down here; what is in it and every thin arrow are read from the code. tests/test_data_flow.py
draws it anew and compares.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import escape

PROJECT = Path(__file__).resolve().parents[1]
PICTURE = PROJECT / "docs" / "images" / "data_flow.svg"
FOLDERS = {
    "crosscomb": "crosscomb", "filters": "crosscomb.filters", "models": "crosscomb.models",
    "training": "crosscomb.training",
}  # fmt: skip
LEFT_OUT = {"__main__", "checked", "errors", "files"}
"""Rooms that nearly all others import, or that only start another: their arrows would say nothing."""

PARTS_OF_SELECTION = {"windows": "windows", "features": "windows", "seen": "windows", "switch": "switch"}
"""Modules of `selection` that are stations of their own; the others are the selector."""

WIDTH, HEIGHT = 1400, 806
FIRST, STEP, BOX = 90, 178, 146  # of the stations: left edge, distance, width
ROW, ROW_HEIGHT = 232, 262


def column(number: int, span: int = 1) -> tuple[int, int]:
    """Left edge and width of stations `number` to `number + span - 1`."""
    return FIRST + STEP * number, BOX + STEP * (span - 1)


@dataclass(frozen=True)
class Box:
    """A room in the picture."""

    title: str
    says: str
    x: int
    width: int
    y: int
    height: int
    colour: str
    wide: bool = False  # its parts stand in a line, not one below the other

    @property
    def centre(self) -> float:
        return self.x + 0.5 * self.width


def station(number: int, title: str, says: str) -> Box:
    """A box in the row of stations."""
    return Box(title, says, *column(number), ROW, ROW_HEIGHT, "#e3eefa")


BOXES = {
    "logs": station(0, "logs", "read, check, mend"),
    "signals": station(1, "signals", "SI units, ISO signs"),
    "filters": station(2, "filters", "each gives a beta"),
    "windows": station(3, "windows", "the last samples"),
    "selector": station(4, "selector", "picks or weighs"),
    "switch": station(5, "switch", "follows, no bumps"),
    "report": station(6, "report", "files and pictures"),
    "cli": Box("cli", "the commands", *column(0, 7), 22, 62, "#eeeeee", wide=True),
    "run": Box("run", "carries samples through the stations, a log at once or live",
               FIRST, column(5)[1] + STEP * 5 + 28, 116, 62, "#eeeeee", wide=True),
    "models": Box("models", "equations of car and tyre",
                  *column(0, 3), ROW + ROW_HEIGHT + 58, 108, "#fdf3d8", wide=True),
    "sklearn_api": Box("sklearn_api", "for notebooks",
                       *column(4, 2), ROW + ROW_HEIGHT + 74, 62, "#e6f4e6", wide=True),
    "training": Box("training", "beside the stations: makes the artefact that holds the selector",
                    *column(0, 7), ROW + ROW_HEIGHT + 186, 62, "#e6f4e6", wide=True),
}  # fmt: skip

DATA = ("logs", "signals", "filters", "windows", "selector", "switch", "report")
"""The way of the data, from station to station."""


def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name."""
    found = {}
    for folder, package in FOLDERS.items():
        for path in sorted((PROJECT / folder).rglob("*.py")):
            parts = path.relative_to(PROJECT / folder).with_suffix("").parts
            found[".".join([package, *(part for part in parts if part != "__init__")])] = path
    return found


def room_of(module: str) -> str:
    """Box that a module stands in."""
    parts = module.split(".")
    if parts[1] == "selection":
        return PARTS_OF_SELECTION.get(parts[-1], "selector")
    return "signals" if parts[1] == "stamps" else parts[1]


def imported(path: Path, known: dict[str, Path]) -> Iterator[str]:
    """Modules of the package that a file imports, also inside its functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in known else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def uses() -> dict[str, set[str]]:
    """Rooms that each room imports."""
    known = modules()
    found: dict[str, set[str]] = {name: set() for name in BOXES}
    for module, path in known.items():
        if "." not in module or room_of(module) in LEFT_OUT:
            continue
        for other in imported(path, known):
            if other in known and "." in other:
                found[room_of(module)].add(room_of(other))
    return {room: others - LEFT_OUT - {room} for room, others in found.items()}


def needed(found: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Pairs of a room and one that imports it, without those that a chain of others implies."""

    def reached(room: str) -> set[str]:
        return found[room].union(*(reached(other) for other in found[room]))

    return sorted(
        (used, user)
        for user, direct in found.items()
        for used in direct
        if not any(used in reached(other) for other in direct - {used})
    )


def parts(room: str) -> list[str]:
    """What is in a box: its sub-folders and modules; a room of one module names that."""
    inside = [module.split(".")[1:] for module in modules() if "." in module and room_of(module) == room]
    deeper = [names[1] for names in inside if len(names) > 1]
    return list(dict.fromkeys(deeper)) or [room]


def text(x: float, y: float, words: str, style: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" class="{style}">{escape(words)}</text>'


def draw_box(room: str, box: Box) -> Iterator[str]:
    """A box with its title and its parts."""
    yield (
        f'<rect x="{box.x}" y="{box.y}" width="{box.width}" height="{box.height}" rx="7" fill="{box.colour}"/>'
    )
    yield text(box.x + 12, box.y + 23, box.title, "title")
    if not box.wide:
        yield text(box.x + 12, box.y + 41, box.says, "says")
        for k, name in enumerate(parts(room)):
            yield text(box.x + 12, box.y + 65 + 17 * k, name, "part")
        return
    yield text(box.x + 24 + 11.3 * len(box.title), box.y + 23, box.says, "says")
    line, lines = "", []
    for name in parts(room):
        if line and 7.0 * len(f"{line} · {name}") > box.width - 24:
            lines.append(line)
            line = ""
        line = f"{line} · {name}" if line else name
    for k, words in enumerate([*lines, line]):
        yield text(box.x + 12, box.y + 45 + 17 * k, words, "part")


def way(used: str, user: str) -> list[tuple[float, float]]:
    """Corners of the arrow from a room to one that imports it."""
    a, b = BOXES[used], BOXES[user]
    below_row = ROW + ROW_HEIGHT
    if {used, user} == {"run", "training"}:  # through the gap before the report
        x = BOXES["report"].x - 26.0
        return [(x, a.y + a.height if a.y < b.y else a.y), (x, b.y if a.y < b.y else b.y + b.height)]
    if a.y == b.y:
        y = a.y + 0.86 * a.height
        if abs(a.x - b.x) <= STEP:
            return [(a.x + a.width, y), (b.x, y)] if a.x < b.x else [(a.x, y), (b.x + b.width, y)]
        side = 18.0 if a.x < b.x else -18.0  # below the boxes between
        return [
            (a.centre + 2 * side, below_row), (a.centre + 2 * side, below_row + 28),
            (b.centre, below_row + 28), (b.centre, below_row),
        ]  # fmt: skip
    narrow = a if a.width < b.width else b
    x = min(max(narrow.centre, max(a.x, b.x) + 10), min(a.x + a.width, b.x + b.width) - 10)
    return [(x, a.y + a.height), (x, b.y)] if a.y < b.y else [(x, a.y), (x, b.y + b.height)]


def draw() -> str:
    """The picture as the text of an SVG file."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">',
        "<style>text{font-family:Helvetica,Arial,'DejaVu Sans',sans-serif;fill:#222}"
        ".title{font-size:17px;font-weight:bold}.says{font-size:12px;font-style:italic;fill:#555}"
        ".part{font-size:12.5px}.note{font-size:13px;fill:#444}"
        "rect{stroke:#7a8794;stroke-width:1}.uses{fill:none;stroke:#31404f;stroke-width:1.6}"
        ".frame{fill:none;stroke-dasharray:5 4}.data{stroke:#2f7fd0;stroke-width:9;stroke-opacity:.55}</style>",
        '<defs><marker id="thin" markerWidth="9" markerHeight="9" refX="8" refY="4.5" orient="auto">'
        '<path d="M0,0.5 L9,4.5 L0,8.5 z" fill="#31404f"/></marker>'
        '<marker id="wide" markerUnits="userSpaceOnUse" markerWidth="16" markerHeight="24" refX="2" refY="12" '
        'orient="auto"><path d="M0,0 L15,12 L0,24 z" fill="#2f7fd0"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff" style="stroke:none"/>',
    ]
    x, width = column(3, 3)
    lines.append(
        f'<rect x="{x - 11}" y="{ROW - 28}" width="{width + 22}" height="{ROW_HEIGHT + 38}" rx="9" class="frame"/>'
    )
    lines.append(text(x, ROW - 11, "selection", "says"))
    for room, box in BOXES.items():
        lines += draw_box(room, box)
    for used, user in needed(uses()):
        corners = " L".join(f"{x:g},{y:g}" for x, y in way(used, user))
        lines.append(f'<path d="M{corners}" class="uses" marker-end="url(#thin)"/>')
    y = ROW + 140.0
    ends = [(BOXES[first].x + BOX, BOXES[second].x) for first, second in pairwise(DATA)]
    last = BOXES[DATA[-1]].x + BOX
    for begin, end in [(FIRST - 50, FIRST), *ends, (last, last + 50)]:
        lines.append(
            f'<line x1="{begin + 2}" y1="{y:g}" x2="{end - 16}" y2="{y:g}" class="data" marker-end="url(#wide)"/>'
        )
    lines += [text(FIRST - 62, y - 18, "log.csv", "note"), text(last + 8, y - 18, "beta", "note")]
    below = HEIGHT - 22
    lines.append(
        f'<line x1="{FIRST}" y1="{below - 5}" x2="{FIRST + 34}" y2="{below - 5}" class="data" '
        'marker-end="url(#wide)"/>'
    )
    lines.append(text(FIRST + 60, below, "the way of the data", "note"))
    lines.append(
        f'<path d="M{FIRST + 240},{below - 5} L{FIRST + 290},{below - 5}" class="uses" marker-end="url(#thin)"/>'
    )
    lines.append(
        text(
            FIRST + 300, below,
            "from a room to one that imports it, less what a chain of arrows says; "
            f"left out: {', '.join(sorted(LEFT_OUT))}, which nearly all import", "note",
        )
    )  # fmt: skip
    return "\n".join([*lines, "</svg>"]) + "\n"


if __name__ == "__main__":
    PICTURE.write_text(draw(), encoding="utf-8")
