"""The locking mechanism: servo, state machine, session, persistence and drivers."""
