"""A sample of the campaign with malformed input (`tools/campaigns/fuzz.yaml`, `docs/results/fuzz.md`)."""

from pathlib import Path

import pytest

from dart_flight.lab.campaign.campaign_spec import cases_of, load_specification
from tests.shared_campaigns import campaign_rows

SPECIFICATION = Path(__file__).parents[2] / "tools" / "campaigns" / "fuzz.yaml"


@pytest.mark.rest
def test_malformed_input_is_rejected_or_accepted_without_a_failure(tmp_path: Path) -> None:
    rows = {row["kind"]: row for row in campaign_rows(tmp_path / "out", "fuzz", "--runs", "1")}
    assert list(rows) == [case["kind"] for case in cases_of(load_specification(SPECIFICATION))]
    for kind, row in rows.items():
        assert not [f for f in row["failures"] if " took " not in f]
        assert row["taken"] > 0 or kind == "configuration"
        assert row["refused"] > 0 or kind in ("frame", "log")
