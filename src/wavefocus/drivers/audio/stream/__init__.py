"""The driver ``sounddevice``: a stream over PortAudio in a process of its own."""
