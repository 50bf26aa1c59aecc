"""The connection to PX4. Only this package imports mavsdk."""
