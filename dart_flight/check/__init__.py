"""`dart-flight check`: everything that can be known on the ground, as findings that end in go or no-go.

`checks` is the list of all checks by stage, `stages` what walks it. `mission_check` judges a mission alone:
bounds, walls, speeds, forces, servo times, coefficients. With a connection `vehicle_reading` measures and
reads; `telemetry_check`, `vehicle_check` and `place_check` judge; `px4_parameters` explains those of PX4's
parameters that matter to a vehicle that flies into walls and compares the rest with `configs/px4/`.
"""
