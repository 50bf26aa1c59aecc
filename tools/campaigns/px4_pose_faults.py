"""Campaign: faults of the forwarded poses on a real PX4."""

from tools.campaigns.px4_motion_capture import fault_page as page

__all__ = ["page"]
