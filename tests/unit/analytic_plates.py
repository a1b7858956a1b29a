"""Plates by their own equations, independent of the product's, with faults: for causes that `verify` names.

`gel`: Hankel waves of an unbounded gel, and two echoes. `mirrors`: a rectangle of gel by mirror images. `disk`: a
clamped disk by Bessel series. `bending`: a simply supported rectangle of glass by its modes. Banks are the plates'
Green's functions with noise at -55 dB, scans are responses of the changed rig with noise at -40 dB.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy.fft
import scipy.special

from tests.unit.independent_plates import disk as membrane
from tests.unit.independent_plates import reflected
from tests.unit.line_verification import scan_of
from wavefocus import GreenArray, Line, Noise, Scene, Source, predict
from wavefocus.config.scene import Output
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.verify.results import Sentinel
from wavefocus.rendering.verify.verdict import compare

NEAREST = Output(interpolation="nearest")

RATE_HZ, TAPS, BAND_HZ = 4000.0, 800, (40.0, 500.0)
BANK_ERROR, SCAN_NOISE = 10 ** (-55 / 20), 10 ** (-40 / 20)
ACTUATORS = 12
LENGTH = 2 * TAPS
FREQUENCY_HZ = np.fft.rfftfreq(LENGTH, 1.0 / RATE_HZ)
USED = np.flatnonzero((FREQUENCY_HZ >= 25.0) & (FREQUENCY_HZ <= 575.0))
OMEGA = 2.0 * np.pi * FREQUENCY_HZ[USED]
FADE = (
    np.sin(0.5 * np.pi * np.clip((FREQUENCY_HZ[USED] - 25) / 15, 0, 1) * np.clip((575 - FREQUENCY_HZ[USED]) / 75, 0, 1))
    ** 2
)


@dataclass(frozen=True)
class Medium:
    """What of a plate changes: speed and loss as factors, a mass in kg at a place in mm."""

    speed: float = 1.0
    loss: float = 1.0
    mass: float = 0.0
    mass_mm: tuple[float, float] = (9.0, -7.0)


def wavenumber(medium, speed_m_s):
    """Of waves whose speed grows a little with frequency, in rad/mm."""
    speed_mm_s = 1e3 * medium.speed * speed_m_s * (OMEGA / 1257.0) ** 0.06
    return OMEGA / speed_mm_s * (1.0 - 0.04j * medium.loss)


def gel(place_mm, source_mm, medium):
    echoes = ((1.0, 1.0), (1.3, 0.3), (-1.45, 0.2))
    k = wavenumber(medium, 5.2)
    waves = (gain * reflected(k, place_mm, scale * source_mm, 0.0, 0.0, 0) for scale, gain in echoes)
    return 1e-2 * OMEGA * sum(waves)


def mirrors(place_mm, source_mm, medium):
    images = reflected(wavenumber(medium, 6.5), place_mm, source_mm, np.array([210.0, 140.0]), -0.85, 1)
    return 1e-2 * OMEGA * images


def disk(place_mm, source_mm, medium):
    """A membrane, clamped at a radius of 125 mm: sum over Bessel modes."""
    speed, loss = 7.5 * medium.speed, 0.07 * medium.loss
    hertz = FREQUENCY_HZ[USED]
    return membrane(place_mm, source_mm, hertz, speed_m_s=speed, loss=loss, radius_mm=125.0, modes=(40, 24))


def bending(place_mm, source_mm, medium):
    """A simply supported plate of glass, 300 x 200 x 0.5 mm: sum over its modes up to 2500 Hz."""
    width, height, stiffness, mass = 0.30, 0.20, 70e9 * 0.0005**3 / 12 / 0.94, 2500 * 0.0005
    m, n = (mode.ravel() for mode in np.meshgrid(np.arange(1, 22), np.arange(1, 16)))
    omega = np.sqrt(stiffness / mass) * medium.speed**2 * np.pi**2 * ((m / width) ** 2 + (n / height) ** 2)
    m, n, omega = (one[omega <= 2 * np.pi * 2500] for one in (m, n, omega))
    here, there = (
        np.sin(np.pi * np.outer(x, m / width)) * np.sin(np.pi * np.outer(y, n / height))
        for x, y in ((points * 1e-3 + np.array([width, height]) / 2).T for points in (place_mm, source_mm))
    )
    mode = omega[:, None] ** 2 * (1.0 + 0.12j * medium.loss) - OMEGA**2
    return (here[:, None] * there) @ (4j * OMEGA / (mass * width * height) / mode)


PLATES = {"gel": gel, "mirrors": mirrors, "disk": disk, "bending": bending}
PITCH_MM = {"bending": 10.0}
SHAPE = {"bending": (85.0, 60.0)}


def places_mm(plate):
    pitch = PITCH_MM.get(plate, 4.0)
    x, y = np.meshgrid(pitch * (np.arange(9) - 4), pitch * (np.arange(7) - 3))
    return np.c_[x.ravel(), y.ravel()].astype(float)


def actuators_mm(plate):
    angle = 2 * np.pi * (np.arange(ACTUATORS) + 0.3) / ACTUATORS
    return np.array(SHAPE.get(plate, (85.0, 58.0))) * np.stack([np.cos(angle), np.sin(angle)], 1)


@cache
def _green(plate, medium, places):
    place_mm, source_mm = np.frombuffer(places).reshape(-1, 2), actuators_mm(plate)
    transfer = PLATES[plate]
    spectra = np.asarray(transfer(place_mm, source_mm, medium))
    if medium.mass > 0.0:
        at = np.array([medium.mass_mm])
        own, to, come = transfer(at + 1.5, at, medium), transfer(place_mm, at, medium), transfer(at, source_mm, medium)
        # Velocity at the mass pulls it with a force of -j omega m v.
        pull = -1j * OMEGA * medium.mass / (1.0 + 1j * OMEGA * medium.mass * own)
        spectra = spectra + to * pull * come
    whole = np.zeros((*spectra.shape[:2], len(FREQUENCY_HZ)), complex)
    whole[..., USED] = spectra * FADE
    return scipy.fft.irfft(whole, LENGTH)[..., :TAPS]


def green(plate, medium=Medium(), place_mm=None):
    place = places_mm(plate) if place_mm is None else place_mm
    return _green(plate, medium, np.ascontiguousarray(place, float).tobytes())


@cache
def lab(plate):
    rng = np.random.default_rng([5, len(plate)])
    bank = GreenArray(
        noisy(green(plate), rng), places_mm(plate), RATE_HZ, actuator_mm=actuators_mm(plate), band_hz=BAND_HZ
    )
    pitch = PITCH_MM.get(plate, 4.0)
    path = Line((-2 * pitch, -pitch), (2 * pitch, pitch))
    source = Source(path, Noise(BAND_HZ, 0.04, 1), speed_mm_s=25 * pitch, step_mm=pitch, emission="per_point")
    return bank, render_with_report(Scene("stroke", (source,), output=NEAREST), bank)[0]


def noisy(values, rng):
    level = BANK_ERROR * np.linalg.norm(values, axis=2, keepdims=True) / np.sqrt(values.shape[2])
    return (values + level * rng.standard_normal(values.shape)).astype(np.float32)


def verified(plate, values, cubic=0.0, *, quiet_db=None):
    """The comparison of a scan of such Green's functions, and of a cubic distortion of the response."""
    (bank, drive), rng = lab(plate), np.random.default_rng([7, 1])

    def scan(factor):
        field = np.asarray(predict(drive, replace(bank, values=values)).field, float)
        loudest = np.abs(field).max()
        field = factor * field / loudest
        field = loudest * (field + cubic * field**3)
        noise = SCAN_NOISE * np.sqrt(np.mean(field**2))
        return scan_of(field + noise * rng.standard_normal(field.shape), drive.start_s, RATE_HZ, noise)

    row = len(bank.position_mm) // 2 + 3
    sentinel = Sentinel(row, noisy(values[[row]], rng)[0], np.full(ACTUATORS, 55.0, np.float32))
    return compare(
        predict(drive, bank), scan(1.0), drive, bank, sentinel=sentinel,
        quiet=None if quiet_db is None else scan(10 ** (-quiet_db / 20)),
    )  # fmt: skip


def driven(values, actuators, factor, late_ms):
    """Green's functions where the drives of some actuators have another level and come later."""
    turn = np.ones((ACTUATORS, len(FREQUENCY_HZ)), complex)
    turn[list(actuators)] = factor * np.exp(-2e-3j * np.pi * late_ms * FREQUENCY_HZ)
    return np.fft.irfft(np.fft.rfft(values, LENGTH) * turn, LENGTH)[..., :TAPS]
