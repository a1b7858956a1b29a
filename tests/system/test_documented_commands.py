"""Every command line in README, tutorial and how-tos works as its page shows it, in the page's order.

Commands are the lines of `sh` and `console` blocks and the inline code of numbered lists. A `console` block marks them
with "$ " and shows some of what they print, numbers aside. Comments, which a reader of the page does not see, say more:

    <!-- not run: REASON -->   before a block or a command: it needs hardware, a network or a person, and is parsed only
    <!-- Ctrl-C -->            after the first position; the exit code is 130
    <!-- file: NAME -->        before a block: the file that the reader writes
    <!-- shell -->             before a block: it is carried out as a whole, sh by a POSIX shell, bat by Windows' own
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest
from markdown_it import MarkdownIt

from tests.lab_files import RIG, RUN, change_text, write_positions
from wavefocus.__main__ import run
from wavefocus.cli import parser
from wavefocus.storage.errors import InputError

ROOT = Path(__file__).parents[2]
EVERY = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = [page for page in EVERY if page.parent == ROOT or page.parent.name in ("tutorial", "how-to")]
BY_PAGE = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


class Step(NamedTuple):
    """A command, a file or lines of Python of a page; what the page shows of its output."""

    kind: str  # "command", "mention", "file", "python", "sh", "bat"
    text: str
    note: str = ""
    shown: tuple[str, ...] = ()


def steps(page):
    """The steps of a page, in order."""
    note, numbered = "", 0
    for token in MarkdownIt("commonmark").parse(page.read_text(encoding="utf-8")):
        numbered += {"ordered_list_open": 1, "ordered_list_close": -1}.get(token.type, 0)
        if token.type == "html_block":
            note = comment(token.content)
        elif token.type == "paragraph_close":
            note = ""
        elif token.type == "fence":
            yield from block(token.info, token.content, note)
            note = ""
        elif token.type == "inline":
            for child in token.children or ():
                if child.type == "html_inline":
                    note = comment(child.content)
                elif child.type == "code_inline" and child.content.startswith("wavefocus "):
                    whole = numbered and len(child.content.split()) > 2 and "..." not in child.content
                    yield Step("command" if whole else "mention", child.content, note)
                    note = ""


def block(language, content, note):
    """The steps of a fenced block."""
    if note.startswith("file: "):
        yield Step("file", content, note.removeprefix("file: "))
    elif note == "shell":
        yield Step(language, content, note)
        for command in re.findall(r"\bwavefocus .*?(?=;|$)", content, re.MULTILINE):
            yield Step("mention", command.replace("\\", "/"), note)
    elif language == "sh":
        yield from (Step("command", line, note) for line in content.replace("\\\n", " ").splitlines())
    elif language == "console":
        for part in re.split(r"^\$ ", content.replace("\\\n", " "), flags=re.MULTILINE)[1:]:
            command, *shown = part.splitlines()
            yield Step("command", command, note, tuple(line for line in shown if line.strip(" .")))
    elif language == "python":
        yield Step("python", content, note)
    else:
        assert not re.search(r"^(\$ )?wavefocus [a-z-]", content, re.MULTILINE), (
            f"a block of commands says sh: {content}"
        )


def comment(text):
    """What a comment says; Markdown after it on the same line would not be shown."""
    said = re.fullmatch(r"<!-- (.*) -->", text.strip())
    return said[1] if said else ""


def words_of(text):
    """The words of a command line without its comment."""
    return shlex.split(text, comments=True)


@pytest.mark.parametrize("page", EVERY, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_is_one_of_the_program(page, capsys):
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    for step in steps(page):
        words = words_of(step.text.partition(" | ")[0]) if step.kind in ("command", "mention") else [""]
        if words[:1] == ["make"]:
            assert words[1] in targets
        elif words[:1] == ["wavefocus"] and not {"...", "COMMAND"}.intersection(words):
            assert fault_of(words[1:], whole=step.kind == "command") == ""


def fault_of(words, *, whole):
    """What the program's own parser finds wrong; unless it is to be whole, prose may leave out what is needed."""
    try:
        parser().parse_args(words)
    except SystemExit:  # the help was shown
        return ""
    except InputError as wrong:
        return "" if not whole and re.search("required|expected one", str(wrong)) else str(wrong)
    return ""


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_the_tutorials_figures_are_those_of_its_commands(tmp_path, monkeypatch, capfd):
    """At full size, within 5 %; how far an interrupted capture is, is by chance."""
    monkeypatch.chdir(tmp_path)
    page, shown = ROOT / "docs" / "tutorial" / "the-first-hour.md", 0
    counts = re.findall(r"\bof (\d+) positions|: (\d+) positions", page.read_text(encoding="utf-8"))
    for step in steps(page):
        if step.kind != "command" or step.note.startswith("not run"):
            continue
        words = words_of(step.text)
        capfd.readouterr()
        assert run(words[1:]) == 0
        printed = "\n".join(capfd.readouterr())
        if words[1] == "init":
            change_text(Path("lab/run.toml"), "spacing_mm = 4.0", "spacing_mm = 8.0")
        elif words[1] == "plan":
            assert set(re.findall(r"positions +(\d+)", printed)) == {one or other for one, other in counts}
        for line in (
            step.shown if words[1] in ("plan", "check", "render", "predict", "movie", "verify", "export") else ()
        ):
            there = re.escape(line).replace(r"\.\.\.", ".*")
            found = re.search(re.sub(r"\d+(?:\\\.\d+)?", r"(\\d+(?:\.\\d+)?)", there), printed)
            assert found is not None, f"{step.text} printed no such line: {line}\n{printed}"
            numbers = [float(number) for number in re.findall(r"\d+(?:\.\d+)?", line)]
            assert [float(number) for number in found.groups()] == pytest.approx(numbers, rel=0.05), line
            shown += len(numbers)
    assert shown > 20


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A measured lab: what pages presuppose that do not begin with an empty folder."""
    folder = tmp_path_factory.mktemp("small")
    assert run(["init", str(folder)]) == 0
    make_small(folder)
    bank = ["--bank", str(folder / "plate.h5")]
    assert run(["capture", str(folder / "run.toml"), *bank]) == 0
    assert run(["render", str(folder / "scene.toml"), *bank, "--out", str(folder / "drive.h5")]) == 0
    assert run(["predict", str(folder / "drive.h5"), *bank, "--out", str(folder / "field.h5")]) == 0
    return folder


def make_small(folder):
    """Put a small plate and run in place of those of `wavefocus init`."""
    (folder / "rig.toml").write_text(RIG, "utf-8")
    (folder / "run.toml").write_text(RUN.replace("[capture]", "[capture]\nkeep_raw = true"), "utf-8")
    write_positions(folder, [(x_mm, y_mm) for y_mm in (-4, 0, 4) for x_mm in range(-58, 63, 4)])
    change_text(folder / "trials.toml", "limit_v = 1.0", "limit_v = 3.0")  # of three actuators


@pytest.mark.nightly
@pytest.mark.timeout(600)
@BY_PAGE
def test_every_command_of_a_page_does_what_the_page_shows(page, small, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    todo = [step for step in steps(page) if step.kind != "mention" and not step.note.startswith("not run")]
    if not any(words_of(step.text)[:2] == ["wavefocus", "init"] for step in todo if step.kind == "command"):
        shutil.copytree(small, tmp_path, dirs_exist_ok=True)
        shutil.copytree(small, tmp_path / "lab")
    for step in todo:  # what the page makes itself is not there
        for made in re.findall(r"--out (\S+)", step.text):
            Path(made).unlink(missing_ok=True)
    for step in todo:
        if step.kind == "file":
            Path(step.note).write_text(step.text, "utf-8")
        elif step.kind == "python":
            exec(step.text, {})
        elif step.kind in ("sh", "bat"):
            carry_out_in_shell(step, tmp_path)
        else:
            capfd.readouterr()
            code = interrupted(step.text) if step.note == "Ctrl-C" else carried_out(step.text)
            printed = "\n".join(capfd.readouterr())
            assert code == (130 if step.note == "Ctrl-C" else 0), f"{step.text}: {printed}"
            for line in step.shown:
                pattern = re.escape(shape(line)).replace(r"\.\.\.", ".*")
                assert re.search(pattern, shape(printed)), f"{step.text} printed no such line: {line}\n{printed}"


def carried_out(text):
    """The exit code of a command line, run in this process."""
    words = words_of(text)
    assert words[0] == "wavefocus", f"mark it with a comment, or write it otherwise: {text}"
    code = run(words[1:])
    if words[1] == "init":
        make_small(Path(words[2]))
    return code


def carry_out_in_shell(step, folder):
    """Carry out a block as the reader of this system does; that of the other system was parsed."""
    if (step.kind == "bat") != (os.name == "nt"):
        return
    script = folder / f"night.{step.kind}"
    script.write_text(step.text, "utf-8")
    shell = ["cmd", "/c"] if os.name == "nt" else ["sh"]
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    with_path = {**os.environ, "PATH": path}
    done = subprocess.run([*shell, str(script)], cwd=folder, env=with_path, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for made in re.findall(r"--out (\S+)|export \S+ (\S+)", step.text):
        assert (folder / "".join(made)).exists(), done.stderr


def interrupted(text):
    """The exit code of a capture that Ctrl-C ends after its first position."""
    words = words_of(text)
    events = Path(words[-1]).with_suffix(".events.jsonl")
    with subprocess.Popen([sys.executable, "-m", *words]) as child:
        while child.poll() is None and not (events.is_file() and "position_committed" in events.read_text("utf-8")):
            time.sleep(0.01)
        child.send_signal(signal.SIGINT)
        return child.wait(60)


def shape(text):
    """A text without its numbers, how long things take, and the width of its blanks."""
    return re.sub(r"\d+ (?:h \d+ min|min \d+ s)|[-+]?\d[\d.,:]*", "#", " ".join(text.split()))
