"""Some of the inputs of benchmarks/fuzz.py: whatever is read is refused in one line or gives finite answers."""

import pytest
from hypothesis import seed

from fuzz import TARGETS, Tally, test_of

INPUTS = 2_000
test_of.__test__ = False  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", TARGETS)
def test_no_input_gives_a_traceback(name: str) -> None:
    tally = Tally(TARGETS[name])
    count = INPUTS * TARGETS[name].share // sum(target.share for target in TARGETS.values())
    seed(14)(test_of(TARGETS[name], tally.take, count))()
    assert not tally.faults, "\n".join(tally.faults.values())
    assert tally.total() >= count
    assert (tally.counts["accepted"] and tally.counts["refused"]) or name == "signals"
