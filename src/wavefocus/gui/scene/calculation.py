"""Drives, field and foci of the present scene, by the functions of the commands, in a process that keeps a bank."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PyQt5.QtCore import QObject, pyqtSignal

from wavefocus.acquisition.wording import hours
from wavefocus.gui.files import FileState, file_state
from wavefocus.gui.scene.document import EMPTY, SceneDocument
from wavefocus.gui.surface import PlotSurface, surface_of
from wavefocus.gui.tab import TabContext
from wavefocus.storage.errors import InputError, WavefocusError

if TYPE_CHECKING:
    from wavefocus.config.scene import SceneConfig
    from wavefocus.rendering.arrays import Int64Array
    from wavefocus.rendering.field.convolution import BankSpectra
    from wavefocus.rendering.field.foci import FocusResults
    from wavefocus.rendering.report.movie import Foci
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field

NO_BANK = "choose a bank: drives and field are computed from its measurements"
LOST = "the calculation's process ended, perhaps for lack of memory; it starts again with the next edit"
# Samples of a field that is looked at, over the two that the highest frequency of the band needs.
_FINER = 4
# Larger ones are made by commands.
_MAX_S = 600.0
_MAX_FIELD_BYTES = 2**30
# A step that does not look for newer edits is waited for no longer than this.
_STOP_WAIT_S = 3.0
# A bank that is measured changes all the time: one whose results are complete is looked at less often.
_LOOK_S, _CALM_LOOK_S = 1.0, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class SceneResults:
    """Drives of a scene with their figures; later its field and the figures of its foci.

    surface: The measured positions, in the order of the field.
    """

    drive: Drive
    foci: Foci
    facts: dict[str, Any]
    surface: PlotSurface
    field: Field | None = None
    figures: FocusResults | None = None


class Calculation(QObject):
    """Calculates the latest scene once it is not edited any more, one stage after the other.

    results: Drives, then with the field, then with the figures of the foci; None where there are none.
    stage: What is being calculated; empty where nothing is.
    problem: Why the scene, or its last stage, cannot be calculated; empty while all is well.
    """

    #: One of these is another.
    changed = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__(document)
        self._context, self._document = context, document
        self._pool: ProcessPoolExecutor | None = None
        self._newest = multiprocessing.get_context("spawn").Value("q", 0)
        self._cancelled_s = self._due_s = self._looked_s = 0.0
        self._wanted = False
        self._bank_state: FileState | None = None
        self.results: SceneResults | None = None
        self.stage = self.problem = ""
        for edited in (document.changed, document.bank_changed):
            edited.connect(self._want)
        document.rig_changed.connect(partial(self._want, 0.3))  # its name changes with each key; a text waits itself
        self._want()

    @property
    def complete(self) -> bool:
        """Whether all is calculated, and of the present scene."""
        results = self.results
        return not (self._wanted or self.stage or results is None or results.figures is None)

    def poll(self, *, shown: bool, look: bool = True) -> None:
        """Calculate the latest scene while its results are shown, and again when the bank has changed.

        look: Whether to look at the bank now.
        """
        now_s, document = time.monotonic(), self._document
        look_due_s = self._looked_s + (_CALM_LOOK_S if self.complete else _LOOK_S)
        if shown and look and now_s >= look_due_s and not self.stage and document.bank is not None:
            self._looked_s = now_s
            if (state := file_state(document.bank)) != self._bank_state:
                self._bank_state, self._wanted = state, True
        if not (self._wanted and shown and now_s >= self._due_s):
            return
        if self.stage:
            self._cancel()  # the newest edit wins
            return
        self._wanted = False
        if document.bank is None or document.problem or not document.draft.source:
            self._refuse(NO_BANK if document.bank is None else document.problem or EMPTY)
            return
        self._bank_state = file_state(document.bank)
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(1, context, _begin_process, (self._newest,))
        self._submit("drives", _drives, document.draft, document.place, document.bank, document.rig)

    def pause(self) -> None:
        """Stop calculating until `poll` is called for what is shown."""
        if not self.complete:
            self._cancel()
            self._wanted = True

    def _want(self, after_s: float = 0.0) -> None:
        self._wanted, self._due_s = True, time.monotonic() + after_s

    def _cancel(self) -> None:
        """Stop calculating; a step that goes on for too long ends with its process. May be called again and again."""
        if self.stage and not self._cancelled_s:
            self._newest.value += 1
            self._cancelled_s = time.monotonic()
        elif self.stage and time.monotonic() > self._cancelled_s + _STOP_WAIT_S:
            self.close()

    def close(self) -> None:
        """End the process at once: it only calculates, and nothing is lost."""
        if self._pool is not None:
            for process in list(self._pool._processes.values()):
                process.kill()
            self._pool.shutdown(wait=False, cancel_futures=True)
        self._pool, self.stage = None, ""

    def _submit(self, stage: str, work: Callable[..., SceneResults], *arguments: object) -> None:
        assert self._pool is not None
        try:
            future = self._pool.submit(work, self._newest.value, *arguments)
        except (BrokenProcessPool, OSError) as failure:
            self.close()
            self._refuse(LOST if isinstance(failure, BrokenProcessPool) else str(failure), stage)
            return
        self._cancelled_s, self.stage = 0.0, stage
        self._context.background.ask("scene", future.result, self._take, self._fail)
        self.changed.emit()

    def _fail(self, failure: Exception) -> None:
        if not self.stage:
            return
        stage, self.stage = self.stage, ""
        if isinstance(failure, BrokenProcessPool):
            self.close()
            self._refuse(LOST, stage)
        elif self._cancelled_s or isinstance(failure, CancelledError):
            return
        elif isinstance(failure, WavefocusError | OSError | MemoryError):
            self._refuse(str(failure) or "there is not enough memory for this scene", stage)
        else:
            raise failure

    def _refuse(self, problem: str, stage: str = "") -> None:
        """Say why there are no results; drives stay where only their field cannot be calculated."""
        self.results, self.problem = self.results if stage == "field" else None, problem
        self.changed.emit()

    def _take(self, results: SceneResults) -> None:
        if not self.stage:
            return
        self.stage = ""
        if self._cancelled_s:
            return
        self.results, self.problem = results, ""
        if results.field is None:
            self._submit("field", _field, results, _field_rate_hz(results.surface))
        elif results.figures is None:
            self._submit("figures", _figures, results)
        else:
            self._looked_s = time.monotonic()
            self.changed.emit()


def _field_rate_hz(surface: PlotSurface) -> float:
    """The rate at which the surface's band is seen well; that of the bank where it has no band."""
    rate_hz, band_hz = surface.sample_rate_hz, surface.band_hz or (0.0, math.inf)
    return rate_hz / max(1, int(rate_hz / (2 * _FINER * band_hz[1])))


# The rest runs in the process.

_NEWEST: list[Any] = []  # the number of the newest scene, shared with the window


def _begin_process(newest: Any) -> None:
    """Keep out of the way of a capture, and end with the window."""
    _NEWEST.append(newest)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        with suppress(OSError):
            os.nice(3)
    window = multiprocessing.parent_process()
    assert window is not None

    def end_with_window() -> None:
        window.join()
        os._exit(1)

    threading.Thread(target=end_with_window, daemon=True).start()


def _checks(number: int) -> Callable[[int, int], None]:
    """A report of progress that raises CancelledError once a newer scene is asked for."""

    def check(_done: int, _total: int) -> None:
        if any(newest.value != number for newest in _NEWEST):
            raise CancelledError

    return check


def _drives(number: int, draft: SceneConfig, place: Path, path: Path, rig: str) -> SceneResults:
    """The drives, as ``wavefocus render``."""
    from wavefocus.gui.scene.document import build_draft
    from wavefocus.rendering.drive.quiet_scene import MISSED_DB
    from wavefocus.rendering.drive.rendering import SceneRenderer
    from wavefocus.rendering.field.prediction import field_unit
    from wavefocus.rendering.field.quiet_levels import quiet_levels
    from wavefocus.rendering.report.movie import Foci
    from wavefocus.rendering.scene.sampling import scene_size
    from wavefocus.rig.limits import rig_of, within
    from wavefocus.storage.bank.reading import open_bank

    scene = build_draft(draft, place)
    _, surface = _measured(path, _state_of(path))
    with open_bank(path) as bank:
        lasts_s = scene_size(scene, sample_rate_hz=float(bank.sample_rate_hz), taps=1, actuators=1).seconds
        if lasts_s > _MAX_S:
            raise InputError(
                f"the scene lasts {hours(min(lasts_s, 1e12))}; while it is edited, scenes of up to {hours(_MAX_S)} are"
                " calculated. Shorten it, or save the drive, which may last longer"
            )
        found = rig_of(Path(rig), bank) if rig else None
        limited = scene if found is None else within(scene, found)
        # In double precision: where loud rows saturate, single is mostly refused, and all would be made twice.
        renderer = SceneRenderer(limited, bank)
        drive, report = renderer.collect(_checks(number)), renderer.report
        facts = {
            "scale": drive.scale, "limited_by": report.limiting.decided_by, "warnings": report.warnings,
            "peak_v": renderer.peak_v, "response_unit": field_unit(bank),
            "dynamic_range_db": report.dynamic_range_db,
            "quiet": [
                {**level.plain, "missed": level.reached_db > level.track.level_db + MISSED_DB}
                for level in quiet_levels(drive, bank)
            ],
        }  # fmt: skip
    return SceneResults(drive, Foci.of(drive), facts, surface)


def _state_of(path: Path) -> FileState:
    if (state := file_state(path)) is None:
        raise InputError(f"{path} is missing (deleted or moved): put it back, or open another bank")
    return state


@lru_cache(2)
def _measured(path: Path, _state: FileState) -> tuple[Int64Array, PlotSurface]:
    """A bank's measured positions, whose rows are sound."""
    from wavefocus.rendering.field.prediction import measured_positions
    from wavefocus.storage.bank.reading import open_bank

    with open_bank(path) as bank:
        bank.require_sound()
        rows = measured_positions(bank)
        if not len(rows):
            raise InputError(f"{path} has no measured position yet; results are shown when it has")
        return rows, surface_of(bank).with_rows(rows)


@lru_cache(1)
def _spectra(path: Path, state: FileState, rate_hz: float) -> BankSpectra:
    """Spectra of a bank's measured positions, kept from edit to edit."""
    from wavefocus.rendering.field.convolution import BankSpectra
    from wavefocus.storage.bank.reading import open_bank

    with open_bank(path) as bank:
        return BankSpectra(bank, _measured(path, state)[0], rate_hz=rate_hz)


def _field(number: int, results: SceneResults, rate_hz: float) -> SceneResults:
    """The field, as ``wavefocus predict``."""
    from wavefocus.rendering.field.prediction import Prediction

    path, check = results.surface.bank, _checks(number)
    check(0, 1)
    state = _state_of(path)
    rows, surface = _measured(path, state)  # there may be more by now than for the drives
    size = 4 * surface.positions * results.drive.drive_v.shape[1] * rate_hz / results.drive.sample_rate_hz
    if size > _MAX_FIELD_BYTES:
        raise InputError(
            f"the field would take {size / 2**30:.1f} GiB: shorten the scene, or save the drive and predict some"
            " positions with wavefocus predict --positions"
        )
    spectra = _spectra(path, state, rate_hz)
    return replace(results, surface=surface, field=Prediction(results.drive, spectra, rows).field(check))


def _figures(number: int, results: SceneResults) -> SceneResults:
    from wavefocus.rendering.field.foci import focus_figures
    from wavefocus.storage.bank.reading import open_bank

    with open_bank(results.surface.bank) as bank:
        return replace(results, figures=focus_figures(results.drive, bank, on_progress=_checks(number)))
