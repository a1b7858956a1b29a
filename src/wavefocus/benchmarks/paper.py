"""The paper's figures on the virtual rig, with a table of its numbers and ours, misses included.

Two plates: the gel without a rim, fitted to the paper's group velocity and attenuation (`wavefocus.mocks.plates.soft`),
and a stadium of the same gel whose rim reflects half of the amplitude or less (`wavefocus.mocks.plates.stadium`). The
figures are drawn on the stadium. The actuators lie on the rim.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from wavefocus.benchmarks import paper_figures as figures
from wavefocus.benchmarks.harness import Entry, Findings, measure
from wavefocus.benchmarks.paper_measures import CLEAR_MM, SATURATION, Paper, clear_rows, focus_fields, focus_figures
from wavefocus.benchmarks.rig_bank import paper_bank
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.rendering.field.wave_figures import impulse_travel
from wavefocus.storage.output_files import write_whole

FOCI, QUICK_FOCI = 120, 24
CLEAR = f"foci further than {CLEAR_MM:g} mm from every actuator"
TRAVEL = "of Green's functions limited to 50-450 Hz, over pairs 20 to 100 mm apart, offset per actuator"
RANGE = "20 lg(largest / smallest n) over the positions"
NUMBERS = {
    "group velocity": (
        "about 4.8 m/s", f"inverse slope of the centroid of energy over distance, {TRAVEL}"),
    "attenuation": (
        "about -3.8 dB/cm", f"slope of 10 lg(r E) over distance r, E the energy {TRAVEL}"),
    "artefacts of a focus near an actuator, without and with saturation": (
        "prominent; greatly diminished", "largest |y(x, T)| beyond 15 mm of the focus over the largest within"),
    "actuators that take part in that focus": (
        "one dominates; more uniform", "rms drive above a quarter of the largest"),
    "louder focus at the same peak drive, by saturation": (
        "increases dynamic range", "ratio of peak drives at equal focus amplitude, same focus"),
    "range of n(x) with saturation": (
        "up to 17 dB", f"{RANGE}, C = {SATURATION:g} median rms; drawn in 3C. The paper does not say whether its n(x)"
        " had it"),
    "range of n(x) without": (
        "up to 17 dB", f"{RANGE}. Waves lose 3.8 dB/cm on their way from the rim to the middle, and a rim that reflects"
        " sends little back as far; whether the paper's n(x) was of all positions is not stated"),
    "focal width": (
        "7 to 10 mm", "full width at half maximum of y at the focus instant: diameter of the disk of equal area;"
        f" {CLEAR}, 10 to 90 %"),
    "distance of the focus from its intended place": (
        "not stated", f"largest |y| within 15 mm at the focus instant, refined by a quadratic; {CLEAR}"),
    "artefact level of foci": (
        "not stated", f"largest |y(x, T)| beyond 15 mm over the largest within; {CLEAR}"),
    "measured and predicted field": (
        "nearly indistinguishable", "|scan - prediction| / |scan| over all positions and samples, within the band;"
        " scanned on the virtual rig"),
    "foci of a circle at 8 cm/s": (
        "faithful", "distance of the largest |y| at each focus instant from its path point"),
    "spectrum at the path points": (
        "stimuli concentrated in 150-300 Hz", "bursts of 50 ms, white in 20-500 Hz, at each of 6 points, 10 cm/s;"
        " energy of y(p_m, t) from 20 ms before t_m to 70 ms after the burst. The paper does not say how white its"
        " bursts were; the virtual signal chain is flat to 500 Hz, and on the stadium an actuator 6 mm from a rim that"
        " reflects and its image cancel in part near 200 Hz"),
    "crosstalk at d = 4 mm, 16 cm/s": (
        "negligible below", "energy at p_m of all other points' foci over that of its own, in a window one period long"
        f" about t_m, pooled over 30 points along x; impulses, saturation C = {SATURATION:g} median rms; negligible:"
        f" below {100 * figures.NEGLIGIBLE:g} %"),
    "crosstalk at d = 16 mm, 100 cm/s": (
        "negligible up to", "as above"),
    "correlation of Green's functions 4 mm apart": (
        "often highly correlated nearby", "coefficient at lag 0, mean over actuators and pairs within 60 mm of the"
        " middle"),
}  # fmt: skip
"""The paper's statement and the definition of our figure."""


PLATES = {
    "soft": VirtualSettings(),
    "stadium": VirtualSettings(plate="stadium", plate_keys=(("rim_admittance", 0.5),)),
}
"""The plates of the table; the figures are drawn on the last."""


def run(out: Path, *, quick: bool = False) -> Findings:
    """Draw the figures into a folder; the points are the paper's numbers and ours."""
    from matplotlib import rc_context

    from wavefocus.rendering.report.canvas import STYLE

    out.mkdir(parents=True, exist_ok=True)
    papers, timings, notes = {}, {}, []
    with rc_context(STYLE):
        for plate, settings in PLATES.items():
            rig = VirtualRig(settings)
            bank, how = paper_bank(out, rig, plate, quick=quick)
            notes.append(f'Bank of the plate "{plate}": {how}.')
            paper = papers[plate] = Paper(bank, rig, quick)
            parts: dict[str, Callable[[], object]] = {
                "travel": partial(travel, paper),
                "foci": partial(foci, paper),
                **{name: partial(draw, paper) for name, draw in figures.FIGURES.items()},
            }
            timings[plate] = measure(parts, 1)
    for name in figures.FIGURES:
        write_whole(out / f"{name}.png", timings["stadium"][name].result.png)
    points = [
        Entry(
            work="the paper's numbers",
            method=what,
            figures={"paper": stated} | {
                key: value
                for plate, paper in papers.items()
                for key, value in ((plate, paper.found[what][0]), (f"{plate}_as_the_paper", paper.found[what][1]))
            },
            remark=definition,
        )
        for what, (stated, definition) in NUMBERS.items()
    ]  # fmt: skip
    points += [
        Entry(work=f"time of each part, {plate}", method=part, timing=timing)
        for plate, found in timings.items()
        for part, timing in found.items()
    ]
    return Findings(points, notes=notes)


def travel(paper: Paper) -> None:
    """Group velocity and attenuation."""
    found = impulse_travel(paper.bank)
    velocity, loss = found.group_velocity_m_s, found.attenuation_db_per_cm
    paper.found["group velocity"] = f"{velocity:.2f} m/s", abs(velocity / 4.8 - 1.0) < 0.03
    paper.found["attenuation"] = f"{-loss:.2f} dB/cm", abs(loss / 3.8 - 1.0) < 0.03


def foci(paper: Paper) -> None:
    """Widths, places and artefacts of many foci."""
    bank, count = paper.bank, QUICK_FOCI if paper.quick else FOCI
    rows = np.sort(np.random.default_rng(3).choice(clear_rows(bank, CLEAR_MM), count, replace=False)).tolist()
    plain, saturated = (focus_figures(bank, rows, focus_fields(bank, rows, c)) for c in (None, SATURATION))
    low, middle, high = np.nanquantile(saturated["width_mm"], [0.1, 0.5, 0.9])
    off_mm, artefact_db = saturated["off_mm"], saturated["artefact_db"]
    gained = float(np.nanmedian(artefact_db - plain["artefact_db"]))
    paper.found["focal width"] = f"median {middle:.1f} mm ({low:.1f} to {high:.1f})", bool(7.0 <= middle <= 10.0)
    paper.found["distance of the focus from its intended place"] = (
        f"median {np.nanmedian(off_mm):.2f} mm, worst {np.nanmax(off_mm):.1f} mm of {count} foci", None,
    )  # fmt: skip
    paper.found["artefact level of foci"] = (
        f"median {np.nanmedian(artefact_db):.1f} dB; saturation changes it by {gained:+.1f} dB", None,
    )  # fmt: skip
