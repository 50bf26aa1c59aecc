"""The manual as static pages: `make site` (docs/architecture.md)."""
