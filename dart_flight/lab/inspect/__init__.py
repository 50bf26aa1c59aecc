"""Impact detection in the ULog of any multirotor with PX4, by the flight core's estimators (`core.sense`).

A log does not contain the mass, so everything is computed as specific force, per kilogram. The thresholds of
the configured vehicle are converted to specific force too, and are used for every log. If a mass is given,
forces in newton are computed as well. The specific thrust is fitted to the log itself, with the curve of
`thrust_curve` for a mass of 1 kg. The error of this fit is measured on held-out segments. The samples pass
through `Senses`, as in flight.
"""
