"""Tables of the keys of configuration files and of the columns of answers, as Markdown, for docs/conf.py.

A line ``<!-- keys: rig mirror -->`` of a page stands for the table of the rig file's [mirror], a line
``<!-- columns -->`` for the columns of ``trials.csv``.
"""

from __future__ import annotations

import json
import re
from dataclasses import MISSING, fields

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from wavefocus.config.fields import FREE, explanation, fields_of, plan_mark, tables_of
from wavefocus.config.rig import RigConfig
from wavefocus.config.rig_instruments import DriverTable
from wavefocus.config.run import RunConfig
from wavefocus.config.scene import SceneConfig
from wavefocus.config.trials import TrialsConfig
from wavefocus.trials.answers import COLUMNS

FILES: dict[str, type[BaseModel]] = {"rig": RigConfig, "run": RunConfig, "scene": SceneConfig, "trials": TrialsConfig}
PLACE = re.compile(r"^<!-- keys: (\w+) ?([\w.]*) -->$", re.MULTILINE)


def with_tables(page: str) -> str:
    """A page with its tables."""
    return PLACE.sub(lambda place: table(place[1], place[2]), page).replace("<!-- columns -->", columns())


def columns() -> str:
    """The columns of ``trials.csv``."""
    lines = ["| column | meaning |", "|---|---|"]
    for name, about in COLUMNS.items():
        levels = ", ".join(f"`{level}` ({meaning})" for level, meaning in about.get("Levels", {}).items())
        unit = f", in {about['Units']}" if "Units" in about else ""
        lines.append(f"| `{name}` | {about['Description']}{unit}{': ' if levels else ''}{levels} |")
    return "\n".join(lines)


def table(file: str, heading: str = "") -> str:
    """The keys of a table of a file; ``rig``, ``watch.room``. Those that a plan's hash includes are marked #."""
    section = next(iter(tables_of(FILES[file], heading)), None) if heading else None
    drivers = section.drivers if section is not None and issubclass(section, DriverTable) else {}
    defaults = _defaults(section)
    whole = FILES[file].model_fields.get(heading.partition(".")[0])
    in_plan = file in ("rig", "run") and (whole is None or plan_mark(whole) is not FREE)
    lines = ["| key | default |" + (" drivers |" if drivers else "") + " meaning |"]
    lines.append("|---|---|---|" + ("---|" if drivers else ""))
    for key, field in fields_of(FILES[file], heading).items():
        if not (field.description or key == "driver"):  # a table of its own, or of a bank alone
            continue
        owners = {name: driver for name, driver in drivers.items() if key in {own.name for own in fields(driver)}}
        default = _default(defaults.get(key, PydanticUndefined), field)
        if owners:
            own = {
                name: next(own.default for own in fields(driver) if own.name == key) for name, driver in owners.items()
            }
            default = ", ".join(
                dict.fromkeys(filter(None, ("needed" if value is MISSING else _shown(value) for value in own.values())))
            )
        mark = " #" if in_plan and plan_mark(field) is not FREE else ""
        meaning = explanation(key, field).removeprefix(": ")
        cells = [f"`{key}`{mark}", default, *([", ".join(owners)] if drivers else []), meaning]
        lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    return "\n".join(lines)


def _defaults(section: type[BaseModel] | None) -> dict[str, object]:
    """What a table without keys becomes; empty where it needs some."""
    try:
        return dict(section.model_validate({})) if section is not None else {}
    except ValidationError:
        return {}


def _default(value: object, field: FieldInfo) -> str:
    if value is PydanticUndefined:
        value = field.get_default(call_default_factory=True)
    return "needed" if value is PydanticUndefined else _shown(value)


def _shown(value: object) -> str:
    """A value as a file has it; nothing where there is none, or where it is too long for a table."""
    if value is None or value == () or isinstance(value, BaseModel):
        return ""
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else f"{text[:40]} …"
