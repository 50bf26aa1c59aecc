"""The parameters of a vehicle: values by name, and the list of the names that the vehicle has.

A missing answer does not prove that the vehicle lacks a parameter. A parameter is absent if the vehicle
reports its absence, or if the vehicle's complete list lacks it and a request by name gets no answer.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Collection, Iterable
from functools import partial
from typing import Any

import msgspec
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.mavlink_direct import MavlinkMessage
from mavsdk.plugins.param import Param, ParamError, ParamResult

from dart_flight.config.parameter_file import Value, is_storable, show_value
from dart_flight.vehicle import messages
from dart_flight.vehicle.messages import AUTOPILOT, ListedParameter
from dart_flight.vehicle.vehicle_session import VehicleError, VehicleSession

_READ_S = 90.0  # timeout for all reads by name together; a read without an answer takes 3 s
_LIST_S = 60.0  # timeout for the complete list
_SILENT_S = 1.5  # after this time without a new entry, the missing entries are requested
_ROUNDS = 3  # after this many consecutive requests without a new entry, the list counts as complete
_CHUNK = 40  # number of entries requested together; a slow radio would drop more
_AGAIN, _AGAIN_S = 3, 0.5  # number of further requests for an unanswered name, and the wait after each
_POLL_S = 0.02

Perform = Callable[[str, Callable[[], Any]], Any]  # arguments: name and function of a request


class ParameterList:
    """The names of a vehicle's parameters, from PARAM_VALUE messages.

    `restarts` counts how often the list started over: PX4's indices change when a module starts to use more
    parameters.
    """

    def __init__(self) -> None:
        self.names: dict[int, str] = {}  # names of the parameters by their index in the list
        self.answered: set[str] = set()  # all received names
        self.count: int | None = None
        self.restarts = 0

    def update(self, entry: ListedParameter) -> None:
        """Process one PARAM_VALUE, on MAVSDK's thread."""
        self.answered.add(entry.name)
        if entry.place >= entry.entries:
            return  # not an entry of the list: a parameter that no module uses, or the list's checksum
        if entry.entries != self.count:
            self.restarts += self.count is not None
            self.count, self.names = entry.entries, {}
        self.names[entry.place] = entry.name

    @property
    def is_complete(self) -> bool:
        return self.count is not None and len(self.names) == self.count

    def missing(self) -> list[int]:
        """Return the indices that have not arrived."""
        return [index for index in range(self.count or 0) if index not in self.names]


class VehicleParameters:
    """Reads and writes the parameters of the autopilot on a link.

    Args:
        plugin: MAVSDK's parameter plugin of the same vehicle.
        perform: performs a request and raises `NoAnswerError` if the vehicle answers no requests at all.
    """

    def __init__(self, session: VehicleSession, plugin: Param, system_id: int, perform: Perform) -> None:
        self._session, self._plugin, self._system_id, self._perform = session, plugin, system_id, perform
        self._list = ParameterList()
        self._is_listed = False  # whether the list has been requested

    def read(
        self, names: Iterable[str], progress: Callable[[int], None], unanswered: set[str]
    ) -> dict[str, Value]:
        """Return the values of the parameters that the vehicle has.

        Add to `unanswered` the names of the parameters whose value and absence are both unknown.
        """
        values: dict[str, Value] = {}
        pending: list[str] = []
        end_s = time.monotonic() + _READ_S
        for done, name in enumerate(names):
            progress(done)
            if time.monotonic() > end_s or (self._is_listed and name not in self._list.answered):
                pending.append(name)
            elif self._read(name, values) is None:
                pending.append(name)
                if not self._is_listed:
                    self._is_listed = True
                    with contextlib.suppress(MavsdkError):
                        self._perform("the list of parameters", self._request_list)
        if not pending:
            return values
        answered = self._ask_again(pending)
        for name in pending:
            known = name in answered or name in self._list.answered
            if known and time.monotonic() <= end_s and self._read(name, values) is not None:
                continue
            if known or not self._list.is_complete:
                unanswered.add(name)
        return values

    def write(self, name: str, value: Value) -> None:
        """Set a parameter; `value` must be an int for an INT32 parameter and a float for a REAL32.

        Raises:
            NoAnswerError: the vehicle does not answer requests.
            VehicleError: the vehicle refuses the value or does not answer, or its type cannot hold the value.
        """
        if not is_storable(value):
            raise VehicleError(f"{name} was not set: {show_value(value)} is out of range")
        write = self._plugin.set_param_int if isinstance(value, int) else self._plugin.set_param_float
        try:
            self._perform(f"parameter {name}", partial(write, name, value))
        except MavsdkError as error:
            refusal = getattr(getattr(error, "result", None), "name", str(error)).lower().replace("_", " ")
            raise VehicleError(f"{name} was not set to {show_value(value)}: {refusal}") from None

    def _read(self, name: str, values: dict[str, Value]) -> bool | None:
        """Read one parameter into `values`; return whether the vehicle has it, or None without an answer."""
        for read in (self._plugin.get_param_int, self._plugin.get_param_float):
            try:
                values[name] = self._perform(f"parameter {name}", partial(read, name))
            except MavsdkError as error:
                result = getattr(error, "result", None)
                if result in (ParamResult.WRONG_TYPE, ParamResult.TYPE_MISMATCH):
                    continue
                return False if result == ParamResult.DOES_NOT_EXIST else None
            return True
        return None

    def _request_list(self) -> None:
        """Request the list of all parameters, and then its missing entries, until the list is complete.

        Raise ParamError if no entry arrives.
        """
        listed, end_s = self._list, time.monotonic() + _LIST_S
        handle = self._session.listen(messages.PARAM_VALUE, lambda entry, _: listed.update(entry))
        try:
            rounds, before = 0, (-1, -1)
            while not listed.is_complete and rounds < _ROUNDS and time.monotonic() < end_s:
                missing = listed.missing()[:_CHUNK]
                if not missing or listed.restarts != before[1]:
                    self._send("PARAM_REQUEST_LIST")
                    missing = []
                for index in missing:
                    self._send("PARAM_REQUEST_READ", param_id="", param_index=index)
                before = (len(listed.names), listed.restarts)
                self._wait_for_entries(missing)
                rounds = 0 if len(listed.names) != before[0] else rounds + 1
        finally:
            self._session.unlisten(handle)
        if listed.count is None:
            raise ParamError(ParamResult.TIMEOUT, "PARAM_REQUEST_LIST")

    def _wait_for_entries(self, requested: Collection[int]) -> None:
        """Wait until the list or its requested part is complete, or until no entry has arrived for 1.5 s."""
        listed, count, since_s = self._list, -1, time.monotonic()
        while not listed.is_complete and time.monotonic() - since_s < _SILENT_S:
            if requested and listed.names.keys() >= set(requested):
                return
            if len(listed.names) != count:
                count, since_s = len(listed.names), time.monotonic()
            time.sleep(_POLL_S)

    def _ask_again(self, names: Collection[str]) -> set[str]:
        """Request all parameters in `names` together, up to 3 times; return the names that PX4 answered.

        PX4 lists only the parameters that its modules use, but also answers for the other parameters.
        """
        found = ParameterList()
        handle = self._session.listen(messages.PARAM_VALUE, lambda entry, _: found.update(entry))
        try:
            for _ in range(_AGAIN):
                for name in set(names) - found.answered:
                    self._send("PARAM_REQUEST_READ", param_id=name, param_index=-1)
                end_s = time.monotonic() + _AGAIN_S
                while set(names) - found.answered and time.monotonic() < end_s:
                    time.sleep(_POLL_S)
        finally:
            self._session.unlisten(handle)
        return found.answered & set(names)

    def _send(self, message: str, **fields: object) -> None:
        target = {"target_system": self._system_id, "target_component": AUTOPILOT}
        text = msgspec.json.encode({**target, **fields}).decode()
        self._session.send_message(MavlinkMessage(message, 0, 0, 0, 0, text))
