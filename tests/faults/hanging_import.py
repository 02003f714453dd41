"""A module whose import hangs."""

import sys
import threading

sys.stderr.write("asleep\n")
sys.stderr.flush()
threading.Event().wait()
