"""Analysis of trials held against simulated participants: how often the 95 % intervals hold the truth.

Each participant has one psychometric function, and answers through the session, the order of trials, the answers file
and the analysis; there are no instruments. Three designs: eight levels 40 times each, one up-down staircase, QUEST+ of
60 trials. Threshold and slope differ from participant to participant; in the last row of each design all lapse more
often than in the others.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times
from wavefocus.trials.analysis.results import psychometric_of
from wavefocus.trials.analysis.shares import table_of
from wavefocus.trials.design import TrialsDesign, load_trials
from wavefocus.trials.simulated import Observer, simulate

PEOPLE, QUICK_PEOPLE = 200, 10
MARK = 0.95
LAPSES = (0.0, 0.02, 0.05)
_TRIALS = """
[trials]
question = "Which way?"
answers = ["left", "right"]
correct = "path"
{repetitions}
familiarise = false
most_alike = 0

[path.left]
kind = "line"
start_mm = [8, 0]
end_mm = [0, 0]

[path.right]
kind = "line"
start_mm = [0, 0]
end_mm = [8, 0]

[signal.burst]
kind = "sine"
frequency_hz = 200.0
duration_s = 0.02

[[stimuli]]
path = ["left", "right"]
signal = "burst"
speed_mm_s = 200
step_mm = 4
amplitude = {levels}
"""
_ADAPTIVE = '\n[adaptive]\nmethod = "{method}"\nfactor = "amplitude"\ntrials = 60\n'
CONSTANT, UP_DOWN, QUEST = "8 levels, 40 trials each", "up-down, 10 reversals", "QUEST+, 60 trials"


@dataclass(frozen=True, slots=True)
class Coverage:
    """Of how many people the intervals hold the truth; errors of the threshold in decades, ratios of the slope."""

    people: int
    threshold_held: int
    slope_held: int
    open_slopes: int
    threshold_error_decades: float
    slope_ratio: float


def designs(folder: Path) -> dict[str, TrialsDesign]:
    """The three designs, read from trials files in a folder."""
    constant = [round(float(one), 6) for one in np.geomspace(0.1, 1.0, 8)]
    ladder = [round(float(one), 6) for one in np.geomspace(10**-1.5, 1.0, 16)]
    texts = {
        CONSTANT: _TRIALS.format(repetitions="repetitions = 20", levels=constant),
        UP_DOWN: _TRIALS.format(repetitions="", levels=ladder) + _ADAPTIVE.format(method="up_down"),
        QUEST: _TRIALS.format(repetitions="", levels=ladder) + _ADAPTIVE.format(method="quest_plus"),
    }
    found = {}
    for number, (name, text) in enumerate(texts.items()):
        file = folder / f"trials-{number}.toml"
        file.write_text(text)
        found[name] = load_trials(file)
    return found


def coverage(design: TrialsDesign, people: int, lapse: float, folder: Path) -> Coverage:
    """Run people through a design and the analysis."""
    held, errors, ratios = [], [], []
    for person in range(people):
        rng = np.random.default_rng((person, people))
        observer = Observer("amplitude", float(rng.uniform(-0.7, -0.4)), float(rng.uniform(6.0, 12.0)), lapse=lapse)
        place = Path(tempfile.mkdtemp(dir=folder))
        rows = simulate(design, f"P{person}", observer, place, person)
        (found,) = psychometric_of(table_of(rows), design.config.trials.answers, design.config.adaptive)
        fit, threshold = found.fit, 10.0**observer.threshold
        ends = zip((fit.threshold_interval, fit.slope_interval), (threshold, observer.slope), strict=True)
        held.append([(low is None or low <= true) and (high is None or true <= high) for (low, high), true in ends])
        held[-1].append(None in fit.slope_interval)
        errors.append(np.log10(fit.threshold / threshold))
        ratios.append(fit.slope / observer.slope)
    threshold_held, slope_held, open_slopes = (int(one) for one in np.sum(held, axis=0))
    return Coverage(people, threshold_held, slope_held, open_slopes, float(np.std(errors)), float(np.median(ratios)))


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Count how often the intervals hold the truth."""
    people = QUICK_PEOPLE if quick else PEOPLE
    points = []
    with tempfile.TemporaryDirectory(dir=out) as name:
        for method, design in designs(Path(name)).items():
            for lapse in LAPSES[1:2] if quick else LAPSES:
                wall_s, cpu_s = time.perf_counter(), time.process_time()
                found = coverage(design, people, lapse, Path(name))
                timing = Times((time.perf_counter() - wall_s) / people, (time.process_time() - cpu_s) / people)
                figures = {
                    "people": found.people, "threshold_held": found.threshold_held, "slope_held": found.slope_held,
                    "threshold_share": found.threshold_held / people, "slope_share": found.slope_held / people,
                    "slopes_open": found.open_slopes, "threshold_error_decades": found.threshold_error_decades,
                    "slope_ratio": found.slope_ratio,
                }  # fmt: skip
                marks = (Mark("threshold_share", MARK), Mark("slope_share", MARK)) if method == CONSTANT else ()
                points.append(
                    Entry(work="simulated participants", method=method, parameters={"lapse_rate": lapse},
                          timing=timing, figures=figures, marks=marks if lapse == LAPSES[1] else ())
                )  # fmt: skip
    return Findings(points, notes=("Time: of one participant, session and analysis.",))
