"""A handler of pyserial: ``hang://host:port`` is a TCP port like ``socket://``; a write hangs once `hangs` is set."""

import threading

from serial.urlhandler import protocol_socket

hangs, hung, released = (threading.Event() for _ in range(3))


class Serial(protocol_socket.Serial):
    """The port."""

    def from_url(self, url):
        return super().from_url(url.replace("hang://", "socket://"))

    def write(self, data):
        if hangs.is_set():
            hangs.clear()
            hung.set()
            released.wait()
        return super().write(data)
