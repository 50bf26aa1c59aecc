"""A flight in the standard schemas of Foxglove, Lichtblick and Rerun, for the live view and for exports.

This package requires foxglove-sdk (extra `live`). Only its module `downsampling` does not need the extra,
because it runs in the flight's own process.
"""
