"""What is known: newest telemetry, thrust, external force, impacts."""
