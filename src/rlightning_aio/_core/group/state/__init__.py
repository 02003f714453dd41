"""Tables: what is known of requests, episodes, envs, hosts and times.

`requests` holds what is in flight and what waits to be handed out, with its legal transitions in
`request_states`. `episodes` counts steps up to the limits of auto_reset, follows envs whose episode
was lost until a result has reported that, and reads the seeds of resets; `snapshot_format` is the
format of saved states. The rest describes envs and rows, hosts, counters and flags. Tables wait for
nothing.
"""
