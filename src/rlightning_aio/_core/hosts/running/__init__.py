"""Run an env: build it, step and reset it, write its rows, take and put back its state.

It is the same code in a worker, in this process and in a Ray actor; `awaited_runner` is its form
for awaitable envs. It knows nothing of frames, pipes and processes.

Rule: a row says whether it is a reset or an end, and holds the return and length of the episode so
far, so no other part has to remember them.
"""
