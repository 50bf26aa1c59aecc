"""A flight in the standard schemas of Foxglove, Lichtblick and Rerun: live and from its log, translated once.

Needs foxglove-sdk, the `live` extra, except for `downsampling`, which is the flight's own end of a live view.
"""
