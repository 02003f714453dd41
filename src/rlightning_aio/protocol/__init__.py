"""What a trainer and its workers say to each other, without any I/O.

Spaces become columns (`columns`), columns and flags become rows of shared memory
(`slab`), numbered requests and replies travel in rings (`rings`) or, where they carry
more than a row holds, in frames (`frames`); `info` packs small info dicts into a row.
Absent on purpose: asyncio, multiprocessing, sockets, ZMQ.
"""
