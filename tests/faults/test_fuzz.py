"""A sample of the campaign of malformed input (`tools/campaigns/fuzz.py`, `docs/results/fuzz.md`)."""

import pytest

from tools.campaigns.fuzz import KINDS, feed

COUNTS = {"mission": 150, "scenario": 50, "configuration": 20, "log": 15, "frame": 1500}


@pytest.mark.parametrize("kind", KINDS)
def test_malformed_input_is_refused_or_understood(kind: str) -> None:
    tally = feed(kind, 0, COUNTS[kind])
    assert not [f for f in tally.failures if " took " not in f]
    assert tally.refused + tally.taken == COUNTS[kind]
    assert tally.taken > 0 or kind == "configuration"
    assert tally.refused > 0 or kind in ("frame", "log")
