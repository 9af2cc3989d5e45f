"""What every estimator must do, asked of those in `crosscomb.filters.learned`."""

import pytest

from estimator_cases import contract


@pytest.mark.parametrize(("make", "check"), list(contract("learned")))
def test_contract(make, check):
    check(make)
