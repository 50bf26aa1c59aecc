"""Campaign: survey and anchors on a real PX4, in the tables of touch.py."""

from tools.campaigns.touch import page

__all__ = ["page"]
