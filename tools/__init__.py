"""Development tools: campaigns, emulated hardware, generators of documentation."""

import dart_flight  # noqa: F401  before NumPy: it sets the number of its threads
