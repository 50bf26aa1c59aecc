"""The bring-up of a vehicle on the bench in measured and judged steps (docs/bringup.md)."""
