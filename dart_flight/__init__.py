"""DART flight: fly a dual-stiffness quadrotor into walls on purpose and profit from it.

`docs/architecture.md` shows the rooms and the way of one IMU sample through them.
"""

__version__ = "0.1.0"
