"""Benchmark of the forwarding of motion-capture poses: its cost in latency and in processor time.

The app of `tools.bench.latency` flies without a motion capture, then with the frames of an emulated OptiTrack
server, which it forwards at `mocap.rate_hz`. The figures are in docs/results/pose_forwarding.md.

    python -m tools.bench.poses [IMPACTS]
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any

from tools.bench.latency import measure, percentile

IMPACTS = 200  # this number of impacts takes a minute for each rate
RATES_HZ = (100, 240)


def rows(impacts: int = IMPACTS) -> list[dict[str, Any]]:
    """Return rows for the benchmark table; the baseline is the same app without a motion capture.

    Raises:
        RuntimeError: no impact was answered.
    """
    alone = _figures(impacts, None)
    found = [_row(name, value, None) for name, value in alone.items()]
    for rate_hz in RATES_HZ:
        command = [sys.executable, "-m", "tools.bench.pose_source", str(rate_hz)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as source:
            assert source.stdout is not None
            try:
                figures = _figures(impacts, source.stdout.readline().strip())
            finally:
                source.kill()
        found += [_row(f"{name}, poses {rate_hz} Hz", v, alone[name]) for name, v in figures.items()]
    return found


def _figures(impacts: int, mocap_url: str | None) -> dict[str, float]:
    result = measure(impacts, mocap_url)
    if not result.wire_ms:
        raise RuntimeError(
            f"none of {impacts} impacts was answered; the guard reported: {result.overruled[:3]}"
        )
    print(
        f"{mocap_url or 'no motion capture'}: {len(result.wire_ms)} of {impacts} impacts answered, "
        f"{result.poses_sent} poses forwarded; the guard took over {len(result.overruled)} times: "
        + "; ".join(sorted(set(result.overruled))),
        file=sys.stderr,
    )
    return {
        "bridge latency p50": percentile(result.wire_ms, 0.5),
        "bridge latency p99": percentile(result.wire_ms, 0.99),
        "bridge app share of a core": result.cpu_percent,
    }


def _row(name: str, value: float, baseline: float | None) -> dict[str, Any]:
    unit, ratio = "%" if "share" in name else "ms", None if baseline is None else baseline / value
    return {"name": name, "value": value, "unit": unit, "baseline": baseline, "ratio": ratio}


if __name__ == "__main__":
    for row in rows(int(sys.argv[1]) if len(sys.argv) > 1 else IMPACTS):
        print(row)
