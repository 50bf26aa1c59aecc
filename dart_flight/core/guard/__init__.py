"""The guard: rules that limit the mission, and the flight after one has fired."""
