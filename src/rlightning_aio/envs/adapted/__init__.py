"""What a worker puts around an env that a user's callable made.

A step limit and resets for the vector interfaces, and films. Sub-environments that a simulator
steps by itself are in its own adapter.
"""
