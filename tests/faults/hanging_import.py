"""Hangs whoever imports it."""

import sys
import threading

sys.stderr.write("asleep\n")
sys.stderr.flush()
threading.Event().wait()
