"""Golden replay: ten stored drives give the stored answers on any machine and numpy.

After a change that is meant to alter answers: `python tests/golden/make.py`, and look at what it changed.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from crosscomb.models.vehicle import load_vehicle
from crosscomb.run.estimate import estimate_log
from crosscomb.selection.artefact import SHIPPED, load_artefact
from crosscomb.signals import UNITS, Signals

GOLDEN = sorted((Path(__file__).parent / "golden").glob("*.csv"))
SAME = 1e-9
"""Largest difference [rad]; particle filters draw and choose, and may differ by more where a last bit does."""


def test_there_are_ten() -> None:
    assert len(GOLDEN) == 10


@pytest.mark.parametrize("artefact", SHIPPED)
@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_golden_logs_give_golden_answers(path: Path, artefact: str) -> None:
    golden = pd.read_csv(path, dtype=str).astype(float)  # exact with every pandas
    inputs = [name for name in golden if name in UNITS]
    estimate = estimate_log(
        Signals("golden", golden[inputs]), load_vehicle("generic_compact"), load_artefact(artefact)
    )
    found = {artefact: estimate.beta, f"{artefact}:std": estimate.beta_std}
    found |= {
        f"{artefact}:{name}": beta for name, beta in estimate.filters.items() if not name.endswith("_pf")
    }
    for name, values in found.items():
        np.testing.assert_allclose(values, golden[name], rtol=0.0, atol=SAME, err_msg=name)
