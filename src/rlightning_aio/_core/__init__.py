"""The engine below the public names; use those, because nothing here is promised.

`group` is the trainer's side: it plans, sends, waits, and decides what becomes of a death. `hosts`
is where envs live: worker processes, this process, Ray, remote clients. `group` knows hosts only by
the seam, `hosts.base` and `hosts.messages`, and only `hosts` knows where an env runs. What both
ends write into shared memory and frames is in `protocol`, what users hold in `batch`.
"""
