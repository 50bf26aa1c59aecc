"""Table of the lab's entry points. The flight part uses the lab only through this table.

No module that flies imports `dart_flight.lab` (docs/architecture.md). Commands and scripts load an entry by
its name when they need it. A flight therefore loads nothing of the lab, and runs without the lab's packages.
"""

from __future__ import annotations

import importlib
from typing import Any, Final

# Commands of the lab; each is a module with the functions `configure` and `run`, as in `cli/`.
COMMANDS: Final = {
    "campaign": "dart_flight.lab.commands.campaign_command",
    "plan": "dart_flight.lab.commands.plan_command",
    "report": "dart_flight.lab.commands.report_command",
    "export": "dart_flight.lab.commands.export_command",
    "predict": "dart_flight.lab.commands.predict_command",
    "studio": "dart_flight.lab.commands.studio_command",
    "calibrate": "dart_flight.lab.commands.calibrate_command",
    "inspect": "dart_flight.lab.commands.inspect_command",
    "series": "dart_flight.lab.commands.series_command",
    "identify": "dart_flight.lab.commands.identify_command",
    "tables": "dart_flight.lab.commands.tables_command",
}
# Functions of the lab that options and methods of the flight part call.
LIVE_VIEW: Final = "dart_flight.lab.scene.live:open_live_view"  # --live
MISSION_PICTURE: Final = "dart_flight.lab.report.figures.mission_figure:write_mission_picture"  # --plot
ROOM_PICTURE: Final = "dart_flight.lab.report.figures.room_figure:write_room_picture"  # `survey --plot`
MISSION_SCENE: Final = "dart_flight.lab.studio.scene_page:show_mission"  # `Mission.show`
PX4_FIGURES: Final = "dart_flight.lab.inspect.px4_log:read_px4_log"  # `dry-run --px4`
SCRIPT_NAMES: Final = "dart_flight.lab.api"  # the names in `dart_flight.__all__`


def load_entry(entry: str) -> Any:
    """Return the module of an entry, or the named object in it if the entry is `module:name`.

    Raises:
        ImportError: a package that only the lab needs is missing.
    """
    module, _, name = entry.partition(":")
    loaded = importlib.import_module(module)
    return getattr(loaded, name) if name else loaded
