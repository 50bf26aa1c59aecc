"""Packages of extras that an installation may lack, and marks of the tests that need them."""

import pytest

try:
    import ruckig
except ModuleNotFoundError:  # the extra `plan` leaves it out on aarch64 with Python 3.13 and newer
    ruckig = None

__all__ = ["needs_ruckig", "ruckig"]

needs_ruckig = pytest.mark.skipif(ruckig is None, reason="ruckig is not installed (extra `plan`)")
