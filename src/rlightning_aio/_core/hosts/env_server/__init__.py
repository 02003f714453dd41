"""The group's end of an env_server, whose clients are workers that start themselves.

`host` is one place, for one client at a time, with what all places of an entry share; `listener` is
their socket, and checks keys. What a client is answered, `protocol.net` decides:
`server_session`. Nothing that arrives is unpickled. The client's end is in `rlightning_aio.remote`.

A place is a host like any other, which is down while it has no client (`base.SelfStarting`).
"""
