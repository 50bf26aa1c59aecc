"""The batteries of one vehicle: the newest reading of each, and the choice of the worst battery."""

from __future__ import annotations

from dart_flight.base.text import battery_figures
from dart_flight.vehicle.messages import BatteryReading

# A battery that never exceeds this fraction of the landing voltage is not a flight battery.
_LEAST_SHARE = 0.5


class Batteries:
    """The batteries that BATTERY_STATUS reports, by id.

    PX4 reacts to the worst of the connected batteries, so this class also selects the worst battery. The
    selection ignores batteries of avionics or payload, and batteries that never had enough voltage to fly.
    `lowest_v` is the voltage below which the vehicle must land.
    """

    def __init__(self, lowest_v: float = 0.0) -> None:
        self._lowest_v = lowest_v
        self._readings: dict[int, BatteryReading] = {}
        self._highest_v: dict[int, float] = {}

    def update(self, reading: BatteryReading) -> None:
        self._readings[reading.id] = reading
        if reading.voltage_v is not None:
            self._highest_v[reading.id] = max(self._highest_v.get(reading.id, 0.0), reading.voltage_v)

    def remove(self, number: int) -> bool:
        """Remove a battery that is no longer connected; return whether it was stored."""
        return self._readings.pop(number, None) is not None

    def flight_batteries(self) -> list[BatteryReading]:
        """Return the flight batteries, or all batteries if there is no flight battery."""
        able = [reading for reading in self._readings.values() if self._is_flight_battery(reading)]
        return able or list(self._readings.values())

    def other_batteries(self) -> list[BatteryReading]:
        counted = self.flight_batteries()
        return [reading for reading in self._readings.values() if reading not in counted]

    def worst(self) -> BatteryReading | None:
        """Return the flight battery with the least charge; a battery below the lowest voltage comes first."""
        return min(self.flight_batteries(), key=self._rank, default=None)

    def _is_flight_battery(self, reading: BatteryReading) -> bool:
        highest_v = self._highest_v.get(reading.id)
        return reading.flies and (highest_v is None or highest_v >= _LEAST_SHARE * self._lowest_v)

    def _rank(self, reading: BatteryReading) -> tuple[bool, float, float, int]:
        volts = reading.voltage_v
        return (
            volts is None or volts >= self._lowest_v,
            1.0 if reading.remaining is None else reading.remaining,
            1e3 if volts is None else volts,
            reading.id,
        )


def describe_reading(reading: BatteryReading) -> str:
    """Return text such as "id 0: 16.2 V, 95 %"."""
    figures = battery_figures(reading.remaining, reading.voltage_v)
    return f"id {reading.id}: {', '.join(reversed(figures))}"
