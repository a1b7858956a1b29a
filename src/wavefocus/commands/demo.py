"""``wavefocus demo``: the whole suite on the virtual rig, a power cut included."""

import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from wavefocus.benchmarks.rig_bank import compare_with_truth
from wavefocus.commands import bank as bank_commands
from wavefocus.commands import init, plan, status
from wavefocus.commands import predict as prediction
from wavefocus.commands import render as rendering
from wavefocus.commands import verify as verification
from wavefocus.config.messages.campaign import Logged, Progress, read_event
from wavefocus.config.run import Virtual
from wavefocus.configuration import load_run
from wavefocus.console import Exit, people, say
from wavefocus.input_files import scan_rows
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.options import RenderOptions
from wavefocus.rendering.scene.model import load_scene
from wavefocus.rig.virtual_bench import virtual_rig
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.errors import InputError, WavefocusError

# The bank is this good at the default noise, or the demo has failed.
BANK_LIMIT_DB = -55.0
PLATE = "stadium"

COMMAND = (sys.executable, "-m", "wavefocus")
_MARKER = "made-by-wavefocus-demo"
# First parts of the names that the demo, commands on its bank and macOS write there; hidden ones begin with a dot.
_OWN = {_MARKER, "rig", "run", "scene", "trials", "fingers", "plate", "drive", "field", "verify", "DS_Store"}


def demo(out: Path, *, quick: bool = False, force: bool = False) -> Exit:
    """Capture, kill half-way, resume, check, render, predict, verify; all files in a folder of its own.

    quick: A hundred positions on a plate without a rim, to see that everything works.
    """
    plate = "soft" if quick else PLATE
    if plate == "stadium" and find_spec("skfem") is None:
        raise InputError("demo: needs scikit-fem, pip install 'wavefocus[plates]'; --quick does without")
    _prepare(out, force=force)
    run, bank, scene, drive = out / "run.toml", out / "plate.h5", out / "scene.toml", out / "drive.h5"
    some = "0-9" if quick else "700-709"
    steps: dict[str, Callable[[], object]] = {
        "Configuration, and the plate from it": lambda: _configure(out, plate, quick=quick),
        "Plan": lambda: plan.plan(run, as_json=False),
        "Capture, until the power is cut half-way": lambda: _capture_and_kill(run, bank),
        "What the bank says after the power cut": lambda: status.status(bank, as_json=False),
        "Resume from the bank alone": lambda: _resume(bank),
        "Check every row": lambda: bank_commands.check(bank, as_json=False),
        "Compare with the plate's truth": lambda: _compare(bank),
        "Render the scene": lambda: rendering.render(
            scene, bank, drive, wav=out / "drive.wav", rig_file=None, options=RenderOptions(), as_json=False
        ),
        "Predict ten positions of its field": lambda: prediction.predict(
            drive, bank, out / "field.h5", some, as_json=False
        ),
        "Play it on the rig, scan it, compare": lambda: _verify(scene, bank, out / "verify", 1 if quick else 8),
    }
    worst, begun_s = Exit.DONE, time.monotonic()
    for name, work in steps.items():
        people().rule(f"{time.monotonic() - begun_s:.1f} s: {name}", align="left")
        outcome = work()
        worst = max(worst, outcome) if isinstance(outcome, Exit) else worst
    done = f"done in {time.monotonic() - begun_s:.1f} s"
    say(f"{done}: open {out / 'verify' / 'report.html'} in a browser; wavefocus gui {bank} shows the bank")
    return worst


def _configure(out: Path, plate: str, *, quick: bool) -> None:
    init.init(out, "virtual")
    # All actuators at once: two hours of the rig's time, and a fifth of the computer's.
    changes = {'plate = "soft"': f'plate = "{plate}"', 'excitation = "sequential"': 'excitation = "staggered"'}
    if quick:
        changes["spacing_mm = 4.0"] = "spacing_mm = 16"
    text = (out / "run.toml").read_text(encoding="utf-8")
    for old, new in changes.items():
        text = text.replace(old, new)
    (out / "run.toml").write_text(text, encoding="utf-8")
    _rig(out / "run.toml")  # computes the plate, or reads it from the cache


def _rig(run: Path) -> VirtualRig:
    configuration = load_run(run)
    return virtual_rig(configuration.rig, configuration.run.virtual or Virtual())


def _prepare(out: Path, *, force: bool) -> None:
    """Take a folder of the demo's own; never clear one that is somebody else's."""
    if out.exists():
        if not (out / _MARKER).is_file() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"--out {out}: is not empty and was not made by the demo; name another folder")
        if any(out.iterdir()) and not force:
            raise InputError(f"--out {out}: holds an earlier demo; name another folder, or replace it with --force")
        for name in sorted(path.name for path in out.iterdir()):
            if name.lstrip("._").partition(".")[0] not in _OWN:
                raise InputError(f"--out {out}: holds {name}, which the demo has not written; move it elsewhere")
        shutil.rmtree(out)
    out.mkdir(parents=True)
    (out / _MARKER).write_text("this folder is cleared whenever the demo runs\n", encoding="utf-8")


def _capture_and_kill(run: Path, bank: Path) -> None:
    """Run a capture in a process of its own and kill it, without warning, half-way."""
    command, done, total = [*COMMAND, "capture", str(run), "--bank", str(bank), "--json"], 0, 0
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        for line in child.stdout:
            match read_event(line):
                case Logged(event=Progress(done=done, total=total)) if 2 * done >= total:
                    child.kill()
                    break
        code = child.wait()
    if code == 0 or not bank.exists():
        raise WavefocusError(f"the capture ended with {code} before it could be interrupted")
    say(f"killed process {child.pid} without warning after {done} of {total} positions")


def _resume(bank: Path) -> None:
    code = subprocess.run([*COMMAND, "resume", str(bank)], check=False).returncode
    if code != 0:
        raise WavefocusError(f"wavefocus resume {bank} ended with exit code {code}")


def _compare(bank: Path) -> Exit:
    """Report how far the bank is from the truth, which nothing else in the suite reads."""
    with open_bank(bank) as view:
        error_db = compare_with_truth(view, _rig(bank.with_name("run.toml")))
    median_db = float(np.nanmedian(error_db))
    say(
        f"error of the bank against the true Green's functions: median {median_db:.1f} dB, worst "
        f"{np.nanmax(error_db):.1f} dB over {error_db.size} pairs (in-band relative L2; limit {BANK_LIMIT_DB:g})"
    )
    return Exit.DONE if median_db <= BANK_LIMIT_DB else Exit.NOT_GOOD_ENOUGH


def _verify(scene: Path, bank: Path, out: Path, every: int) -> Exit:
    """Scan what the scene needs, and one of every so many other positions."""
    with open_bank(bank) as view:
        needed = scan_rows("path", load_scene(scene), view.position_mm, scene) or ()
        rows = sorted({*needed, *range(0, view.positions, every)})
    return verification.verify(scene, bank, Path("virtual"), out, ",".join(map(str, rows)), as_json=False)
