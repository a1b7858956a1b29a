"""Records that a rig is examined by: silence, the loopback alone, what single outputs leak, and a few actuators."""

import math

import numpy as np

from wavefocus.acquisition.judgement import CALIBRATION_SPARE
from wavefocus.acquisition.leak import BAND_HZ, SWEEP_S, leak_of
from wavefocus.acquisition.setup import Setup, naming_role, point_at, record_silence, take_record
from wavefocus.calibration.clock.missing_reference import ReferenceMissingError
from wavefocus.calibration.clock.timing import fit_clock
from wavefocus.calibration.crosstalk import REMEDY, UNKNOWN_ROWS_SHARE, Crosstalk
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.config.limits import QualityLimits
from wavefocus.config.messages.rig_checks import Act, Finding, Verdict
from wavefocus.drivers.protocols import Recorder, Recording, RecordLabel

PARKED_S = 0.1  # longest time that a mirror of any driver takes to its parking direction
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


def check_silence(recorder: Recorder, sample_rate_hz: float, range_v: tuple[float, float]) -> list[Finding]:
    """Record while nothing plays: whether a record comes, and what it holds; raises InstrumentError of the recorder."""
    recording = record_silence(recorder, SWEEP_S, sample_rate_hz, range_v, RecordLabel(0, 1, 0, "doctor"))
    count = f"{recording.volts.shape[1]} samples of 2 channels"
    findings: list[Finding] = [Finding("recorder", "record", "ok", count)]
    for channel, name in enumerate(("reference", "response")):
        volts = recording.volts[channel].astype(np.float64)
        noise_v, offset_v, step_v = float(volts.std()), float(volts.mean()), recording.volts_per_count[channel]
        what = f"{1e3 * noise_v:.3g} mV rms, {1e3 * offset_v:+.3g} mV offset; step {1e3 * step_v:.3g} mV"
        verdict: Verdict = "ok"
        remedy, act = "", None
        if recording.over_range[channel]:
            verdict, remedy = "fail", "check what is plugged in there"
            what += f"; it reaches {range_v[channel]:g} V"
        elif noise_v == 0.0:
            verdict, remedy, act = (
                "warn",
                "check cable and terminal configuration",
                Act("edit-rig", "recorder.terminal"),
            )
            what += ": not even noise"
        findings.append(Finding("recorder", f"{name} noise", verdict, what, remedy, act))
    return findings


def check_loopback(setup: Setup, amplitude_v: float, sample_rate_hz: float) -> list[Finding]:
    """Play only on the loopback: level, latency, clock ratio and what else is on the line.

    Raises InstrumentError: of the player or the recorder.
    """
    signal_v = _sweep(amplitude_v, sample_rate_hz).signal_v()
    recording = take_record(setup, setup.signals_v(signal_v), sample_rate_hz, RecordLabel(0, 1, 1, "doctor"))
    channel = setup.loopback_channel
    if recording.over_range[0]:
        what = f"{amplitude_v:g} V reaches the end of the reference input"
        remedy = "raise recorder.reference_range_v, or lower what is played"
        act = Act("edit-rig", "recorder.reference_range_v")
        return [Finding("player", "loopback level", "fail", what, remedy, act)]
    try:
        found = fit_clock(recording.volts[0], signal_v)
    except ReferenceMissingError as missing:
        remedy = missing.remedy
        if missing.cause == "silence":
            remedy = f"check the cable from output {channel} of the player to the recorder's reference input"
        check = "clock ratio" if missing.cause == "rate" else "loopback level"
        return [Finding("player", check, "fail", str(missing), remedy)]
    latency_s = found.offset_samples / sample_rate_hz - setup.pre_roll_s
    return [
        _level(found.gain / setup.reference_gain, amplitude_v, channel),
        _figure(
            "latency",
            f"{1e3 * latency_s:.1f} ms, {1e3 * setup.post_roll_s:.0f} ms of post-roll to cover it",
            latency_s <= LATENCY_SHARE * setup.post_roll_s,
            "raise recorder.post_roll_s, or choose a smaller buffer",
            Act("edit-rig", "recorder.post_roll_s"),
        ),
        _figure(
            "clock ratio",
            f"the recorder's clock runs {abs(found.skew_ppm):.1f} ppm "
            f"{'slower' if found.skew_ppm < 0 else 'faster'} than the player's",
            abs(found.skew_ppm) <= GOOD_PPM,
            "check the sample rates set at the interface; the estimator allows 500 ppm",
        ),
        _figure(
            "loopback purity",
            f"{-found.residual_db:.0f} dB above noise and distortion",
            found.residual_db <= GOOD_RESIDUAL_DB,
            "look for hum, a loose cable or a range much too wide",
        ),
        crosstalk_finding(leak_of(setup, recording, sample_rate_hz, BAND_HZ)),
    ]


def crosstalk_finding(found: Crosstalk) -> Finding:
    """What of the loopback leaks into the response input, and what to do about it."""
    if found.reaches(UNKNOWN_ROWS_SHARE):
        return Finding("recorder", "crosstalk", "fail", f"the loopback leaks into the response input: {found}", REMEDY)
    if not found.resolves(UNKNOWN_ROWS_SHARE):
        what = f"the response input is too loud to see a leak of the loopback below {found.visible_db:.0f} dB"
        return Finding("recorder", "crosstalk", "warn", what, "point the beam where light comes back, or play louder")
    return Finding("recorder", "crosstalk", "ok", str(found))


def check_pickup(setup: Setup, amplitude_v: float, sample_rate_hz: float) -> list[Finding]:
    """Play each output while no light comes back, shutter closed or beam parked: what of its voltage is picked up.

    Raises InstrumentError: of any instrument.
    """
    mirror = setup.instruments.mirror
    with naming_role("mirror"):
        mirror.park()
        mirror.block()
    setup.instruments.clock.sleep(PARKED_S)
    signal_v = _sweep(amplitude_v, sample_rate_hz).signal_v()
    found: list[Crosstalk] = []
    for number, actuators in enumerate([(), *((actuator,) for actuator in range(len(setup.actuator_channels)))]):
        label = RecordLabel(0, 1, number, "pickup")
        recording = take_record(setup, setup.signals_v(signal_v, *actuators), sample_rate_hz, label)
        found.append(leak_of(setup, recording, sample_rate_hz, BAND_HZ))
    alone, *single = found
    # Each record has the loopback's leak too: what exceeds it is the output's own.
    own = [Crosstalk(one.share - alone.is_seen * alone.share, one.delay_s, one.error) for one in single]
    worst = max(range(len(own)), key=lambda actuator: abs(own[actuator].share))
    if own[worst].reaches(UNKNOWN_ROWS_SHARE):
        what = f"the response input picks up output {setup.actuator_channels[worst]}: "
        what += f"{own[worst].level_db:.1f} dB re its voltage"
        return [Finding("recorder", "pickup", "fail", what, REMEDY)]
    visible_db = max(one.visible_db for one in own)
    return [Finding("recorder", "pickup", "ok", f"none of {len(own)} outputs is picked up above {visible_db:.0f} dB")]


def check_response(setup: Setup, amplitude_v: float, sample_rate_hz: float) -> list[Finding]:
    """Listen to silence and to a few actuators at the middle of the surface: whether the vibrometer detects them.

    Raises InstrumentError: of any instrument.
    """
    signal_v = _sweep(amplitude_v, sample_rate_hz).signal_v()
    point_at(setup, 0.0, 0.0)
    silence_v = setup.signals_v(np.zeros_like(signal_v))
    quiet = take_record(setup, silence_v, sample_rate_hz, RecordLabel(0, 1, 1, "doctor"))
    noise_v = _in_band_v(quiet, sample_rate_hz)
    count = len(setup.actuator_channels)
    chosen = sorted({round(index * count / ACTUATORS_HEARD) % count for index in range(ACTUATORS_HEARD)})
    snr_db: dict[int, float] = {}
    for actuator in chosen:
        signals_v = {setup.actuator_channels[actuator]: signal_v}
        recording = take_record(setup, signals_v, sample_rate_hz, RecordLabel(0, 1, 2 + actuator, "doctor"))
        if recording.over_range[1]:
            what = f"actuator {actuator} reaches the end of the response input"
            remedy = "raise recorder.response_range_v, choose a wider range at the vibrometer, or lower what is played"
            act = Act("edit-rig", "recorder.response_range_v")
            return [Finding("vibrometer", "response", "fail", what, remedy, act)]
        snr_db[actuator] = 20 * math.log10(_in_band_v(recording, sample_rate_hz) / noise_v)
    return _heard(snr_db, amplitude_v)


def _in_band_v(recording: Recording, sample_rate_hz: float) -> float:
    """Rms of the response in the band of the sweep; never quite 0."""
    volts = recording.volts[1].astype(np.float64)
    frequency_hz = np.fft.rfftfreq(volts.size, 1 / sample_rate_hz)
    band = (frequency_hz >= BAND_HZ[0]) & (frequency_hz <= BAND_HZ[1])
    return math.sqrt(2 * float(np.sum(np.abs(np.fft.rfft(volts)[band]) ** 2))) / len(volts) + 1e-9


def _sweep(amplitude_v: float, sample_rate_hz: float) -> PlayedExcitation:
    return PlayedExcitation(sample_rate_hz, *BAND_HZ, SWEEP_S, DECAY_S, amplitude_v, averages=1)


def _figure(check: str, what: str, good: bool, remedy: str, act: Act | None = None) -> Finding:
    """A figure of the loopback that is good, or worth a warning."""
    return Finding("player", check, "ok", what) if good else Finding("player", check, "warn", what, remedy, act)


def _level(gain: float, amplitude_v: float, channel: int) -> Finding:
    what = f"{abs(gain) * amplitude_v:.4g} V for {amplitude_v:.4g} V asked"
    if gain < 0:
        return _figure("loopback level", f"{what}, upside down", False, f"swap the wires of output {channel}")
    off = abs(gain - 1)
    if off <= BAD_LEVEL:
        return Finding("player", "loopback level", "ok", what)
    remedy = "run wavefocus calibrate --only outputs, or correct player.full_scale_v and recorder.reference_gain"
    return Finding("player", "loopback level", "fail", what, remedy, Act("calibrate", "outputs"))


def _heard(snr_db: dict[int, float], amplitude_v: float) -> list[Finding]:
    best = max(snr_db, key=lambda actuator: snr_db[actuator])
    what = f"signal {snr_db[best]:.0f} dB above noise at the middle, actuator {best} at {amplitude_v:.3g} V"
    if not math.isfinite(snr_db[best]) or snr_db[best] < MIN_SNR_DB:
        remedy = "check that the beam is on the surface and in focus, the vibrometer's cable, and the amplifiers"
        return [Finding("vibrometer", "response", "fail", what, remedy)]
    verdict: Verdict = "ok" if snr_db[best] >= GOOD_SNR_DB else "warn"
    remedy = "" if verdict == "ok" else "focus the laser, put reflective film on the surface, or drive louder"
    findings: list[Finding] = [Finding("vibrometer", "response", verdict, what, remedy)]
    for actuator, ratio_db in snr_db.items():
        if ratio_db < MIN_SNR_DB:
            what = f"actuator {actuator} is hardly above the noise ({ratio_db:z.0f} dB)"
            remedy = "run wavefocus calibrate --only actuators; check its cable, amplifier and coil"
            findings.append(Finding("vibrometer", "actuator", "fail", what, remedy, Act("calibrate", "actuators")))
    return findings
