"""Write docs/reference/stiff-cases.md from the tests of the stiff and extreme cases and what they measured.

Run as ``python tools/stiff_cases.py`` from the project's folder. Every row of the table has tests named after it; the
page says how many passed, and the figures that they recorded.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

PAGE = Path("docs/reference/stiff-cases.md")
TESTS = [f"tests/unit/test_stiff_cases_{part}.py" for part in ("rendering", "plates")]
ROWS = [
    ("1", "dead actuator", "sigma = inf, NaN drive", "warning: its drive is 0, the others untouched", "1e-12"),
    ("2", "path point that was not measured", "n = inf, everything NaN", "refused, naming the point", "-"),
    ("3-5", "bank in units of 1e-15 to 1e15; 1e+-200", "R under- or overflows", "the same drive; refused", "1e-12"),
    ("6", "tails of denormal numbers", "-", "as zeros", "1e-12"),
    ("7", "one NaN or infinity in the bank", "a segment of NaN", "refused, naming position and actuator", "-"),
    ("8-9", "saturation C <= 0, not finite; huge", "0/0; overflow", "refused; sigma = 1 exactly", "exact"),
    ("10-12", "path off the grid, grid too coarse", "42 to 80 % error, silently",
     "warning with the error per frequency; refused beyond the tolerance", "asked for"),
    ("13", "path outside the surface", "silent snap", "refused with its place", "-"),
    ("14", "faster than the waves", "nothing blows up", "correct, with a warning", "1e-12"),
    ("15-16", "one point, zero length, repeated points, v = 0", "division by zero",
     "the static focus; an empty signal is refused", "1e-12"),
    ("17", "identical FIRs everywhere", "-", "one convolution", "1e-12"),
    ("18", "source longer than the FIRs", "70 % error by circular wrap", "linear convolution", "1e-12"),
    ("19", "very many path points", "gigabytes", "bounded memory", "40 MB + drives"),
    ("20-21", "dt not whole samples", "250 ms of drift over 5000 points", "absolute rounding", "half a sample"),
    ("22", "response longer than its window", "3 % of the energy inside", "warning with the tail's share", "-"),
    ("23", "wrap-around in a synthetic bank", "tail at -11 dB", "warning above -40 dB in the last tenth", "-"),
    ("24", "dividing by the sweep outside its band", "215 % error", "least squares", "1 % at 60 dB"),
    ("25", "band-only bins on a leaky bank", "1.4e-3", "correct within the printed bound", "the bound"),
    ("26", "segments of 20 samples", "80 % of the energy out of band", "correct, warning with the loss", "1e-12"),
    ("27", "int16, float16, big-endian, strided banks", "wrong by 1e6", "as float64", "1e-12"),
    ("28", "position on an actuator", "NaN", "finite source radius", "finite"),
    ("29", "growing wave (wrong sign of Im k)", "NaN", "refused", "-"),
    ("30", "r = 0 of a thin plate", "NaN", "the analytic limit", "1e-6"),
    ("31", "time step beyond the explicit limit", "1e161", "refused before the first step, naming the limit", "-"),
    ("32", "Newmark at 0.1 ms", "-0.8 % in frequency at 500 Hz", "correct, dispersion reported", "5 % of it"),
    ("34", "everything below the converter's step", "silence", "refused", "-"),
    ("35", "overlapping emission times", "negative slices", "the documented sum", "1e-12"),
    ("36", "duplicate or collinear positions", "a library's error", "merged; refused where degenerate", "1e-12"),
    ("37", "strided or memory-mapped banks", "silent copies", "as float64", "1e-12"),
]  # fmt: skip
"""Row, case, what the plain way does, what is right, tolerance."""
STABILITY = """

## Time stepping on a thin plate

kappa^2 biharmonic(w) + w'' = 0 is stiff: the fastest oscillation of a grid of spacing h has the angular frequency
8 kappa / h^2.

| method (`benchmarks/plate.py`) | stable steps | error in time |
|---|---|---|
| leapfrog (`TimeStepper`, beta = 0) | dt <= h^2 / (4 kappa): 2.55 us at 4 mm of 1 mm glass; longer: refused | small |
| Newmark (`TimeStepper`, beta = 1/4) | all | modes ring too low: -0.8 % at 500 Hz for dt = 0.1 ms (`frequency_error`) |
| modal exponentials (`ExactPlate`) | all | 1e-12 of the closed form after 20,000 steps at Q = 10,000 |
"""
NAMED = re.compile(r"test_rows?_(\d+)(?:_(to|and)_(\d+))?_")


def rows_of(test: str) -> set[int]:
    """Rows that a test is named after."""
    found = NAMED.match(test)
    if found is None:
        return set()
    first, how, last = int(found[1]), found[2], int(found[3] or found[1])
    return set(range(first, last + 1)) if how == "to" else {first, last}


def main() -> int:
    """Run the tests and write the page; 1 where a row has no test or one fails."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTS, f"--junitxml={report}"],
            check=False,
        )
        cases = list(ElementTree.parse(report).iter("testcase"))
    lines, wrong = [], False
    for number, case, plain, right, tolerance in ROWS:
        first, _, last = number.partition("-")
        wanted = set(range(int(first), int(last or first) + 1))
        mine = [test for test in cases if rows_of(test.get("name", "")) & wanted]
        passed = [test for test in mine if test.find("failure") is None and test.find("error") is None]
        wrong |= not mine or len(passed) < len(mine)
        properties = [item for test in mine for item in test.iter("property") if item.get("name") == "measured"]
        recorded = [item.get("value", "") for item in properties]
        figures = list(dict.fromkeys(text for text in recorded if not text.startswith("relative error")))
        errors = [float(text.split()[-1]) for text in recorded if text.startswith("relative error")]
        if errors:
            figures.append(f"relative error at most {max(errors):.1g}")
        figures.append(f"{len(passed)} of {len(mine)} tests pass" if mine else "no test")
        lines.append(f"| {number} | {case} | {plain} | {right} | {tolerance} | {'; '.join(figures)} |")
    text = (
        "# Stiff and extreme cases\n\n"
        "Made by `python tools/stiff_cases.py` from the tests named after each row\n"
        "(`tests/unit/test_stiff_cases_*.py`). The plain way is eqs. (14) to (17) of the paper as written down, in\n"
        "NumPy; errors are relative L2 errors of the drives, the largest that any test of the row found.\n\n"
        "| row | case | the plain way | wavefocus | tolerance | measured |\n|---|---|---|---|---|---|\n"
    )
    PAGE.write_text(text + "\n".join(lines) + STABILITY, encoding="utf-8")
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
