"""A trained tree for people: as indented text and as a picture, in physical units."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crosscomb.selection.artefact import Artefact
from crosscomb.selection.features import layout

MOST_DEPTH = 4
"""Levels that a picture shows; the text has all of them."""


def feature_names(artefact: Artefact) -> list[str]:
    """What the tree of an artefact looks at, with units."""
    return list(layout(artefact.filter_names).names) if artefact.tree_sees_all else artefact.window.names


def tree_text(artefact: Artefact) -> str:
    """The tree as indented text: one line per question and per leaf.

    Parameters
    ----------
    artefact : Artefact
    """
    tree, names = artefact.tree, feature_names(artefact)
    lines: list[str] = []

    def walk(node: int, depth: int) -> None:
        indent = "    " * depth
        if tree.left[node] < 0:
            lines.append(f"{indent}{_leaf(artefact, node)}")
            return
        asked, unit = _split(names[tree.feature[node]])
        lines.append(f"{indent}{asked} <= {tree.threshold[node]:.4g} {unit}:")
        walk(tree.left[node], depth + 1)
        lines.append(f"{indent}else:")
        walk(tree.right[node], depth + 1)

    walk(0, 0)
    return "\n".join(lines) + "\n"


def tree_figure(artefact: Artefact) -> Figure:
    """Draw the upper levels of the tree; yes goes left.

    Parameters
    ----------
    artefact : Artefact
    """
    tree = artefact.tree
    places: dict[int, tuple[float, int]] = {}

    def place(node: int, depth: int, left: float) -> float:
        """Place a node over its leaves; give the x where the next leaf goes."""
        if tree.left[node] < 0 or depth == MOST_DEPTH:
            places[node] = (left + 0.5, depth)
            return left + 1.0
        middle = place(tree.left[node], depth + 1, left)
        right = place(tree.right[node], depth + 1, middle)
        places[node] = (0.5 * (places[tree.left[node]][0] + places[tree.right[node]][0]), depth)
        return right

    width = place(0, 0, 0.0)
    deepest = max(depth for _, depth in places.values())
    figure = Figure(figsize=(max(7.0, 1.75 * width), 1.5 * (deepest + 1) + 0.6), layout="constrained")
    axis = figure.subplots()
    for node, (x, depth) in places.items():
        for child, word in ((tree.left[node], "yes"), (tree.right[node], "no")):
            if child in places and child > 0:
                axis.plot([x, places[child][0]], [-depth, -places[child][1]], color="0.6", lw=1, zorder=0)
                axis.text(
                    0.5 * (x + places[child][0]), -depth - 0.5, word, fontsize=7, color="0.4", ha="center",
                    backgroundcolor="white",
                )  # fmt: skip
        _box(axis, artefact, node, x, depth)
    axis.set_axis_off()
    axis.set_title(
        "Which filter is taken; " + ("all levels" if deepest < MOST_DEPTH else f"upper {MOST_DEPTH} levels")
    )
    return figure


def _box(axis: Axes, artefact: Artefact, node: int, x: float, depth: int) -> None:
    tree = artefact.tree
    if tree.left[node] < 0 or depth == MOST_DEPTH:
        text, colour = _leaf(artefact, node).replace(" (", "\n("), "#d7ecd9"
        if tree.left[node] >= 0:
            text += "\n…"
    else:
        asked, unit = _split(feature_names(artefact)[tree.feature[node]])
        text, colour = (
            f"{asked.replace('(', chr(10) + '(', 1)}\n<= {tree.threshold[node]:.3g} {unit}?",
            "#dbe7f5",
        )
    axis.text(
        x, -depth, text, ha="center", va="center", fontsize=7.5,
        bbox={"boxstyle": "round", "facecolor": colour, "edgecolor": "0.5"},
    )  # fmt: skip


def _leaf(artefact: Artefact, node: int) -> str:
    pick = artefact.tree.picks[node]
    share = 100 * artefact.tree.shares[node][pick]
    return f"-> {artefact.filter_names[pick]} ({share:.0f} % of the weight)"


def _split(name: str) -> tuple[str, str]:
    """Name and unit of a feature."""
    asked, _, unit = name.rpartition(" [")
    return (asked, unit.rstrip("]")) if asked else (name, "")
