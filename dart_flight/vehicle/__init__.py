"""The one door to PX4: nothing else imports mavsdk."""

from dart_flight.vehicle.clock import ClockEstimate, LockstepClock
from dart_flight.vehicle.session import VehicleSession, connect

__all__ = ["ClockEstimate", "LockstepClock", "VehicleSession", "connect"]
