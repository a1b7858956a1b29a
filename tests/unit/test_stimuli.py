"""Stimuli on disk: rendered once, verified after that, refused beyond limits."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.lab_files import write_arrays
from tests.simulated_people import design_of
from tests.unit.plate_banks import ACTUATOR_MM, RATE_HZ, SQUARE_MM, plate_greens
from wavefocus import InputError, open_bank, read_drive, render, write_drive
from wavefocus.rendering.drive.coil_limits import DriveLimits, peaks
from wavefocus.rendering.drive.wav import Interface
from wavefocus.trials.stimuli import prepare

TRIALS = """
[trials]
question = "Felt?"
answers = ["no", "yes"]

[path]
right = { kind = "line", start_mm = [-8, 0], end_mm = [8, 0] }

[signal]
tap = { kind = "impulse" }

[[stimuli]]
path = "right"
signal = "tap"
speed_mm_s = 100
amplitude = [0, 0.003, 0.007]
step_mm = 4
emission = "per_point"
"""
NAMES = ["right-100mm_s-tap-amp0", "right-100mm_s-tap-amp0.003", "right-100mm_s-tap-amp0.007"]
LOUDEST = NAMES[-1]
NO_LIMITS = DriveLimits()
INTERFACE = Interface(int(RATE_HZ), np.full(len(ACTUATOR_MM), 5.0))


@pytest.fixture
def bank(tmp_path):
    write_bank(tmp_path / "bank.h5", SQUARE_MM[(np.abs(SQUARE_MM) <= (8, 4)).all(axis=1)])
    with open_bank(tmp_path / "bank.h5") as view:
        yield view


def write_bank(path, position_mm):
    write_arrays(path, plate_greens(position_mm).astype(np.float32), position_mm, RATE_HZ)


def prepared(design, bank, limits=NO_LIMITS, interface=INTERFACE, out="out", **more):
    return prepare(design, bank, design.file.parent / out, limits=limits, interface=interface, **more)


def test_stimuli_are_the_drives_of_their_scenes_and_stand_in_the_manifest(tmp_path, bank):
    design = design_of(tmp_path, TRIALS)
    done: list[tuple[int, int]] = []
    made = prepared(design, bank, on_progress=lambda *count: done.append(count))
    assert done == [(0, 3), (1, 3), (2, 3), (3, 3)]
    manifest = json.loads((made.folder / "manifest.json").read_text(encoding="utf-8"))
    assert (manifest["trials_sha256"], manifest["bank_sha256"]) == (design.sha256, made.bank_sha256)
    assert list(manifest["stimuli"]) == list(made.sha256) == NAMES
    assert not made.drive(NAMES[0]).drive_v.any()
    for name in NAMES[1:]:
        stimulus = design.stimuli[name]
        drive, right = made.drive(name), render(stimulus.scene, bank)
        entry = manifest["stimuli"][name]
        assert np.abs(drive.drive_v - right.drive_v).max() <= 1e-15 * np.abs(right.drive_v).max()
        assert (drive.start_s, drive.scale, drive.drive_v.shape) == (right.start_s, 1.0, right.drive_v.shape)
        assert entry["sha256"] == made.sha256[name]
        assert (entry["amplitude"], entry["peak_v"]) == (stimulus.amplitude, peaks(drive.drive_v).max())


def test_given_again_then_only_what_is_missing_is_rendered(tmp_path, bank):
    design = design_of(tmp_path, TRIALS)
    first = prepared(design, bank)
    (first.folder / f"{LOUDEST}.h5").unlink()
    times = {file: file.stat().st_mtime_ns for file in first.folder.iterdir()}
    assert prepared(design, bank) == first
    assert (first.folder / f"{LOUDEST}.h5").is_file()
    assert {file: file.stat().st_mtime_ns for file in times} == times


def test_stimuli_begun_by_an_earlier_version_go_on_with_their_interpolation(tmp_path):
    tone = '{ kind = "sine", frequency_hz = 150.0, duration_s = 0.05 }'
    between = TRIALS.replace("start_mm = [-8, 0]", "start_mm = [-7, 1]").replace('{ kind = "impulse" }', tone)
    between += "[output]\n"
    write_bank(tmp_path / "wide.h5", SQUARE_MM)
    with open_bank(tmp_path / "wide.h5") as bank:
        named = prepared(design_of(tmp_path, between + 'interpolation = "nearest"\n'), bank)
        design = design_of(tmp_path, between)
        auto = prepared(design, bank, out="now")
        assert [text.partition(":")[0] for text in named.warnings] == [f"stimuli {NAMES[1]}, {LOUDEST}"]  # no silence
        assert named.sha256[LOUDEST] != auto.sha256[LOUDEST]
        manifest = json.loads((named.folder / "manifest.json").read_text(encoding="utf-8"))
        manifest["trials_sha256"] = design.sha256
        del manifest["stimuli"][LOUDEST]
        (named.folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
        for name in (LOUDEST, NAMES[1]):
            (named.folder / f"{name}.h5").unlink()
        assert prepared(design, bank).sha256 == named.sha256


def test_a_limit_then_a_stimulus_beyond_it_is_refused_with_the_amplitude_that_fits(tmp_path, bank):
    peak_v = float(peaks(render(design_of(tmp_path, TRIALS).stimuli[LOUDEST].scene, bank).drive_v).max())
    for limits in (DriveLimits(peak_v=0.9 * peak_v, peak_key="player.limit_v"), DriveLimits(rms_v=0.1 * peak_v)):
        with pytest.raises(InputError) as refused:
            prepared(design_of(tmp_path, TRIALS), bank, limits)
        text = str(refused.value)
        assert text.startswith(f"{tmp_path / 'trials.toml'}: stimulus {LOUDEST}: ")
        assert (limits.peak_key if limits.peak_v else limits.rms_key) in text
        fits = text.split("amplitude of ")[1].split(maxsplit=1)[0]
        (tmp_path / "again").mkdir(exist_ok=True)
        prepared(design_of(tmp_path / "again", TRIALS.replace("0.003, 0.007", fits)), bank, limits)
        for file in (tmp_path / "again" / "out" / "stimuli").iterdir():
            file.unlink()


def test_what_does_not_fit_the_rig_or_bank_or_the_stimuli_that_are_there_is_refused(tmp_path, bank):
    design = design_of(tmp_path, TRIALS)
    for match, view, interface in (
        ("full scale", bank, Interface(int(RATE_HZ), np.full(len(ACTUATOR_MM), 1e-6))),
        ("10 actuators, the rig 3", bank, Interface(int(RATE_HZ), np.full(3, 5.0))),
        ("drives in A", replace(bank, drive_unit="A"), INTERFACE),
    ):
        with pytest.raises(InputError, match=match):
            prepared(design, view, interface=interface)
    beyond = design_of(tmp_path, TRIALS.replace("[8, 0]", "[80, 0]"))
    with pytest.raises(InputError, match=rf"trials.toml: stimulus {NAMES[0]}: .*point"):
        prepared(beyond, bank, out="other")
    prepared(design, bank)
    with pytest.raises(InputError, match=r"manifest.json: .*trials.toml"):
        prepared(design_of(tmp_path, TRIALS + "# another\n"), bank)
    write_bank(tmp_path / "other.h5", SQUARE_MM[:1])
    with open_bank(tmp_path / "other.h5") as other, pytest.raises(InputError, match=r"manifest.json: .*other.h5"):
        prepared(design_of(tmp_path, TRIALS), other)


def test_a_damaged_or_exchanged_drive_or_a_file_of_others_is_named_and_stays(tmp_path, bank):
    design = design_of(tmp_path, TRIALS)
    made = prepared(design, bank)
    file = made.folder / f"{LOUDEST}.h5"
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2] + b"\xff" + content[len(content) // 2 + 1 :])
    with pytest.raises(InputError, match=rf"^{file}"):
        prepared(design, bank)
    write_drive(file, read_drive(made.folder / f"{NAMES[1]}.h5"), force=True)
    with pytest.raises(InputError, match=rf"^{file}: holds another drive"):
        prepared(design, bank)
    (made.folder / "manifest.json").unlink()
    file.write_text("mine")
    with pytest.raises(InputError, match="exists"):
        prepared(design, bank)
    assert file.read_text() == "mine"
    for text in ("", "[]", '{"stimuli": 3}', '{"stimuli": {"a": {}}}', '{"stimuli": {"a": {"sha256": 1}}}'):
        (made.folder / "manifest.json").write_text(text)
        with pytest.raises(InputError, match=r"manifest.json: is"):
            prepared(design, bank)
