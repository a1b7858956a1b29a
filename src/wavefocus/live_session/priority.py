"""Priority of a live session among the computer's other programs."""

import os
import sys
import threading
from contextlib import suppress

_HIGH_PRIORITY_CLASS = 0x80


def raise_priority(*others: threading.Thread) -> None:
    """Let this thread, and threads and processes that it starts from now on, run before other programs, if it may.

    others: Threads of this process that do so too. One that holds Python's lock holds up this one for as long as
        other programs run in its place.

    On Linux by a real-time priority, which a limit (``rtprio`` in /etc/security/limits.d, as audio servers ask for it)
    or root allows; on Windows by the high priority class; elsewhere not at all.
    """
    if sys.platform == "linux":
        for thread in (threading.current_thread(), *others):
            with suppress(OSError):
                # The lowest of the real-time priorities: audio servers stay above.
                os.sched_setscheduler(thread.native_id or 0, os.SCHED_RR, os.sched_param(1))
    elif sys.platform == "win32":
        import ctypes

        kernel = ctypes.windll.kernel32
        kernel.SetPriorityClass(kernel.GetCurrentProcess(), _HIGH_PRIORITY_CLASS)
