"""What every estimator must do, asked of those in `crosscomb.filters.planar`."""

import pytest

from estimator_cases import contract


@pytest.mark.parametrize(("make", "check"), list(contract("planar")))
def test_contract(make, check):
    check(make)
