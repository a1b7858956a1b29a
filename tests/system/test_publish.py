"""A bank published as a folder for a data repository: an RO-Crate that its own library reads."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from rocrate.rocrate import ROCrate

from wavefocus.__main__ import run
from wavefocus.crate import licence_id
from wavefocus.storage.bank.reading import open_bank

PUBLICATION = """
[publication]
title = "Three coils"
description = "A small plate."
licence = "CC-BY-4.0"
organisation = "A University"
database = "plates"
room = "laboratory"
keywords = ["haptics"]
references = ["https://doi.org/10.1000/xyz"]
people = [
    { name = "Jane D\u00f6e", orcid = "0000-0002-1825-0097", affiliation = "A University" },
    { name = "John Roe" },
    { name = "John Roe" },
]
"""


@pytest.fixture
def publication(tmp_path: Path) -> Path:
    (tmp_path / "publication.toml").write_text(PUBLICATION, encoding="utf-8")
    return tmp_path / "publication.toml"


def publish(bank: Path, out: Path, *options: object) -> int:
    return run(["publish", str(bank), "--out", str(out), *map(str, options)])


@pytest.fixture
def crate(bank: Path, tmp_path: Path, publication: Path) -> Path:
    assert publish(bank, tmp_path / "crate", "--publication", publication, "--to", "netcdf,mat,wav,csv") == 0
    return tmp_path / "crate"


def test_given_a_publication_then_the_crates_library_reads_who_what_and_how(crate: Path) -> None:
    found = ROCrate(crate)
    root = found.root_dataset
    assert (found.name, root["description"], found.license["name"]) == ("Three coils", "A small plate.", "CC-BY-4.0")
    assert found.license.id == "https://spdx.org/licenses/CC-BY-4.0"
    assert [one.id for one in root["author"]] == ["https://orcid.org/0000-0002-1825-0097", "#person-John%20Roe"]
    assert root["author"][0]["affiliation"]["name"] == root["publisher"]["name"] == "A University"
    parts = {one.id for one in root["hasPart"]}
    assert parts >= {"plate.nc", "plate.mat", "plate-wav/", "plate.csv", "README.md", "quality.png", "green.png"}
    assert all((crate / one).exists() for one in parts)
    session = found.dereference("#session-1")
    assert session.type == "CreateAction"
    assert session["startTime"] <= session["endTime"]
    assert session["actionStatus"] == "http://schema.org/CompletedActionStatus"
    instruments = {one.id: one for one in session["instrument"]}
    assert set(instruments) == {"#software", "#device-mirror", "#device-recorder", "#device-player"}
    assert instruments["#software"]["name"] == "wavefocus"
    facts = {one["name"]: one["value"] for one in root["variableMeasured"]}
    assert (facts["measured positions"], facts["taps"], facts["sample rate"]) == (6, 1000, 10_000.0)


def test_given_a_crate_then_its_terms_are_those_of_its_context_and_every_reference_leads_somewhere(
    crate: Path,
) -> None:
    metadata = json.loads((crate / "ro-crate-metadata.json").read_text(encoding="utf-8"))
    terms = json.loads(files("rocrate").joinpath("data/ro-crate.jsonld").read_text(encoding="utf-8"))["@context"]
    known = {one["@id"] for one in metadata["@graph"]}
    assert len(known) == len(metadata["@graph"])

    def references(value: Any) -> list[str]:
        if isinstance(value, dict):
            return [value["@id"]]
        return [one for part in value for one in references(part)] if isinstance(value, list) else []

    for entity in metadata["@graph"]:
        assert {key for key in entity if not key.startswith("@")} | {entity["@type"]} <= set(terms), entity
        for key, value in entity.items():
            if key not in ("conformsTo", "citation"):
                assert set(references(value)) <= known, (entity["@id"], key)


def test_given_a_crate_then_every_file_is_whole_by_its_checksum(crate: Path) -> None:
    listed = dict(reversed(line.split("  ")) for line in (crate / "SHA256SUMS").read_text("utf-8").splitlines())
    there = {one.relative_to(crate).as_posix() for one in crate.rglob("*") if one.is_file()}
    assert set(listed) == there - {"SHA256SUMS"}
    for name, digest in listed.items():
        assert hashlib.sha256((crate / name).read_bytes()).hexdigest() == digest
    entity = ROCrate(crate).dereference("plate.nc")
    assert (entity["sha256"], int(entity["contentSize"])) == (listed["plate.nc"], (crate / "plate.nc").stat().st_size)


def test_given_a_crate_then_its_exports_hold_the_banks_rows(bank: Path, crate: Path) -> None:
    with open_bank(bank) as view, open_bank(crate / "plate.nc") as copy:
        green = np.stack([view.green(row) for row in range(view.positions)])
        assert np.array_equal(np.stack([copy.green(row) for row in range(copy.positions)]), green)
        assert np.array_equal(copy.quality["snr_db"], view.quality["snr_db"])
    assert np.array_equal(scipy.io.loadmat(crate / "plate.mat")["green"], green)
    assert len(list((crate / "plate-wav").glob("*.wav"))) == 6


def test_given_a_crate_then_the_readme_says_it_to_people(crate: Path) -> None:
    text = (crate / "README.md").read_text(encoding="utf-8")
    assert text.startswith("# Three coils\n")
    assert all(
        words in text for words in ("Jane D\u00f6e, John Roe, John Roe", "CC-BY-4.0", "laboratory", "## Sessions")
    )
    for name in re.findall(r"\]\((\S+)\)", text):
        assert (crate / name).read_bytes().startswith(b"\x89PNG")


def test_given_secrets_addresses_and_folders_in_the_configuration_then_none_is_published(
    lab: Path, tmp_path: Path, publication: Path
) -> None:
    secret = "mailto://jane:hunter2@example.org"
    with (lab / "rig.toml").open("a", encoding="utf-8") as file:
        file.write(f'\n[messages]\nurls = ["{secret}"]\n\n[[usb]]\nrole = "recorder"\nvendor_id = 1\nproduct_id = 2\n'
                   'serial_number = "SN-0042"\n')  # fmt: skip
    bank = lab / "plate.h5"
    assert run(["capture", str(lab / "run.toml"), "--bank", str(bank)]) == 0
    assert publish(bank, tmp_path / "crate", "--publication", publication, "--to", "netcdf,sofa,uff,npz,wav,csv") == 0
    content = b"".join(one.read_bytes() for one in (tmp_path / "crate").rglob("*") if one.is_file())
    for word in ("hunter2", "example.org", str(tmp_path), tmp_path.name, "rig.toml"):
        assert word.encode() not in content, word
    assert ROCrate(tmp_path / "crate").dereference("#device-recorder")["serialNumber"] == "SN-0042"


def test_given_a_bank_of_another_program_then_it_is_published_without_history(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["green"] = np.random.default_rng(1).standard_normal((4, 2, 50)).astype(np.float32)
        file["position_mm"] = [[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]]
        file.attrs["sample_rate_hz"] = 2000.0
    assert publish(tmp_path / "foreign.h5", tmp_path / "crate", "--json") == 0
    told = capsys.readouterr()
    assert "not stated: title, licence, people" in told.err
    assert json.loads(told.out)["sessions"] == 0
    found = ROCrate(tmp_path / "crate")
    assert "license" not in found.root_dataset
    assert found.dereference("plate.nc") is None
    assert (tmp_path / "crate" / "positions.png").is_file()  # no quality is known: the status is drawn


def test_given_an_imported_bank_then_its_origin_is_published(bank: Path, tmp_path: Path) -> None:
    assert run(["export", str(bank), str(tmp_path / "plate.npz"), "--to", "npz"]) == 0
    assert run(["import", str(tmp_path / "plate.npz"), "--bank", str(tmp_path / "imported.h5")]) == 0
    assert publish(tmp_path / "imported.h5", tmp_path / "crate") == 0
    found = ROCrate(tmp_path / "crate")
    assert "plate.npz" in found.dereference("#import")["description"]
    assert found.dereference("#device-mirror") is None
    assert found.dereference("#import")["description"] in (tmp_path / "crate" / "README.md").read_text("utf-8")


def test_given_an_earlier_publication_then_force_replaces_it_whole(
    bank: Path, crate: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (crate / "SHA256SUMS").read_bytes()
    assert publish(bank, crate) == 2
    assert "--force" in capsys.readouterr().err
    assert (crate / "SHA256SUMS").read_bytes() == before
    assert publish(bank, crate, "--to", "npz", "--force") == 0
    assert sorted(one.name for one in crate.iterdir()) == sorted(
        ["plate.npz", "quality.png", "green.png", "spectrum.png", "README.md", "SHA256SUMS", "ro-crate-metadata.json"]
    )
    assert not list(crate.parent.glob(".*.partial"))


def stranger(crate: Path, bank: Path) -> Path:
    (crate / "notes.txt").write_text("mine", encoding="utf-8")
    return bank


def of_itself(crate: Path, bank: Path) -> Path:
    return crate / "plate.nc"


@pytest.mark.parametrize(("prepare", "told"), [(stranger, "holds notes.txt"), (of_itself, "is an input")])
def test_given_a_folder_with_something_to_keep_then_not_even_force_replaces_it(
    bank: Path, crate: Path, capsys: pytest.CaptureFixture[str], prepare: Callable[[Path, Path], Path], told: str
) -> None:
    source = prepare(crate, bank)
    before = {one: one.read_bytes() for one in crate.rglob("*") if one.is_file()}
    assert publish(source, crate, "--force") == 2
    assert told in capsys.readouterr().err
    assert {one: one.read_bytes() for one in crate.rglob("*") if one.is_file()} == before


def test_given_a_format_that_does_not_exist_then_nothing_is_written(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert publish(bank, tmp_path / "crate", "--to", "npz,doc") == 2
    assert "'doc'" in capsys.readouterr().err
    assert not (tmp_path / "crate").exists()


@pytest.mark.parametrize(
    ("licence", "address"),
    [
        ("CC-BY-4.0", "https://spdx.org/licenses/CC-BY-4.0"),
        ("CC0-1.0", "https://spdx.org/licenses/CC0-1.0"),
        ("MIT", "https://spdx.org/licenses/MIT"),
        ("https://example.org/terms", "https://example.org/terms"),
        ("for teaching, 2026", "#licence"),
    ],
)
def test_given_a_licence_then_its_address_is_found(licence: str, address: str) -> None:
    assert licence_id(licence) == address
