"""The process that is an emulated audio interface: it runs an audio server, and records as a client of it.

Run as ``python -m wavefocus.mocks.wire.jack_interface DESCRIPTOR`` by `wavefocus.mocks.wire.jack_server`, with a line
of JSON and then one word per line on standard input. It ends with its parent, and takes the server with it.
"""

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from wavefocus.mocks.wire import WireFaultPlan
from wavefocus.mocks.wire.jack_server import DEVICE, PLACE_S, START_S, STOP_S, AudioRing, RingWriter


@contextlib.contextmanager
def _server_place() -> Iterator[str]:
    """The name of a server that no other program on this machine uses, and room for it in shared memory.

    A few names, used again and again: a server that was killed stays registered until one of its name follows, and
    eight are all there is room for. Raises RuntimeError.
    """
    import fcntl

    memory = os.statvfs("/dev/shm")
    # A jackd takes 42 MB of /dev/shm, however few ports it has (measured, 1.9.21).
    # Of eight that may be registered; a person may run one.
    places = min(7, max(1, memory.f_blocks * memory.f_frsize // 45_000_000))
    latest_s = time.monotonic() + PLACE_S
    while True:
        for place in range(places):
            name = f"wavefocus-{os.getuid()}-{place}"
            lock = Path(tempfile.gettempdir()) / f"{name}.lock"
            with open(lock, "a", opener=_not_through_links) as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    continue
                yield name
                return
        if time.monotonic() > latest_s:
            raise RuntimeError(f"{places} emulated interfaces are running, and /dev/shm has no room for one more")
        time.sleep(0.05)


def _not_through_links(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o600)


_CLIENT_TIMEOUT_MS = 200
"""jackd that waits for its clients (--sync) stands still for ten times this when one died in the middle of a period."""

_TERMINATE_S = 1.0
"""jackd stands still for two seconds over a client that died; that is not waited for."""


class _JackInterface:
    """One audio server and its recording client.

    faults: What goes wrong, by periods.
    orders: Gets the words of faults that are due, with their seconds.
    """

    def __init__(
        self, ring: AudioRing, name: str, faults: WireFaultPlan, orders: queue.SimpleQueue[tuple[str, float]]
    ) -> None:
        import jack  # needs the audio server's library

        self._jack = jack
        self._ring = ring
        self._name = name
        self._faults = faults
        self._orders = orders
        self._recording = RingWriter(ring)
        self._client: Any = None
        self._server: subprocess.Popen[bytes] | None = None
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  # as long as the process
        self._frozen = False
        # What the server's library prints is of no use to anybody: whether it answers is seen.
        for quiet in (jack.set_error_function, jack.set_info_function):
            quiet(lambda _: None)

    def start(self, channels: int = 0) -> None:
        """Start the server, or one more after it was killed, and record from it; returns when it runs steadily.

        channels: Outputs, at most those of the ring; 0 for as many.
        """
        if self._client is not None:
            self._client.close()
            self._client = None
        latest_s = time.monotonic() + START_S
        while (client := self._served()) is None:
            if time.monotonic() > latest_s:
                raise RuntimeError(f"jackd did not start: {self._last_words()}")
            time.sleep(0.02)
        self._client = client
        ports = [
            client.inports.register(f"playback_{number + 1}", is_terminal=True, is_physical=True)
            for number in range(channels or self._ring["channels"])
        ]
        np.frombuffer(bytes(4), np.float32).any()  # what the first use costs is not for the first cycle

        def record(_frames: int) -> None:
            now_ns = time.monotonic_ns()
            sounding = self._recording.take(now_ns, [port.get_array() for port in ports])
            due = self._faults.due("period")
            if sounding:
                due += self._faults.due("sounding")
            for fault in due:
                self._orders.put((fault.kind, fault.seconds))

        client.set_process_callback(record)
        enough = self._ring["cycle"] + 4
        self._recording.note_return()
        client.activate()
        while self._ring["cycle"] < enough:
            if time.monotonic() > latest_s:
                raise RuntimeError(f"jackd does not run: {self._last_words()}")
            time.sleep(0.005)
        self._ring["silent"] = 0

    def _served(self) -> Any:
        """See to it that there is a server; its client, None as long as it lets none in."""
        if not self._running():  # not yet, or one that died of the same name is not yet gone
            # setpriv: the server must not outlive this process, whatever ends it.
            server = ["setpriv", "--pdeathsig", "KILL", "jackd", "--name", self._name, "--port-max", "128"]
            server += ["--no-realtime", "--no-mlock", "--sync", "--timeout", str(_CLIENT_TIMEOUT_MS)]
            server += ["-d", "dummy", "-C", "0", "-P", "0"]
            server += ["-r", str(self._ring["rate_hz"]), "-p", str(self._ring["period_frames"])]
            environment = {**os.environ, "JACK_NO_AUDIO_RESERVATION": "1"}
            self._server = subprocess.Popen(
                server, stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log, env=environment
            )
        try:
            return self._jack.Client(DEVICE, use_exact_name=True, no_start_server=True)
        except self._jack.JackOpenError:
            return None

    def freeze(self) -> None:
        """Stop the server as a driver that hangs; the outputs fall silent."""
        if self._running():
            self._signal(signal.SIGSTOP)
            self._frozen = True
            self._ring["silent"] = 1

    def thaw(self) -> None:
        """Let it go on."""
        if self._frozen:
            self._ring["silent"] = 0
            self._recording.note_return()
            self._signal(signal.SIGCONT)
            self._frozen = False

    def kill(self) -> None:
        """End the server without notice, as pulling the plug does."""
        if self._server is not None:
            self._server.kill()
            self._server.wait(STOP_S)
            self._frozen = False
            self._ring["silent"] = 1

    def note_death(self) -> None:
        """See whether the server ended by itself."""
        if not self._running():
            self._ring["silent"] = 1

    def stop(self) -> None:
        """End server and recording, and clear up what a killed server leaves in shared memory."""
        self.thaw()
        if not self._end_in_order():
            # A successor of the same name clears up.
            with contextlib.suppress(RuntimeError):
                self.start()
            if not self._end_in_order():
                self.kill()
        # All but the semaphores of clients that were there when it was killed.
        for left in Path("/dev/shm").glob(f"jack_sem.*_{self._name}_*"):
            left.unlink(missing_ok=True)

    def _end_in_order(self) -> bool:
        """Whether the server ended as servers should; killed if not."""
        client, server = self._client, self._server
        if server is None or not self._running():
            return False
        self._client = None

        def leave() -> None:
            client.deactivate()
            client.close()
            server.terminate()

        leaving = threading.Thread(target=leave, daemon=True)
        leaving.start()
        leaving.join(_TERMINATE_S)
        try:
            server.wait(_TERMINATE_S)
        except subprocess.TimeoutExpired:
            self.kill()
            leaving.join(STOP_S)
            return False
        return True

    def _running(self) -> bool:
        return self._server is not None and self._server.poll() is None

    def _signal(self, number: int) -> None:
        if self._server is not None:
            self._server.send_signal(number)

    def _last_words(self) -> str:
        self._log.seek(0)
        return self._log.read().decode(errors="replace")[-400:]


def main() -> None:
    """Be the interface until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    settings = json.loads(sys.stdin.readline())
    # They are checked already, and this process starts sooner without pydantic.
    faults: Any = tuple(SimpleNamespace(**keys) for keys in settings["faults"])
    ring = AudioRing(int(sys.argv[1]))
    orders: queue.SimpleQueue[tuple[str, float]] = queue.SimpleQueue()

    def answer(**what: object) -> None:
        with contextlib.suppress(BrokenPipeError):  # a parent that is gone needs no answer
            print(json.dumps(what), file=answers, flush=True)

    try:
        with _server_place() as name:
            os.environ["JACK_DEFAULT_SERVER"] = name
            interface = _JackInterface(ring, name, WireFaultPlan("player", faults), orders)
            interface.start()
            answer(server=name)
            threading.Thread(target=_listen, args=(orders,), daemon=True).start()
            try:
                _obey(interface, orders, ring["period_frames"] / ring["rate_hz"], answer)
            finally:
                interface.stop()
    except (RuntimeError, OSError, ImportError) as error:
        answer(failed=str(error))
    answers.close()


def _listen(orders: queue.SimpleQueue[tuple[str, float]]) -> None:
    for line in sys.stdin:
        orders.put((line.strip(), -1.0))
    orders.put(("end", 0.0))


def _obey(
    interface: _JackInterface, orders: queue.SimpleQueue[tuple[str, float]], period_s: float, answer: Any
) -> None:
    """Carry out orders, which want an answer and have -1 seconds, and faults, which do not."""

    def later(word: str, seconds: float) -> None:
        if seconds > 0:
            timer = threading.Timer(seconds, orders.put, [(word, 0.0)])
            timer.daemon = True
            timer.start()

    while True:
        try:
            word, seconds = orders.get(timeout=0.05)
        except queue.Empty:
            interface.note_death()
            continue
        if word == "end":
            return
        if word == "underflow":
            interface.freeze()
            time.sleep(max(3 * period_s, seconds))
            interface.thaw()
        elif word in ("frozen", "freeze"):
            interface.freeze()
            later("thaw", seconds)
        elif word in ("lost", "kill"):
            interface.kill()
            later("start", seconds)
        elif word == "thaw":
            interface.thaw()
        elif word.startswith("start"):
            interface.start(int(word.removeprefix("start") or 0))
        if seconds < 0:
            answer(done=word)


if __name__ == "__main__":
    main()
