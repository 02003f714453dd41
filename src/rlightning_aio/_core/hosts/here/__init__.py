"""Envs in the trainer's own process: `inline` runs them, `loop` awaits them in its event loop.

No message is packed on the way. An env that dies here takes the trainer along.
"""
