"""Envs of an OpenEnv server: the env, its WebSocket session, and headers that no log shows.

The server's side is in `rlightning_aio.plugins.openenv.server`.
"""
