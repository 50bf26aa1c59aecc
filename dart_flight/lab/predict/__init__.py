"""One collision or drop, predicted step by step."""
