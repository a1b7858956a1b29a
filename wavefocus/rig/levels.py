"""How loudly a rig is tried out."""

from __future__ import annotations

from config.rig import RigConfig
from config.rig_player import PlayerSection

MOST_AMPLITUDE_V = 1.0
# An output that puts out four times what the rig believes is still within the limit.
SAFE_SHARE = 0.25


def safe_amplitude_v(rig: RigConfig) -> float:
    """A peak voltage well below the rig's limits, of volts and of rms, and below the ends of the recorder's ranges."""
    recorder = rig.recorder
    half_range_v = min(recorder.reference_range_v / recorder.reference_gain, recorder.response_range_v) / 2
    return min(MOST_AMPLITUDE_V, SAFE_SHARE * largest_sine_v(rig.player), half_range_v)


def largest_sine_v(player: PlayerSection) -> float:
    """Largest peak of a sine or a sweep that any actuator may get for as long as one likes."""
    rms_v = player.largest_rms_v
    return player.largest_v if rms_v is None else min(player.largest_v, 2**0.5 * rms_v)
