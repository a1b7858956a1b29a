"""The cost of look-ahead: live drives against those of the true path, by how much sources lag their positions.

Bank: the virtual soft plate with noise at -58 dB, 1500 positions, 20 actuators, 2000 taps at 10 kHz. A source of noise
from 50 to 450 Hz follows a finger, 60 positions a second, each received 0 to 8 ms after it was true. The truth is the
scene of the finger's path, rendered with all of the future known, later by the look-ahead and by the mean time from a
position to the block that it takes effect in. Figures, over 1 s that begins 0.3 s after the source:

- error: relative L2 error of the response at the position nearest to the moving source;
- prediction: relative L2 error of the drives against the scene that the session records: what prediction alone does.
  The rest of the error is the finger's sampling and jitter, which no look-ahead lessens;
- artefacts: energy further than 15 mm from the source over that at it, in dB over the truth's;
- splatter: energy of the drives above 600 Hz, of the whole; the truth's is that of the bank's noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavefocus.benchmarks.harness import Entry, Findings, Mark, relative_error
from wavefocus.benchmarks.rig_bank import QUICK_ERROR_DB, RATE_HZ, default_grid, true_bank
from wavefocus.calibration.blas import one_blas_thread
from wavefocus.config.scene import Output
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.focus_figures import FOCUS_RADIUS_MM
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.signals import Noise
from wavefocus.rendering.scene.trajectory_path import TrajectoryPath
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.output_files import replacement

LOOK_AHEADS_MS = (0, 10, 20, 30, 40, 50, 100, 150, 200, 240)
QUICK_MS = (0, 50, 240)
BLOCK_S, POSITIONS_HZ, LATEST_S = 0.005, 60.0, 0.008
LASTS_S, JUDGED_S = 1.7, (0.3, 1.3)
SIGNAL = Noise((50.0, 450.0), 0.4, 5)
FIELD_HZ = 2000.0
EVERY_ROW = 12
ABOVE_HZ = 600.0
SUFFICIENT_ERROR = 1e-3
PICTURE = "live-look-ahead.png"

Motion = Callable[[Float64Array], Float64Array]
"""Places (n, 2) in millimetres at instants (n,) in seconds."""


def _stroke(time_s: Float64Array) -> Float64Array:
    return np.stack([-60.0 + 80.0 * time_s, 5.0 + 0.0 * time_s], axis=1)


def _circle(time_s: Float64Array) -> Float64Array:
    angle = 100.0 / 25.0 * time_s
    return 25.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _to_and_fro(time_s: Float64Array) -> Float64Array:
    return np.stack([30.0 * np.sin(2.0 * np.pi * 0.8 * time_s), 1.0 + 0.0 * time_s], axis=1)


MOTIONS: dict[str, tuple[Motion, str]] = {
    "a stroke at 80 mm/s": (_stroke, "nearest"),
    "a circle of 50 mm at 100 mm/s": (_circle, "nearest"),
    "that circle, bilinear": (_circle, "bilinear"),
    "to and fro over 60 mm, up to 150 mm/s": (_to_and_fro, "nearest"),
}
"""With the interpolation of each."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The drive of a true path, its responses, and where they are looked at.

    motion, interpolation: Which path, and the bank between its positions.
    first_sample, delay_s: Where the source begins without look-ahead; mean time from a position to its block.
    focus: Place among the rows of the one nearest to the source at each sample of the field.
    far, bool (rows, samples): Rows further than 15 mm from the source.
    """

    motion: Motion
    interpolation: str
    first_sample: int
    delay_s: float
    drive: Drive
    rows: Int64Array
    focus: Int64Array
    far: BoolArray
    field: Float64Array


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Measure every motion at every look-ahead, and draw the diagram into a folder."""
    rig = VirtualRig()
    bank = true_bank(rig, default_grid(rig), QUICK_ERROR_DB)
    points = []
    with one_blas_thread():
        for name, (motion, interpolation) in list(MOTIONS.items())[: 1 if quick else None]:
            truth = _truth(bank, motion, interpolation)
            points += [_measured(bank, name, truth, ms) for ms in (QUICK_MS if quick else LOOK_AHEADS_MS)]
    if out is not None:
        _draw(out / PICTURE, points)
    return Findings(
        points,
        truth="the drives of the true path, later by the look-ahead",
        notes=[
            "From 215 ms and the time between two positions on nothing is predicted: 2000 taps, three blocks of 5 ms."
        ],
    )


def _orders(motion: Motion) -> list[tuple[int, float, Float64Array]]:
    """Block, instant and place of each position that is received."""
    time_s = np.arange(0.0, LASTS_S, 1.0 / POSITIONS_HZ)
    received_s = time_s + np.random.default_rng(1).uniform(0.0, LATEST_S, len(time_s))
    block = np.ceil(received_s / BLOCK_S).astype(np.int64)
    return list(zip(block.tolist(), time_s.tolist(), motion(time_s), strict=True))


def _scene(path: TrajectoryPath, start_s: float, interpolation: str) -> Scene:
    return Scene("finger", (Source(path, SIGNAL, start_s, repeat=True),), output=Output(interpolation=interpolation))


def _truth(bank: GreenArray, motion: Motion, interpolation: str) -> Truth:
    orders, block_samples = _orders(motion), round(BLOCK_S * RATE_HZ)
    delay_s = float(np.mean([block * BLOCK_S - time_s for block, time_s, _ in orders]))
    first = orders[0][0] * block_samples
    time_s = np.arange(0.0, LASTS_S, 1e-3)
    path = TrajectoryPath(time_s, motion(first / RATE_HZ + time_s - delay_s), np.minimum(time_s / 0.01, 1.0))
    drive, _ = render_with_report(_scene(path, first / RATE_HZ, interpolation), bank)
    at_s = np.arange(round(LASTS_S * FIELD_HZ)) / FIELD_HZ
    places_mm = motion(at_s - delay_s)
    away_mm = np.hypot(*(bank.position_mm[:, None] - places_mm).transpose(2, 0, 1))
    nearest = away_mm.argmin(axis=0)
    rows = np.union1d(np.unique(nearest), np.arange(0, bank.positions, EVERY_ROW))
    focus, far = np.searchsorted(rows, nearest), away_mm[rows] > FOCUS_RADIUS_MM
    whole = replace(drive, drive_v=drive.drive_v[:, bank.taps - 1 :], start_s=0.0)
    return Truth(motion, interpolation, first, delay_s, whole, rows, focus, far, _field(bank, whole, rows))


def _field(bank: GreenArray, drive: Drive, rows: Int64Array) -> Float64Array:
    nowhere = np.zeros(0, dtype=np.int64)
    plain = replace(drive, focus_sample=nowhere, focus_position=nowhere, focus_source=nowhere)
    return np.asarray(predict(plain, bank, rows.tolist(), rate_hz=FIELD_HZ).field, dtype=np.float64)


def _measured(bank: GreenArray, name: str, truth: Truth, look_ahead_ms: int) -> Entry:
    look_ahead = round(look_ahead_ms * RATE_HZ / 1e3)
    begin, stop = (truth.first_sample + round(one * RATE_HZ) for one in JUDGED_S)
    live_v, recorded_v = _played(bank, truth, look_ahead, stop + look_ahead)
    live = replace(truth.drive, drive_v=live_v[:, look_ahead:])
    field = _field(bank, live, truth.rows)
    judged = slice(round(begin / RATE_HZ * FIELD_HZ), round(stop / RATE_HZ * FIELD_HZ))
    columns = np.arange(judged.start, judged.stop)
    at_focus, true_focus = (one[truth.focus[judged], columns] for one in (field, truth.field))
    far = truth.far[:, judged]
    away, true_away = (
        float(np.square(one[:, judged][far]).mean() / np.square(focus).mean())
        for one, focus in ((field, at_focus), (truth.field, true_focus))
    )
    drives = [one[:, begin:stop] for one in (live.drive_v, truth.drive.drive_v)]
    splatter_db, true_splatter_db = (_splatter_db(one) for one in drives)
    prediction = relative_error(drives[0], recorded_v[:, look_ahead:][:, begin:stop])
    return Entry(
        work=name,
        method="live",
        parameters={"look_ahead_ms": float(look_ahead_ms)},
        error=relative_error(at_focus, true_focus),
        figures={
            "prediction_error": prediction,
            "artefacts_db": 10.0 * math.log10(away / true_away),
            "splatter_db": splatter_db,
            "true_splatter_db": true_splatter_db,
        },
        marks=(Mark("prediction_error", SUFFICIENT_ERROR, at_most=True),)
        if look_ahead_ms >= LOOK_AHEADS_MS[-1]
        else (),
    )


def _played(bank: GreenArray, truth: Truth, look_ahead: int, stop: int) -> tuple[Float64Array, Float64Array]:
    """Drives of a session up to a sample, and those of the scene that it records, from scene time 0."""
    block_samples = round(BLOCK_S * RATE_HZ)
    engine = LiveEngine(
        bank, block_samples=block_samples, look_ahead_samples=look_ahead, interpolation=truth.interpolation,
        signal=SIGNAL, record=True,
    )  # fmt: skip
    orders, blocks, knots = _orders(truth.motion), [], []
    while engine.next_sample < stop or orders:
        while orders and orders[0][0] * block_samples <= engine.next_sample:
            _, _, place_mm = orders.pop(0)
            engine.move("finger", (float(place_mm[0]), float(place_mm[1])))
        knots += [part.knots for part in engine.take_record()]
        blocks.append(engine.next_block())
    sample, at_mm, amplitude = (
        np.concatenate([getattr(one, part) for one in knots]) for part in ("sample", "at_mm", "amplitude")
    )
    path = TrajectoryPath((sample - sample[0]) / RATE_HZ, at_mm, amplitude)
    recorded, _ = render_with_report(_scene(path, float(sample[0] / RATE_HZ), truth.interpolation), bank)
    return np.concatenate(blocks, axis=1)[:, :stop], recorded.drive_v[:, bank.taps - 1 :]


def _splatter_db(drive_v: Float64Array) -> float:
    power = np.square(np.abs(np.fft.rfft(drive_v * np.hanning(drive_v.shape[1]), axis=1))).sum(axis=0)
    above = np.fft.rfftfreq(drive_v.shape[1], 1.0 / RATE_HZ) > ABOVE_HZ
    return float(10.0 * np.log10(power[above].sum() / power.sum()))


def _draw(path: Path, points: list[Entry]) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from wavefocus.benchmarks.page import MARKERS
    from wavefocus.rendering.report.canvas import COLOURS

    figure = Figure(figsize=(11.4, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    error, away, splatter = figure.subplots(1, 3)
    for number, name in enumerate(dict.fromkeys(one.work for one in points)):
        mine = [one for one in points if one.work == name]
        ms = [one.parameters["look_ahead_ms"] for one in mine]
        style = {"color": COLOURS[number], "marker": MARKERS[number], "markersize": 4.5, "linewidth": 1.3}
        error.plot(ms, [100.0 * (one.error or 0.0) for one in mine], label=name, **style)
        predicted = [100.0 * float(one.figures["prediction_error"] or 0.0) for one in mine]
        error.plot(ms, predicted, linestyle=":", **{**style, "marker": ""})
        away.plot(ms, [one.figures["artefacts_db"] for one in mine], **style)
        splatter.plot(ms, [one.figures["splatter_db"] for one in mine], **style)
    error.plot([], [], color="#666666", linestyle=":", label="of the drives, by prediction alone")
    error.set(ylabel="%", title="Error at the focus", yscale="log", ylim=(1e-3, 100.0))
    error.yaxis.set_major_formatter("{x:g}")
    away.set(ylabel="dB over the true path's", title="Energy beyond 15 mm")
    splatter.set(ylabel="dB", title="Energy of the drives above 600 Hz")
    for axes in (error, away, splatter):
        axes.set_xlabel("look-ahead (ms)")
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    with replacement(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")
