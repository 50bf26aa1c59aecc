"""The one table through which the flight part reaches the lab (docs/architecture.md).

Nothing that flies imports `dart_flight.lab`. What a command line or a script asks of it is named here and
imported when it is asked for, so that a flight loads none of it and runs where none of it would import.
"""

from __future__ import annotations

import importlib
from typing import Any, Final

# Commands of the lab: each a module with `configure` and `run`, as those in `cli/`.
COMMANDS: Final = {
    "campaign": "dart_flight.lab.commands.campaign_command",
    "plan": "dart_flight.lab.commands.plan_command",
    "report": "dart_flight.lab.commands.report_command",
    "export": "dart_flight.lab.commands.export_command",
    "predict": "dart_flight.lab.commands.predict_command",
    "calibrate": "dart_flight.lab.commands.calibrate_command",
    "inspect": "dart_flight.lab.commands.inspect_command",
    "identify": "dart_flight.lab.commands.identify_command",
    "tables": "dart_flight.lab.commands.tables_command",
}
# What commands of the flight part offer beside a flight.
LIVE_VIEW: Final = "dart_flight.lab.scene.live:open_live_view"  # --live
MISSION_PICTURE: Final = "dart_flight.lab.report.figures.mission_figure:write_mission_picture"  # --plot
ROOM_PICTURE: Final = "dart_flight.lab.report.figures.room_figure:write_room_picture"  # `survey --plot`
PX4_FIGURES: Final = "dart_flight.lab.inspect.px4_log:read_px4_log"  # `dry-run --px4`
SCRIPT_NAMES: Final = "dart_flight.lab.api"  # `dart_flight.simulate` and the others of `dart_flight.__all__`


def load_entry(entry: str) -> Any:
    """What an entry of this table names: a module, or with `module:name` something in it.

    Raises:
        ImportError: a package that only the lab needs is missing.
    """
    module, _, name = entry.partition(":")
    loaded = importlib.import_module(module)
    return getattr(loaded, name) if name else loaded
