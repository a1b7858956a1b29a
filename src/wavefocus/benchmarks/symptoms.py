"""Causes of a failed verification, simulated one by one on four plates, and what `verify` calls them.

Banks are the plates' true Green's functions with noise at -55 dB; scans are predicted from the true Green's functions
of the changed rig, with noise. Each case has one cause of random size, at random actuators. A name is wrong if it is
certain and not the cause's; a cause without a name (a finger that rests on the plate) may have none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from wavefocus.benchmarks.harness import Entry, Findings, Mark
from wavefocus.config.outline import Outline
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.metrics import band_weights
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Line
from wavefocus.rendering.scene.signals import Noise
from wavefocus.rendering.verify.results import Sentinel, Symptom
from wavefocus.rendering.verify.scan import Scan
from wavefocus.rendering.verify.verdict import Verification, compare
from wavefocus.storage.drive_file import Drive

Float64Array = NDArray[np.float64]

RATE_HZ, TAPS, BAND_HZ = 4000.0, 800, (40.0, 500.0)
BANK_ERROR, SCAN_NOISE = 10 ** (-55 / 20), 10 ** (-40 / 20)
ACTUATORS = 10
STEPS = np.arange(6) - 2.5
PITCH_MM = {"thin": 10.0}
"""Of the grid, where it is not 4 mm: waves on glass are long."""
OUTLINES = {"thin": Outline.rectangle(250.0, 170.0)}
STADIUM = Outline.stadium(160.0, 110.0)
PLATES = ("soft", "stadium", "thin", "solid")
KEYS: dict[str, dict[str, Any]] = {"thin": {"quality": 30.0}}
FINGER = {"mass_kg": 0.0, "damping_n_s_m": 0.0, "stiffness_n_m": 0.0}
CASES, QUICK_CASES = 36, 18


def places_mm(plate: str) -> Float64Array:
    """Positions of a plate's bank, (36, 2)."""
    pitch_mm = PITCH_MM.get(plate, 4.0)
    return np.stack(np.meshgrid(pitch_mm * STEPS, pitch_mm * STEPS), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class Rig:
    """A plate as its settings say: true Green's functions at places."""

    plate: str
    keys: tuple[tuple[str, Any], ...] = ()
    warmer_k: float = 0.0

    def green(self, position_mm: Float64Array) -> Float64Array:
        """Green's functions within the band, float64 (positions, actuators, taps)."""
        rig = _rig(self)
        length = int(scipy_fft.next_fast_len(2 * TAPS, real=True))
        weights = band_weights(length, RATE_HZ, BAND_HZ)
        used = np.flatnonzero(weights)
        bins = slice(int(used[0]), int(used[-1]) + 1)
        whole = np.zeros((len(position_mm), ACTUATORS, length // 2 + 1), np.complex128)
        whole[..., bins] = rig.truth_spectra(position_mm, TAPS, length, bins, RATE_HZ) * weights[bins]
        return np.asarray(scipy_fft.irfft(whole, length, axis=2)[..., :TAPS])


@cache
def _rig(rig: Rig) -> VirtualRig:
    outline = OUTLINES.get(rig.plate, STADIUM)
    inner = Outline.stadium(220.0, 145.0) if rig.plate == "thin" else Outline.stadium(140.0, 90.0)
    actuator_mm = inner.at((np.arange(ACTUATORS) + 0.4) * inner.perimeter_mm / ACTUATORS)
    keys = KEYS.get(rig.plate, {}) | {"speed_per_k": 0.0, "loss_per_k": 0.0} | dict(rig.keys)
    return VirtualRig(
        VirtualSettings(
            seed=3,
            plate=rig.plate,
            plate_keys=tuple(keys.items()),
            outline=outline,
            actuator_mm=tuple((float(x), float(y)) for x, y in actuator_mm),
            room_c=((0.0, 21.0 + rig.warmer_k),),
        )
    )


@dataclass(frozen=True, slots=True)
class SymptomCase:
    """One cause: the code that it should get and the actuators, and what a scan shows under it.

    green: Green's functions of the changed rig.
    sentinel: Those of the sentinel position measured again; as `green` by default.
    respond, drive: What happens to responses (positions, samples), relative to their largest, and to drives.
    code: None where no cause has the name: then anything certain is wrong.
    """

    cause: str
    code: str | None
    actuators: tuple[int, ...] | None
    green: Float64Array
    respond: Callable[[Float64Array], Float64Array] = field(default=lambda response: response)
    drive: Callable[[Float64Array], Float64Array] = field(default=lambda drive: drive)
    size: str = ""


@dataclass(frozen=True, slots=True)
class Lab:
    """A plate with its bank, a scene's drive, and the truth."""

    plate: str
    truth: Float64Array
    bank: GreenArray
    drive: Drive

    def verified(self, case: SymptomCase, rng: np.random.Generator, *, again: bool = True) -> Verification:
        """The verification of a scan under one cause; `again`: with the sentinel position measured again."""
        drive = replace(self.drive, drive_v=case.drive(self.drive.drive_v))
        field = np.asarray(predict(drive, replace(self.bank, values=case.green)).field, np.float64)
        loudest = float(np.abs(field).max())
        field = loudest * case.respond(field / loudest)
        noise = SCAN_NOISE * float(np.sqrt(np.mean(field**2)))
        field = field + noise * rng.standard_normal(field.shape)
        count = len(self.truth)
        scan = Scan(
            field.astype(np.float32), np.arange(count), RATE_HZ, self.drive.start_s, "m/s", np.ones(count, np.uint8),
            np.ones(count, np.int64), np.full(count, noise), np.ones(count), np.ones(count),
        )  # fmt: skip
        row = count // 2 + 3
        sentinel = Sentinel(row, _noisy(case.green[[row]], rng)[0], np.full(ACTUATORS, 55.0, np.float32))
        return compare(
            predict(self.drive, self.bank), scan, self.drive, self.bank, sentinel=sentinel if again else None
        )


@cache
def lab(plate: str) -> Lab:
    """A plate with its bank and a drive."""
    rng = np.random.default_rng([5, len(plate)])
    position_mm = places_mm(plate)
    truth = Rig(plate).green(position_mm)
    actuator_mm = np.asarray(_rig(Rig(plate)).settings.actuator_mm)
    bank = GreenArray(_noisy(truth, rng), position_mm, RATE_HZ, actuator_mm=actuator_mm, band_hz=BAND_HZ)
    signal = Noise(BAND_HZ, 0.04, 1)
    pitch_mm = PITCH_MM.get(plate, 4.0)
    path = Line((-1.5 * pitch_mm, -0.5 * pitch_mm), (1.5 * pitch_mm, 0.5 * pitch_mm))
    source = Source(path, signal, speed_mm_s=25.0 * pitch_mm, step_mm=pitch_mm, emission="per_point")
    drive, _ = render_with_report(Scene("stroke", (source,)), bank)
    return Lab(plate, truth, bank, drive)


def _noisy(green: Float64Array, rng: np.random.Generator) -> NDArray[np.float32]:
    noise = rng.standard_normal(green.shape)
    noise *= BANK_ERROR * np.linalg.norm(green, axis=2, keepdims=True) / np.sqrt(green.shape[2])
    return (green + noise).astype(np.float32)


def _some(rng: np.random.Generator, least: int = 1, most: int = ACTUATORS - 1) -> list[int]:
    return sorted(rng.permutation(ACTUATORS)[: rng.integers(least, most + 1)].tolist())


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _driven(lab: Lab, cause: str, code: str, chosen: Sequence[int], factor: float, size: str = "") -> SymptomCase:
    each = np.ones(ACTUATORS)
    each[list(chosen)] = factor
    all_of_them = len(chosen) == ACTUATORS
    actuators = () if all_of_them else tuple(chosen)
    return SymptomCase(cause, code, actuators, lab.truth * each[:, None], size=size)


def _delayed(lab: Lab, cause: str, chosen: Sequence[int], late_s: float) -> SymptomCase:
    each_s = np.zeros(ACTUATORS)
    each_s[list(chosen)] = late_s
    length = 2 * TAPS
    turn = np.exp(-2j * np.pi * each_s[:, None] * np.fft.rfftfreq(length, 1.0 / RATE_HZ))
    green = np.fft.irfft(np.fft.rfft(lab.truth, length) * turn, length)[..., :TAPS]
    actuators = () if len(chosen) == ACTUATORS else tuple(chosen)
    return SymptomCase(cause, "delay", actuators, green, size=f"{1e3 * late_s:.2f} ms")


def _mirrored(lab: Lab, code: str, matrix: Float64Array, offset_mm: Float64Array, size: str) -> SymptomCase:
    return SymptomCase(code, code, (), Rig(lab.plate).green(places_mm(lab.plate) @ matrix.T + offset_mm), size=size)


def polarity(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """Crossed wires of some actuators."""
    return _driven(lab, "polarity", "polarity", _some(rng, 1, 4), -1.0)


def silent(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """Actuators that do not move."""
    return _driven(lab, "silent", "silent", _some(rng, 1, 3), 0.0)


def level_of_one(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """One actuator's level."""
    db = _sign(rng) * rng.uniform(2.0, 6.0)
    return _driven(lab, "level of one", "level", _some(rng, 1, 1), 10 ** (db / 20), f"{db:.1f} dB")


def level_of_some(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """The level of some actuators alike."""
    db = _sign(rng) * rng.uniform(1.0, 6.0)
    return _driven(lab, "level of some", "level", _some(rng, 2), 10 ** (db / 20), f"{db:.1f} dB")


def level_of_all(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """The level of all responses."""
    db = _sign(rng) * rng.uniform(0.7, 6.0)
    return _driven(lab, "level of all", "level", range(ACTUATORS), 10 ** (db / 20), f"{db:.1f} dB")


def delay_of_one(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """One actuator's delay."""
    return _delayed(lab, "delay of one", _some(rng, 1, 1), _sign(rng) * rng.uniform(2e-4, 2e-3))


def delay_of_some(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """The delay of some actuators alike."""
    return _delayed(lab, "delay of some", _some(rng, 2), _sign(rng) * rng.uniform(1e-4, 1e-3))


def delay_of_all(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """The delay of all responses."""
    return _delayed(lab, "delay of all", range(ACTUATORS), _sign(rng) * rng.uniform(5e-5, 2e-3))


def swapped(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """Two exchanged cables."""
    chosen = _some(rng, 2, 2)
    order = np.arange(ACTUATORS)
    order[chosen] = order[chosen[::-1]]
    return SymptomCase("swapped", "swapped", tuple(chosen), lab.truth[:, order])


def shifted(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """A mirror that aims beside."""
    angle, far_mm = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.15, 1.2) * PITCH_MM.get(lab.plate, 4.0)
    return _mirrored(lab, "shifted", np.eye(2), far_mm * np.array([np.cos(angle), np.sin(angle)]), f"{far_mm:.1f} mm")


def rotated(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """A mirror that is turned."""
    deg = _sign(rng) * rng.uniform(4.0, 20.0)
    cos, sin = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return _mirrored(lab, "rotated", np.array([[cos, -sin], [sin, cos]]), np.zeros(2), f"{deg:.1f} deg")


def scaled(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """A mirror that moves too far, or not far enough."""
    factor = 1.0 + _sign(rng) * rng.uniform(0.06, 0.25)
    return _mirrored(lab, "scaled", factor * np.eye(2), np.zeros(2), f"{100 * factor - 100:.0f} %")


def speed(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """Faster or slower waves."""
    change = _sign(rng) * rng.uniform(0.012, 0.05)
    green = Rig(lab.plate, (("speed_per_k", change),), 1.0).green(places_mm(lab.plate))
    return SymptomCase("speed", "speed", (), green, size=f"{100 * change:.1f} %")


def damping(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """Other losses in the plate."""
    change = float(rng.choice([-0.4, -0.25, 0.25, 0.5, 1.0]))
    green = Rig(lab.plate, (("loss_per_k", change),), 1.0).green(places_mm(lab.plate))
    return SymptomCase("damping", "damping", (), green, size=f"{100 * change:.0f} %")


def cubic_response(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """A cubic vibrometer or plate."""
    share = _sign(rng) * rng.uniform(0.3, 1.0)
    return replace(
        SymptomCase("nonlinear response", "nonlinear", (), lab.truth, size=f"{share:.2f}"),
        respond=lambda response: response + share * response**3,
    )


def clipped_drive(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """An amplifier that clips."""
    limit = rng.uniform(0.4, 0.7)
    return replace(
        SymptomCase("clipped drive", "nonlinear", (), lab.truth, size=f"{limit:.2f}"),
        drive=lambda drive: np.clip(drive, -limit * np.abs(drive).max(), limit * np.abs(drive).max()),
    )


def cubic_drive(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """Cubic amplifiers or coils."""
    share = _sign(rng) * rng.uniform(0.3, 1.0)
    return replace(
        SymptomCase("nonlinear drive", "nonlinear", (), lab.truth, size=f"{share:.2f}"),
        drive=lambda drive: drive + share * drive * (drive / np.abs(drive).max()) ** 2,
    )


def finger(lab: Lab, rng: np.random.Generator) -> SymptomCase:
    """Mass, damper or spring at one place: no cause that has a name."""
    kind = str(rng.choice(["mass_kg", "damping_n_s_m", "stiffness_n_m"]))
    size = {"mass_kg": 2e-3, "damping_n_s_m": 2.0, "stiffness_n_m": 3e3}[kind] * float(rng.choice([0.5, 1.0, 2.0]))
    place_mm = tuple(rng.uniform((-30.0, -20.0), (30.0, 20.0)).round().tolist())
    keys = FINGER | {"place_mm": place_mm, kind: size}
    green = Rig(lab.plate, (("finger", _Frozen(keys)),)).green(places_mm(lab.plate))
    return SymptomCase("finger", None, None, green, size=f"{kind} {size:g} at {place_mm}")


class _Frozen(dict[str, Any]):
    """A table of keys that can be cached by."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(sorted(self.items())))


CAUSES: tuple[Callable[[Lab, np.random.Generator], SymptomCase], ...] = (
    polarity, silent, level_of_one, level_of_some, level_of_all, delay_of_one, delay_of_some, delay_of_all, swapped,
    shifted, rotated, scaled, speed, damping, cubic_response, cubic_drive, clipped_drive, finger,
)  # fmt: skip


def outcome(case: SymptomCase, found: Verification) -> str:
    """``named``, ``guessed`` (not certain), ``unexplained``, ``passed``, or ``wrong``."""
    right = [_is(case, symptom) for symptom in found.symptoms]
    certain = [symptom.certain for symptom in found.symptoms]
    if any(sure and not fits for sure, fits in zip(certain, right, strict=True)):
        return "wrong"
    if any(sure and fits for sure, fits in zip(certain, right, strict=True)):
        return "named"
    if any(right):
        return "guessed"
    return "unexplained" if found.symptoms else "passed" if found.passed else "unnamed"


def _is(case: SymptomCase, symptom: Symptom) -> bool:
    return symptom.code == case.code and (case.actuators is None or symptom.actuators == case.actuators)


def cases(plate: str, count: int, seed: int = 1) -> Iterator[tuple[SymptomCase, np.random.Generator]]:
    """Random cases on a plate: each cause in turn."""
    for number in range(count):
        rng = np.random.default_rng([seed, PLATES.index(plate), number])
        yield CAUSES[number % len(CAUSES)](lab(plate), rng), rng


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Count outcomes by cause and plate."""
    points = []
    for plate in ("soft",) if quick else PLATES:
        found: dict[str, list[str]] = {}
        for case, rng in cases(plate, QUICK_CASES if quick else CASES):
            verification = lab(plate).verified(case, rng)
            found.setdefault(case.cause, []).append(outcome(case, verification))
        for cause, outcomes in found.items():
            words = ("named", "guessed", "unexplained", "passed", "wrong")
            figures = {word: float(outcomes.count(word)) for word in words}
            marks = (Mark("wrong", 0.0, at_most=True),)
            points.append(Entry(work=cause, method=plate, parameters={}, figures=figures, marks=marks))
    return Findings(sorted(points, key=lambda point: point.work), "the cause that was simulated")
