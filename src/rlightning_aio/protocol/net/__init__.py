"""What an env_server and its clients say to each other, without any I/O.

Messages and arrays become frames (`wire`, `payload`), spaces become plain data
(`space_description`), and what was asked, executed and lost is settled by two state
machines (`server_session`, `client_session`). Rule: nothing here is ever pickled.
"""
