"""The one door to PX4: nothing else imports mavsdk."""

from dart_flight.vehicle.clock import ClockEstimate
from dart_flight.vehicle.session import VehicleSession, connect

__all__ = ["ClockEstimate", "VehicleSession", "connect"]
