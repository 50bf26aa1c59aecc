"""Campaign: trial series on a real PX4, in the table of series_embedded.py."""

from tools.campaigns.series_embedded import page

__all__ = ["page"]
