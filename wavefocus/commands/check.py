"""``wavefocus check``: checksums and physical sanity of every row."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from calibration.bank_check import check_bank
from wavefocus.console import say
from wavefocus.exits import Exit


def check(bank: Path, *, as_json: bool) -> Exit:
    """Tell everything that is wrong with a bank; errors make the exit code 1, warnings do not."""
    findings = check_bank(bank)
    errors = sum(one.severity == "error" for one in findings)
    if as_json:
        print(json.dumps({"bank": str(bank), "errors": errors, "findings": [asdict(one) for one in findings]}))
    for one in findings:
        say(f"{one.severity}: {one.message}")
    say(f"{bank}: {errors} errors, {len(findings) - errors} warnings")
    return Exit.NOT_GOOD_ENOUGH if errors else Exit.DONE
