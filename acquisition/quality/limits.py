"""When a position is good enough, as a run file says it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class QualityLimits:
    """When a position is good enough.

    Parameters
    ----------
    poor_residual_db : float
        A record is suspect when the fitted response leaves more than this unexplained,
        in dB of the response.
    excess_noise_db : float
        A suspect record makes the position poor when its residual in volts is also this much
        above the residual of the position's quietest record. Both must hold: a far
        actuator's record is mostly noise and still honest, a near one's residual is
        large in volts and still small beside its response.
    poor_snr_db : float
        The position is poor when even its best record has less signal-to-noise ratio.
    max_attempts : int
        Attempts at a position before it is committed as it is.
    poor_harmonic_db : float
        A record is clipped or distorted when the third harmonic at its loudest moment is above this, in dB of the
        fundamental.
    speckle_step_mm : float
        How far the mirror moves aside where the light does not come back, >= 0.
    remeasure_pass : int
        How often, at the end of a campaign, all that is not valid is measured again, >= 0.
    second_look : str
        ``"auto"``: the pass also measures what neighbours cannot judge, and two measurements must agree; ``"never"``.
    reference_db : float
        How far the level of the reference may be from that of the records before, in dB, > 0. From its calibration
        it may be `CALIBRATION_SPARE` times as far.
    """

    poor_residual_db: float = -50.0
    excess_noise_db: float = 8.0
    poor_snr_db: float = 20.0
    max_attempts: int = 3
    poor_harmonic_db: float = -42.0
    speckle_step_mm: float = 0.1
    remeasure_pass: int = 1
    second_look: str = "auto"
    reference_db: float = 0.1

    @property
    def confirms(self) -> bool:
        """Whether positions that neighbours cannot judge are measured twice."""
        return self.second_look != "never" and self.remeasure_pass > 0
