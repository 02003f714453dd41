"""Many envs used as one: the core that never waits, and the two drivers around it."""
