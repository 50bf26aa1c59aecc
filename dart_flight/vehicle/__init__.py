"""The connection to PX4. Only this package imports mavsdk.

`link` ensures that only one program at a time uses a link.
"""
