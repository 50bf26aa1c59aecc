"""The measurements behind the manual's results; each has a specification and a page of results."""
