"""Estimators of the core: newest telemetry, thrust, external force and torque, impacts."""
