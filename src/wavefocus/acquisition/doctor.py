"""Examination of a rig: each instrument opened, identified and exercised within a time limit, and a few records."""

import math
from collections.abc import Callable
from functools import partial
from typing import TypeVar, cast

import numpy as np

from wavefocus.acquisition.judgement import CALIBRATION_SPARE
from wavefocus.acquisition.leak import BAND_HZ, SWEEP_S, check_pickup, crosstalk_finding, leak_of
from wavefocus.acquisition.setup import (
    MAX_DELAY_DIFFERENCE_S,
    SETTLE_S,
    Openers,
    Setup,
    point_at,
    record_silence,
    take_record,
    wired,
)
from wavefocus.calibration import Float64Array
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.calibration.timing import ClockFitter
from wavefocus.config.messages.rig_checks import Act, Finding, Verdict
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import QualityLimits
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.protocols import DeviceIdentity, Mirror, Player, Recorder, Recording, RecordLabel
from wavefocus.drivers.registry import VibrometerReading
from wavefocus.drivers.timeouts import CallThread, HungError

Answer = TypeVar("Answer")

HUNG_REMEDY = "unplug it and plug it in again, or switch it off and on; then run wavefocus doctor again"


def finding(
    instrument: str, check: str, verdict: Verdict, what: str, remedy: str = "", act: Act | None = None
) -> Finding:
    """A finding; what would put it right is left out where nothing is wrong."""
    if verdict == "ok":
        return Finding(instrument, check, verdict, what)
    return Finding(instrument, check, verdict, what, remedy, act)


def _worse(verdict: Verdict, *, unless: bool) -> Verdict:
    return "ok" if unless else verdict


class RigFindings:
    """Collects findings; a question that raises becomes one.

    publish: Gets each finding as it is made.
    """

    def __init__(self, publish: Callable[[Finding], None]) -> None:
        self._publish = publish
        self._hung: set[str] = set()

    def add(
        self, instrument: str, check: str, verdict: Verdict, what: str, remedy: str = "", act: Act | None = None
    ) -> None:
        """Report a finding, see `finding`."""
        self._publish(finding(instrument, check, verdict, what, remedy, act))

    def ask(self, instrument: str, check: str, question: Callable[[], Answer], deadline_s: float) -> Answer | None:
        """Ask an instrument; once more after a passing fault; None where there is no answer: a finding says why."""
        if instrument in self._hung:
            self.add(instrument, check, "skipped", "it did not come back from the check before")
            return None
        thread = CallThread(f"doctor {instrument}")
        try:
            try:
                return thread.call(question, deadline_s)
            except TransientInstrumentError as passing:
                answer = thread.call(question, deadline_s)
                self.add(instrument, check, "warn", f"only at the second try: {passing.cause}", passing.remedy)
                return answer
        except HungError:
            self._hung.add(instrument)
            self.add(instrument, check, "fail", f"it did not come back within {deadline_s:g} s", HUNG_REMEDY)
        except InstrumentError as failure:
            # A check may need several instruments; the one that failed is the one to look at.
            where = failure.role or instrument
            self.add(where, check, "fail", f"{failure.operation}: {failure.cause}", failure.remedy)
        except Exception as defect:  # a defect of a driver must not hide what the other instruments say
            words = f"{type(defect).__name__}: {defect}"
            self.add(instrument, check, "fail", words, "this is a defect of the program: please report it")
        finally:
            thread.abandon()
        return None


SAMPLE_RATE_HZ = 10_000.0
# Longest waits, on top of what a question takes by its nature.
OPEN_S, ANSWER_S = 60.0, 30.0
# A mirror that reads back and stands further off than this does not meet its positions: half a millimetre at 1 m.
MAX_ASTRAY_MRAD = 0.5
WEAK_LIGHT = 0.2


def examine(openers: Openers, publish: Callable[[Finding], None], *, play: bool) -> dict[str, DeviceIdentity]:
    """Open, identify and exercise every instrument, and shut it down.

    publish: Gets every finding as it is made.
    play: Whether anything may sound.

    Returns the identities of the instruments that answered, by role.
    """
    examination = _Examination(openers, publish, play)
    examination.run()
    return examination.identities


class _Examination(RigFindings):
    """Publishes the findings about a rig's instruments, as far as these are there."""

    def __init__(self, openers: Openers, publish: Callable[[Finding], None], allowed_to_play: bool) -> None:
        super().__init__(publish)
        self._rig, self._openers, self._may_play = openers.rig, openers, allowed_to_play
        self._mirror: Mirror | None = None
        self._recorder: Recorder | None = None
        self._player: Player | None = None
        self.identities: dict[str, DeviceIdentity] = {}

    def run(self) -> None:
        try:
            vibrometer = self._open()
            # What needs an instrument that is not there is skipped, so that nobody asks it.
            opened = cast("tuple[Mirror, Recorder, Player]", (self._mirror, self._recorder, self._player))
            setup = wired(self._rig, *opened, self._openers.clock, vibrometer)
            points = self._check_mirror(setup)
            self._check_delay(setup)
            self._check_outputs(setup)
            self._check_sound(setup, points=points)
        finally:
            self._put_to_rest()

    def _open(self) -> VibrometerReading:
        """Open and identify; an instrument that fails is left out, and a vibrometer counts as one of 1 m/s per V."""
        openers = self._openers
        vibrometer = self.ask("vibrometer", "opening", openers.vibrometer, OPEN_S)
        if vibrometer is not None:
            words = f"{vibrometer.identity}, {vibrometer.sensitivity_m_s_per_v:g} m/s per V"
            self.add("vibrometer", "identity", "ok", words)
            if (level := vibrometer.signal_level) is not None:
                remedy = "focus the laser, clean its window, put reflective film on the surface"
                verdict = _worse("warn", unless=level >= WEAK_LIGHT)
                self.add("vibrometer", "signal level", verdict, f"{100 * level:.0f} % of full", remedy)
        self._mirror = self.ask("mirror", "opening", openers.mirror, OPEN_S)
        self._recorder = self.ask("recorder", "opening", openers.recorder, OPEN_S)
        self._player = self.ask("player", "opening", openers.player, OPEN_S)
        for name, role in (("mirror", self._mirror), ("recorder", self._recorder), ("player", self._player)):
            sentence = None if role is None else self.ask(name, "identity", role.identify, ANSWER_S)
            if role is not None and sentence is not None:
                self.add(name, "identity", "ok", sentence)
                self.identities[name] = role.identity
        return vibrometer or VibrometerReading(1.0, "", None, None, "")

    def _check_mirror(self, setup: Setup) -> bool:
        """Send the mirror to the corners of the surface and back to its middle; True where it went there."""
        limit_mrad, mirror = self._rig.mirror.limit_mrad, self._mirror
        if mirror is None:
            self.add("mirror", "corners", "skipped", "the mirror is not there")
            return False
        middle_mm = _middle_mm(self._rig)
        x_mrad, y_mrad = setup.mirror_map.angles_mrad(*np.vstack([_corners_mm(self._rig, middle_mm), middle_mm]).T)
        angles = [(float(x), float(y)) for x, y in zip(x_mrad, y_mrad, strict=True)]
        reach_mrad = max(max(map(abs, pair)) for pair in angles)
        if reach_mrad > limit_mrad:
            what = f"the surface needs {reach_mrad:.0f} mrad, mirror.limit_mrad is {limit_mrad:g}"
            remedy = "raise the limit if the mirror allows it, or move the mirror back"
            self.add("mirror", "corners", "fail", what, remedy, Act("edit-rig", "mirror.limit_mrad"))
            return False
        astray: list[float] = []
        for at_mrad in angles:
            found = self.ask("mirror", "corners", partial(_astray_mrad, mirror, at_mrad), OPEN_S)
            if found is None:
                return False
            astray += found
        what = f"{len(angles) - 1} corners and the middle reached, "
        what += f"read back within {max(astray):.3f} mrad" if astray else "not read back: it reports no position"
        meets = max(astray, default=0.0) <= MAX_ASTRAY_MRAD
        remedy = "see that nothing holds the mirror, and that its units are those of the rig file"
        self.add("mirror", "corners", _worse("fail", unless=meets), what, remedy)
        return meets

    def _check_delay(self, setup: Setup) -> None:
        """Compare the stated delay between the inputs with the device's conversion clock."""
        recorder, rate_hz, stated_s = self._recorder, SAMPLE_RATE_HZ, setup.inter_channel_delay_s
        if recorder is None:
            return
        device_s = self.ask("recorder", "input delay", partial(recorder.sampling_delay_s, rate_hz), ANSWER_S)
        if device_s is None:
            return
        as_stated = abs(device_s - stated_s) <= MAX_DELAY_DIFFERENCE_S
        what = f"the response is sampled {1e6 * device_s:.2f} us after the reference at {rate_hz:g} Hz"
        what += "" if as_stated else f"; stated are {1e6 * stated_s:.2f} us"
        remedy = f"write {device_s:.4g} into recorder.inter_channel_delay_s, or run wavefocus calibrate --only inputs"
        act = Act("edit-rig", "recorder.inter_channel_delay_s")
        self.add("recorder", "input delay", _worse("warn", unless=as_stated), what, remedy, act)

    def _check_outputs(self, setup: Setup) -> None:
        if self._player is None:
            self.add("player", "outputs", "skipped", "the player is not there")
            return
        there, needed = self._player.channels, 1 + max((*setup.actuator_channels, setup.loopback_channel))
        what = f"{there}, {needed} needed" if there >= needed else f"it has {there}, {needed} are wired"
        remedy = "choose the interface with enough outputs, or correct player.channels"
        verdict = _worse("fail", unless=there >= needed)
        self.add("player", "outputs", verdict, what, remedy, Act("edit-rig", "player.channels"))

    def _check_sound(self, setup: Setup, *, points: bool) -> None:
        """Records of silence, of the loopback and of actuators, as far as the instruments for them are there."""
        amplitude_v, why = self._rig.safe_amplitude_v, ""
        if self._recorder is None:
            self.add("recorder", "record", "skipped", "the recorder is not there")
        if self._recorder is None or not self._tell(
            "recorder", "record", partial(_check_silence, self._recorder, setup.range_v)
        ):
            why = "the recorder gave no record"
        if self._player is None:
            why = "the player is not there"
        elif not self._may_play:
            why = "nothing was to be played"
        if why:
            self.add("player", "loopback", "skipped", why)
        elif not self._tell("player", "loopback", partial(_check_loopback, setup, amplitude_v)):
            why = "without a loopback the response cannot be measured"
        elif not points:
            why = "the mirror does not point, so the beam may be anywhere"
        if why:
            self.add("vibrometer", "response", "skipped", why)
            self.add("recorder", "pickup", "skipped", f"not measured: {why}")
            return
        self._tell("vibrometer", "response", partial(_check_response, setup, amplitude_v, _middle_mm(self._rig)))
        if self._rig.shutter is not None or not self._parks_on_surface(setup):
            records_s = (1 + len(setup.actuator_channels)) * (setup.pre_roll_s + 2 * SWEEP_S + setup.post_roll_s)
            self._tell(
                "recorder", "pickup", partial(check_pickup, setup, amplitude_v, SAMPLE_RATE_HZ), OPEN_S + records_s
            )
        else:
            what = "not measured: the mirror has no shutter, and the beam parked at mirror.park_mrad is on the surface"
            self.add("recorder", "pickup", "skipped", what)

    def _parks_on_surface(self, setup: Setup) -> bool:
        tangents = [*np.tan(np.array(self._rig.mirror.park_mrad) / 1000), 1.0]
        x, y, scale = np.linalg.solve(np.array(setup.mirror_map.matrix), tangents)
        return bool(self._rig.surface.outline.contains(np.array([[x / scale, y / scale]])).all())

    def _tell(
        self, instrument: str, check: str, listen: Callable[[], list[Finding]], deadline_s: float = OPEN_S
    ) -> bool:
        """Publish the findings of a record; True where nothing of that instrument failed."""
        found = self.ask(instrument, check, listen, deadline_s)
        for finding in found or ():
            self._publish(finding)
        return found is not None and not any(one.verdict == "fail" for one in found if one.instrument == instrument)

    def _put_to_rest(self) -> None:
        """Mute, park and release whatever is open; only failures are reported."""
        player, recorder, mirror = self._player, self._recorder, self._mirror
        at_rest: dict[str, tuple[Callable[[], None], ...]] = {
            "player": () if player is None else (player.mute, player.close),
            "recorder": () if recorder is None else (recorder.abort, recorder.close),
            "mirror": () if mirror is None else (mirror.park, mirror.close),
        }
        for name, steps in at_rest.items():
            for step in steps:
                self.ask(name, "putting it to rest", step, ANSWER_S)


# Corners that the mirror is tried at: of the largest rectangle on the surface, a little within.
CORNER_SHARE = 0.95
SIGNS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])


def _middle_mm(rig: RigConfig) -> Float64Array:
    """The origin; where it lies outside the surface or near its edge, the place farthest from the edge, (2,)."""
    outline = rig.surface.outline
    left, bottom, right, top = outline.box_mm
    place_mm = np.stack(np.meshgrid(np.linspace(left, right, 101), np.linspace(bottom, top, 101)), axis=-1)
    place_mm = np.vstack([np.zeros(2), place_mm.reshape(-1, 2)])
    depth_mm = outline.depth_mm(place_mm)
    return np.asarray(place_mm[0 if depth_mm[0] > depth_mm.max() / 2 else depth_mm.argmax()])


def _corners_mm(rig: RigConfig, middle_mm: Float64Array) -> Float64Array:
    """Corners of the largest rectangle of the surface's proportions about its middle, (4, 2)."""
    corner_mm = np.array([rig.surface.length_mm, rig.surface.width_mm]) / 2
    shares = np.linspace(0, 1, 101)
    inside = rig.surface.outline.contains(middle_mm + shares[:, None, None] * SIGNS * corner_mm).all(axis=1)
    return np.asarray(middle_mm + CORNER_SHARE * shares[inside].max() * SIGNS * corner_mm)


def _astray_mrad(mirror: Mirror, at_mrad: tuple[float, float]) -> list[float]:
    """Send the mirror somewhere and wait: how far off it stands, or nothing where it cannot say."""
    mirror.move_to(*at_mrad)
    mirror.wait_settled(SETTLE_S)
    there = mirror.where_mrad()
    return [] if there is None else [max(abs(a - b) for a, b in zip(there, at_mrad, strict=True))]


DECAY_S = 0.2
# Quiet enough: a campaign's records want 40 dB and more between signal and silence.
GOOD_SNR_DB, MIN_SNR_DB = 40.0, 20.0
# From this deviation of the loopback's level on, a campaign with default limits finds every position poor.
BAD_LEVEL = 10 ** (CALIBRATION_SPARE * QualityLimits().reference_db / 20) - 1
# Converters of one decade are within 100 ppm of each other; the estimator looks for 500.
GOOD_PPM = 100.0
GOOD_RESIDUAL_DB = -40.0
# How much of the post-roll the player's latency may use up.
LATENCY_SHARE = 0.7
ACTUATORS_HEARD = 3


def _check_silence(recorder: Recorder, range_v: tuple[float, float]) -> list[Finding]:
    """Record while nothing plays: whether a record comes, and what it holds; raises InstrumentError of the recorder."""
    recording = record_silence(recorder, SWEEP_S, SAMPLE_RATE_HZ, range_v, RecordLabel(0, 1, 0, "doctor"))
    count = f"{recording.volts.shape[1]} samples of 2 channels"
    findings: list[Finding] = [Finding("recorder", "record", "ok", count)]
    for channel, name in enumerate(("reference", "response")):
        volts = recording.volts[channel].astype(np.float64)
        noise_v, offset_v, step_v = float(volts.std()), float(volts.mean()), recording.volts_per_count[channel]
        what = f"{1e3 * noise_v:.3g} mV rms, {1e3 * offset_v:+.3g} mV offset; step {1e3 * step_v:.3g} mV"
        judged: tuple[Verdict, str, str, Act | None] = "ok", what, "", None
        if recording.over_range[channel]:
            judged = "fail", f"{what}; it reaches {range_v[channel]:g} V", "check what is plugged in there", None
        elif noise_v == 0.0:
            act = Act("edit-rig", "recorder.terminal")
            judged = "warn", f"{what}: not even noise", "check cable and terminal configuration", act
        findings.append(finding("recorder", f"{name} noise", *judged))
    return findings


def _check_loopback(setup: Setup, amplitude_v: float) -> list[Finding]:
    """Play only on the loopback: level, latency, clock ratio and what else is on the line.

    Raises InstrumentError: of the player or the recorder.
    """
    signal_v = _sweep_v(amplitude_v)
    recording = take_record(setup, setup.signals_v(signal_v), SAMPLE_RATE_HZ, RecordLabel(0, 1, 1, "doctor"))
    channel = setup.loopback_channel
    if recording.over_range[0]:
        what = f"{amplitude_v:g} V reaches the end of the reference input"
        remedy = "raise recorder.reference_range_v, or lower what is played"
        act = Act("edit-rig", "recorder.reference_range_v")
        return [Finding("player", "loopback level", "fail", what, remedy, act)]
    try:
        found = ClockFitter(signal_v).fit(recording.volts[0])
    except ReferenceMissingError as missing:
        remedy = missing.remedy
        if missing.cause == "silence":
            remedy = f"check the cable from output {channel} of the player to the recorder's reference input"
        check = "clock ratio" if missing.cause == "rate" else "loopback level"
        return [Finding("player", check, "fail", str(missing), remedy)]
    latency_s, ppm = found.offset_samples / SAMPLE_RATE_HZ - setup.pre_roll_s, found.skew_ppm
    in_time = _worse("warn", unless=latency_s <= LATENCY_SHARE * setup.post_roll_s)
    latency = f"{1e3 * latency_s:.1f} ms, {1e3 * setup.post_roll_s:.0f} ms of post-roll to cover it"
    larger, act = "raise recorder.post_roll_s, or choose a smaller buffer", Act("edit-rig", "recorder.post_roll_s")
    clock = f"the recorder's clock runs {abs(ppm):.1f} ppm {'slower' if ppm < 0 else 'faster'} than the player's"
    rates = "check the sample rates set at the interface; the estimator allows 500 ppm"
    purity = f"{-found.residual_db:z.0f} dB above noise and distortion"
    clean = _worse("warn", unless=found.residual_db <= GOOD_RESIDUAL_DB)
    return [
        _level(found.gain / setup.reference_gain, amplitude_v, channel),
        finding("player", "latency", in_time, latency, larger, act),
        finding("player", "clock ratio", _worse("warn", unless=abs(ppm) <= GOOD_PPM), clock, rates),
        finding("player", "loopback purity", clean, purity, "look for hum, a loose cable or a range much too wide"),
        crosstalk_finding(leak_of(setup, recording, SAMPLE_RATE_HZ, BAND_HZ)),
    ]


def _check_response(setup: Setup, amplitude_v: float, middle_mm: Float64Array) -> list[Finding]:
    """Listen to silence and to a few actuators at the middle of the surface: whether the vibrometer detects them.

    Raises InstrumentError: of any instrument.
    """
    signal_v = _sweep_v(amplitude_v)
    point_at(setup, *middle_mm.tolist())
    silence_v = setup.signals_v(np.zeros_like(signal_v))
    noise_v = _in_band_v(take_record(setup, silence_v, SAMPLE_RATE_HZ, RecordLabel(0, 1, 1, "doctor")))
    count = len(setup.actuator_channels)
    chosen = sorted({round(index * count / ACTUATORS_HEARD) % count for index in range(ACTUATORS_HEARD)})
    snr_db: dict[int, float] = {}
    for actuator in chosen:
        signals_v = {setup.actuator_channels[actuator]: signal_v}
        recording = take_record(setup, signals_v, SAMPLE_RATE_HZ, RecordLabel(0, 1, 2 + actuator, "doctor"))
        if recording.over_range[1]:
            what = f"actuator {actuator} reaches the end of the response input"
            remedy = "raise recorder.response_range_v, choose a wider range at the vibrometer, or lower what is played"
            act = Act("edit-rig", "recorder.response_range_v")
            return [Finding("vibrometer", "response", "fail", what, remedy, act)]
        snr_db[actuator] = 20 * math.log10(_in_band_v(recording) / noise_v)
    return _heard(snr_db, amplitude_v)


def _in_band_v(recording: Recording) -> float:
    """Rms of the response in the band of the sweep; never quite 0."""
    volts = recording.volts[1].astype(np.float64)
    frequency_hz = np.fft.rfftfreq(volts.size, 1 / SAMPLE_RATE_HZ)
    band = (frequency_hz >= BAND_HZ[0]) & (frequency_hz <= BAND_HZ[1])
    return math.sqrt(2 * float(np.sum(np.abs(np.fft.rfft(volts)[band]) ** 2))) / len(volts) + 1e-9


def _sweep_v(amplitude_v: float) -> Float64Array:
    return PlayedExcitation(SAMPLE_RATE_HZ, *BAND_HZ, SWEEP_S, DECAY_S, amplitude_v, averages=1).signal_v()


def _level(gain: float, amplitude_v: float, channel: int) -> Finding:
    what = f"{abs(gain) * amplitude_v:.4g} V for {amplitude_v:.4g} V asked"
    if gain < 0:
        return Finding(
            "player", "loopback level", "warn", f"{what}, upside down", f"swap the wires of output {channel}"
        )
    remedy = "run wavefocus calibrate --only outputs, or correct player.full_scale_v and recorder.reference_gain"
    verdict = _worse("fail", unless=abs(gain - 1) <= BAD_LEVEL)
    return finding("player", "loopback level", verdict, what, remedy, Act("calibrate", "outputs"))


def _heard(snr_db: dict[int, float], amplitude_v: float) -> list[Finding]:
    best = max(snr_db, key=lambda actuator: snr_db[actuator])
    what = f"signal {snr_db[best]:.0f} dB above noise at the middle, actuator {best} at {amplitude_v:.3g} V"
    if not math.isfinite(snr_db[best]) or snr_db[best] < MIN_SNR_DB:
        remedy = "check that the beam is on the surface and in focus, the vibrometer's cable, and the amplifiers"
        return [Finding("vibrometer", "response", "fail", what, remedy)]
    remedy = "focus the laser, put reflective film on the surface, or drive louder"
    verdict = _worse("warn", unless=snr_db[best] >= GOOD_SNR_DB)
    findings = [finding("vibrometer", "response", verdict, what, remedy)]
    for actuator, ratio_db in snr_db.items():
        if ratio_db < MIN_SNR_DB:
            what = f"actuator {actuator} is hardly above the noise ({ratio_db:z.0f} dB)"
            remedy = "run wavefocus calibrate --only actuators; check its cable, amplifier and coil"
            findings.append(Finding("vibrometer", "actuator", "fail", what, remedy, Act("calibrate", "actuators")))
    return findings
