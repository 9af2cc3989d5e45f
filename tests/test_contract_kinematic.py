"""What every estimator must do, asked of those in `crosscomb.filters.kinematic`."""

import pytest

from estimator_cases import contract


@pytest.mark.parametrize(("make", "check"), list(contract("kinematic")))
def test_contract(make, check):
    check(make)
