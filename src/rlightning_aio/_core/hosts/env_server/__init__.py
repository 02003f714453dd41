"""The group's end of an env_server, whose clients come and go.

`host` is the host of all clients, `listener` their socket, `authenticator` their keys, and the two
limiters keep strangers from wearing it down. What a client is answered, `protocol.net` decides:
`server_session`. Nothing that arrives is unpickled. The client's end is in `rlightning_aio.remote`.

The group knows clients only as members, envs that join and leave (`Membership`). A client keeps its
slot under its name until another client needs it while this one is absent. A lost client leaves one
result, marked like that of a replaced worker.
"""
