"""Envs of an OpenEnv server: the env, its WebSocket session, and headers that no log shows."""
