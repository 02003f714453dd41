"""Envs of an OpenEnv server: the env, and its session over a WebSocket."""
