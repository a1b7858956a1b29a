"""``wavefocus check``: checksums and physical sanity of every row."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from calibration.bank_check import check_bank
from wavefocus.console import say
from wavefocus.exits import Exit

# So many lines of a kind are read; the rest is for programs.
MOST_LINES = 10


def check(bank: Path, *, as_json: bool) -> Exit:
    """Tell everything that is wrong with a bank; errors make the exit code 1, warnings do not."""
    findings = check_bank(bank)
    errors = sum(one.severity == "error" for one in findings)
    if as_json:
        print(json.dumps({"bank": str(bank), "errors": errors, "findings": [asdict(one) for one in findings]}))
    told = {severity: [one for one in findings if one.severity == severity] for severity in ("error", "warning")}
    for severity, some in told.items():
        for one in some[:MOST_LINES]:
            say(f"{severity}: {one.message}")
        if len(some) > MOST_LINES:
            say(f"{severity}: and {len(some) - MOST_LINES} more; --json tells all")
    say(f"{bank}: {errors} errors, {len(findings) - errors} warnings")
    return Exit.NOT_GOOD_ENOUGH if errors else Exit.DONE
