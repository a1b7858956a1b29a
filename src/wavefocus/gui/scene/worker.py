"""The process that calculates scenes for the window, and what it keeps of a bank between edits.

A thread of the window would hold it up: with 1500 positions its ticks came up to 0.24 s late. The process also keeps
its memory to itself, ends with the window, and can be ended at any time.
"""

from __future__ import annotations

import os
import time
import traceback
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from wavefocus.config.rig_instruments import PlayerSection
from wavefocus.config.scene import Regularisation
from wavefocus.gui.scene.calculation import Answer, CalculationProgress, Finished, Order, PredictedField, SceneRequest
from wavefocus.gui.scene.draft import build_draft
from wavefocus.gui.scene.drives_and_foci import (
    focus_figures,
    missing_rows,
    missing_text,
    render_while_edited,
    summarise,
)
from wavefocus.gui.surface import PlotSurface, surface_of
from wavefocus.rendering.arrays import Int64Array
from wavefocus.rendering.field.bank_spectra import MAX_FACTOR, PASSED, BankSpectra
from wavefocus.rendering.field.foci import loudest_instants
from wavefocus.rendering.field.prediction import Prediction, field_unit, measured_positions
from wavefocus.rendering.greens.regularisation import saturation_threshold
from wavefocus.rendering.scene.model import Scene
from wavefocus.rig.limits import rig_of, stricter
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError, WavefocusError

# An edit is noticed between two parts of the field; each takes a fraction of a second.
PART_POSITIONS = 128
MAX_SPECTRA_BYTES = 512 * 2**20
# The measured band may reach beyond its upper edge, which a sweep's fade leaves behind.
_ROOM = 1.05

_Identity = tuple[Path, int, int, int, int]


class BankCache:
    """An open bank, and what does not depend on the scene until the file changes."""

    surface: PlotSurface

    def __init__(self) -> None:
        self._bank: Bank | None = None
        self._identity: _Identity | None = None
        self._content: tuple[bytes, bytes] = (b"", b"")
        self._median: float | None = None
        self._spectra: dict[int, BankSpectra] = {}
        self._spectra_bytes = 0
        self.rows: Int64Array = np.zeros(0, np.int64)

    @property
    def bank(self) -> Bank:
        assert self._bank is not None
        return self._bank

    def open(self, path: Path) -> Bank:
        """Open a bank, or go on with it. Raises InputError where it is missing or cannot be read."""
        identity = _identity_of(path)
        if self._bank is not None and identity == self._identity:
            return self._bank
        before = None if self._identity is None else self._identity[0]
        self.close()
        bank = open_bank(path)
        try:
            bank.require_sound()
        except InputError:
            bank.close()
            raise
        self._bank, self._identity = bank, identity
        attempts = bank.quality.get("attempts")
        content = bank.status.tobytes(), b"" if attempts is None else np.asarray(attempts).tobytes()
        # Banks of other programs do not say what has changed.
        foreign = not content[1] or bank.plan_sha256 is None
        if foreign or before != path or content != self._content:
            self._content, self._median, self._spectra, self._spectra_bytes = content, None, {}, 0
            self.rows, _ = measured_positions(bank)
            if len(self.rows):
                self.surface = surface_of(bank).with_rows(self.rows)
        return bank

    def changed(self, path: Path) -> bool:
        """Whether the file has changed since it was opened. Raises InputError where it is missing."""
        return _identity_of(path) != self._identity

    def close(self) -> None:
        if self._bank is not None:
            with suppress(OSError):
                self._bank.close()
        self._bank = self._identity = None

    def absolute(self, regularisation: Regularisation) -> Regularisation:
        """The same regularisation with C itself, from the bank's median. Raises InputError where that is 0."""
        if not regularisation.saturation:
            return regularisation
        if self._median is None:
            self._median = saturation_threshold(Regularisation(saturation=1.0), self.bank)
        threshold = float(np.float64(regularisation.saturation) * self._median)
        return regularisation.model_copy(update={"saturation": 0.0, "saturation_absolute": threshold})

    @property
    def factor(self) -> int:
        """How many times lower the field's rate may be without losing any of the band; 1 without a band."""
        if self.bank.band_hz is None:
            return 1
        most = PASSED * self.bank.sample_rate_hz / 2.0 / (_ROOM * self.bank.band_hz[1])
        return int(np.clip(most, 1, MAX_FACTOR))

    @property
    def rate_hz(self) -> float:
        return self.bank.sample_rate_hz / self.factor

    def spectra(self, first: int) -> BankSpectra:
        """Spectra of the rows of a part of the field, which begins at one of them; kept while there is room."""
        kept = self._spectra.get(first)
        if kept is not None:
            return kept
        made = BankSpectra(self.bank, self.rows[first : first + PART_POSITIONS], rate_hz=self.rate_hz)
        if self._spectra_bytes + made.size_bytes <= MAX_SPECTRA_BYTES:
            self._spectra[first] = made
            self._spectra_bytes += made.size_bytes
        return made


def _identity_of(path: Path) -> _Identity:
    try:
        found = path.stat()
    except FileNotFoundError:
        raise InputError(f"{path} is missing (deleted or moved): put it back, or open another bank") from None
    return path, found.st_dev, found.st_ino, found.st_mtime_ns, found.st_size


MAX_FIELD_BYTES = 192 * 2**20
# Fields are sampled two or three times a period; they are shown at eight times as many instants.
FINER = 8
# Nothing that takes long starts so soon after an edit: the next one may follow.
QUIET_S = 0.12
_BANK_LOOK_EVERY_S = 1.0
_PROGRESS_EVERY_S = 0.1
# A capture must not be slowed down by the editor.
_NICE = 10
_LOW_PASS_REACH = 64


class SupersededError(Exception):
    """A newer order has arrived."""


def serve(connection: Connection) -> None:
    """Calculate the latest request until the window is gone."""
    if hasattr(os, "nice"):
        with suppress(OSError):
            os.nice(_NICE)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        Calculator(connection).serve()


class Calculator:
    """Calculates the latest scene that was asked for.

    connection: Brings orders and receives answers.
    most_field_bytes: Of a longer field only the beginning is predicted.
    """

    def __init__(self, connection: Connection, most_field_bytes: int = MAX_FIELD_BYTES) -> None:
        self._connection = connection
        self._most_field_bytes = most_field_bytes
        self._reported_s = -1.0
        self.cache = BankCache()

    def serve(self) -> None:
        """Carry out orders until the connection is closed, which raises EOFError or OSError."""
        order: Order = self._connection.recv()
        while True:
            order, complete = self._latest(order), True
            if isinstance(order, SceneRequest):
                try:
                    complete = self.calculate(order)
                except SupersededError:
                    order = self._latest(None)
                    continue
            else:
                self._connection.send(Finished(order.number))
            order = self._wait(order, complete=complete)

    def calculate(self, request: SceneRequest, quiet_s: float = QUIET_S) -> bool:
        """Calculate a scene; returns False where it may succeed when the bank has changed.

        Raises SupersededError: A newer order has arrived.
        """
        try:
            self._calculate(request, quiet_s)
        except (SupersededError, EOFError, ConnectionError):
            raise
        except (WavefocusError, OSError, MemoryError) as failure:
            problem = str(failure) or "there is not enough memory for this scene"
            self._send(Finished(request.number, problem))
            return False
        except Exception:
            self._send(Finished(request.number, "the calculation failed", traceback.format_exc()))
            return True
        self._send(Finished(request.number))
        return True

    def _calculate(self, request: SceneRequest, quiet_s: float) -> None:
        number = request.number
        self._send(CalculationProgress(number, "scene", 0.0))
        scene = build_draft(request.draft, request.place, allow_large=request.allow_large)
        bank = self.cache.open(request.bank)
        if not len(self.cache.rows):
            raise InputError(f"{bank.path} has no measured position yet; results are shown when it has")
        rig = None if request.rig is None else rig_of(request.rig, bank)
        self._check(quiet_s)
        scene = replace(scene, regularisation=self.cache.absolute(scene.regularisation))
        drive = self._drives(number, scene, bank, None if rig is None else rig.player)
        self._field(number, scene, bank, drive)

    def _drives(self, number: int, scene: Scene, bank: Bank, player: PlayerSection | None) -> Drive:
        def report(done: int, total: int) -> None:
            self._check()
            self._send(CalculationProgress(number, "drives", done / total))

        report(0, 1)
        limits = stricter(scene.output, player)
        try:
            rendered = render_while_edited(scene, bank, limits, report)
        except InputError as refused:
            if rows := missing_rows(scene, bank):
                raise InputError(missing_text(rows, str(refused))) from None
            raise
        self._check()
        ohm = None if player is None else player.coil_resistance_ohm
        self._send(summarise(number, scene, bank, rendered, limits, ohm))
        return rendered.drive

    def _field(self, number: int, scene: Scene, bank: Bank, drive: Drive) -> None:
        self._check()
        cache, rows = self.cache, self.cache.rows
        factor, rate_hz = cache.factor, cache.rate_hz
        looked = loudest_instants(drive, bank)
        whole = -(-(drive.drive_v.shape[1] + bank.taps - 1) // factor)
        samples = min(whole, max(1, self._most_field_bytes // (4 * len(rows))))
        beginning = drive.drive_v[:, : (samples + _LOW_PASS_REACH) * factor]
        shown = replace(drive, drive_v=beginning)
        field = np.empty((samples, len(rows)), np.float32)
        for first in range(0, len(rows), PART_POSITIONS):
            self._check()
            self._send(CalculationProgress(number, "field", first / len(rows)))
            part = rows[first : first + PART_POSITIONS]
            predicted = Prediction(shown, cache.spectra(first), part).field().field[:, :samples]
            field[:, first : first + len(part)] = predicted.T
        time_s = looked.time_s(drive.sample_rate_hz)
        seen = time_s < drive.start_s + samples / rate_hz
        self._send(
            PredictedField(
                number=number,
                surface=cache.surface,
                rows=rows,
                field=field,
                sample_rate_hz=rate_hz,
                start_s=drive.start_s,
                finer=FINER if factor > 1 else 1,
                unit=field_unit(bank),
                limit=float(looked.peak[seen].max(initial=0.0)),
                marks_s=tuple(time_s[seen].tolist()),
                lasts_s=whole / rate_hz,
            )
        )
        self._send(CalculationProgress(number, "figures", 0.0))
        self._send(focus_figures(number, looked.instants, field, rate_hz, rows, bank, scene, drive, self._check))

    def _wait(self, order: Order, *, complete: bool) -> Order:
        """Wait for the next order; repeat the last one when the bank may have what was missing."""
        gone = False
        while not self._connection.poll(_BANK_LOOK_EVERY_S):
            if not isinstance(order, SceneRequest):
                continue
            try:
                changed = self.cache.changed(order.bank)
            except (InputError, OSError) as failure:
                if complete:
                    self._connection.send(Finished(order.number, str(failure)))
                    complete = False
                gone = True
                continue
            if gone or (changed and not complete):
                return order
        return self._latest(None)

    def _latest(self, order: Order | None) -> Order:
        while order is None or self._connection.poll():
            order = self._connection.recv()
        return order

    def _check(self, wait_s: float = 0.0) -> None:
        """Raise SupersededError when a newer order has arrived, or arrives within some seconds."""
        if self._connection.poll(wait_s):
            raise SupersededError

    def _send(self, answer: Answer) -> None:
        if isinstance(answer, CalculationProgress):
            now_s = time.monotonic()
            if answer.share > 0.0 and now_s - self._reported_s < _PROGRESS_EVERY_S:
                return
            self._reported_s = now_s
        self._connection.send(answer)
