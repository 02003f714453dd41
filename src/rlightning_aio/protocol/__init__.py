"""The protocol between a trainer and its workers, without any I/O.

Spaces become columns (`columns`); columns and flags become rows of shared memory (`slab`).
Numbered requests and replies travel in rings (`rings`), or in frames (`frames`) if they don't fit
a row; `info` packs small info dicts into a row.
Absent on purpose: asyncio, multiprocessing, sockets, ZMQ.
"""
