"""Impact detection in the ULog of any multirotor with PX4, by the flight core's estimator and detector.

A log does not contain the mass. Everything is therefore computed as specific force, per kilogram. The
thresholds of the configured vehicle are also converted to specific force, and are used for every log. Forces
in newton are computed if a mass is given. The specific thrust is fitted to the log itself, with the curve of
`thrust_curve` for a mass of 1 kg. Held-out segments of the log give the error of the thrust. The samples made
from the log pass through `FlightState`, `ForceEstimator` and `ImpactDetector` of `core.sense`, the same code
as in flight.
"""
