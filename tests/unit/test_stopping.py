"""How signals become a stop."""

import signal
import subprocess
import sys

import pytest

from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.ending import stop_on_signals


def test_given_a_third_interrupt_then_the_way_out_is_not_disturbed():
    with stop_on_signals(StopRequest()):
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)


def test_given_a_process_that_waits_then_sigterm_ends_it_through_its_cleanup():
    program = (
        "import time\n"
        "from wavefocus.acquisition.engine.session import StopRequest\nfrom wavefocus.ending import stop_on_signals\n"
        "with stop_on_signals(StopRequest()):\n"
        "    try:\n"
        "        print('ready', flush=True)\n"
        "        time.sleep(30)\n"
        "    finally:\n"
        "        print('muted', flush=True)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert child.stdout is not None
    with child.stdout as lines:
        assert lines.readline().strip() == b"ready"
        child.terminate()
        assert lines.readline().strip() == b"muted"
    assert child.wait(timeout=10) != 0
