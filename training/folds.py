"""Split recordings, never windows: into the paper's three parts, and into folds inside the training part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sklearn.model_selection import GroupKFold


@dataclass(frozen=True)
class Parts:
    """Indices of the recordings in each part (Atheupe 2023, section 6.4: 75, 15 and 10 %)."""

    training: list[int]
    validation: list[int]
    test: list[int]


def split_recordings(n: int, seed: int) -> Parts:
    """Split n recordings 75/15/10 at random; validation and test get at least one each."""
    order = np.random.default_rng(seed).permutation(n)
    n_validation, n_test = max(1, round(0.15 * n)), max(1, round(0.10 * n))
    n_training = n - n_validation - n_test
    return Parts(
        training=sorted(order[:n_training].tolist()),
        validation=sorted(order[n_training : n_training + n_validation].tolist()),
        test=sorted(order[n_training + n_validation :].tolist()),
    )


def grouped_folds(training: list[int], folds: int, seed: int) -> list[tuple[list[int], list[int]]]:
    """Folds by recording: pairs of (recordings to fit on, recordings to test on)."""
    folds = min(folds, len(training))
    recordings = np.array(training)
    splitter = GroupKFold(n_splits=folds, shuffle=True, random_state=seed)
    return [
        (recordings[fit].tolist(), recordings[test].tolist())
        for fit, test in splitter.split(recordings, groups=recordings)
    ]
