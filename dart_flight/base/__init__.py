"""What every room stands on: rotations, frames, records, streams, errors."""
