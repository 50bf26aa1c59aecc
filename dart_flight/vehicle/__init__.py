"""The only access to PX4: nothing else imports mavsdk."""

from dart_flight.vehicle.clock import ClockEstimate, LockstepClock
from dart_flight.vehicle.ground_link import GroundLink
from dart_flight.vehicle.session import VehicleError, VehicleSession, connect

__all__ = ["ClockEstimate", "GroundLink", "LockstepClock", "VehicleError", "VehicleSession", "connect"]
