"""An examination under way: the doctor in a process of its own, its findings on the page as they are made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gui.rig.examination_page import ExaminationPage
from gui.rig.lines_process import LinesProcess, Told
from gui.rig.remedies import Finding
from gui.shell.tab import TabContext

_STOPPED = 130


class Examination:
    """At most one examination.

    Parameters
    ----------
    context : TabContext
        Starts commands, tells sentences.
    page : ExaminationPage
        Shows the findings.
    """

    def __init__(self, context: TabContext, page: ExaminationPage) -> None:
        self._context, self._page = context, page
        self._process: LinesProcess | None = None

    @property
    def running(self) -> bool:
        """Whether it holds the instruments."""
        return self._process is not None

    def start(self, rig: Path, options: Sequence[str]) -> None:
        """Start one."""
        quiet = [] if self._page.plays.isChecked() else ["--no-play"]
        arguments = ["doctor", str(rig), "--lines", *quiet, *options]
        self._process = LinesProcess.started(self._context, arguments, "the examination cannot be started")
        if self._process is not None:
            self._page.begin()

    def cancel(self) -> None:
        """End it; instruments are put to rest first."""
        if self._process is not None:
            self._process.interrupt()

    def poll(self) -> None:
        """Take up what came in."""
        process = self._process
        if process is not None and process.hand_over(self._hear):
            self._process = None
            self._ended(process)

    def let_go(self) -> None:
        """The window closes: the doctor puts the instruments to rest when nobody reads its findings."""
        if self._process is not None:
            self._process.interrupt()
            self._process.let_go()
            self._process = None

    def _hear(self, told: Told) -> None:
        finding = told.get("finding")
        if isinstance(finding, dict):
            self._page.add(Finding.told(finding))

    def _ended(self, process: LinesProcess) -> None:
        code = process.exit_code
        if code in (0, 1) and self._page.findings:
            good = "✔ all well: " if code == 0 else ""
            self._page.finish(f"{good}{self._page.counted()}")
        elif code == _STOPPED:
            self._page.finish("cancelled; the instruments were put to rest")
        else:
            self._page.finish("the examination did not come to its end")
            self._context.messages.fault(process.ending())
