"""The guard: rules that limit the mission, and the flight after a rule has fired."""
