"""The example of docs/how-to/write-a-driver.md, installed as another distribution, and drivers that are broken."""

import json
import os
from pathlib import Path

import pytest

from tests.system import lines
from tests.wire.emulated import RIG

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "how-to" / "write-a-driver.md"
KEYS = 'serial_number = "A-1234"\nlimit_mrad = 200.0\npark_mrad = [-190.0, -190.0]'

# What the maker's package does; each move takes 20 ms.
MAKERS_PACKAGE = '''
import time

class AcmeError(Exception):
    """The controller refuses."""

class ConnectionLost(AcmeError):
    """The controller is gone."""

class Controller:
    model = "GS-2"
    def __init__(self, serial_number):
        if serial_number != "A-1234":
            raise ConnectionLost(f"no controller {serial_number}")
        self.still_at_s = 0.0
    def ping(self):
        return "GS-2, firmware 1.0"
    def go(self, x_deg, y_deg):
        if max(abs(x_deg), abs(y_deg)) > 10:
            raise AcmeError("out of range")
        self.still_at_s = time.monotonic() + 0.02
    def busy(self):
        return time.monotonic() < self.still_at_s
    def close(self):
        pass
'''


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder in which pip has installed the example's distribution."""
    from tests.system.test_documented_commands import steps

    source, target = tmp_path_factory.mktemp("wavefocus-acme"), tmp_path_factory.mktemp("installed")
    for step in steps(PAGE):
        if step.kind == "file":
            (source / step.note).write_text(step.text, "utf-8")
    pip = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    done = lines.python(*pip, "--target", target, source)
    assert done.returncode == 0, done.stderr
    return target


def python(*arguments, paths, cwd=ROOT):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    return lines.python(*arguments, env=environment, cwd=cwd)


def rig_of(dialect, mirror="", keys=""):
    wires = {"actuators": [[0.0, 0.0]], "recorder": "localhost:1", "period_frames": 4096}
    return RIG.format(dialect=dialect, mirror=mirror, keys=keys, **wires)


@pytest.fixture
def rig(tmp_path):
    text = rig_of("acme-gs", keys=KEYS).replace('port = ""\n', "")
    (tmp_path / "rig.toml").write_text(text, "utf-8")
    (tmp_path / "run.toml").write_text('rig = "rig.toml"\n', "utf-8")
    (tmp_path / "maker").mkdir()
    (tmp_path / "maker" / "acme_mirror.py").write_text(MAKERS_PACKAGE, "utf-8")
    return tmp_path / "rig.toml"


@pytest.mark.long
def test_given_the_example_as_a_distribution_then_it_passes_the_tests_of_mirrors(installed, rig):
    suite = ["tests/contract/test_mirror_contract.py", "--hardware", rig, "-n", "0", "-q", "-p", "no:cov"]
    done = python("-m", "pytest", *suite, paths=(installed, rig.parent / "maker"))
    assert done.returncode == 0, done.stdout
    assert "4 passed" in done.stdout


@pytest.mark.long
def test_given_no_package_of_the_maker_then_doctor_names_it_and_blames_no_defect(installed, rig):
    done = python("-m", "wavefocus", "doctor", rig, "--json", paths=(installed,))
    assert done.returncode == 1
    faults = [one for one in json.loads(done.stdout)["findings"] if "acme_mirror" in one["what"]]
    assert [(one["instrument"], one["verdict"]) for one in faults] == [("mirror", "fail")]
    assert "defect" not in faults[0]["remedy"]


# The entry points of one distribution, and what is said of each.
BROKEN = {
    "missing-module": ("missing_module:Good", "ModuleNotFoundError"),
    "ending": ("ending:Good", "SystemExit"),
    "escaping": ("escaping:Good", "GeneratorExit"),
    "number": ("acme:NUMBER", "is not a data class"),
    "renamed": ("acme:Good", "has the name 'good'"),
    "asi-tiger": ("acme:Tiger", "has the name of a driver that is there already"),
    "plain": ("acme:Plain", "has a field that is not declared with rig_key: number"),
    "settling": ("acme:Settling", "has a key that the table has: settle_s"),
    "scaled": ("acme:Scaled", "has a key that driver mirrorcle-mti has with another type: full_scale_mrad"),
    "unable": ("acme:Unable", "lacks open"),
    "virtual": ("acme:Virtual", "has the name of a driver that is there already"),
    "threaded": ("acme:Threaded", "has keys that cannot be read: "),
    "unlike": ("acme:Unlike", "has keys that cannot be read: "),
}
BUILT_IN = {"asi-tiger", "virtual"}
ACME = """
import threading
from dataclasses import dataclass, make_dataclass
from wavefocus.drivers.registry import rig_key
NUMBER = 1
class Opens:
    def open(self, settings): ...
def driver(name, field=(), kind=int, base=Opens, **options):
    fields = [(field, kind, rig_key("it", **options))] if field else []
    return make_dataclass(name.title(), fields, bases=(base,), namespace={"name": name})
Good, Tiger, Virtual, Unable = driver("good"), driver("asi-tiger"), driver("virtual"), driver("unable", base=object)
Plain = make_dataclass("Plain", [("number", int, 3)], bases=(Opens,), namespace={"name": "plain"})
Settling = driver("settling", "settle_s", float)
Scaled = driver("scaled", "full_scale_mrad", str)
Threaded = driver("threaded", "thread", threading.Thread)
Unlike = driver("unlike", "word", str, pattern=("(", "must be one"))
@dataclass
class Ends:
    name = "ends"
    def open(self, settings):
        raise SystemExit(0)
@dataclass
class Fails(Opens):
    name = "fails"
    def __post_init__(self):
        raise OSError("no such device")
"""
READ = """
import json, sys
from pathlib import Path
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.registry import MIRRORS
from wavefocus.rig.instruments import openers_of
from wavefocus.storage.errors import InputError
told, causes = {}, []
for name in sys.argv[1:]:
    try:
        load_rig(Path(name))
    except InputError as error:
        told[Path(name).stem] = str(error)
for name in sys.argv[-2:]:
    try:
        openers_of(load_rig(Path(name))).mirror()
    except InstrumentError as error:
        causes.append(error.cause)
print(json.dumps([MIRRORS.failures, told, causes]))
"""


def test_rigs_of_drivers_that_cannot_be_used_are_refused_with_the_reason(tmp_path):
    facts = tmp_path / "site" / "acme-1.0.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Name: acme\nVersion: 1.0\n", "utf-8")
    points = "".join(f"{name} = {point}\n" for name, (point, _) in BROKEN.items())
    points += "good = acme:Good\nfails = acme:Fails\nends = acme:Ends\n"
    (facts / "entry_points.txt").write_text(f"[wavefocus.mirrors]\n{points}", "utf-8")
    (facts.parent / "ending.py").write_text("raise SystemExit(3)", "utf-8")
    (facts.parent / "escaping.py").write_text("raise GeneratorExit", "utf-8")
    (facts.parent / "acme.py").write_text(ACME, "utf-8")
    rigs = [tmp_path / f"{name}.toml" for name in (*BROKEN, "fails", "good", "ends")]
    for rig in rigs:
        rig.write_text(rig_of(rig.stem, mirror="COM3"), "utf-8")
    done = python("-c", READ, *rigs, paths=(facts.parent,))
    assert done.returncode == 0, done.stderr
    failures, told, causes = json.loads(done.stdout)
    for name, (point, reason) in BROKEN.items():
        assert failures[name].startswith(f"{point} of acme 1.0 ")
        assert reason in failures[name]
        if name not in BUILT_IN:
            assert told[name].startswith(f"{tmp_path / name}.toml: mirror.driver")
            assert failures[name] in told[name]
    assert told.pop("fails").endswith("cannot be used: OSError: no such device")
    assert "port" in told.pop("virtual")  # the built-in one has none
    assert set(told) == set(BROKEN) - BUILT_IN
    for cause, reason in zip(causes, ("what its driver opened is no Mirror", "its driver ended with 0"), strict=True):
        assert reason in cause
