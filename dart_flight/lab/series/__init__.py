"""Trial series: hits on one wall, from the first flight to dated coefficients (docs/series.md)."""
