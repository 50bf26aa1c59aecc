"""Export of a flight log in standard schemas, as an MCAP file for Foxglove, Lichtblick and Rerun."""

from __future__ import annotations

from pathlib import Path

from dart_flight.config.document import report_write_errors
from dart_flight.config.packages import missing_package
from dart_flight.recording.about import flown_mission
from dart_flight.recording.reader import Log

_DESCRIPTION = "flight"
_KEPT = ("mission", "world", "seed", "software", "host", "started_utc")


def export_foxglove(log: Log, path: Path) -> int:
    """Write the file and return its number of messages; times are the autopilot's, as in the log."""
    mission = flown_mission(log.about, log.source)
    try:
        import foxglove  # noqa: PLC0415  (an extra)

        from dart_flight.lab.scene.channels import Channels  # noqa: PLC0415
        from dart_flight.lab.scene.downsampling import Downsampler  # noqa: PLC0415
        from dart_flight.lab.scene.translation import SceneTranslator  # noqa: PLC0415
    except ImportError:
        raise missing_package("--foxglove needs foxglove-sdk", "live") from None
    channels, thinning, translation = Channels(), Downsampler(), SceneTranslator(mission)
    with report_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        written = foxglove.open_mcap(path, allow_overwrite=True, context=channels.context)
    count = 0
    with written as file:
        file.write_metadata(_DESCRIPTION, {key: log.about[key] for key in _KEPT if key in log.about})
        for entry in log.entries:
            for record in thinning.select(entry.record):
                for message in translation.translate(record):
                    channels.publish(message)
                    count += 1
    return count
