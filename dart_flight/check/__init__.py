"""`dart-flight check`: everything that can be known on the ground, as findings that end in go or no-go.

`mission` judges a mission alone: bounds, walls, speeds, forces, servo times, coefficients. With a connection
`vehicle` measures stream rates, battery, estimator and servo output, and `parameters` explains those of PX4's
parameters that matter to a vehicle that flies into walls and compares the rest with `configs/px4/`.
"""
