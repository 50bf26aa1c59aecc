"""Flight state and estimators of the core: thrust, external force, external torque and impacts."""
