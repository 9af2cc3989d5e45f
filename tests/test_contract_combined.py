"""What every estimator must do, asked of those in `crosscomb.filters.combined`."""

import pytest

from estimator_cases import contract


@pytest.mark.parametrize(("make", "check"), list(contract("combined")))
def test_contract(make, check):
    check(make)
