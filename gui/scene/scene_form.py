"""What holds for all of a scene: its name, how its drives are regularised, and what limits them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from PyQt5.QtWidgets import QCheckBox, QLabel, QVBoxLayout, QWidget

from gui.scene.document import SceneDocument
from gui.scene.draft import RegularisationDraft
from gui.scene.fields import ChoiceField, NumberField
from gui.scene.form import TINY, WIDE, Form
from gui.scene.surface.keys import OUTPUT_KEYS, REGULARISATION_KEYS, SCENE_KEYS

_SATURATIONS = (
    ("", "off"),
    ("saturation", "at a fraction of the bank's median"),
    ("saturation_absolute", "at a level of its own"),
)
_USUAL = {"saturation": 0.5, "saturation_absolute": 1e-4}
_STEPS = {"saturation": 0.1, "saturation_absolute": 1e-5}


class SceneForm(QWidget):
    """The numbers that all sources share.

    Parameters
    ----------
    document : SceneDocument
        What is edited.
    """

    def __init__(self, document: SceneDocument) -> None:
        super().__init__()
        self._document = document
        self._usual = dict(_USUAL)
        self.scene = Form(SCENE_KEYS)
        self.regularisation = Form(REGULARISATION_KEYS)
        self.output = Form(OUTPUT_KEYS)
        self.large = QCheckBox("Allow large scenes (--allow-large)")
        self.large.setAccessibleName("Allow large scenes")
        self.large.setToolTip("Render scenes of over an hour, 8 GiB of drives or a million path points, too")
        self.saturates = ChoiceField(
            "Saturation", _SATURATIONS,
            "Holds actuators back that are so near that they would drown the others (eq. 14)",
        )  # fmt: skip
        self.level = NumberField("Saturation level", "", TINY, WIDE, 0.1, "C of eq. (14), in the unit chosen above it")
        regularisation = self.regularisation.rows
        regularisation.insertRow(0, QLabel("C"), self.level)
        regularisation.insertRow(0, QLabel("Saturation"), self.saturates)
        column = QVBoxLayout(self)
        column.setContentsMargins(6, 6, 6, 6)
        for words, form in (
            ("Scene", self.scene),
            ("Regularisation", self.regularisation),
            ("Output", self.output),
        ):
            heading = QLabel(words)
            heading.setProperty("role", "strong")
            column.addWidget(heading)
            column.addWidget(form)
            column.addSpacing(6)
        column.addWidget(self.large)
        column.addStretch(1)
        width = max(label.sizeHint().width() for label in self.output.labels.values())
        for form in (self.scene, self.regularisation, self.output):
            form.align(width)
        self.large.toggled.connect(document.allow)
        self.scene.edited.connect(lambda key, value: self._edit({key: value}, f"scene {key}"))
        self.regularisation.edited.connect(lambda key, value: self._regularise({key: value}, ""))
        self.output.edited.connect(
            lambda key, value: self._edit({"output": replace(document.draft.output, **{key: value})}, f"output {key}")
        )
        self.saturates.edited.connect(self._saturate)
        self.level.edited.connect(lambda value: self._regularise({self._saturates(): value}, "level"))
        document.edited.connect(self.show_scene)
        self.show_scene()

    def show_scene(self) -> None:
        """Show the scene's numbers."""
        draft = self._document.draft
        self.scene.show_values(draft)
        self.regularisation.show_values(draft.regularisation)
        self.output.show_values(draft.output)
        which = self._saturates()
        self.saturates.show_value(which)
        self.level.setEnabled(bool(which))
        if which:
            self.level.setSingleStep(_STEPS[which])
            self.level.show_value(getattr(draft.regularisation, which))

    def _saturates(self) -> str:
        """Which of the two keys says where saturation begins; empty for neither."""
        held = self._document.draft.regularisation
        if held.saturation_absolute:
            return "saturation_absolute"
        return "saturation" if held.saturation else ""

    def _saturate(self, which: str) -> None:
        former = self._saturates()
        held = self._document.draft.regularisation
        if former:
            self._usual[former] = getattr(held, former)
        regularisation = RegularisationDraft(normalise=held.normalise)
        if which:
            level: dict[str, Any] = {which: self._usual[which]}
            regularisation = replace(regularisation, **level)
        self._edit({"regularisation": regularisation}, "")

    def _regularise(self, changes: dict[str, Any], gesture: str) -> None:
        self._edit({"regularisation": replace(self._document.draft.regularisation, **changes)}, gesture)

    def _edit(self, changes: dict[str, Any], gesture: str) -> None:
        self._document.edit("edit the scene", replace(self._document.draft, **changes), gesture=gesture)
