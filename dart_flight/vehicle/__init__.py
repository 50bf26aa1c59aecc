"""The connection to PX4, the only package that imports mavsdk; `link` grants the link to one program."""
