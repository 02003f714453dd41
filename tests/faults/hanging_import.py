"""Hangs whoever imports it."""

import threading

threading.Event().wait()
