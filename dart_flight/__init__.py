"""DART flight: fly a dual-stiffness quadrotor into walls on purpose and profit from it.

`docs/architecture.md` shows the rooms and the way of one IMU sample through them.
"""

import os

# Before NumPy is first imported: the threads of its linear algebra only wait for each other on matrices of
# the sizes here, and what they burn meanwhile is missing to a flight on the same machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.1.0"
