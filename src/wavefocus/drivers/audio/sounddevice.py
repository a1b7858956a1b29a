"""The player driver ``sounddevice``: its keys."""

from dataclasses import dataclass

from wavefocus.drivers.protocols import Player
from wavefocus.drivers.registry import PLAYERS, Outputs, rig_key


@PLAYERS.register
@dataclass(frozen=True, kw_only=True)
class SoundDevice:
    """Any audio interface that PortAudio has a host API for."""

    host_api: str | None = rig_key(
        "PortAudio's name of the driver model; any, if left out", default=None, in_plan="free"
    )
    device: str = rig_key("the interface's name, or a part of it that no other has", in_plan="free")
    block_frames: int = rig_key(
        "Frames per callback; 0 for what suits the host", default=0, in_plan="free", ge=0, le=1_000_000
    )

    name = "sounddevice"

    def open(self, outputs: Outputs) -> Player:
        from wavefocus.drivers.audio.stream.player import StreamPlayer

        return StreamPlayer(
            self.host_api,
            self.device,
            channels=len(outputs.full_scale_v),
            channel_full_scale_v=outputs.full_scale_v,
            interface_rate_hz=outputs.rate_hz,
            block_frames=self.block_frames,
        )
