"""The checks before a flight, for `check`, `fly` and `survey`; their findings decide between go and no-go.

`checks` lists all checks by stage, and `stages` runs them. `mission_check` checks a mission without a
vehicle: bounds, walls, speeds, forces, servo times, coefficients. With a connection, `vehicle_reading` reads
the vehicle's parameters and telemetry; `telemetry_check`, `vehicle_check` and `place_check` evaluate them.
`px4_parameters` explains the PX4 parameters that matter in a collision and compares the other parameters with
`configs/px4/`.
"""
