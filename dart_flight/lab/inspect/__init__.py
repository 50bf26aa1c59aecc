"""Impact detection in PX4's logs, with the flight core's own estimator and detector on any multirotor's ULog.

A log does not contain the mass. Everything is therefore computed as specific force, per kilogram. The
thresholds of the configured vehicle are converted to specific force too, and apply to every vehicle. Forces
in newton are computed if a mass is given. Specific thrust is fitted from the log itself with the curve of
`thrust_curve` at mass one, and its error is measured on held-out segments. The samples made from the log pass
through `FlightState`, `ForceEstimator` and `ImpactDetector` of `core.sense`, the same code as in flight.
"""
