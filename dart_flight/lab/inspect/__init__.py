"""What a PX4 log felt: the flight core's own estimator and detector on any multirotor's ULog.

A log holds no mass. Everything is computed as specific force, per kilogram, with the thresholds of the
configured vehicle in the same form, so that there is one operating point for all vehicles; newtons come
out where a mass is given. Specific thrust is fitted from the log itself: the curve of `thrust_curve` with
mass one, and its error on stretches that the fit has not seen. The samples made from the log go through
`core.sense.Senses`, the same code as in flight.
"""
