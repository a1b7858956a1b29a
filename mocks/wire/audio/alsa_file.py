"""An audio interface of ALSA's own making that writes what it is given to a file; it has no clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]

SYSTEM_DESCRIPTION = "/usr/share/alsa/alsa.conf"
"""ALSA's own; without it PortAudio aborts when it lists devices."""


class AlsaFile:
    """Describes the interface to ALSA, and reads what was played to it.

    It takes any number of channels at any rate, as fast as they come: good for routing and samples, not for time.


    host_api, device: What a player has to ask for.
    environment: What ALSA needs to find it.
    """

    host_api = "ALSA"

    def __init__(self, folder: Path, device: str = "filed") -> None:
        self.device = device
        self._frames_file = folder / "frames.raw"
        description = folder / "asound.conf"
        description.write_text(
            f'pcm.{device} {{ type file file "{self._frames_file}" format "raw" slave.pcm "null" }}\n',
            encoding="utf-8",
        )
        self.environment = {"ALSA_CONFIG_PATH": f"{SYSTEM_DESCRIPTION}:{description}"}

    def played(self, channels: int) -> Float32Array:
        """All that was played so far.

        channels: As many as the stream had.

        Returns float32 (channels, frames): parts of full scale, from the stream's first frame on.
        """
        samples = np.fromfile(self._frames_file, dtype=np.float32)
        return samples[: samples.size // channels * channels].reshape(-1, channels).T
