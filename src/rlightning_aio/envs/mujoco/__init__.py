"""MuJoCo tasks stepped together: one call steps all simulations in MuJoCo's threads.

`batch` is the env, `tasks` are Gymnasium's tasks in array form, `threads` is the call, `outputs` is
what it copies for a task. A MuJoCo task alone in a worker is in `simulators.gymnasium`.
"""
