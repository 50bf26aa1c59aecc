"""YAML files in, typed, validated, frozen objects out; every error names file, line and key."""

from dart_flight.config.document import InputError
from dart_flight.config.mission import Collision, Mission, load_mission, parse_mission
from dart_flight.config.provenance import VehicleSource, find_vehicle
from dart_flight.config.vehicle import Coefficients, VehicleConfig, default_config_path, load_vehicle

__all__ = [
    "Coefficients",
    "Collision",
    "InputError",
    "Mission",
    "VehicleConfig",
    "VehicleSource",
    "default_config_path",
    "find_vehicle",
    "load_mission",
    "load_vehicle",
    "parse_mission",
]
