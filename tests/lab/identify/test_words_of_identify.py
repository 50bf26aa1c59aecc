"""Intervals, unknowns and plausibility limits in the output of `identify` and `predict`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dart_flight.cli import main
from dart_flight.config.document import InputError
from dart_flight.lab.identify import speed_ratios
from dart_flight.lab.identify.trial_readers import read_trials
from dart_flight.lab.identify.trials import TrialReading
from tests.doubles.ulog_file import write_ulog


@pytest.mark.parametrize("shares", [[-0.041], [-0.041, -0.036, -0.05], [0.02, 0.01], [1.2, 0.97], [0.5]])
def test_the_interval_of_a_ratio_contains_its_value(shares: list[float]) -> None:
    for least, most in ((0.0, 1.0), (-np.inf, np.inf)):
        found = speed_ratios._ratio(np.array(shares), np.full(len(shares), 0.01), least, most)
        assert found is not None
        assert least <= found.low <= found.value <= found.high <= most


def test_a_prediction_from_ratios_reports_forces_and_times_as_unknown(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["predict", "--restitution", "0.5", "--velocity", "-1", "0.5"]) == 0
    out = capsys.readouterr().out
    assert "nan" not in out
    assert out.count("unknown") == 7


def test_large_distances_are_accepted_in_a_flight_log_but_not_in_a_table(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    time = np.arange(0.0, 4.0, 0.01)
    normal = 87.0 - 87.0 * np.minimum(time, 2.0) / 2.0 - 0.0 * time
    rows = "".join(f"{t:.3f},{x:.4f}\n" for t, x in zip(time, normal, strict=True))
    table = tmp_path / "trial.csv"
    table.write_text("time_s,normal_m\n" + rows)
    with pytest.raises(InputError, match="reach 87 m and seem to be in millimetres"):
        read_trials(table, TrialReading())
    samples = [(1e6 * (1.0 + t), [x, 0.0, -1.0, 0.0, 0.0, 0.0]) for t, x in zip(time, normal, strict=True)]
    fields = "float x;float y;float z;float vx;float vy;float vz;"
    log = write_ulog(tmp_path / "a.ulg", {("vehicle_local_position", 0): (fields, samples)})
    (trial,) = read_trials(log, TrialReading(wall=(0.0, 0.0, 0.0)))
    assert trial.normal.value.max() == pytest.approx(87.0, abs=0.1)
