"""Campaign: replays of flights with a real PX4, in the table of replay.py."""

from tools.campaigns.replay import page

__all__ = ["page"]
