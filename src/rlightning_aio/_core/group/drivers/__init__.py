"""How a procedure of the engine waits: what it yields (`wait`), and the two drivers.

The engine's operations are generators that yield what to wait for. A driver blocks or awaits until
that has happened and resumes them. Nothing here knows requests or envs.
"""
