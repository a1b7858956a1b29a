"""The symptoms of a verification in words: what is wrong, and what to do about it."""

from __future__ import annotations

import numpy as np

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.report.words import number
from wavefocus.rendering.verify.record import PointMm, Symptom


def level(actuators: tuple[int, ...], level_db: float, *, reversed_: bool, silent: bool) -> Symptom:
    """One actuator's level or polarity, or that of all responses where `actuators` is empty."""
    who = f"Actuator {actuators[0]}" if actuators else "The whole surface"
    if silent:
        sentence = f"{who} does not move: its response is {number(-level_db, 'dB')} below that in the bank."
        remedy = "Check its cable, its amplifier channel and its coil."
        return Symptom("silent", actuators, level_db, "dB", sentence, remedy)
    if reversed_:
        also = f" and its level {_louder(level_db)}" if abs(level_db) >= 0.5 else ""
        sentence = f"{who} moves in the opposite direction: its polarity is reversed{also}."
        remedy = (
            f"Exchange the two wires of actuator {actuators[0]} at its amplifier channel."
            if actuators
            else "Check the wires of the loopback, the sign of the vibrometer's output, and the recorder's inputs."
        )
        return Symptom("polarity", actuators, level_db, "dB", sentence, remedy)
    if actuators:
        sentence = f"Actuator {actuators[0]} is {_louder(level_db)} than in the bank."
        remedy = f"Set the amplifier channel of actuator {actuators[0]} as it was when the bank was measured."
    else:
        sentence = f"All responses are {_louder(level_db)} than predicted."
        remedy = "Set amplifier volume, vibrometer range and sensitivity as they were when the bank was measured."
    return Symptom("level", actuators, level_db, "dB", sentence, remedy)


def delay(actuators: tuple[int, ...], late_s: float) -> Symptom:
    """One actuator's delay, or that of all responses."""
    late = f"{abs(1e3 * late_s):.2f} ms {'later' if late_s > 0.0 else 'earlier'}"
    if actuators:
        sentence = f"Actuator {actuators[0]} moves {late} than in the bank."
        remedy = "Check the latency of its output: filters, sample rate conversion, another interface or channel."
    else:
        sentence = f"All responses come {late} than predicted."
        remedy = (
            "Check inter_channel_delay_s and latency_s in the rig file, the vibrometer's filter, and that the"
            " recorder's rate is that of the bank."
        )
    return Symptom("delay", actuators, 1e3 * late_s, "ms", sentence, remedy)


def swapped(one: int, other: int) -> Symptom:
    """Two actuators play each other's drive."""
    sentence = f"Actuators {one} and {other} are swapped: each plays the drive of the other."
    remedy = f"Exchange the cables of actuators {one} and {other}, or their entries in player.channels of the rig file."
    return Symptom("swapped", (one, other), None, "", sentence, remedy)


def speed(relative: float) -> Symptom:
    """Waves are faster or slower than in the bank."""
    percent = 100.0 * relative
    sentence = f"Waves are {abs(percent):.1f} % {'faster' if percent > 0.0 else 'slower'} than in the bank."
    remedy = "The surface is warmer, colder or drier than it was: bring it back to that state, or measure a new bank."
    return Symptom("speed", (), percent, "%", sentence, remedy)


def shifted(positions: tuple[int, ...], shift_mm: PointMm, line: str) -> Symptom:
    """The positions of one grid row, or all, show the field of a neighbouring place; `line` names the grid row."""
    where = f"({shift_mm[0]:+g}, {shift_mm[1]:+g}) mm"
    if line:
        sentence = f"The grid row at {line} is shifted: its positions show the field {where} further."
        remedy = (
            "Compare their places in the position list with those of their neighbours; measure them anew with"
            " wavefocus remeasure."
        )
    else:
        sentence = f"The whole scan is shifted: every position shows the field {where} further."
        remedy = "Calibrate the mirror: the laser, the mirror or the surface has moved since the bank was measured."
    distance_mm = float(np.hypot(*shift_mm))
    return Symptom("shifted", (), distance_mm, "mm", sentence, remedy, positions=positions, shift_mm=shift_mm)


def other_levels(level_db: Float64Array) -> Symptom:
    """The levels of many actuators differ from the bank's."""
    other = np.flatnonzero(np.abs(level_db) >= 0.5)
    sentence = (
        f"Wrong bank: {len(other)} of {len(level_db)} actuators have other levels than in it"
        f" ({number(float(level_db.min()), 'dB')} to {number(float(level_db.max()), 'dB')})."
    )
    remedy = (
        "Name the bank that was measured with these actuators and amplifier settings, or measure a new one:"
        " each actuator's level is in verify.json."
    )
    return Symptom("wrong_bank", tuple(other.tolist()), None, "", sentence, remedy)


def unexplained(correlation: float, alike: float) -> Symptom:
    """No cause explains the error; with a small correlation the bank is taken for another plate's."""
    if not correlation >= alike:
        sentence = f"Wrong bank: the scan does not resemble the prediction (median correlation {number(correlation)})."
        remedy = "Name the bank that was measured on this surface with these actuators, or measure a new one."
        return Symptom("wrong_bank", (), correlation, "", sentence, remedy)
    sentence = "The error is not explained by noise, nor by an actuator, levels, delays, the grid or the wave speed."
    remedy = (
        "Look at the error map: errors in one area point to the surface or something that touches it. Measure a few"
        ' positions anew with "wavefocus remeasure" and compare.'
    )
    return Symptom("unexplained", (), None, "", sentence, remedy)


def _louder(level_db: float) -> str:
    return f"{number(abs(level_db), 'dB')} {'louder' if level_db > 0.0 else 'quieter'}"
