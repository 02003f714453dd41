"""What runs inside a worker: `base.BaseEnv` and one module for each simulator."""
