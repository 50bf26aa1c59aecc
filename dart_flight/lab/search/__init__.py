"""The search over scenarios."""
