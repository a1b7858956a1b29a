"""The metadata of a published bank: an RO-Crate 1.2 (https://w3id.org/ro/crate/1.2), a README, and checksums."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

from wavefocus.campaign.provenance import SessionRecord
from wavefocus.config.run import Publication
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.storage.text_file import read_regular

METADATA_NAME, README_NAME, SUMS_NAME = "ro-crate-metadata.json", "README.md", "SHA256SUMS"
_CRATE = "https://w3id.org/ro/crate/1.2"
_MEDIA_TYPES = {
    ".csv": "text/csv",
    ".json": "application/json",
    ".mat": "application/x-matlab-data",
    ".md": "text/markdown",
    ".nc": "application/x-netcdf",
    ".npz": "application/zip",
    ".png": "image/png",
    ".sofa": "application/x-netcdf",
    ".wav": "audio/wav",
}
_ACTION_STATUS = {
    "finished": "http://schema.org/CompletedActionStatus",
    "stopped": "http://schema.org/CompletedActionStatus",
    "failed": "http://schema.org/FailedActionStatus",
}
Entity = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Part:
    """A file or, ending with a slash, a folder of the crate: its name and what it holds."""

    name: str
    holds: str


@dataclass(frozen=True, slots=True)
class Crate:
    """All that is said of a published bank.

    facts: Name, value and unit of each figure of the measurement; an empty unit where it has none.
    parts: Its exports and pictures.
    devices: Who the instruments are, by role.
    software: Program that measured the bank.
    origin: Report of the import of a bank that was measured elsewhere; else empty.
    """

    title: str
    description: str
    publication: Publication
    facts: Sequence[tuple[str, float | str, str]]
    parts: Sequence[Part]
    devices: Mapping[str, DeviceIdentity]
    sessions: Sequence[SessionRecord]
    software: str
    origin: str = ""
    published: date = field(default_factory=lambda: datetime.now(UTC).date())

    def write(self, folder: Path) -> None:
        """Write README, metadata and checksums of a folder that holds the parts."""
        (folder / README_NAME).write_text(self.readme(), encoding="utf-8", newline="\n")
        sums = _checksums(folder, [part for part in folder.rglob("*") if part.is_file()])
        graph = {entity["@id"]: entity for entity in self._entities(folder, sums)}  # one of people of one name
        metadata = {"@context": f"{_CRATE}/context", "@graph": list(graph.values())}
        text = json.dumps(metadata, indent=2, ensure_ascii=False) + "\n"
        (folder / METADATA_NAME).write_text(text, encoding="utf-8", newline="\n")
        sums |= _checksums(folder, [folder / METADATA_NAME])
        lines = "".join(f"{sums[name]}  {name}\n" for name in sorted(sums))
        (folder / SUMS_NAME).write_text(lines, encoding="utf-8", newline="\n")

    def readme(self) -> str:
        """The README for people."""
        return "\n\n".join(part for part in self._readme_parts() if part) + "\n"

    def _readme_parts(self) -> Iterator[str]:
        about = self.publication
        yield f"# {as_markdown(self.title)}"
        yield "\n\n".join(as_markdown(part) for part in re.split(r"\n\s*\n", self.description))
        people = ", ".join(person.name for person in about.people)
        yield "\n".join(
            f"- {name}: {as_markdown(text)}"
            for name, text in (
                ("Authors", people),
                ("Publisher", about.organisation),
                ("Licence", about.licence or "not stated yet"),
                ("Set-up", about.room),
                ("References", ", ".join(about.references)),
                ("Prepared", f"{self.published.isoformat()} with wavefocus {version('wavefocus')}"),
            )
            if text
        )
        yield "## Files"
        files = (*self.parts, Part(METADATA_NAME, "this description for programs (RO-Crate)"))
        sums = f"| `{SUMS_NAME}` | checksums of all files; `sha256sum -c SHA256SUMS` verifies them |"
        rows = [f"| `{part.name}` | {as_markdown(part.holds)} |" for part in files]
        yield "\n".join(["| file | holds |", "|---|---|", *rows, sums])
        for name in (part.name for part in self.parts if part.name.endswith(".nc")):
            yield f'```python\nimport xarray\n\nbank = xarray.open_dataset("{name}", engine="h5netcdf")\n```'
        yield "## Measurement"
        figures = (
            (as_markdown(name), f"{_shown(value)} {as_markdown(unit)}".rstrip()) for name, value, unit in self.facts
        )
        yield "\n".join(["| figure | value |", "|---|---|", *(f"| {name} | {value} |" for name, value in figures)])
        yield CONVENTIONS
        for part in self.parts:
            if part.name.endswith(".png"):
                words = as_markdown(part.holds)
                yield f"![{words}]({part.name})\n\n*{words[0].upper()}{words[1:]}.*"
        if self.origin:
            yield f"## Origin\n\n{as_markdown(self.origin)}"
        if self.devices:
            yield "## Instruments"
            devices = [(role, as_markdown(str(identity)) or "not stated") for role, identity in self.devices.items()]
            yield "\n".join(f"- {as_markdown(role)}: {words}" for role, words in devices)
        if self.sessions:
            yield "## Sessions"
            yield "\n".join(
                f"- {one.started:%Y-%m-%d %H:%M} to {one.ended:%Y-%m-%d %H:%M} UTC: {as_markdown(one.summary)}"
                for one in self.sessions
            )

    def _entities(self, folder: Path, sums: Mapping[str, str]) -> Iterator[Entity]:
        about = self.publication
        people = {person.name: _person_id(person.name, person.orcid) for person in about.people}
        places = dict.fromkeys([person.affiliation for person in about.people] + [about.organisation])
        licence = licence_id(about.licence) if about.licence else None
        facts = [f"#fact-{number}" for number in range(len(self.facts))]
        data = [part.name for part in self.parts if not part.name.endswith(".png")]
        yield {
            "@id": METADATA_NAME, "@type": "CreativeWork", "about": {"@id": "./"}, "conformsTo": {"@id": _CRATE},
        }  # fmt: skip
        parts = [*(part.name for part in self.parts), README_NAME, SUMS_NAME]
        yield _known({
            "@id": "./", "@type": "Dataset", "name": self.title, "description": self.description,
            "datePublished": self.published.isoformat(), "license": _reference(licence),
            "author": _references(people.values()), "publisher": _reference(_slug("organisation", about.organisation)),
            "keywords": ", ".join(about.keywords), "citation": list(about.references),
            "isPartOf": _reference(_slug("collection", about.database)), "variableMeasured": _references(facts),
            "hasPart": _references(quote(name) for name in parts),
            "mentions": _references([*(f"#session-{number}" for number in range(1, len(self.sessions) + 1)),
                                     *(["#import"] if self.origin else [])]),
        })  # fmt: skip
        if self.origin:
            yield {
                "@id": "#import", "@type": "CreateAction", "name": "Import of a measurement made elsewhere",
                "description": self.origin, "instrument": {"@id": "#software"},
            }  # fmt: skip
        if licence:
            yield {"@id": licence, "@type": "CreativeWork", "name": about.licence, "description": "Licence of the data"}
        for person in about.people:
            yield _known({
                "@id": people[person.name], "@type": "Person", "name": person.name,
                "affiliation": _reference(_slug("organisation", person.affiliation)),
            })  # fmt: skip
        for place in filter(None, places):
            yield {"@id": _slug("organisation", place), "@type": "Organization", "name": place}
        if about.database:
            yield {"@id": _slug("collection", about.database), "@type": "Collection", "name": about.database}
        for part in (*self.parts, Part(README_NAME, "description for people"), Part(SUMS_NAME, "checksums")):
            yield _part(part, folder, sums)
        for identifier, (name, value, unit) in zip(facts, self.facts, strict=True):
            yield _known({"@id": identifier, "@type": "PropertyValue", "name": name, "value": value, "unitText": unit})
        for role, identity in self.devices.items():
            yield _known({
                "@id": f"#device-{role}", "@type": "IndividualProduct", "category": role,
                "name": f"{role}: {identity.product or 'not stated'}",
                "manufacturer": identity.maker, "serialNumber": identity.serial,
            })  # fmt: skip
        known = re.match(r"(\S+) (\d[\w.+-]*)", self.software)
        name, number = known.groups() if known else (self.software, "")
        yield _known({"@id": "#software", "@type": "SoftwareApplication", "name": name, "version": number})
        instruments = _references(["#software", *(f"#device-{role}" for role in self.devices)])
        for number, session in enumerate(self.sessions, 1):
            yield _known({
                "@id": f"#session-{number}", "@type": "CreateAction", "name": f"Measurement, session {number}",
                "startTime": session.started.isoformat(), "endTime": session.ended.isoformat(),
                "actionStatus": _ACTION_STATUS.get(session.outcome),
                "description": session.summary, "instrument": instruments, "agent": _references(people.values()),
                "result": _references(quote(name) for name in data),
            })  # fmt: skip


CONVENTIONS = (
    "Coordinates are millimetres on the surface: origin at its centre, x right, y up, seen from the laser. A Green's "
    "function g is a discrete FIR from drive sample to response sample, without a factor dt: the response at a "
    "position is the sum over the actuators of g convolved with the actuator's drive; tap 0 is the instant of the "
    "drive sample."
)


_ADDRESS = re.compile(r"https?://[^\s<>()\[\]\"'`\\\\|]+")
_SCRIPT = re.compile(r"(?i)\b(javascript|vbscript|data):(?=\S)")


def as_markdown(text: str) -> str:
    """A text of others as one line of Markdown that shows it: no HTML, links, headings, emphasis or tables.

    Addresses that begin with http stay as they are.
    """
    words = " ".join(text.split())
    shown, end = [], 0
    for address in _ADDRESS.finditer(words):
        shown += [_escaped(words[end : address.start()]), address[0]]
        end = address.end()
    line = "".join([*shown, _escaped(words[end:])])
    return re.sub(
        r"^(\d{1,9})([.)])(?=\s|$)|^([-+=#])", lambda found: (found[1] or "") + "\\" + (found[2] or found[3]), line
    )


def _escaped(text: str) -> str:
    text = re.sub(r"&(?=#?\w+;)", "&amp;", text).replace("<", "&lt;").replace(">", "&gt;")
    text = re.sub(r"[\\`*\[\]|~]|(?<!\w)_|_(?!\w)", r"\\\g<0>", text)
    return _SCRIPT.sub(r"\1&#58;", text)


def licence_id(licence: str) -> str:
    """An address for a licence: its own, that of SPDX for an identifier such as ``CC-BY-4.0``, or one of the crate."""
    if re.fullmatch(r"https?://\S+", licence):
        return licence
    if re.fullmatch(r"[A-Za-z0-9]+(-[A-Za-z0-9.]+)*-[0-9][A-Za-z0-9.+-]*|MIT|ISC|0BSD|Unlicense", licence):
        return f"https://spdx.org/licenses/{licence}"
    return "#licence"


def published_files(folder: Path) -> set[str]:
    """Names of all files that the checksums in a folder list, and of the list; empty where there is none."""
    try:
        lines = read_regular(folder / SUMS_NAME).decode().splitlines()
    except (OSError, ValueError):
        return set()
    return {SUMS_NAME, *(line.partition("  ")[2] for line in lines)}


def _part(part: Part, folder: Path, sums: Mapping[str, str]) -> Entity:
    entity = {"@id": quote(part.name), "@type": "File", "name": part.name, "description": part.holds}
    if part.name.endswith("/"):
        return {**entity, "@type": "Dataset"}
    media = _MEDIA_TYPES.get(
        Path(part.name).suffix, "text/plain" if part.name == SUMS_NAME else "application/octet-stream"
    )
    entity["encodingFormat"] = media
    if part.name in sums:
        entity |= {"contentSize": str((folder / part.name).stat().st_size), "sha256": sums[part.name]}
    return entity


def _checksums(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    sums = {}
    for path in files:
        with path.open("rb") as file:
            sums[path.relative_to(folder).as_posix()] = hashlib.file_digest(file, "sha256").hexdigest()
    return sums


def _person_id(name: str, orcid: str | None) -> str:
    return f"https://orcid.org/{orcid}" if orcid else str(_slug("person", name))


def _slug(kind: str, name: str | None) -> str | None:
    return f"#{kind}-{quote(name, safe='')}" if name else None


def _reference(identifier: str | None) -> Entity | None:
    return {"@id": identifier} if identifier else None


def _references(identifiers: Iterable[str]) -> list[Entity]:
    return [{"@id": one} for one in dict.fromkeys(identifiers)]


def _known(entity: Entity) -> Entity:
    """What is known of an entity; one value alone is no list, as RO-Crate recommends."""
    known = {key: value for key, value in entity.items() if value not in (None, "", [])}
    return {key: value[0] if isinstance(value, list) and len(value) == 1 else value for key, value in known.items()}


def _shown(value: float | str) -> str:
    return as_markdown(value) if isinstance(value, str) else f"{value:.6g}"
