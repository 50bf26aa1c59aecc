"""Shells around the core, one per world, and the runners of many flights.

The `fly_*` functions return the verdict and share their arguments. `seed` determines the sensor noise and the
random quantities `spreads` (`sim.draws`: name -> standard deviation). A flight makes its own folder in
`log_dir`. `progress` receives every record on a separate thread, but in `fast` on the flight's thread.
`viewer` receives every record on the thread that processed the record. `speed` is the highest real-time
factor.
"""
