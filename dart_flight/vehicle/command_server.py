"""The receiver of the operator's commands from a ground station: `MAV_CMD_USER_1` to this component.

MAVSDK does not acknowledge a subscribed command, so this module sends the acknowledgement.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, Final, NamedTuple

import msgspec
from mavsdk.plugins.mavlink_direct_server import MavlinkDirectServer, MavlinkMessage

COMPONENT: Final = 195  # component id of this program; it differs from MAVSDK's default server component
USER_COMMAND: Final = 31010  # MAV_CMD_USER_1


class Result(IntEnum):
    """The answer to a command, with MAV_RESULT's values."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2


_PREFIX: Final = {Result.ACCEPTED: "", Result.TEMPORARILY_REJECTED: "not now: ", Result.DENIED: "denied: "}


class Press(NamedTuple):
    """A received command: param1, param2, and whether the sender marks the command as a repetition."""

    button: int
    value: int = 0
    repeated: bool = False


class _Fields(msgspec.Struct):
    param1: float | None = None
    param2: float | None = None
    confirmation: int = 0


class CommandServer:
    """A receiver of the commands of one ground station; answers are sent on MAVSDK's thread.

    Args:
        system_id: system id of the only ground station that is allowed to send commands.
        answer: returns the result of a button press and the reason for this result.
        note: receives one line about every command, for log and ground station. Commands of other systems
            cause a line only once.

    Attributes:
        refused: number of commands from other systems; all of them are denied.
    """

    def __init__(
        self,
        mavsdk: Any,
        system_id: int,
        answer: Callable[[Press], tuple[Result, str]],
        note: Callable[[str], None],
    ) -> None:
        raw = getattr(mavsdk, "_mavsdk", mavsdk)
        self._server = MavlinkDirectServer(raw.server_component_by_id(COMPONENT))
        self._system_id, self._answer, self._note = system_id, answer, note
        self.refused = 0
        self._server.subscribe_command(USER_COMMAND, self._handle_command)

    def _handle_command(self, message: Any, _: Any) -> None:
        if message.system_id != self._system_id:
            self.refused += 1
            result = Result.DENIED
            text = f"system {message.system_id} is not allowed to send commands (ground_station.system_id)"
        else:
            result, text = self._answer(_press_of(message.fields_json))
        fields = {
            "command": USER_COMMAND,
            "result": int(result),
            "progress": 0,
            "result_param2": 0,
            "target_system": message.system_id,
            "target_component": message.component_id,
        }
        target = (message.system_id, message.component_id)
        self._server.send_message(
            MavlinkMessage("COMMAND_ACK", 0, 0, *target, msgspec.json.encode(fields).decode())
        )
        if message.system_id == self._system_id or self.refused == 1:
            self._note(f"{_PREFIX[result]}{text}")


def _press_of(fields_json: str) -> Press:
    fields = msgspec.json.decode(fields_json, type=_Fields)
    return Press(_whole(fields.param1), _whole(fields.param2), fields.confirmation > 0)


def _whole(value: float | None) -> int:
    """Return a parameter as an integer: -1 if it is not whole, 0 for NaN."""
    return 0 if value is None else int(value) if float(value).is_integer() else -1
