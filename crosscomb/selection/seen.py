"""What filters and windows say of a stretch of a drive: what selectors choose by and what training learns from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from crosscomb.filters.base import Inputs
from crosscomb.models.vehicle import Vehicle
from crosscomb.signals import COLUMN, truth_of


@dataclass(frozen=True)
class Seen:
    """Grid points of one drive, any number of them, and what was made of them.

    Attributes
    ----------
    vehicle : Vehicle
        The car that the filters ran for.
    points : (n, columns)
        The signals at the working rate, as of `crosscomb.signals.Signals.rows`.
    inputs : Inputs
        The same as filters take them.
    beta, beta_std, nis : (n, filters) [rad], [rad], [-]
    innovations : list of (n, m)
        Of each filter, see `KernelFilter.innovations`.
    extras : list of (n, e)
        Of each filter, all that it tells beside beta (`KernelFilter.extras`); an empty list where nobody asked.
    windows : (n, f) float32
        Features of the window that ends at each point, see `crosscomb.selection.windows`.
    """

    vehicle: Vehicle
    points: np.ndarray
    inputs: Inputs
    beta: np.ndarray
    beta_std: np.ndarray
    nis: np.ndarray
    innovations: list[np.ndarray]
    extras: list[np.ndarray]
    windows: np.ndarray

    def only(self, members: Sequence[int]) -> Seen:
        """Keep some of the filters, in the order given."""
        chosen = list(members)
        if chosen == list(range(self.beta.shape[1])):
            return self
        return replace(
            self,
            beta=self.beta[:, chosen],
            beta_std=self.beta_std[:, chosen],
            nis=self.nis[:, chosen],
            innovations=[self.innovations[member] for member in chosen],
            extras=[self.extras[member] for member in chosen] if self.extras else [],
        )

    def column(self, name: str) -> np.ndarray:
        """A signal at the grid points ``(n,)`` in its SI unit."""
        return self.points[:, COLUMN[name]]

    @property
    def beta_ref(self) -> np.ndarray:
        """Ground-truth sideslip angle ``(n,) [rad]``, see `crosscomb.signals.Signals`."""
        return truth_of(self.column)
