"""The studio: a page in the browser that shows a room, edits its file, plans, flies and plays flights.

The model (`open_file`, `edits`, `scene_model`, `engine`, `playback`) has no viser in it; the view draws it.
"""
