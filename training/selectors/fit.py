"""Fit a selector on the windows of some recordings: its shape and its trust come from folds inside them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from crosscomb.models.vehicle import Vehicle
from crosscomb.selection.answer import select, start_selection
from crosscomb.selection.artefact import Artefact, FilterSettings
from crosscomb.selection.choice import Choice
from crosscomb.selection.correction import Correction
from crosscomb.selection.features import layout
from crosscomb.selection.switch import SwitchSettings
from crosscomb.selection.tree import Tree
from crosscomb.selection.trust import Trust
from crosscomb.selection.windows import WindowSettings
from crosscomb.training.folds import grouped_folds
from crosscomb.training.metrics import rms
from crosscomb.training.selectors.bank import BankRun
from crosscomb.training.selectors.fit_boosted import fit_choice, fit_temperature
from crosscomb.training.selectors.fit_correction import (
    FEW,
    FULL,
    Size,
    fit_correction,
    fit_doubt,
    left_over,
    recording_weights,
)
from crosscomb.training.selectors.fit_tree import (
    TreeShape,
    cut,
    fit_tree,
    keep_what_is_sure,
    to_tree,
    without_idle_questions,
)
from crosscomb.training.selectors.fit_trust import fit_trust
from crosscomb.training.selectors.labels import Windows, concatenate

GROWN = TreeShape(8, 0.005)
"""A tree is grown so far once, and cut to each depth that is tried."""

DEPTHS = (4, 6, 8)

ANY = TreeShape(6, 0.005)
"""Where boosted trees choose, the tree only knows the range of its features."""


@dataclass(frozen=True)
class SelectorKind:
    """A way to train a selector.

    Attributes
    ----------
    summary : str
    window : WindowSettings
    by_regret : bool
        Weigh every choice in a window by the error it saves, instead of one plain label per window.
    shape : TreeShape
        How far a tree grows.
    depths : tuple of int
        Depths that it may be cut to, chosen by inner folds; without any it stays as it grew.
    all_signals : bool
        The tree looks at all features instead of the windows.
    choice : {"", "hard", "soft"}
        Boosted trees on all features that switch, or blend by probability.
    corrected : bool
        A learned correction on top; nothing then looks at what filters say of themselves.
    """

    summary: str
    window: WindowSettings
    by_regret: bool = True
    shape: TreeShape = GROWN
    depths: tuple[int, ...] = ()
    all_signals: bool = False
    choice: str = ""
    corrected: bool = False

    @property
    def needs_all(self) -> bool:
        """Whether it takes more than the windows of ay and yaw rate."""
        return self.all_signals or bool(self.choice) or self.corrected


STATISTICS = WindowSettings(features="statistics", history=40)

SELECTORS: dict[str, SelectorKind] = {
    "tree": SelectorKind(
        "decision tree on statistics of ay and yaw-rate windows, trained for the cost of a wrong choice", STATISTICS,
        depths=DEPTHS,
    ),
    "paper": SelectorKind(
        "decision tree on the raw ay and yaw-rate windows with plain labels, as in Atheupe 2023",
        WindowSettings(features="raw"),
        by_regret=False,
        shape=TreeShape(8, 0.01, 0.0),
    ),
    "tree_all": SelectorKind(
        "the same tree on all signals, innovations and the filters' disagreement", STATISTICS,
        depths=DEPTHS, all_signals=True,
    ),
    "boosted": SelectorKind(
        "boosted trees on all signals that foretell the error of each filter", STATISTICS, shape=ANY, choice="hard"
    ),
    "soft": SelectorKind(
        "the same, blending the filters by calibrated probabilities", STATISTICS, shape=ANY, choice="soft"
    ),
    "hybrid": SelectorKind(
        "learned correction of the best filter, fading to a blend outside the training data", STATISTICS,
        shape=ANY, choice="soft", corrected=True,
    ),
}  # fmt: skip

MOST_BALANCE = 8.0
"""A real recording counts at most so many times as much as a simulated one."""

INNER_FOLDS = 3
"""Folds inside the recordings of one fit, for the shape of the tree and for the trust."""

THINNING = 10
"""Every so many samples count in the calibration: neighbours say the same."""


Fitted = TypeVar("Fitted")


@dataclass(frozen=True)
class Fitter:
    """What all fits of one training share.

    Attributes
    ----------
    selector : str
        Key of `SELECTORS`.
    rate : float [Hz]
    filters : list of FilterSettings
    vehicle : Vehicle or None
    seed : int
    banks : sequence of BankRun
    windows : sequence of Windows
        Of each recording.
    rmse : sequence of (w, filters) [rad]
        Of the windows of each recording.
    simulated : sequence of bool
        Whether each recording is.
    known : dict
        Trees that were fitted, by what they were fitted on: selectors that share it fit them once.
    """

    selector: str
    rate: float
    filters: list[FilterSettings]
    vehicle: Vehicle | None
    seed: int
    banks: Sequence[BankRun]
    windows: Sequence[Windows]
    rmse: Sequence[np.ndarray]
    simulated: Sequence[bool]
    known: dict[tuple[Hashable, ...], Any] = field(default_factory=dict)

    @property
    def kind(self) -> SelectorKind:
        """How the selector is trained."""
        return SELECTORS[self.selector]

    @property
    def names(self) -> list[str]:
        """Names of the filters."""
        return [entry.name for entry in self.filters]

    def together(self, members: Sequence[int]) -> Windows:
        """Windows of some recordings."""
        return concatenate([self.windows[i] for i in members])

    def owner(self, members: Sequence[int]) -> np.ndarray:
        """Place in `members` of the recording of each of their windows ``(w,)``."""
        return np.repeat(np.arange(len(members)), [len(self.rmse[i]) for i in members])

    def balance(self, members: Sequence[int]) -> np.ndarray:
        """Weight of each recording ``(members,)``: simulated and real ones count the same in all."""
        counts = np.array([len(self.rmse[i]) for i in members], float)
        simulated = np.array([self.simulated[i] for i in members])
        weight = np.ones(len(counts))
        if 0 < simulated.sum() < len(counts):
            share = counts[simulated].sum() / counts[~simulated].sum()
            weight[~simulated] = min(max(share, 1.0 / MOST_BALANCE), MOST_BALANCE)
        return weight

    def safe(self, members: Sequence[int]) -> int:
        """Filter with the lowest median RMSE: nearly right in most driving, whatever it does in slides."""
        rmse = [np.sqrt(np.mean(self.rmse[i] ** 2, axis=0)) for i in members]
        return int(np.argmin(np.median(rmse, axis=0)))

    def fit(self, members: Sequence[int]) -> tuple[Artefact, TreeShape]:
        """Fit on some recordings: the shape of the tree and the trust are found on folds inside them."""
        inner = grouped_folds(list(members), INNER_FOLDS, self.seed)
        depths = self.kind.depths or (self.kind.shape.depth,)
        candidates = [[(test, self._plain(fit, depth)) for fit, test in inner] for depth in depths]
        best = int(np.argmin([self._rmse(fitted) for fitted in candidates]))
        left_out, shape = candidates[best], replace(self.kind.shape, depth=depths[best])
        artefact = self._plain(members, depths[best])
        if self.kind.choice:
            parts = [self._choice(fit) for fit, _ in inner]
            update = {"temperature": fit_temperature(parts, [self.together(test) for _, test in inner])}
            left_out = [
                (test, one.model_copy(update={"choice": part.model_copy(update=update)}))
                for (test, one), part in zip(left_out, parts, strict=True)
            ]
            choice = self._choice(members).model_copy(update=update)
            artefact = artefact.model_copy(update={"choice": choice})
        artefact = artefact.model_copy(update={"trust": self._trust(left_out)})
        if self.kind.corrected:
            choices = [one.choice for _, one in left_out if one.choice is not None]
            correction = self._correction(members, inner, choices)
            artefact = artefact.model_copy(update={"correction": correction})
        return artefact, shape

    def _plain(self, members: Sequence[int], depth: int) -> Artefact:
        """Artefact with a tree of this depth only, its doubt not calibrated."""
        kind, safe = self.kind, self.safe(members)
        what = (kind.window.features, kind.by_regret, kind.all_signals, kind.shape, *members)
        grown = self._once(("tree", *what), lambda: self._grown(members, safe))
        tree = self._once((depth, *what), lambda: self._sure(cut(grown, depth), members, safe))
        # The safe choice of the paper is the particle filter; ours is measured.
        paper = self.selector == "paper" and "random_walk_pf" in self.names
        return Artefact(
            selector_name=self.selector,
            rate=self.rate,
            window=kind.window,
            filters=self.filters,
            fallback="random_walk_pf" if paper else self.names[safe],
            switch=SwitchSettings(),
            tree=tree,
            tree_sees_all=kind.all_signals,
            vehicle=self.vehicle,
        )

    def _once(self, what: tuple[Hashable, ...], fit: Callable[[], Fitted]) -> Fitted:
        """Fit something unless that is known."""
        if what not in self.known:
            self.known[what] = fit()
        return self.known[what]  # type: ignore[no-any-return]

    def _grown(self, members: Sequence[int], safe: int) -> Tree:
        """Tree as far as it grows."""
        windows = self.together(members)
        features = self._asked(windows)
        weight = self._weight(members, safe)
        fitted = fit_tree(features, windows, self.kind.by_regret, self.kind.shape, self.seed, weight)
        return to_tree(fitted, features, len(self.filters))

    def _sure(self, tree: Tree, members: Sequence[int], safe: int) -> Tree:
        """The tree departs from the safe filter only where that surely pays."""
        if not self.kind.by_regret:
            return tree
        windows = self.together(members)
        leaves = tree.leaves(self._asked(windows))
        return without_idle_questions(keep_what_is_sure(tree, leaves, windows, self.owner(members), safe))

    def _asked(self, windows: Windows) -> np.ndarray:
        """Features ``(w, f) float32`` that the tree asks for."""
        return windows.everything if self.kind.all_signals else windows.features

    def _rmse(self, left_out: Sequence[tuple[list[int], Artefact]]) -> float:
        """Mean RMSE [rad] of the picked filters over the windows of recordings that their tree was not fitted on."""
        each = []
        for members, artefact in left_out:
            for windows in (self.windows[i] for i in members):
                picked = artefact.tree.predict(self._asked(windows))
                each.append(rms(windows.rmse[np.arange(len(picked)), picked]))
        return float(np.mean(each))

    def _choice(self, members: Sequence[int]) -> Choice:
        seen = layout(self.names).plain if self.kind.corrected else None
        trees = self._once(
            ("choice", self.kind.corrected, *members),
            lambda: fit_choice(self.together(members), self.names, self.seed, seen),
        )
        return Choice(trees=trees, soft=self.kind.choice == "soft")

    def _trust(self, left_out: Sequence[tuple[list[int], Artefact]]) -> Trust:
        """Calibrate beta_std on recordings that their artefact was not fitted on (split conformal)."""
        parts = []
        for members, artefact in left_out:
            plain = artefact.model_copy(update={"trust": Trust()})
            for bank in (self.banks[i] for i in members):
                answers = [select(start_selection(plain), run) for run in bank.runs]
                every = np.flatnonzero(bank.counted)[::THINNING]
                error = np.concatenate([answer.beta for answer in answers])[every] - bank.beta_ref[every]
                beta_std = np.concatenate([answer.beta_std for answer in answers])[every]
                parts.append((error, beta_std, bank.joined(lambda run: run.beta)[every]))
        error, beta_std, beta = (np.concatenate(column) for column in zip(*parts, strict=True))
        return fit_trust(error, beta_std, beta)

    def _weight(self, members: Sequence[int], anchor: int) -> np.ndarray:
        """Weight of each window of some recordings ``(w,)``, by what a filter leaves of them."""
        owner = self.owner(members)
        rmse = np.concatenate([self.rmse[i][:, anchor] for i in members])
        return recording_weights(rmse, owner) * self.balance(members)[owner]

    def _correction(
        self,
        members: Sequence[int],
        inner: Sequence[tuple[list[int], list[int]]],
        choices: Sequence[Choice],
    ) -> Correction:
        """Fit the correction on all members and its doubt on what parts of them left out."""
        anchor = self.safe(members)

        def fit_on(some: Sequence[int], size: Size) -> Correction:
            weight = self._weight(some, anchor)
            return fit_correction(self.together(some), weight, self.names, anchor, self.seed, size)

        parts = [
            left_over(fit_on(fit, FEW), choice, self.together(test), self._weight(test, anchor), self.names)
            for (fit, test), choice in zip(inner, choices, strict=True)
        ]
        doubt, trust = fit_doubt(parts, self.names, anchor, self.seed)
        return fit_on(members, FULL).model_copy(update={"doubt": doubt, "trust": trust})
