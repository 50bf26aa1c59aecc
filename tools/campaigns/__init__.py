"""The measurements behind the manual's results, one specification and one page each."""
