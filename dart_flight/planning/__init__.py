"""Planning of collisions: approaches, the closed-loop flight model, rollouts, surveys and replanning."""
