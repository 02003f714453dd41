"""Worker processes: their handle, and their own program.

`host` is the trainer's side; `worker` is the worker's. `fork_server` is a program of
its own: it imports what workers need, forks them, and reports their exits. `fork_messages` is what
the trainer and it tell each other, and `spares` keeps fork servers for the next group. What becomes
of a worker that has died, `supervision` decides.
"""
