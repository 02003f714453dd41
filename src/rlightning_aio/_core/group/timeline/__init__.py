"""The timeline of a group: what happened when, for Perfetto and for people.

`trace` notes begin and end of requests, spans and deaths while a group runs, `records` are what it
notes, and `file` writes them. A group that records nothing does not call anything here.
"""
