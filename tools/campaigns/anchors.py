"""Campaign: walls as anchors on plain GPS, in the tables of touch.py (docs/results/anchors.md)."""

from tools.campaigns.touch import page

__all__ = ["page"]
