"""Campaign: hits on a real PX4, in the table of faster_hits.py."""

from tools.campaigns.faster_hits import page

__all__ = ["page"]
