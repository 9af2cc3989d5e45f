"""What every estimator must do, asked of those in `crosscomb.filters.random_walk`."""

import pytest

from estimator_cases import contract


@pytest.mark.parametrize(("make", "check"), list(contract("random_walk")))
def test_contract(make, check):
    check(make)
