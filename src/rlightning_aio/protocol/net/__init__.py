"""The protocol between an env_server and its clients, without I/O.

Messages and arrays become frames (`wire`, `payload`), and spaces become plain data
(`space_description`). Two state machines (`server_session` with its parts, `client_session`) track
requests, answers and losses. Rule: nothing here is ever pickled.
"""
