"""The planner: search for missions that satisfy a scenario."""
