"""A series of drops on the ground, from recordings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dart_flight.base.records import Mode
from dart_flight.cli import main
from dart_flight.config.vehicle import load_vehicle
from tests.command_fixtures import Refuse, folder, refusal_of  # noqa: F401
from tests.doubles.synthetic_trials import drop_trial, write_csv

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.usefixtures("folder")


def new_drops(*options: str) -> int:
    return main(["series", "new", "drops", "--drop", "0.05..0.4", "--ground", "concrete", *options])


def test_recorded_drops_give_coefficients(capsys: pytest.CaptureFixture[str]) -> None:
    """The ground's k is 1.2 times the configured k."""
    assert new_drops("--modes", "flexible", "--held-out", "0") == 0
    assert main(["series", "next", "drops"]) == 0
    assert "flexible: drop from these heights, m: 0.05, " in capsys.readouterr().err
    truth = load_vehicle().materials["concrete"].coefficients(Mode.FLEXIBLE).scaled(1.2, 1.0, 1.0)
    rng = np.random.default_rng(1)
    for i, height in enumerate((0.1, 0.2, 0.3), start=1):
        write_csv(drop_trial(truth, height, rng), Path(f"drop_{i}.csv"))
        assert main(["series", "add", "drops", f"drop_{i}.csv", "--height", str(height)]) == 0
        capsys.readouterr()
        assert main(["series", "status", "drops", "--json"]) == 0
        mode = json.loads(capsys.readouterr().out)["modes"]["flexible"]
        # The scatter between drops is not known from one or two, however narrow their own intervals are.
        assert mode["coefficients"]["k"]["more_hits"] >= 3 - i
    value, low, high = mode["coefficients"]["k"]["statistical"]
    assert mode["used"] == 3
    assert value == pytest.approx(truth.k, rel=0.03)
    assert mode["coefficients"]["k"]["whole"] == [value, low, high]
    assert mode["coefficients"]["mu"]["prior_share"] == 1.0
    Path("mine.yaml").write_text((ROOT / "configs/dart.yaml").read_text("utf-8"), "utf-8")
    assert main(["series", "apply", "drops", "--config", "mine.yaml"]) == 0
    source = load_vehicle("mine.yaml").materials["concrete"].source
    assert source.endswith("3 hits flexible (dart-flight series); mu, nu not measured")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--drop", "0.1..0.4"], "a series of drops has --ground"),
        (["--drop", "0.1..0.4", "--ground", "moss"], "moss"),
        (["--drop", "0.4..0.1", "--ground", "concrete"], "expected low < high"),
        ([], "give --mission and --wall, or --drop and --ground"),
    ],
)
def test_an_impossible_series_of_drops_is_refused(
    words: list[str],
    message: str,
    refusal_of: Refuse,  # noqa: F811
) -> None:
    assert message in refusal_of("series", "new", "drops", *words)


def test_drops_are_not_flown(refusal_of: Refuse) -> None:  # noqa: F811
    assert new_drops() == 0
    assert "drops are not flown" in refusal_of("series", "fly", "drops", "--fast")
