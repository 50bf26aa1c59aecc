"""Campaign: flights with a real PX4 on a busy computer, in the table of busy_computer.py."""

from tools.campaigns.busy_computer import page

__all__ = ["page"]
