"""``wavefocus analyse``: statistics of the answers to trials, and a report."""

import json
from pathlib import Path

from wavefocus.console import say
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replaced_folder, require_replaceable_folder
from wavefocus.storage.text_file import read_regular
from wavefocus.trials.analysis.consistency import stored_design, unfit_rows
from wavefocus.trials.analysis.report import build_report, left_out_lines, percent
from wavefocus.trials.analysis.results import FORMAT, analysis_of
from wavefocus.trials.analysis.statistics import RIGHT
from wavefocus.trials.answers import ANSWERS, FACTS, read_answers, read_facts

_RESULT = "analysis.json"


def analyse(folder: Path, out: Path | None, *, force: bool, as_json: bool) -> None:
    """Analyse a folder of trials into a folder of results, by default its folder ``analysis``.

    Raises InputError: the answers are missing or damaged, there are none yet, or the results must stay.
    """
    out = folder / "analysis" if out is None else out
    require_replaceable_folder(out, _written(out), (folder / ANSWERS, folder / FACTS), by="analyse", force=force)
    rows, facts = read_answers(folder), read_facts(folder)
    if not rows:
        raise InputError(f"{folder / ANSWERS} holds no answer yet")
    design = stored_design(facts, folder / FACTS)
    left_out = unfit_rows(rows, design, facts)
    unfit = {row.line for row in left_out}
    rows = tuple(row for line, row in enumerate(rows, 2) if line not in unfit)
    if not rows:
        raise InputError(
            f"{folder / ANSWERS}: no row fits the experiment of {FACTS}; line {left_out[0].line}: {left_out[0].reason}"
        )
    analysis = analysis_of(rows, design.config.trials, design.config.adaptive, left_out)
    sources = [
        ("answers", f"{ANSWERS} of {folder.absolute().name}"),
        ("trials file", str(facts.get("trials_file", ""))),
        *(("trials file, SHA-256", one) for one in analysis.tables),
        *(("bank, SHA-256", one) for one in analysis.banks),
    ]
    html, pictures = build_report(analysis, sources)
    with replaced_folder(out) as place:
        (place / "report.html").write_bytes(html.encode())
        for picture in pictures:
            (place / f"{picture.name}.png").write_bytes(picture.png)
        names = sorted(path.name for path in place.iterdir())
        document = {**analysis.document(), "files": [*names, _RESULT]}
        (place / _RESULT).write_bytes((json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode())
    if as_json:
        print(json.dumps({**document, "out": str(out)}))
    whole = next((one for one in analysis.shares if not one.participant and not one.factors), None)
    right = f", {percent(whole.share)} right" if whole is not None and whole.outcome == RIGHT else ""
    people = len(analysis.trials)
    for line in left_out_lines(analysis):
        say(f"warning: {line}")
    say(f"{out / 'report.html'}: {len(rows)} answers of {people} participant{'s' * (people != 1)}{right}")


def _written(out: Path) -> set[str]:
    """Files that an earlier analysis wrote into a folder."""
    try:
        document = json.loads(read_regular(out / _RESULT))
        return {str(one) for one in document["files"]} if document["format"] == FORMAT else set()
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return set()
