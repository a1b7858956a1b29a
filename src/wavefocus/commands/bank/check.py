"""``wavefocus check``: checksums and physical sanity of every row."""

import json
from dataclasses import asdict
from pathlib import Path

from wavefocus.calibration.check import check_file
from wavefocus.console import answer, say, spinner
from wavefocus.exits import Exit

# So many lines of a kind are read; the rest is for programs.
MAX_LINES = 10


def check(file: Path, *, as_json: bool) -> Exit:
    """Report everything that is wrong with a file; errors make the exit code 1, warnings do not."""
    with spinner("verifying every row, and comparing it with its neighbours"):
        findings = check_file(file)
    errors = sum(one.severity == "error" for one in findings)
    if as_json:
        print(json.dumps({"bank": str(file), "errors": errors, "findings": [asdict(one) for one in findings]}))
    line = say if as_json else answer
    by_severity = {level: [one for one in findings if one.severity == level] for level in ("error", "warning", "note")}
    for severity, some in by_severity.items():
        for one in some[:MAX_LINES]:
            line(f"{severity}: {one.message}")
        if len(some) > MAX_LINES:
            line(f"{severity}: and {len(some) - MAX_LINES} more; --json lists all")
    line(f"{file}: {errors} errors, {len(by_severity['warning'])} warnings")
    return Exit.NOT_GOOD_ENOUGH if errors else Exit.DONE
