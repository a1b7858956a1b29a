"""Answers as a folder in the layout of BIDS 1.10 for behavioural experiments (Brain Imaging Data Structure).

Each participant has a table ``sub-LABEL/beh/sub-LABEL_task-NAME_beh.tsv`` and a JSON file that describes its columns.
Labels hold only letters and digits; ``participants.tsv`` has the code of each label.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

from wavefocus.trials.analysis.results import Analysis
from wavefocus.trials.answers import COLUMNS, Row

BIDS_VERSION = "1.10.0"
_OF_THE_FILE = {"participant"}
"""Columns that the name of the file has."""


def write_bids(folder: Path, rows: Sequence[Row], analysis: Analysis, facts: Mapping[str, Any]) -> None:
    """Write the folder's files.

    folder: Exists and is empty.
    facts: Of ``trials.json``.
    """
    software = facts.get("software")
    version = str(software["wavefocus"]) if isinstance(software, dict) and "wavefocus" in software else "unknown"
    generated = [{"Name": "wavefocus", "Version": version}]
    named = {"Name": analysis.name, "BIDSVersion": BIDS_VERSION}
    _json(folder / "dataset_description.json", {**named, "DatasetType": "raw", "GeneratedBy": generated})
    _text(folder / "README", _readme(analysis))
    task = _label(analysis.name) or "trials"
    sidecar = {
        "TaskName": analysis.name,
        "TaskDescription": f"{analysis.question} Answers: {', '.join(analysis.answers)}.",
        "StimulusPresentation": {"SoftwareName": "wavefocus", "SoftwareVersion": version},
        **{name: about for name, about in COLUMNS.items() if name not in _OF_THE_FILE},
    }
    labels = _labels(sorted(analysis.trials))
    for code, label in labels.items():
        place = folder / f"sub-{label}" / "beh"
        place.mkdir(parents=True)
        stem = f"sub-{label}_task-{task}_beh"
        own = sorted((row for row in rows if row.participant == code), key=lambda row: row.trial)
        names = [field.name for field in fields(Row)]
        kept = [number for number, name in enumerate(names) if name not in _OF_THE_FILE]
        values = [[_cell(astuple(row)[number]) for number in kept] for row in own]
        _table(place / f"{stem}.tsv", [names[number] for number in kept], values)
        _json(place / f"{stem}.json", sidecar)
    people = [[f"sub-{label}", code, str(analysis.trials[code])] for code, label in labels.items()]
    _table(folder / "participants.tsv", ["participant_id", "code", "trials"], people)
    about = {
        "code": {"Description": "Code of the participant in trials.csv"},
        "trials": {"Description": "Number of answered trials"},
    }
    _json(folder / "participants.json", about)
    derived = folder / "derivatives" / "wavefocus"
    derived.mkdir(parents=True)
    derivative = {**named, "Name": f"{analysis.name}: analysis", "DatasetType": "derivative", "GeneratedBy": generated}
    _json(derived / "dataset_description.json", derivative)
    _json(derived / "analysis.json", analysis.document())


def _readme(analysis: Analysis) -> str:
    return (
        f"# {analysis.name}\n\nParticipants: {len(analysis.trials)}. Question: {analysis.question}\n\n"
        "Each row of sub-*/beh/*_beh.tsv is one answered trial; the JSON file of the same name describes the columns.\n"
        "Participants have codes; their names are not stored. derivatives/wavefocus/analysis.json has the statistics.\n"
    )


def _labels(codes: Sequence[str]) -> dict[str, str]:
    """A label of letters and digits for each code, no two alike but for capitals."""
    found: dict[str, str] = {}
    for code in codes:
        label = _label(code) or "0"
        while label.casefold() in {used.casefold() for used in found.values()}:
            label += "x"
        found[code] = label
    return found


def _label(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]", "", text)


def _cell(value: object) -> str:
    """A value of a TSV file; what is missing is n/a."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if value is None or value == "":
        return "n/a"
    return repr(value) if isinstance(value, float) else str(value)


def _table(path: Path, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    _text(path, "".join("\t".join(line) + "\n" for line in (head, *rows)))


def _json(path: Path, content: Mapping[str, object]) -> None:
    _text(path, json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def _text(path: Path, text: str) -> None:
    path.write_bytes(text.encode())
