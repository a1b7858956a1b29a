"""Examination of signals: silence, loopback and surface."""

from __future__ import annotations

import math

import numpy as np

from acquisition.measuring.record import ANSWER_MARGIN_S, point_at, take_record
from acquisition.measuring.setup import Setup
from calibration.clock.timing import ReferenceMissingError, fit_clock
from calibration.excitation.sweeps import Excitation
from config.messages.doctor import Act, Finding, Verdict
from drivers.protocols import Recorder, Recording, RecordRequest, Take

SILENCE_S = 0.5
SWEEP_S, DECAY_S = 0.5, 0.2
BAND_HZ = (40.0, 400.0)
# Quiet enough: a campaign's records want 40 dB and more between signal and silence.
GOOD_SNR_DB, LEAST_SNR_DB = 40.0, 20.0
# The level of the loopback: calibrated outputs are within 1 %, those of one model within some.
GOOD_LEVEL, LEAST_LEVEL = 0.05, 0.5
# Converters of one decade are within 100 ppm of each other; the estimator looks for 500.
GOOD_PPM = 100.0
GOOD_RESIDUAL_DB = -40.0
# How much of the post-roll the player's latency may use up.
LATENCY_SHARE = 0.7
ACTUATORS_HEARD = 3


def check_silence(recorder: Recorder, sample_rate_hz: float, range_v: tuple[float, float]) -> list[Finding]:
    """Record while nothing plays: whether a record comes, and what it holds.

    Raises InstrumentError: of the recorder.
    """
    request = RecordRequest(
        samples=round(SILENCE_S * sample_rate_hz),
        sample_rate_hz=sample_rate_hz,
        range_v=range_v,
        take=Take(0, 1, 0, "doctor"),
    )
    try:
        recorder.start(request)
        recording = recorder.read(SILENCE_S + ANSWER_MARGIN_S)
    except BaseException:
        recorder.abort()
        raise
    findings: list[Finding] = [Finding("recorder", "record", "ok", f"{request.samples} samples of 2 channels")]
    for name, volts, step_v, reached, end_v in zip(
        ("reference", "response"),
        recording.volts.astype(np.float64),
        recording.volts_per_count,
        recording.over_range,
        range_v,
        strict=True,
    ):
        noise_v, offset_v = float(volts.std()), float(volts.mean())
        what = f"{1e3 * noise_v:.3g} mV rms, {1e3 * offset_v:+.3g} mV offset; step {1e3 * step_v:.3g} mV"
        if reached:
            findings.append(
                Finding(
                    "recorder",
                    f"{name} noise",
                    "fail",
                    f"{what}; it reaches {end_v:g} V",
                    "check what is plugged in there",
                )
            )
        elif noise_v == 0.0:
            findings.append(
                Finding(
                    "recorder",
                    f"{name} noise",
                    "warn",
                    f"{what}: not even noise",
                    "check cable and terminal configuration",
                    Act("edit-rig", "recorder.terminal"),
                )
            )
        else:
            findings.append(Finding("recorder", f"{name} noise", "ok", what))
    return findings


def check_loopback(setup: Setup, amplitude_v: float, sample_rate_hz: float) -> list[Finding]:
    """Play on the loopback alone: level, latency, clock ratio and what else is on the line.

    Raises InstrumentError: of the player or the recorder.
    """
    signal_v = _sweep(amplitude_v, sample_rate_hz).signal_v()
    recording = take_record(setup, {setup.loopback_channel: signal_v}, sample_rate_hz, Take(0, 1, 1, "doctor"))
    channel = setup.loopback_channel
    if recording.over_range[0]:
        remedy = "raise recorder.reference_range_v, or lower what is played"
        return [
            Finding(
                "player",
                "loopback level",
                "fail",
                f"{amplitude_v:g} V reaches the end of the reference input",
                remedy,
                Act("edit-rig", "recorder.reference_range_v"),
            )
        ]
    try:
        found = fit_clock(recording.volts[0], signal_v)
    except ReferenceMissingError as missing:
        remedy = f"check the cable from output {channel} of the player to the recorder's reference input"
        return [Finding("player", "loopback level", "fail", str(missing), remedy)]
    return [
        _level(found.gain / setup.reference_gain, amplitude_v, channel),
        _latency(found.offset_samples / sample_rate_hz - setup.pre_roll_s, setup.post_roll_s),
        _clock(found.skew_ppm),
        _purity(found.residual_db),
    ]


def check_response(setup: Setup, amplitude_v: float, sample_rate_hz: float) -> list[Finding]:
    """Listen to silence and to a few actuators at the middle of the surface: whether the vibrometer detects them.

    Raises InstrumentError: of any instrument.
    """
    signal_v = _sweep(amplitude_v, sample_rate_hz).signal_v()
    point_at(setup, 0.0, 0.0)
    silence_v = {setup.loopback_channel: np.zeros_like(signal_v)}
    quiet = take_record(setup, silence_v, sample_rate_hz, Take(0, 1, 1, "doctor"))
    noise_v = _in_band_v(quiet, sample_rate_hz)
    count = len(setup.actuator_channels)
    chosen = sorted({round(index * count / ACTUATORS_HEARD) % count for index in range(ACTUATORS_HEARD)})
    snr_db: dict[int, float] = {}
    for actuator in chosen:
        signals_v = {setup.actuator_channels[actuator]: signal_v}
        recording = take_record(setup, signals_v, sample_rate_hz, Take(0, 1, 2 + actuator, "doctor"))
        if recording.over_range[1]:
            remedy = "raise recorder.response_range_v, choose a wider range at the vibrometer, or lower what is played"
            return [
                Finding(
                    "vibrometer",
                    "response",
                    "fail",
                    f"actuator {actuator} reaches the end of the response input",
                    remedy,
                    Act("edit-rig", "recorder.response_range_v"),
                )
            ]
        snr_db[actuator] = 20 * math.log10(_in_band_v(recording, sample_rate_hz) / noise_v)
    return _heard(snr_db, amplitude_v)


def _in_band_v(recording: Recording, sample_rate_hz: float) -> float:
    """Rms of the response in the band of the sweep; never quite 0."""
    volts = recording.volts[1].astype(np.float64)
    spectrum = np.fft.rfft(volts)
    frequency_hz = np.fft.rfftfreq(volts.size, 1 / sample_rate_hz)
    band = (frequency_hz >= BAND_HZ[0]) & (frequency_hz <= BAND_HZ[1])
    energy = float(np.sum(np.abs(spectrum[band]) ** 2))
    return math.sqrt(2 * energy) / len(volts) + 1e-9


def _sweep(amplitude_v: float, sample_rate_hz: float) -> Excitation:
    return Excitation(
        sample_rate_hz=sample_rate_hz,
        start_hz=BAND_HZ[0],
        stop_hz=BAND_HZ[1],
        duration_s=SWEEP_S,
        decay_s=DECAY_S,
        amplitude_v=amplitude_v,
        averages=1,
    )


def _level(gain: float, amplitude_v: float, channel: int) -> Finding:
    what = f"{abs(gain) * amplitude_v:.4g} V for {amplitude_v:.4g} V asked"
    if gain < 0:
        return Finding(
            "player", "loopback level", "warn", f"{what}, upside down", f"swap the wires of output {channel}"
        )
    off = abs(gain - 1)
    if off <= GOOD_LEVEL:
        return Finding("player", "loopback level", "ok", what)
    remedy = "run wavefocus calibrate --only outputs, or correct player.full_scale_v and recorder.reference_gain"
    verdict: Verdict = "warn" if off <= LEAST_LEVEL else "fail"
    return Finding("player", "loopback level", verdict, what, remedy, Act("calibrate", "outputs"))


def _latency(latency_s: float, post_roll_s: float) -> Finding:
    what = f"{1e3 * latency_s:.1f} ms, {1e3 * post_roll_s:.0f} ms of post-roll to cover it"
    if latency_s <= LATENCY_SHARE * post_roll_s:
        return Finding("player", "latency", "ok", what)
    return Finding(
        "player",
        "latency",
        "warn",
        what,
        "raise recorder.post_roll_s, or choose a smaller buffer",
        Act("edit-rig", "recorder.post_roll_s"),
    )


def _clock(skew_ppm: float) -> Finding:
    what = f"the recorder's runs {skew_ppm:+.1f} ppm faster than the player's"
    if abs(skew_ppm) <= GOOD_PPM:
        return Finding("player", "clock ratio", "ok", what)
    return Finding(
        "player",
        "clock ratio",
        "warn",
        what,
        "check the sample rates set at the interface; the estimator allows 500 ppm",
    )


def _purity(residual_db: float) -> Finding:
    what = f"{-residual_db:.0f} dB above noise and distortion"
    if residual_db <= GOOD_RESIDUAL_DB:
        return Finding("player", "loopback purity", "ok", what)
    return Finding("player", "loopback purity", "warn", what, "look for hum, a loose cable or a range much too wide")


def _heard(snr_db: dict[int, float], amplitude_v: float) -> list[Finding]:
    best = max(snr_db, key=lambda actuator: snr_db[actuator])
    what = f"signal {snr_db[best]:.0f} dB above noise at the middle, actuator {best} at {amplitude_v:.3g} V"
    if not math.isfinite(snr_db[best]) or snr_db[best] < LEAST_SNR_DB:
        remedy = "check that the beam is on the surface and in focus, the vibrometer's cable, and the amplifiers"
        return [Finding("vibrometer", "response", "fail", what, remedy)]
    verdict: Verdict = "ok" if snr_db[best] >= GOOD_SNR_DB else "warn"
    remedy = "" if verdict == "ok" else "focus the laser, put reflective film on the surface, or drive louder"
    findings: list[Finding] = [Finding("vibrometer", "response", verdict, what, remedy)]
    for actuator, ratio_db in snr_db.items():
        if ratio_db < LEAST_SNR_DB:
            remedy = "run wavefocus calibrate --only actuators; check its cable, amplifier and coil"
            findings.append(
                Finding(
                    "vibrometer",
                    "actuator",
                    "fail",
                    f"actuator {actuator} is hardly above the noise ({ratio_db:z.0f} dB)",
                    remedy,
                    Act("calibrate", "actuators"),
                )
            )
    return findings
