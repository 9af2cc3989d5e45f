"""What every estimator must do, asked of those in `crosscomb.filters.single_track`."""

import pytest

from estimator_cases import contract


@pytest.mark.parametrize(("make", "check"), list(contract("single_track")))
def test_contract(make, check):
    check(make)
