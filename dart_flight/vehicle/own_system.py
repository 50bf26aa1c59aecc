"""The MAVLink system id of this program, which must equal the vehicle's.

PX4 forwards a ground station's command to a component only if the component belongs to the vehicle's system.
"""

from __future__ import annotations

import ctypes
from typing import Any

from mavsdk import mavsdk as binding
from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration


def send_as(mavsdk: Any, component: ComponentType, system_id: int) -> int:
    """Send all subsequent messages of a connection as a component of system `system_id`.

    MAVSDK's C library has a function for this; its Python package does not. Return the system id that the
    messages then have. If the library lacks this function, the messages keep MAVSDK's default id.
    """
    configuration = Configuration.create_with_component_type(component)
    if configuration.system_id == system_id:
        return system_id
    set_configuration = getattr(binding._cmavsdk_lib, "mavsdk_set_configuration", None)
    if set_configuration is None:
        return int(configuration.system_id)
    set_configuration.argtypes, set_configuration.restype = [ctypes.c_void_p, ctypes.c_void_p], None
    configuration.system_id = system_id
    raw = getattr(mavsdk, "_mavsdk", mavsdk)
    set_configuration(raw._handle, configuration._handle)
    return system_id
