"""Stimuli played on a rig's actuators, their onsets found by a marker that the recorder gets through the loopback.

The laser is parked meanwhile: nobody needs the vibrometer, and people touch the surface.
"""

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.acquisition.engine.recovery import Recovery
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.setup import Setup, Step, naming_role, silence, take_record
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.calibration.timing import ClockFitter
from wavefocus.config.messages.campaign import Event, Fault, ReconnectTried, State
from wavefocus.config.trials import MaskingTable
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.protocols import RecordLabel
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.verify.scan import marker_v

MAX_VOID = 3
"""Presentations of one trial that may fail passingly before the session ends."""
MASKING_HZ = (50.0, 8000.0)
MASKING_CREST = 5.0
"""Peaks of the masking noise over its rms: a normal distribution goes beyond once in a million samples."""
MASKING_FADE_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Sound:
    """What one presentation plays.

    drive_v: Volts, (actuators, samples).
    onset_samples: Sample of scene time zero: the first focus instant.
    plays: How often it plays.
    """

    drive_v: Float64Array
    onset_samples: int
    plays: int


@dataclass(frozen=True, slots=True)
class Onset:
    """When a stimulus began.

    at_s: Scene time zero of its first play, of `time.monotonic`.
    error_ms: How much later than by the request to play and the player's stated latency; None where it states none.
    within_ms: Half the duration of the call that started the record: the onset is known to so much.
    attempts: Presentations begun until one succeeded.
    """

    at_s: float
    error_ms: float | None
    within_ms: float
    attempts: int = 1


def presented_v(sound: Sound, pause_s: float, rate_hz: float) -> Float64Array:
    """All plays of a stimulus, (actuators, samples).

    The onset of a play comes `pause_s` after the last sample of the play before, or as soon as its lead-in allows.
    """
    gap = np.zeros((len(sound.drive_v), max(0, round(pause_s * rate_hz) - sound.onset_samples)))
    return np.concatenate([sound.drive_v, *[gap, sound.drive_v] * (sound.plays - 1)], axis=1)


def pink_noise(samples: int, rate_hz: float, rms_v: float, seed: bytes) -> Float64Array:
    """Noise whose power density falls as 1 / f from 50 Hz to 8 kHz, or to 0.45 of the rate, faded, (samples,).

    It is the same for the same seed; no sample is beyond `MASKING_CREST` times the rms.
    """
    generator = np.random.Generator(np.random.PCG64(int.from_bytes(hashlib.sha256(seed).digest(), "big")))
    length = scipy.fft.next_fast_len(samples, real=True)
    hertz = np.arange(length // 2 + 1) * rate_hz / length
    inside = (hertz >= MASKING_HZ[0]) & (hertz <= min(MASKING_HZ[1], 0.45 * rate_hz))
    spectrum = generator.normal(size=(hertz.size, 2)).view(np.complex128)[:, 0]
    spectrum *= np.where(inside, 1.0 / np.sqrt(np.maximum(hertz, MASKING_HZ[0])), 0.0)
    noise = scipy.fft.irfft(spectrum, length)[:samples]
    noise = np.clip(noise * (rms_v / noise.std()), -MASKING_CREST * rms_v, MASKING_CREST * rms_v)
    edge_s = (np.arange(samples) + 0.5) / rate_hz
    return np.asarray(noise * np.sin(0.5 * np.pi * np.clip(edge_s / MASKING_FADE_S, 0, 1)) ** 2
                      * np.sin(0.5 * np.pi * np.clip(edge_s[::-1] / MASKING_FADE_S, 0, 1)) ** 2)  # fmt: skip


class RigPresenter:
    """Presents stimuli on an open rig; a lost instrument is waited for, a void presentation repeated.

    setup: The open rig.
    sound_of: The stimulus of a name.
    rate_hz: Rate of the drives.
    pause_s: Between the plays of a stimulus.
    masking, seed: Noise that plays with every stimulus, and the design's seed, from which it follows.
    """

    def __init__(
        self,
        setup: Setup,
        sound_of: Callable[[str], Sound],
        rate_hz: float,
        pause_s: float,
        masking: MaskingTable | None,
        seed: int,
    ) -> None:
        self._setup, self._sound_of, self._rate_hz, self._pause_s = setup, sound_of, rate_hz, pause_s
        self._masking, self._seed = masking, seed
        # Long enough for a fit to a few microseconds, short beside any stimulus.
        self._marker_v = marker_v(setup, round(0.1 * rate_hz), rate_hz)
        self._clock_fit = ClockFitter(self._marker_v)
        self._latency_s = _latency_s(setup)
        self._note: Callable[[str], object] = lambda sentence: None
        session = Session(setup.clock, self._follow, StopRequest())
        session.enter(State.RUNNING, "trials")
        self._recovery = Recovery(setup, session)
        with naming_role("mirror"):
            setup.mirror.park()

    def present(self, stimulus: str, trial: int, note: Callable[[str], object]) -> Onset:
        """Play a stimulus to its end and find its onset.

        trial: Number of the trial, for the instruments' logs and the masking noise; 0 in the familiarisation.
        note: Receives a sentence about each instrument that was lost, and each presentation that is repeated.

        Raises InstrumentError: an instrument did not come back in time, failed for good, or no presentation of
        `MAX_VOID` had a marker on the reference channel or came to its end.
        """
        self._note = note
        sound, attempts = self._sound_of(stimulus), 0

        def once() -> Onset:
            nonlocal attempts
            attempts += 1
            return self._once(sound, RecordLabel(trial, attempts, 0, "presentation"))

        for void in range(1, MAX_VOID + 1):
            try:
                onset = self._recovery.retry_after_reconnect(once)
                return Onset(onset.at_s, onset.error_ms, onset.within_ms, attempts)
            except TransientInstrumentError as failure:
                if void == MAX_VOID:
                    raise
                note(f"{failure.instrument}: {failure.cause}: the trial is repeated")
                self._recovery.renew_if_repeated(failure)
            except ReferenceMissingError as missing:
                if void == MAX_VOID:
                    raise self._no_marker(missing) from missing
                note(f"no marker on the reference input ({missing}): the trial is repeated")
        raise AssertionError("every presentation returns or raises")

    def mute(self) -> None:
        """Silence all outputs, and drop a record under way."""
        silence(self._setup)

    def signals_v(self, sound: Sound, label: RecordLabel) -> tuple[Mapping[int, Float64Array], int]:
        """Volts of all channels that sound, and the sample of the onset."""
        setup, rate_hz = self._setup, self._rate_hz
        drive_v = presented_v(sound, self._pause_s, rate_hz)
        around = 0 if self._masking is None else round(self._masking.around_s * rate_hz)
        onset = around + sound.onset_samples
        samples = max(drive_v.shape[1], sound.onset_samples + self._marker_v.size) + 2 * around
        signals: dict[int, Float64Array] = {}
        for channel, volts in zip(setup.actuator_channels, drive_v, strict=True):
            if volts.any():
                signals[channel] = np.zeros(samples)
                signals[channel][around : around + volts.size] = volts
        signals[setup.loopback_channel] = np.zeros(samples)
        signals[setup.loopback_channel][onset : onset + self._marker_v.size] = self._marker_v
        if (masking := self._masking) is not None:
            seed = f"{self._seed}/{label.position}/{label.attempt}".encode()
            signals[masking.output] = pink_noise(samples, rate_hz, masking.rms_v, seed)
        return signals, onset

    def _once(self, sound: Sound, label: RecordLabel) -> Onset:
        clock, rate_hz = self._setup.clock, self._rate_hz
        signals_v, onset = self.signals_v(sound, label)
        at_s: dict[Step, float] = {}
        recording = take_record(
            self._setup, signals_v, rate_hz, label, reached=lambda step: at_s.__setitem__(step, clock.now_s())
        )
        fit = self._clock_fit.fit(recording.volts[0])
        within_s = (at_s["started"] - at_s["starting"]) / 2
        found_s = at_s["starting"] + within_s + fit.offset_samples / rate_hz
        error_ms = None
        if self._latency_s is not None:
            error_ms = 1e3 * (found_s - (at_s["playing"] + self._latency_s + onset / rate_hz))
        # A virtual rig's clock is not the wall's; both stand at the end of the record now. Between two readings the
        # processor may be taken away.
        ahead_s = max(time.monotonic() - clock.now_s() for _ in range(5))
        return Onset(found_s + ahead_s, error_ms, 1e3 * within_s)

    def _follow(self, event: Event) -> None:
        match event:
            case Fault(instrument=instrument, cause=cause):
                self._note(f"{instrument}: {cause}: the trial is repeated once it is back")
            case ReconnectTried(instrument=instrument, outcome=outcome):
                self._note(f"{instrument}: {outcome}")

    def _no_marker(self, missing: ReferenceMissingError) -> InstrumentError:
        loopback = self._setup.loopback_channel
        remedy = f"check the loopback cable, from output {loopback} of the audio interface to the reference input"
        return InstrumentError("recorder", "finding the onset of a stimulus", str(missing), remedy)


def _latency_s(setup: Setup) -> float | None:
    try:
        return getattr(setup.player, "latency_s", None)
    except InstrumentError:  # its driver states none
        return None
