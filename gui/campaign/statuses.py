"""The contract's status bits in words.

`acquisition.quality.judgement` has them too; with it comes all that measures, for which the window would have to wait.
"""

from __future__ import annotations

from storage.bank.ledger import DISABLED, FAILED, OVER_RANGE, POOR_SIGNAL, VALID

__all__ = ["DISABLED", "FAILED", "NOT_MEASURED", "OVER_RANGE", "POOR_SIGNAL", "VALID", "WORDS", "status_text"]

NOT_MEASURED = 0
WORDS = {VALID: "valid", OVER_RANGE: "over-range", POOR_SIGNAL: "poor", FAILED: "failed", DISABLED: "disabled"}


def status_text(status: int) -> str:
    """Status bits in words."""
    return ", ".join(word for bit, word in WORDS.items() if status & bit) or "not measured"
