"""The locking mechanism: cam, servo, state machine and drivers. All but the drivers and the store is pure."""
