"""The stages from a scene's text to drives, field and figures; each is given up as soon as a newer scene came."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gui.scene.results.drives import missing_rows, missing_words, render_while_edited, stricter, told_drive
from gui.scene.results.foci import Snapshots, figures_of, look_at_foci
from gui.scene.results.messages import Done, Failed, FieldBegun, FieldPart, Plate, Progress, Request, Told
from gui.scene.results.plate import PlateBank
from gui.shell.front_door import RigLimits
from gui.surface.surface import surface_of
from rendering.field.model import field_unit
from rendering.field.prediction import Prediction
from rendering.scene.model import Scene
from storage.bank.reading import Bank
from storage.drive_file import Drive
from storage.errors import InputError, WavefocusError

ReadScene = Callable[..., Scene]
ReadRig = Callable[[Path], RigLimits]

MOST_FIELD_BYTES = 192 * 2**20
# Waves that are sampled two or three times a period are shown at eight times as many instants.
FINER = 8


class SupersededError(Exception):
    """A newer order came; what is under way is not wanted any more."""


class Calculator:
    """Calculates scenes; what does not depend on the scene is kept from one to the next.

    Parameters
    ----------
    tell : callable
        Receives what is found.
    check : callable
        Called often; what it raises ends the calculation. It may be told how long to wait for a newer order, in s.
    read_scene, read_rig : callable
        As `gui.shell.front_door.FrontDoor` has them.
    most_field_bytes : int
        Of a longer field the beginning is predicted.
    """

    def __init__(
        self,
        tell: Callable[[Told], object],
        check: Callable[[float], None],
        read_scene: ReadScene,
        read_rig: ReadRig,
        most_field_bytes: int = MOST_FIELD_BYTES,
    ) -> None:
        self._tell, self._check = tell, check
        self._read_scene, self._read_rig = read_scene, read_rig
        self._plate = PlateBank()
        self._told_plate = False
        self._most_field_bytes = most_field_bytes

    def calculate(self, request: Request, quiet_s: float) -> bool:
        """Calculate a scene and tell what comes of it; False where the bank does not have what it needs.

        Parameters
        ----------
        request : Request
            The scene.
        quiet_s : float
            Nothing that takes long begins before so long after it: people may not be done yet.

        Raises
        ------
        SupersededError
            By `check`.
        """
        try:
            self._calculate(request, quiet_s)
        except (WavefocusError, OSError, MemoryError) as failure:
            sentence = str(failure).removeprefix(f"{request.place}: ") or "there is no memory left for this scene"
            self._tell(Failed(request.number, sentence))
            return False
        return True

    def bank_changed(self, bank: Path) -> bool:
        """Whether a bank is another than it was. Raises InputError where it is gone."""
        return self._plate.changed(bank)

    def _calculate(self, request: Request, quiet_s: float) -> None:
        number = request.number
        self._tell(Progress(number, "scene", 0.0))
        scene = self._read_scene(request.text, request.place, request.allow_large)
        bank, anew = self._plate.open(request.bank)
        self._told_plate &= not anew
        if not self._told_plate:
            self._tell_plate(number, bank)
        rig = None if request.rig is None else self._read_rig(request.rig)
        if rig is not None and rig.actuators != bank.actuators:
            raise InputError(
                f"{request.rig} has {rig.actuators} actuators, {bank.path} {bank.actuators}: choose the rig that the"
                " bank was measured with"
            )
        self._check(quiet_s)
        scene = Scene(scene.name, scene.sources, self._plate.absolute(scene.regularisation), scene.output)
        drive = self._drives(number, scene, bank, rig)
        self._field(number, scene, bank, drive)
        self._tell(Done(number))

    def _tell_plate(self, number: int, bank: Bank) -> None:
        rows, surface = self._plate.rows, surface_of(bank)
        if not len(rows):
            raise InputError(f"{bank.path} has no measured position yet; the picture comes when it has")
        self._tell(Plate(number, rows, surface.with_rows(rows)))
        self._told_plate = True

    def _drives(self, number: int, scene: Scene, bank: Bank, rig: RigLimits | None) -> Drive:
        def told(done: int, total: int) -> None:
            self._check(0.0)
            self._tell(Progress(number, "drives", done / total))

        told(0, 1)
        limits = stricter(scene.output, rig)
        try:
            drive, limiting, warnings, lasts_s = render_while_edited(scene, bank, limits, told)
        except InputError as refused:
            if rows := missing_rows(scene, bank):
                raise InputError(missing_words(rows, str(refused))) from None
            raise
        self._check(0.0)
        self._tell(told_drive(number, scene, bank, drive, limits, rig, limiting, warnings, lasts_s))
        return drive

    def _field(self, number: int, scene: Scene, bank: Bank, drive: Drive) -> None:
        self._check(0.0)
        plate, factor, rate_hz = self._plate, self._plate.factor, self._plate.rate_hz
        looked = look_at_foci(drive, bank)
        whole = -(-(drive.drive_v.shape[1] + bank.taps - 1) // factor)
        samples = min(whole, max(1, self._most_field_bytes // (4 * len(plate.rows))))
        ends_s = drive.start_s + samples / rate_hz
        time_s = looked.time_s(drive.sample_rate_hz)
        seen = time_s < ends_s
        unit = field_unit(bank)
        marks = tuple(time_s[seen].tolist())
        limit = float(looked.peak[seen].max(initial=0.0))
        finer = FINER if factor > 1 else 1
        lasts_s = whole / rate_hz
        self._tell(FieldBegun(number, samples, rate_hz, drive.start_s, finer, unit, limit, marks, lasts_s))
        snapshots = Snapshots(looked, drive.sample_rate_hz, drive.start_s, rate_hz, len(plate.rows))
        shown = _beginning_of(drive, samples * factor, factor)
        parts, first = plate.parts(), 0
        for index, rows in enumerate(parts):
            self._check(0.0)
            self._tell(Progress(number, "field", index / len(parts)))
            field = Prediction(shown, plate.spectra(index, rows), rows).field().field[:, :samples]
            part = np.ascontiguousarray(field.T, np.float32)
            snapshots.take(first, part)
            self._tell(FieldPart(number, first, part))
            first += len(rows)
        self._tell(Progress(number, "figures", 0.0))
        self._tell(figures_of(number, snapshots, plate.rows, bank, scene, drive, lambda: self._check(0.0)))


def _beginning_of(drive: Drive, samples: int, factor: int) -> Drive:
    """As much of a drive as the first samples of its field are made of, the reach of a low-pass included."""
    most = samples + 64 * factor
    if drive.drive_v.shape[1] <= most:
        return drive
    return Drive(
        drive.drive_v[:, :most], drive.sample_rate_hz, drive.start_s, drive.method, drive.scale, drive.omitted_bound,
        drive.focus_sample, drive.focus_position, drive.focus_source, drive.drive_unit,
    )  # fmt: skip
