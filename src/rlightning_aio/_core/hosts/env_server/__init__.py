"""The group's end of an env_server, whose clients come and go.

`host` is the host of all clients, `listener` their socket, `authenticator` their keys, and the two
limiters keep strangers from wearing it down. Nothing that arrives is unpickled. The client's end is
in `rlightning_aio.remote`.
"""
