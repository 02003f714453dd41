"""MuJoCo tasks stepped together: one call steps all simulations in MuJoCo's threads.

`batch` is the env, `tasks` are Gymnasium's tasks in array form, `threads` is the call, `forces` are
contact forces. A MuJoCo task alone in a worker is in `simulators.gymnasium`.
"""
