"""Sessions as bluesky's documents: against the schemas of event-model, and read by its own tools."""

from __future__ import annotations

import json
from pathlib import Path

import event_model
import h5py
import pytest

from tests.lab_files import POSITIONS
from tests.system.conftest import with_faults
from wavefocus.__main__ import run

NAMES = event_model.DocumentNames


def _documents(file: Path) -> list[tuple[str, dict]]:
    return [(line["name"], line["doc"]) for line in map(json.loads, file.read_text("utf-8").splitlines())]


def test_given_a_session_then_each_document_keeps_its_schema_and_names_the_bank(lab: Path) -> None:
    bank, file = lab / "plate.h5", lab / "documents.jsonl"
    assert run(["capture", str(lab / "run.toml"), "--bank", str(bank), "--documents", str(file)]) == 0
    documents = _documents(file)
    for name, document in documents:
        event_model.schema_validators[NAMES[name]].validate(document)
    assert [name for name, _ in documents][:3] == ["start", "descriptor", "stream_resource"]
    events = [document for name, document in documents if name == "event"]
    assert [[event["data"]["x_mm"], event["data"]["y_mm"]] for event in events] == POSITIONS
    datums = [document for name, document in documents if name == "stream_datum"]
    assert [datum["indices"]["start"] for datum in datums] == list(range(len(POSITIONS)))
    resource = next(document for name, document in documents if name == "stream_resource")
    with h5py.File(resource["uri"].removeprefix("file://")) as content:
        descriptor = next(document for name, document in documents if name == "descriptor")
        assert list(content[resource["parameters"]["dataset"]].shape) == descriptor["data_keys"]["green"]["shape"]
    assert documents[-1][1]["exit_status"] == "success"
    assert documents[-1][1]["num_events"] == {"primary": len(POSITIONS)}
    # event-model's own router takes them, as bluesky's callbacks do.
    seen = []
    router = event_model.DocumentRouter()
    router.event = seen.append
    for name, document in documents:
        router(name, document)
    assert len(seen) == len(POSITIONS)


def test_given_a_failed_session_and_a_resume_then_both_are_runs_of_one_file(lab: Path) -> None:
    with_faults(lab, 'role = "player"\noperation = "play"\nkind = "lost"\nposition = 3')
    bank, file = lab / "plate.h5", lab / "documents.jsonl"
    assert run(["capture", str(lab / "run.toml"), "--bank", str(bank), "--documents", str(file)]) == 3
    documents = _documents(file)
    assert documents[-1][1]["exit_status"] == "fail"
    starts = [document for name, document in documents if name == "start"]
    assert len(starts) == 1
    run(["resume", str(bank), "--documents", str(file)])
    starts = [document for name, document in _documents(file) if name == "start"]
    assert len(starts) == len({start["uid"] for start in starts}) == 2


def test_given_a_file_of_something_else_then_the_campaign_goes_on_and_the_file_stays(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = lab / "thesis.txt"
    file.write_text("chapter 1\n", encoding="utf-8")
    assert run(["capture", str(lab / "run.toml"), "--bank", str(lab / "plate.h5"), "--documents", str(file)]) == 0
    assert file.read_text("utf-8") == "chapter 1\n"
    assert "thesis.txt" in capsys.readouterr().err
