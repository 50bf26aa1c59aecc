"""The guard: the rules that limit the mission, and the commands after a rule has fired."""
