"""What ``render`` and ``movie`` do besides drives: limits, sounds, figures, pictures; drives played by ``play``."""

import itertools
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import soundfile
from PIL import Image, ImageSequence

from tests.lab_files import change_text, point_scene, stroke_scene, write_foreign
from tests.system.captures import answered, refused, said_by, wavefocus
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, load_scene
from wavefocus.storage.drive_file import Drive, read_drive, write_drive

RATE_HZ = 2000.0
STROKE = stroke_scene(
    [0.5, 0], [12, 4], 'kind = "sine", frequency_hz = 150.0, duration_s = 0.03', 'emission = "per_point"',
    speed_mm_s=200.0,
)  # fmt: skip
SCENE = STROKE + point_scene([4, 8], 'kind = "impulse"', "start_s = 0.02", "[regularisation]\nsaturation = 0.7")
RIG = "[actuators]\nposition_mm = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0]]\n\n[player]\n"


RENDER = ("render", "scene.toml", "--bank", "bank.h5", "--out", "drive.h5", "--force")


@pytest.fixture
def lab(tmp_path, monkeypatch):
    write_foreign(tmp_path / "bank.h5", gain=[[[1.0], [2.0], [8.0]]])
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    (tmp_path / "rig.toml").write_text(f"{RIG}limit_v = 2.0\nlimit_rms_v = 1e-3\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def predict(out, *options):
    assert wavefocus("predict", "drive.h5", "--bank", "bank.h5", "--out", out, *options) == 0


def rms_v():
    return np.sqrt(np.mean(read_drive("drive.h5").drive_v ** 2, axis=1))


def test_limits_of_scene_and_rig_then_the_stricter_scales_and_the_actuator_is_named(lab, capsys):
    assert wavefocus(*RENDER) == 0
    free_v = read_drive("drive.h5").drive_v
    (lab / "scene.toml").write_text(SCENE + "\n[output]\nlimit_rms_v = 2e-3\n", encoding="utf-8")
    told, drive = answered(capsys, *RENDER), read_drive("drive.h5")
    assert rms_v().max() == pytest.approx(2e-3, rel=1e-9)
    assert (told["limited_by"], told["limiting_actuator"]) == ("limit_rms_v", int(np.argmax(rms_v())))
    assert np.allclose(drive.drive_v, drive.scale * free_v, rtol=1e-12, atol=0)
    assert answered(capsys, *RENDER, "--rig", "rig.toml")["scale"] == pytest.approx(drive.scale / 2, rel=1e-9)
    assert rms_v().max() == pytest.approx(1e-3, rel=1e-9)
    assert "--tolerance-db" in refused(capsys, *RENDER, "--tolerance-db", "0")


def test_the_wav_of_a_scene_that_is_too_loud_reaches_full_scale_and_not_more(lab, capsys):
    """A waveform is larger between the samples of its drive than at them: both are kept within full scale."""
    (lab / "scene.toml").write_text(SCENE.replace("150.0", "800.0"), encoding="utf-8")
    rig = f"{RIG}interface_rate_hz = 48000\nfull_scale_v = 1e-4\nlimit_v = 1e-4\n"
    (lab / "rig.toml").write_text(rig, encoding="utf-8")
    told = said_by(capsys, *RENDER, "--json", "--rig", "rig.toml", "--wav", "drive.wav")
    heard, rate_hz = soundfile.read("drive.wav")
    drive = read_drive("drive.h5")
    assert (rate_hz, heard.shape[1]) == (48_000, len(drive.drive_v))
    assert np.abs(heard).max() == pytest.approx(1.0, abs=1e-6)
    assert np.abs(drive.drive_v).max() <= 1e-4
    found = json.loads(told.out)
    assert found["peak_v"] == pytest.approx(np.abs(drive.drive_v).max(), rel=1e-9)
    assert "between samples" in found["limited_by"]
    assert found["scale"] == drive.scale < 1
    assert "between samples = 0.0001 V; actuator" in told.err


def test_given_a_field_then_movie_draws_it_and_tells_which_waves_are_shown(lab, capsys):
    assert wavefocus(*RENDER) == 0
    predict("field.h5")
    files = ["--drive", "drive.h5", "--out", "field.gif", "--snapshots", "foci.png"]
    shown = ["--slow", "10", "--from-s", "0", "--to-s", "0.014"]
    told = answered(capsys, "movie", "field.h5", "--bank", "bank.h5", *files, *shown)
    with Image.open("field.gif") as gif, Image.open("foci.png") as picture:
        assert gif.n_frames == told["frames"] > 3
        assert (gif.width, gif.info["duration"], gif.info["loop"]) == (720, 40, 0)
        frames = [np.asarray(frame.convert("RGB"), dtype=int) for frame in ImageSequence.Iterator(gif)]
        assert all(np.any(one != other) for one, other in itertools.pairwise(frames))
        assert picture.width > 1000
    assert told["slowed"] == pytest.approx(10.0)
    predict("low.h5", "--rate", RATE_HZ / 2)
    said = f"predicted at {RATE_HZ / 2:g} Hz: it shows waves up to {0.2 * RATE_HZ:g} Hz alone"
    assert said in said_by(capsys, "movie", "low.h5", "--bank", "bank.h5", "--out", "low.gif", *shown).err


def test_given_a_movie_that_cannot_be_then_one_sentence_says_why(lab, capsys):
    assert wavefocus(*RENDER) == 0
    predict("field.h5", "--positions", "14")
    for options, named in (
        ((), "--out"),
        (("--snapshots", "foci.png"), "--drive"),
        (("--snapshots", "foci.png", "--drive", "drive.h5"), "holds no focus"),
        (("--out", "nowhere/field.gif"), "there is no folder"),
        (("--out", "field.gif", "--from-s", "9"), "nothing to show"),
    ):
        assert named in refused(capsys, "movie", "field.h5", "--bank", "bank.h5", *options)
        assert not list(lab.glob("*.gif"))


def test_given_a_focus_then_its_reported_peak_is_what_predict_finds_there(lab, capsys):
    sine = '{ kind = "sine", frequency_hz = 150.0, duration_s = 0.1 }'
    for signal, limit in (('{ kind = "impulse" }', ""), (sine, "limit_v = 1e-4")):
        source = f'[[source]]\namplitude = 0.001\npath = {{ kind = "point", at_mm = [4, 8] }}\nsignal = {signal}\n'
        (lab / "scene.toml").write_text(f"{source}[output]\n{limit}\n", encoding="utf-8")
        found = answered(capsys, *RENDER)
        predict("field.h5", "--positions", 5 * 2 + 1, "--force")  # (4, 8) mm
        with h5py.File("field.h5") as file:
            assert found["focus_peak"] == pytest.approx(np.abs(file["field"][:]).max(), rel=1e-5)
        assert found["response_unit"] == "m/s"


def test_given_the_bar_of_the_page_then_its_points_move_abreast_and_say_the_same(tmp_path):
    page = Path(__file__).parents[2] / "docs/how-to/render-and-play.md"
    text = page.read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0]
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    bar = Scene("bar", load_scene(tmp_path / "scene.toml").sources[:3])
    position_mm = np.array([(x, y) for y in np.arange(-12.0, 45.0, 4.0) for x in np.arange(-44.0, 45.0, 4.0)])
    green = np.random.default_rng(5).standard_normal((len(position_mm), 3, 80)) * np.exp(-np.arange(80) / 20)
    drive = render_with_report(bar, GreenArray(green, position_mm, 2000.0))[0]
    sample, place = drive.focus_sample.reshape(3, 21), position_mm[drive.focus_position].reshape(3, 21, 2)
    assert (sample == sample[0]).all()
    assert (place[:, :, 0] == place[0, :, 0]).all()
    np.testing.assert_array_equal(np.diff(place[:, :, 1], axis=0), 8.0)
    signals = [source.signal.samples(2000.0) for source in bar.sources]
    assert all(np.array_equal(one, signals[0]) for one in signals)


# --- drives that are played


POWER = "limit_v = 2.0\ncoil_resistance_ohm = 8.0\nlimit_power_w = 0.04\n"
TIME_S = np.arange(15_000) / 10_000.0


PLAY = ("play", "drive.h5", "--rig", "rig.toml")


@pytest.fixture
def playing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(f"{RIG}{POWER}", encoding="utf-8")
    write(0.5)
    return tmp_path


def write(amplitude_v, actuators=3):
    drive_v = np.zeros((actuators, TIME_S.size))
    drive_v[1] = amplitude_v * np.sin(2 * np.pi * 100.0 * TIME_S)
    none = np.zeros(0, np.int64)
    write_drive("drive.h5", Drive(drive_v, 10_000.0, -0.2, "sampled", 1.0, 0.0, none, none, none), force=True)


def test_given_a_drive_then_it_is_played_and_told(playing, capsys):
    told = said_by(capsys, *PLAY, "--loop", "3", "--gain-db", "-6.0206", "--json")
    figures = json.loads(told.out)
    assert (figures["seconds"], figures["loops"]) == (4.5, 3)
    assert figures["peak_v"] == pytest.approx(0.25, rel=1e-5)
    assert "4.5 s on 3 actuators" in told.err
    assert "muted" in told.err


def test_given_more_than_an_actuator_may_get_then_the_gain_that_would_do_does(playing, capsys):
    write(4.0)
    told = refused(capsys, *PLAY, "--gain-db", "1")
    assert "actuator 1" in told
    assert "player.limit_v" in told
    told = refused(capsys, *PLAY, "--gain-db", "-6.03")  # that is within 2 V, and the coil's power counts next
    assert "player.limit_power_w" in told
    assert "V rms" in told
    gain_db = told.split("--gain-db ")[1].split(",")[0]
    assert wavefocus(*PLAY, "--gain-db", gain_db) == 0
    assert 20 * np.log10(4.0 / 2**0.5 / 0.32**0.5) == pytest.approx(-float(gain_db), abs=0.011)
    # Loud at both ends: 0.3 s of each within a second, and 0.6 s where they meet.
    write(np.where((TIME_S >= 0.3) & (TIME_S < 1.2), 0.0, 0.9))
    change_text(playing / "rig.toml", "0.04", "0.02")
    assert wavefocus(*PLAY) == 0
    assert "V rms" in refused(capsys, *PLAY, "--loop", "2")


def test_given_what_cannot_be_played_then_one_sentence_names_it(playing, capsys):
    (playing / "run.toml").write_text('rig = "rig.toml"\n\n[sweep]\namplitude_v = 1.0\n', encoding="utf-8")
    told = refused(capsys, "plan", "run.toml")  # a sweep beyond the coil's power
    assert "sweep.amplitude_v" in told
    assert "player.limit_power_w" in told
    assert "--gain-db" in refused(capsys, *PLAY, "--gain-db", "400")
    assert "--loop" in refused(capsys, *PLAY, "--loop", "0")
    write(0.1, actuators=4)
    assert "for 4 actuators" in refused(capsys, *PLAY)
    change_text(playing / "rig.toml", "coil_resistance_ohm = 8.0", "")
    assert "player.coil_resistance_ohm" in refused(capsys, *PLAY)
