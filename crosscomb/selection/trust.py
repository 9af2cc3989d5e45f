"""How far to trust an answer: its standard deviation, calibrated."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from crosscomb.checked import Record


class Trust(Record):
    """How doubt is calibrated, so that beta +- 1.96 beta_std holds the truth in 95 % of the samples.

    Attributes
    ----------
    disagreement : float
        Share of the spread of the filters' beta that counts as standard deviation.
    floor : float
        Least standard deviation before scaling [rad].
    scale : float
        Found on recordings left out of the fit.
    """

    disagreement: float = Field(default=0.0, ge=0.0)
    floor: float = Field(default=0.0, ge=0.0)
    scale: float = Field(default=1.0, gt=0.0)

    def widen(self, beta_std: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Calibrated standard deviation ``(n,) [rad]`` of an answer with what the filters say ``(n, filters)``."""
        spread = np.nan_to_num(beta.max(axis=1) - beta.min(axis=1))
        return self.scale * np.sqrt(beta_std**2 + (self.disagreement * spread) ** 2 + self.floor**2)
