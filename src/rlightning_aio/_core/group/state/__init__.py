"""Tables: what is known of requests, envs, hosts and times.

`requests` holds what is in flight and what waits to be handed out, with its legal transitions in
`request_states`. The rest describes envs and rows, hosts, counters and flags. Tables decide nothing
and wait for nothing.
"""
