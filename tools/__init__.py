"""Development tools: benchmarks, campaigns, generators of documentation, test helpers."""

import dart_flight  # noqa: F401  must precede NumPy, because it sets the number of NumPy's threads
