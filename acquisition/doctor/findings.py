"""What an examination finds, and questions to instruments that end whatever the instrument does."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from config.messages.doctor import Act, Finding, Verdict
from drivers.errors import InstrumentError, TransientInstrumentError
from drivers.timeouts import CallThread, HungError

Answer = TypeVar("Answer")

HUNG_REMEDY = "unplug it and plug it in again, or switch it off and on; then run wavefocus doctor again"


class Findings:
    """Collects findings; a check that raises becomes one.

    publish: Gets each finding as it is made.
    """

    def __init__(self, publish: Callable[[Finding], None]) -> None:
        self.publish = publish
        self._hung: set[str] = set()

    def add(
        self, instrument: str, check: str, verdict: Verdict, what: str, remedy: str = "", act: Act | None = None
    ) -> None:
        """Tell a finding."""
        self.publish(Finding(instrument, check, verdict, what, remedy, act))

    def skip(self, instrument: str, check: str, why: str) -> None:
        """Tell that a check was not made."""
        self.add(instrument, check, "skipped", why)

    def ask(self, instrument: str, check: str, question: Callable[[], Answer], deadline_s: float) -> Answer | None:
        """Ask an instrument; once more after a passing fault; what fails for good is a finding.

        instrument, check: Who is asked, and which check it is for.
        deadline_s: Longest wait.

        Returns the answer, or None where there is none: then a finding says why.
        """
        if instrument in self._hung:
            self.skip(instrument, check, "it did not come back from the check before")
            return None
        thread = CallThread(f"doctor {instrument}")
        try:
            try:
                return thread.call(question, deadline_s)
            except TransientInstrumentError as passing:
                answer = thread.call(question, deadline_s)
                self.add(instrument, check, "warn", f"only at the second try: {passing.cause}", passing.remedy)
                return answer
        except HungError:
            self._hung.add(instrument)
            self.add(instrument, check, "fail", f"it did not come back within {deadline_s:g} s", HUNG_REMEDY)
        except InstrumentError as failure:
            # A check may need several instruments; the one that failed is the one to look at.
            self.add(failure.role or instrument, check, "fail", f"{failure.operation}: {failure.cause}", failure.remedy)
        except Exception as defect:  # a defect of a driver must not hide what the other instruments say
            words = f"{type(defect).__name__}: {defect}"
            self.add(instrument, check, "fail", words, "this is a defect of the program: please report it")
        finally:
            thread.abandon()
        return None
