"""Many envs used as one: `group` from the public classes down to its tables.

Imports run down: `api` (the two public groups), `setup` (what is started), `timeline`, `engine`
(send, wait, apply, hand out), `supervision` (deaths, hangs, restarts), `tables` (what all parts
share), `episodes` (step limits, losses, snapshots), `state`, `drivers` (how a procedure waits).
No module here does I/O or reads a clock, but for the drivers; none knows where an env runs.
"""
