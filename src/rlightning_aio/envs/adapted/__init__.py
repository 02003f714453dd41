"""What a worker puts around an env that a user's callable made.

A step limit and resets for the vector interfaces; for a vector environment of one, the form of a
single env. Sub-environments that a simulator steps by itself are in its own adapter.
"""
