"""``hang://host:port``: a TCP port like ``socket://`` whose reads and writes hang while `hangs` is set."""

import threading

from serial.urlhandler import protocol_socket

hangs = threading.Event()
released = threading.Event()
hung = threading.Semaphore(0)


def hang():
    """Return at once, or once `released` is set where `hangs` is."""
    if hangs.is_set():
        hung.release()
        released.wait()


class Serial(protocol_socket.Serial):
    """The port."""

    def from_url(self, url):
        return super().from_url(url.replace("hang://", "socket://"))

    def write(self, data):
        hang()
        return super().write(data)
