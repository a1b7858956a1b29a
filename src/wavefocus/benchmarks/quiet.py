"""Quiet places: levels against drive energy and peak voltage, on all plates; error and run time, resting and moving.

Noise of 50 to 450 Hz for 0.5 s, focused near the middle of the plate; banks of 20 actuators with noise at -58 dB,
positions 4 mm apart. Figures:

- plain: level at the loudest quiet place with plain time reversal, energy over that at the focus;
- level: the same with quiet places, by the prediction of the whole drive;
- energy, peak: of the drives, over plain time reversal's; of random layouts also what 90 % of them keep to;
- truth: the level by the plate's own Green's functions at the very place, off the grid.

Each level is asked for to within 10 times the energy; what that cannot buy is what the level falls short by.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times, measure
from wavefocus.benchmarks.plate import RIGS
from wavefocus.benchmarks.rig_bank import QUICK_ERROR_DB, default_grid, true_bank
from wavefocus.config.scene import Output
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.field.quiet_levels import quiet_levels
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import QuietPlace, Scene, Source
from wavefocus.rendering.scene.paths import Circle, Point
from wavefocus.rendering.scene.signals import Noise
from wavefocus.storage.drive_file import Drive

PLATES = ("soft", "stadium", "thin", "solid")
NOISE = Noise((50.0, 450.0), 0.5, 1)
FINGERS = ((1, 12.0), (1, 24.0), (4, 12.0), (4, 24.0), (4, 40.0), (9, 30.0))
MARKS = {(4, 24.0): 3.0, (1, 12.0): 2.5}
"""Energy that nine of ten random layouts are to keep to, on the gels."""
CROSS = ((24.0, 0.0), (0.0, 24.0), (-24.0, 0.0), (0.0, -24.0))
CAP = 10.0


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Measure all works."""
    banks = {}
    for name in PLATES[:2] if quick else PLATES:
        rig = VirtualRig(RIGS[name])
        position_mm = default_grid(rig)
        # Banks keep to a square of 100 mm.
        banks[name] = rig, true_bank(rig, position_mm[(np.abs(position_mm) < 50.0).all(axis=1)], QUICK_ERROR_DB)
    points = [one for name, (_, bank) in banks.items() for one in _random_layouts(name, bank, 4 if quick else 10)]
    points += [cross(name, bank) for name, (_, bank) in banks.items()]
    points += [disc(name, bank, places) for name, (_, bank) in banks.items() for places in (CROSS[:1], CROSS)]
    points += [_off_grid(name, rig, bank) for name, (rig, bank) in banks.items()]
    speeds_mm_s = (100.0,) if quick else (25.0, 100.0, 400.0)
    points += [moving(name, banks[name][1], speed) for name in PLATES[:1] for speed in speeds_mm_s]
    points += [one for name in PLATES[:1] for one in _run_times(banks[name][1], 1 if quick else 3)]
    return Findings(
        points, notes=[f"Levels are in dB; at most {CAP:g} times the energy of plain time reversal is spent."]
    )


def _random_layouts(plate: str, bank: GreenArray, count: int) -> list[Entry]:
    """Points at -30 dB in random directions, by number and distance of the fingers."""
    rng, points = np.random.default_rng(5), []
    for fingers, distance_mm in FINGERS:
        found = []
        for _ in range(count):
            focus_mm = _on_grid(bank, rng.uniform(-8.0, 8.0, 2))
            places = _around(rng, bank, focus_mm, fingers, distance_mm)
            found.append(_figures(bank, scene_of(focus_mm, places)))
        table = {name: np.array([one[name] for one in found]) for name in found[0]}
        limit = MARKS.get((fingers, distance_mm)) if plate in ("soft", "stadium") else None
        marks = (
            () if limit is None else (Mark("energy_90", limit, at_most=True), Mark("level_90_db", -29.5, at_most=True))
        )
        points.append(
            Entry(
                work=f"points in random layouts, -30 dB, {count} each", method=plate,
                parameters={"fingers": float(fingers), "distance_mm": distance_mm},
                figures={
                    "plain_db": float(np.median(table["plain_db"])), "level_db": float(np.median(table["level_db"])),
                    "energy": float(np.median(table["energy"])), "peak": float(np.median(table["peak"])),
                    "level_90_db": float(np.quantile(table["level_db"], 0.9)),
                    "energy_90": float(np.quantile(table["energy"], 0.9)),
                },
                marks=marks,
            )
        )  # fmt: skip
    return points


def cross(plate: str, bank: GreenArray) -> Entry:
    """Four points about the focus at -30 dB."""
    marks = (
        (Mark("energy", 7.0, at_most=True), Mark("peak", 1.5, at_most=True), Mark("level_db", -29.5, at_most=True))
        if plate == "soft"
        else ()
    )
    return Entry(
        work="cross of four at 24 mm, -30 dB", method=plate, figures=_figures(bank, _about(bank, CROSS)), marks=marks
    )


def disc(plate: str, bank: GreenArray, places: Sequence[tuple[float, float]]) -> Entry:
    """Fingertips of 4 mm radius: one at -30 dB, four at -15 dB."""
    level_db, most = (-30.0, 3.0) if len(places) == 1 else (-15.0, 6.0)
    scene = _about(bank, places, radius_mm=4.0, level_db=level_db)
    marks = Mark("energy", most, at_most=True), Mark("level_db", level_db + 0.5, at_most=True)
    return Entry(
        work="discs of 4 mm radius at 24 mm", method=plate,
        parameters={"fingers": float(len(places)), "asked_db": level_db}, figures=_figures(bank, scene),
        marks=marks if plate == "soft" else (),
    )  # fmt: skip


def _off_grid(plate: str, rig: VirtualRig, bank: GreenArray) -> Entry:
    """Four points at 24 mm in the middle of grid cells: the level by the plate's own Green's functions there."""
    focus_mm = _on_grid(bank, (0.0, 0.0))
    places = [tuple((_on_grid(bank, focus_mm + np.array(one)) + 2.0).tolist()) for one in CROSS]
    scene = scene_of(focus_mm, places)
    drive, _ = render_with_report(scene, bank)
    figures = _figures(bank, scene, drive)
    truth = true_bank(rig, np.array([*places, focus_mm]), None)
    power = np.square(predict(drive, truth).field).sum(axis=1)
    true_db = float(10 * np.log10(power[:-1].max() / power[-1]))
    marks = (Mark("truth_db", -28.0, at_most=True),) if plate in ("soft", "stadium") else ()
    return Entry(
        work="four points off the grid, -30 dB", method=plate, figures={**figures, "truth_db": true_db}, marks=marks
    )


def moving(plate: str, bank: GreenArray, speed_mm_s: float) -> Entry:
    """Four points on a circle of 24 mm about the focus, all of which move along it."""
    focus_mm = _on_grid(bank, (0.0, 0.0))
    paths = [Circle(tuple(focus_mm.tolist()), 24.0, 1.0, 90.0 * quarter) for quarter in range(4)]
    scene = Scene(
        "moving", (Source(Point(tuple(focus_mm.tolist())), NOISE),), output=Output(most_energy=CAP),
        quiet=tuple(QuietPlace(one, speed_mm_s, level_db=-26.0) for one in paths),
    )  # fmt: skip
    timing = measure({"ours": partial(render_with_report, scene, bank)}, 1)["ours"]
    marks = Mark("level_db", -25.0, at_most=True), Mark("energy", 4.0, at_most=True)
    return Entry(
        work="four points that move on a circle of 24 mm, -26 dB", method=plate, parameters={"speed_mm_s": speed_mm_s},
        timing=timing, figures=_figures(bank, scene, timing.result[0]),
        marks=marks if speed_mm_s == 100.0 else (),
    )  # fmt: skip


def _run_times(bank: GreenArray, repeats: int) -> list[Entry]:
    """Time to render 4 s, without quiet places and with four: points of the bank, off the grid, and moving."""
    focus_mm = _on_grid(bank, (0.0, 0.0))
    noise = Noise((50.0, 450.0), 4.0, 1)
    on = [tuple(_on_grid(bank, focus_mm + np.array(one)).tolist()) for one in CROSS]
    off = [(x + 2.0, y + 2.0) for x, y in on]
    resting = Source(Point(tuple(focus_mm.tolist())), noise)
    circle = Source(Circle(tuple(focus_mm.tolist()), 10.0, 5.0), noise, 0.0, 80.0, 2.0)
    points = []
    for name, source in (("resting", resting), ("moving", circle)):
        scenes = {
            "plain": Scene("time", (source,)),
            "four points": Scene("time", (source,), quiet=tuple(QuietPlace(Point(one)) for one in on)),
            "four points off the grid": Scene("time", (source,), quiet=tuple(QuietPlace(Point(one)) for one in off)),
        }
        found = measure(
            {key: partial(render_with_report, one, bank) for key, one in scenes.items()}, repeats, warm=True
        )
        plain: Times = found["plain"]
        points += [
            Entry(work=f"render 4 s, {name} source", method=key, timing=timing,
                  figures={"of_plain": timing.cpu_s / plain.cpu_s},
                  marks=(Mark("of_plain", 5.0, at_most=True),) if key == "four points" else ())
            for key, timing in found.items()
        ]  # fmt: skip
    return points


def scene_of(
    focus_mm: Float64Array,
    places: Sequence[tuple[float, float]],
    *,
    radius_mm: float = 0.0,
    level_db: float = -30.0,
) -> Scene:
    """Noise focused at a point, with quiet places at others."""
    return Scene(
        "quiet", (Source(Point(tuple(focus_mm.tolist())), NOISE),),
        output=Output(most_energy=CAP), quiet=tuple(QuietPlace(Point(one), 0.0, radius_mm, level_db) for one in places),
    )  # fmt: skip


def _about(bank: GreenArray, places: Sequence[tuple[float, float]], **keys: object) -> Scene:
    focus_mm = _on_grid(bank, (0.0, 0.0))
    there = [tuple(_on_grid(bank, focus_mm + np.array(one)).tolist()) for one in places]
    return scene_of(focus_mm, there, **keys)  # type: ignore[arg-type]


def _figures(bank: GreenArray, scene: Scene, drive: Drive | None = None) -> dict[str, float]:
    """Levels of the loudest place, energy and peak of the drives."""
    plain, _ = render_with_report(Scene(scene.name, scene.sources), bank)
    made = drive if drive is not None else render_with_report(scene, bank)[0]
    before = quiet_levels(replace(plain, quiet=made.quiet), bank)
    return {
        "plain_db": max(one.reached_db for one in before),
        "level_db": max(one.reached_db for one in quiet_levels(made, bank)),
        "energy": float(np.square(made.drive_v).sum() / np.square(plain.drive_v).sum()),
        "peak": float(np.abs(made.drive_v).max() / np.abs(plain.drive_v).max()),
    }


def _on_grid(bank: GreenArray, at_mm: Float64Array | tuple[float, float]) -> Float64Array:
    return np.asarray(bank.position_mm[int(np.argmin(np.hypot(*(bank.position_mm - at_mm).T)))])


def _around(
    rng: np.random.Generator, bank: GreenArray, focus_mm: Float64Array, fingers: int, distance_mm: float
) -> list[tuple[float, float]]:
    """Positions of the bank about so far from the focus, and from each other at least 10 mm."""
    apart = np.hypot(*(bank.position_mm - focus_mm).T)
    ring = bank.position_mm[np.abs(apart - distance_mm) < 3.0]
    chosen: list[Float64Array] = []
    for at_mm in ring[rng.permutation(len(ring))]:
        if all(np.hypot(*(at_mm - one)) >= 10.0 for one in chosen):
            chosen.append(at_mm)
        if len(chosen) == fingers:
            break
    return [(float(x), float(y)) for x, y in chosen]
