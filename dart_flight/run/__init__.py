"""Programs that fly the core in each world, and functions that run many flights.

The `fly_*` functions return the verdict and share their arguments. `seed` determines the sensor noise and the
random quantities. `spreads` maps the name of a quantity (`sim.draws`) to its standard deviation. A flight
makes its own folder in `log_dir`. `progress` receives every record: in `fast` on the flight's thread, in
other worlds on a separate thread. `viewer` receives every record on the thread that processed the record.
`speed` is the highest real-time factor.
"""
