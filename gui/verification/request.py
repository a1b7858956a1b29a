"""The choices of a verification: scene, bank, rig, folder, positions."""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass
from pathlib import Path

from PyQt5.QtWidgets import QCheckBox, QComboBox, QGridLayout, QHBoxLayout, QLabel, QLineEdit, QSpinBox, QWidget

from gui.files import PathField
from gui.tab import TabContext
from gui.toml_files import names_virtual_rig
from gui.widgets import named
from rendering.verify.record import FIELD_NAMES, PICTURE_NAMES, RECORD_NAME, REPORT_NAME
from storage.errors import InputError

_CHOICES = (
    ("all", "all positions", "Every position of the bank"),
    ("every", "one position in", "For a quick look: one position of so many, in the bank's order"),
    ("path", "along the path", "What the scene is rendered from, and all within 15 mm of its paths"),
    ("selected", "selected on the map", "The positions that are selected in the Campaign tab, of this bank"),
    ("rows", "these rows", "Bank rows from 0: single or as ranges, 3,5-9"),
)
_FOLDER = "verify"


@dataclass(frozen=True, slots=True)
class Request:
    """The command of a verification, and the folder that it writes."""

    arguments: tuple[str, ...]
    out: Path
    is_virtual: bool


class RequestForm(QWidget):
    """Two rows of fields; `choice` holds the positions to scan."""

    def __init__(self, context: TabContext) -> None:
        super().__init__()
        self._context = context
        settings = context.settings
        self.scene = PathField("&Scene", ".toml", "scene file", settings)
        self.bank = PathField("&Bank", ".h5", "bank to verify", settings)
        self.rig = PathField("Ri&g", ".toml", "rig file", settings)
        self.out = PathField("F&older", "", "folder for the report", settings)
        tip = "Play on the virtual rig that comes with wavefocus, without a rig file"
        self.virtual = named(QCheckBox("virtual"), tip, "Virtual rig")
        self.positions = QComboBox()
        self.positions.setAccessibleName("Positions to scan")
        for key, words, _ in _CHOICES:
            self.positions.addItem(words, key)
        self.step = named(QSpinBox(), "One position in so many, in the bank's order", "One position in so many")
        self.step.setRange(2, 1000)
        self.rows = named(QLineEdit(), "Bank rows from 0: single or as ranges, 3,5-9", "Bank rows to scan")
        self.rows.setPlaceholderText("0-99,120")
        tip = "Allow scenes of over an hour, 8 GiB of drives or a million path points (--allow-large)"
        self.large = named(QCheckBox("large"), tip, "Allow large scenes")
        self.choice = QWidget()
        row = QHBoxLayout(self.choice)
        row.setContentsMargins(0, 0, 0, 0)
        label = QLabel("&Positions")
        label.setBuddy(self.positions)
        for part in (label, self.positions, self.step, self.rows, self.large):
            row.addWidget(part)
        rig = QHBoxLayout()
        rig.addWidget(self.rig, stretch=1)
        rig.addWidget(self.virtual)
        grid = QGridLayout(self)
        grid.setContentsMargins(0, 0, 0, 0)
        grid.addWidget(self.scene, 0, 0)
        grid.addWidget(self.bank, 0, 1)
        grid.addLayout(rig, 1, 0)
        grid.addWidget(self.out, 1, 1)
        for column, fields in enumerate(((self.scene, self.rig), (self.bank, self.out))):
            grid.setColumnStretch(column, 1)
            labels = [label for field in fields if (label := field.findChild(QLabel)) is not None]
            for label in labels:
                label.setMinimumWidth(max(one.sizeHint().width() for one in labels))
        self.bank.chosen.connect(self.take_bank)
        for field in (self.scene, self.rig):
            field.chosen.connect(settings.opened)
        self.virtual.toggled.connect(self.rig.setDisabled)
        self.positions.currentIndexChanged.connect(self._show_choice)
        self._restore_settings()
        self._show_choice()

    def take_bank(self, bank: Path) -> None:
        """Verify a bank; empty fields are filled with the files next to it."""
        self.bank.show_path(bank)
        self._context.settings.opened(bank)
        for field, name in ((self.scene, "scene.toml"), (self.rig, "rig.toml")):
            if field.path is None and (neighbour := bank.with_name(name)).is_file():
                field.show_path(neighbour)
        if self.out.path is None:
            self.out.show_path(bank.with_name(_FOLDER))

    def missing(self) -> str:
        """What has to be chosen first; empty when a verification can be started."""
        fields = [(self.scene, "a scene file"), (self.bank, "a bank"), (self.out, "a folder")]
        if not self.virtual.isChecked():
            fields.insert(2, (self.rig, "a rig file, or the virtual rig"))
        words = [word for field, word in fields if field.path is None]
        return "" if not words else f"choose {', and '.join(words)}"

    def request(self) -> Request:
        """The command of the present choices; results in the folder are kept, and a numbered folder is used instead.

        Raises
        ------
        InputError
            A choice is missing, or the positions are wrong.
        """
        if missing := self.missing():
            raise InputError(f"{missing} first")
        scene, bank, out = self.scene.path, self.bank.path, self.out.path
        assert scene is not None
        assert bank is not None
        assert out is not None
        out = unused_folder(out)
        rig = "virtual" if self.virtual.isChecked() else str(self.rig.path)
        arguments = ["verify", str(scene), "--bank", str(bank), "--rig", rig, "--out", str(out), "--json"]
        if self.large.isChecked():
            arguments.append("--allow-large")
        if positions := self._positions(bank):
            arguments += ["--positions", positions]
        return Request(tuple(arguments), out, names_virtual_rig(rig))

    def save_settings(self) -> None:
        """Keep the choices for the next session."""
        settings = self._context.settings
        for name, field in self._fields().items():
            settings.keep(f"verification/{name}", str(field.path or ""))
        settings.keep("verification/virtual", int(self.virtual.isChecked()))
        settings.keep("verification/positions", str(self.positions.currentData()))
        settings.keep("verification/step", self.step.value())
        settings.keep("verification/rows", self.rows.text())

    def _positions(self, bank: Path) -> str:
        match self.positions.currentData():
            case "every":
                return f"every:{self.step.value()}"
            case "path":
                return "path"
            case "selected":
                return self._selected(bank)
            case "rows":
                text = self.rows.text().strip()
                if not text:
                    raise InputError("name the bank rows to scan, as 3,5-9, or choose other positions")
                return text
        return ""

    def _selected(self, bank: Path) -> str:
        selection = self._context.selection
        if not selection.rows or selection.bank is None:
            raise InputError("nothing is selected on the campaign's map; Ctrl-click or Shift-drag there selects")
        if selection.bank.absolute() != bank.absolute():
            raise InputError(
                f"the campaign's map shows {selection.bank}, and {bank} is to be verified; open that bank in the "
                "Campaign tab and select there"
            )
        return ",".join(str(row) for row in sorted(selection.rows))

    def _show_choice(self) -> None:
        key = self.positions.currentData()
        self.positions.setToolTip(next(tip for one, _, tip in _CHOICES if one == key))
        self.step.setVisible(key == "every")
        self.rows.setVisible(key == "rows")

    def _restore_settings(self) -> None:
        settings = self._context.settings
        for name, field in self._fields().items():
            if text := settings.text(f"verification/{name}"):
                field.show_path(Path(text))
        self.virtual.setChecked(settings.whole("verification/virtual", 0) == 1)
        self.positions.setCurrentIndex(max(0, self.positions.findData(settings.text("verification/positions", "all"))))
        self.step.setValue(settings.whole("verification/step", 4))
        self.rows.setText(settings.text("verification/rows"))

    def _fields(self) -> dict[str, PathField]:
        return {"scene": self.scene, "bank": self.bank, "rig": self.rig, "out": self.out}


def unused_folder(folder: Path) -> Path:
    """Return the folder, or the first of ``NAME-2``, ``NAME-3``, ... where it holds results of a verification."""
    if not _holds_results(folder):
        return folder
    stem, _, number = folder.name.rpartition("-")
    first = folder.with_name(stem) if stem and number.isdecimal() else folder
    if first != folder and not first.is_dir():
        first = folder
    numbered = (first.with_name(f"{first.name}-{count}") for count in itertools.count(2))
    return next(one for one in numbered if not _holds_results(one))


def _holds_results(folder: Path) -> bool:
    names = (RECORD_NAME, REPORT_NAME, *FIELD_NAMES, *PICTURE_NAMES)
    return any(os.path.lexists(folder / name) for name in names) or (os.path.lexists(folder) and not folder.is_dir())
