"""Drives of sources whose positions arrive while they sound: as the recorded scene renders, and independent ones."""

import itertools
import math
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

from tests.unit.plate_banks import plate_bank
from wavefocus import GreenArray, Impulse, InputError, Noise, Sine, load_scene
from wavefocus.config.scene import Regularisation
from wavefocus.drivers.audio.resampling import converted, lead_samples, rate_ratio
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.live.finer import MAX_ENERGY, finer_rows, independent_filters
from wavefocus.rendering.live.lives import emitted_by
from wavefocus.rendering.live.recording import SessionRecording
from wavefocus.rendering.scene.trajectory import Trajectory

RATE_HZ, TAPS, BLOCK = 1000.0, 60, 8
SUFFICIENT = TAPS - 1 + 4 * BLOCK
GRID_MM = np.array([(4.0 * x - 20.0, 4.0 * y - 20.0) for y in range(11) for x in range(11)])
DECAY = np.exp(-np.arange(TAPS) / 15.0)
GREEN = np.random.default_rng(3).standard_normal((len(GRID_MM), 3, TAPS)) * DECAY
BANK = GreenArray(GREEN, GRID_MM, RATE_HZ, band_hz=(20.0, 400.0))
SINGLE = 2e-6
"""Rounding of single precision."""
STEADY = Noise((50.0, 300.0), 0.12, seed=5)
HELD = Regularisation(saturation_absolute=0.5)
PLATE = plate_bank()


def engine_of(bank=BANK, *, look_ahead=0, **options):
    return LiveEngine(bank, block_samples=BLOCK, look_ahead_samples=look_ahead, signal=STEADY, record=True, **options)


def run(engine, blocks, order, recording=None):
    """Drives of some blocks, and the parts of the record by number of the life."""
    drives, lives = [], {}
    for block in range(blocks):
        order(block)
        drives.append(engine.next_block())
        record = engine.take_record()
        if recording is not None:
            recording.add(record)
        for part in record:
            lives.setdefault(part.number, []).append(part)
    return np.concatenate(drives, axis=1), lives


def course_of(parts):
    knots = [part.knots for part in parts]
    return Trajectory(
        *(np.concatenate([getattr(one, key) for one in knots]) for key in ("sample", "at_mm", "amplitude"))
    )


def felt_v(folder, samples):
    """What the scene of a recording renders to, from scene time 0 on."""
    drive_v = render_with_report(load_scene(folder / "scene.toml"), BANK)[0].drive_v[:, TAPS - 1 :]
    return np.pad(drive_v, [(0, 0), (0, max(0, samples - drive_v.shape[1]))])[:, :samples]


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_given_sufficient_look_ahead_then_the_drives_are_those_of_the_recorded_scene(tmp_path, interpolation):
    engine = engine_of(look_ahead=SUFFICIENT + 4 * BLOCK, interpolation=interpolation, regularisation=HELD)

    def order(block):
        if block % 4 == 0 and block < 60:
            engine.move("finger", (-15.0 + 0.4 * block, 9.0 * np.sin(block / 9.0)), 1.0 + 0.02 * block)
        if block % 2 == 0 and 20 < block < 90:
            engine.move("thumb", (18.0 if block > 50 else -17.0, 0.1 * block - 5.0))  # jumps
        if block == 40:
            engine.end_source("finger")
            engine.set_signal("thumb", emitted_by(Sine(90.0, 0.05), RATE_HZ, repeat=False))
        if block == 70:
            engine.set_signal("thumb", emitted_by(Impulse(), RATE_HZ))

    with SessionRecording(tmp_path, rate_hz=RATE_HZ, regularisation=HELD, interpolation=interpolation) as recording:
        drive_v, lives = run(engine, 150, order, recording)
    wanted_v = felt_v(tmp_path, drive_v.shape[1])
    assert engine.sufficient_samples == SUFFICIENT
    assert [parts[0].name for parts in lives.values()] == ["finger", "thumb", "thumb", "finger", "thumb", "thumb"]
    assert all(parts[-1].over for parts in lives.values())
    np.testing.assert_allclose(drive_v, wanted_v, rtol=0, atol=SINGLE * np.abs(wanted_v).max())


@pytest.mark.parametrize("velocity_mm", [0.0, 0.03])
def test_no_further_position_then_the_velocity_is_held_within_the_surface_and_fades(velocity_mm):
    engine = engine_of()
    moved = 20

    def order(block):
        if block < moved:
            engine.move("finger", (10.0 + velocity_mm * BLOCK * block, 0.0))

    drive_v, lives = run(engine, 150, order)
    course, last = course_of(lives[0]), (moved - 1) * BLOCK
    assert int(course.sample[-1]) == last + 250 + 10
    (at_mm, late_mm, end_mm), amplitude = course.at(np.array([last + 100, last + 250, last + 260]))
    np.testing.assert_allclose(at_mm, [10.0 + velocity_mm * (last + 100), 0.0], atol=1e-9)
    assert late_mm.tolist() == end_mm.tolist()
    assert late_mm[0] == pytest.approx(20.0 if velocity_mm else 10.0, abs=velocity_mm + 1e-9)
    assert amplitude.tolist() == [1.0, 1.0, 0.0]
    assert np.abs(drive_v[:, last + 250 - BLOCK : last + 250]).max() > 0
    assert np.abs(drive_v[:, last + 260 + 1 :]).max() < SINGLE * np.abs(drive_v).max()
    assert not drive_v[:, last + 260 + 6 * BLOCK :].any()  # what was emitted 20 ms before a block still counts
    assert engine.state() == ()


def test_a_jump_an_end_or_a_hole_on_the_way_then_one_life_fades_and_another_appears():
    status = np.ones(len(GRID_MM), dtype=np.uint8)
    status[60] = 0  # at (0, 0) mm
    engine = engine_of(GreenArray(GREEN, GRID_MM, RATE_HZ, status=status))
    places_mm = [(-10.0, 8.0)] * 10 + [(10.0, 8.0)] * 10 + [(-4.0, 0.0)] * 10 + [(4.0, 0.0)] * 10
    _, lives = run(engine, 60, lambda block: engine.move("finger", places_mm[block]) if block < 40 else None)
    assert len(lives) == 4
    for number, parts in lives.items():
        course = course_of(parts)
        assert (int(course.sample[0]), course.at_mm[-1].tolist()) == (80 * number, list(places_mm[10 * number]))
        times = np.array([80 * number, 80 * number + 5, 80 * number + 10, 80 * number + 80, 80 * number + 90])
        amplitude = course.at(times)[1]
        np.testing.assert_allclose(amplitude[:3], [0.0, 0.5, 1.0])
        if number < 3:
            np.testing.assert_allclose(amplitude[3:], [1.0, 0.0])
            assert int(course.sample[-1]) == 80 * number + 90
    for refused in ((0.0, 0.0), (1.9, 0.0)):
        with pytest.raises(InputError, match="not measured"):
            engine.move("finger", refused)
    # Rows of zeros or NaN are no part of the surface either.
    green = GREEN.copy()
    green[60], green[61] = 0.0, np.nan  # at (0, 0) and (4, 0) mm
    engine = engine_of(GreenArray(green, GRID_MM, RATE_HZ))
    for refused in ((0.0, 0.0), (4.0, 0.0)):
        with pytest.raises(InputError):
            engine.move("finger", refused)
    _, lives = run(engine, 80, lambda block: engine.move("finger", (-12.0 + 0.5 * block, 0.0)) if block < 10 else None)
    assert course_of(lives[0]).at_mm[-1][0] == pytest.approx(-2.0, abs=0.07)


def test_order_takes_effect_with_next_block_even_where_that_was_computed_before():
    orders = (
        lambda engine: engine.move("finger", (-3.0, 6.0)),
        lambda engine: engine.set_signal("finger", emitted_by(Sine(90.0, 0.1), RATE_HZ)),
        lambda engine: engine.end_source("finger"),
    )
    for blocks, order in itertools.product((11, 12, 13), orders):
        ordered, other = engine_of(), engine_of()
        for engine in (ordered, other):
            engine.move("finger", (-5.0, 6.0))
            for _ in range(blocks):
                engine.next_block()
        order(ordered)
        difference = ordered.next_block() - other.next_block()
        assert np.abs(difference).max() > 1e-3 * np.abs(other.next_block()).max()


def test_of_more_names_than_are_kept_one_that_moved_lately_keeps_its_signal():
    engine, own = engine_of(), Sine(100.0, 0.1)
    for names in (["finger"], range(40), range(40, 80)):
        for name in names:
            engine.set_signal(str(name), emitted_by(own, RATE_HZ))
        engine.move("finger", (0.0, 0.0))
        engine.next_block()
        engine.end_source("finger")
    assert {part.signal for part in engine.take_record()} == {own}


def test_given_a_wrong_position_then_it_is_refused_and_the_sources_sound_on():
    engine, names = engine_of(), [f"finger {number}" for number in range(31)] + ["finger"]
    for name in names:
        engine.move(name, (1.0, 1.0))
    engine.next_block()
    before = engine.state()
    here = (0.0, 0.0)
    for wrong in (
        ("finger", (np.nan, 0.0)), ("finger", (0.0, np.inf)), ("finger", (40.0, 0.0)), ("finger", (1e300, -1e300)),
        ("finger", here, np.nan), ("finger", here, 1e300), ("", here), ("f" * 101, here), ("one too many", here),
    ):  # fmt: skip
        with pytest.raises(InputError):
            engine.move(*wrong)
        assert engine.state() == before
    for _ in range(10):
        engine.next_block()
    assert [one.name for one in engine.state()] == names


@pytest.mark.parametrize(("frame_rate_hz", "independent"), [(44_100.0, True), (1600.0, False)])
def test_interface_rate_then_drives_are_those_of_banks_rate_between_its_samples(frame_rate_hz, independent):
    drives = []
    for rate_hz in (PLATE.sample_rate_hz, frame_rate_hz):
        engine = LiveEngine(
            PLATE, block_samples=11, look_ahead_samples=360, frame_rate_hz=rate_hz, signal=Noise((80.0, 300.0), 0.2, 6),
            regularisation=Regularisation(independent=independent),
        )  # fmt: skip
        drives.append(
            run(engine, 48, lambda block, engine=engine: engine.move("finger", (8.0 * np.sin(block / 30.0), 3.0)))[0]
        )
    coarse, fine = drives
    assert fine.shape[1] == math.ceil(Fraction(48 * 11) * Fraction(frame_rate_hz) / 2000)
    wanted = converted(coarse, rate_ratio(2000.0, frame_rate_hz))[:, lead_samples(rate_ratio(2000.0, frame_rate_hz)) :]
    # The conversion rings where the drives end.
    inner = slice(fine.shape[1] // 2, fine.shape[1] * 7 // 8)
    error = np.linalg.norm(fine[:, inner] - wanted[:, : fine.shape[1]][:, inner]) / np.linalg.norm(fine[:, inner])
    assert error < 1e-4


def test_given_a_session_that_goes_on_then_its_folder_holds_a_scene_up_to_now(tmp_path):
    engine = engine_of(look_ahead=SUFFICIENT + 4 * BLOCK)
    felt = {"rate_hz": RATE_HZ, "regularisation": Regularisation(), "interpolation": "nearest"}

    def order(block):
        if block % 3 == 0:
            engine.move("finger", (0.1 * block, 0.0))

    with SessionRecording(tmp_path, **felt) as recording:
        drive_v, lives = run(engine, 90, order, recording)
        while len((tmp_path / "source-0.csv").read_text().splitlines()) < 25:
            pass
        wanted_v = felt_v(tmp_path, 400)
    np.testing.assert_allclose(drive_v[:, :400], wanted_v, rtol=0, atol=SINGLE * np.abs(wanted_v).max())
    for name in ("scene.toml", "source-0.csv", "scene-2.toml", "signal-3.wav"):  # a lab's own, or of a renamed scene
        (lab := tmp_path / f"with {name}").mkdir()
        (lab / "source-01.csv").touch()
        SessionRecording(lab, **felt).close()
        (lab / name).touch()
        with pytest.raises(InputError, match=f"{name} exists; name a new folder"):
            SessionRecording(lab, **felt)
    with SessionRecording(tmp_path / "none", **felt) as recording:
        pass
    assert recording.scene is None
    assert list((tmp_path / "none").iterdir()) == []
    wide = SimpleNamespace(samples=lambda rate_hz: np.ones((9, 2000)))  # libsndfile writes at most 1024 channels
    with SessionRecording(tmp_path / "wide", **felt) as recording:
        recording.add([replace(part, signal=wide) for part in lives[0]])
    assert "signal-0.wav cannot be written" in recording.failure


# --- independent sources


SIGNAL = Noise((80.0, 400.0), 0.3, 4)
FINGERS_MM = [(-10.0, -10.0), (14.0, -10.0), (-10.0, 14.0), (14.0, 14.0)]


def rows_of(places, actuators, bins, seed=0):
    random = np.random.default_rng(seed)
    return random.standard_normal((places, actuators, bins, 2)).astype(np.float32).view(np.complex64)[..., 0]


def test_filters_are_the_least_change_of_time_reversal_and_level_under_its_response():
    green, own = rows_of(6, 9, 5), [[0, 3], [1], [2, 4, 5]]
    sigma = np.random.default_rng(1).uniform(0.2, 1.0, (9, 1)).astype(np.float32)
    plain = green[:3].conj() * sigma
    filters, bounded = independent_filters(green, own, plain, quiet_db=-20.0, max_energy=1e6)
    assert not bounded.any()
    floor = 0.01 * np.square(np.abs(green)).sum(axis=1).mean()
    for bin_ in range(5):
        rows = green[..., bin_].astype(np.complex128)
        for source, mine in enumerate(own):
            h, quiet, w0 = rows[mine[0]], np.delete(rows, mine, axis=0), plain[source, :, bin_]
            matrix = np.zeros((10, 10), dtype=np.complex128)
            matrix[:9, :9] = np.eye(9) + quiet.conj().T @ quiet / floor
            matrix[:9, 9], matrix[9, :9] = h.conj(), h
            w = np.linalg.solve(matrix, np.append(w0, h @ w0))[:9]
            np.testing.assert_allclose(filters[source, :, bin_], w, rtol=0, atol=2e-5 * np.abs(w).max())


def independent_engine(independent=True, interpolation="nearest", bank=PLATE):
    return LiveEngine(
        bank, block_samples=10, look_ahead_samples=0, signal=SIGNAL, interpolation=interpolation,
        regularisation=Regularisation(independent=independent),
    )  # fmt: skip


def played(places_mm, *, blocks=70, **options):
    """Drives, without look-ahead, of sources at rest of which the first alone sounds."""
    engine, drives = independent_engine(**options), []
    for block in range(blocks):
        for source, place_mm in enumerate(places_mm if block % 2 == 0 else ()):
            engine.move(f"{source}", place_mm, float(source == 0))
        drives.append(engine.next_block())
    return np.concatenate(drives, axis=1)


def response(drive_v, place_mm, bank=PLATE):
    row = int(np.argmin(np.square(bank.position_mm - place_mm).sum(axis=1)))
    whole = sum(np.convolve(one, green) for one, green in zip(drive_v, bank.green(row), strict=True))
    return whole[bank.taps : -bank.taps]


def test_of_fingers_at_rest_each_source_is_quiet_at_the_others():
    plain, quiet = (played(FINGERS_MM, independent=one) for one in (False, True))
    own = [np.square(response(one, FINGERS_MM[0])).sum() for one in (plain, quiet)]
    others = [max(np.square(response(one, place)).sum() for place in FINGERS_MM[1:]) for one in (plain, quiet)]
    assert 10 * np.log10(others[0] / own[0]) > -12.0
    assert 10 * np.log10(others[1] / own[1]) < -25.0
    assert np.sqrt(own[1]) == pytest.approx(np.sqrt(own[0]), rel=0.1)
    assert np.square(quiet).sum() < MAX_ENERGY * np.square(plain).sum()


@pytest.mark.long
def test_fingers_near_one_another_sound_within_the_energy_and_it_is_said():
    alone = GreenArray(PLATE.values[:, :1], PLATE.position_mm, PLATE.sample_rate_hz, band_hz=PLATE.band_hz)
    for bank, kind, places_mm in (
        (PLATE, "nearest", [(3.0, 3.0), (3.0, 3.0)]),
        (PLATE, "nearest", [(3.0, 3.0), (4.0, 3.0)]),
        (PLATE, "bilinear", [(3.0, 3.0), (-3.0, 3.0), (3.0, -3.0)]),
        (PLATE, "nearest", [(4.0 * number % 24.0 - 12.0, 4.0 * (number // 6) - 8.0) for number in range(24)]),
        (alone, "nearest", FINGERS_MM),
    ):
        options = {"blocks": 40, "interpolation": kind, "bank": bank}
        plain, quiet = (played(places_mm, independent=one, **options) for one in (False, True))
        assert np.isfinite(quiet).all()
        assert np.square(quiet).sum() < 1.2 * MAX_ENERGY * np.square(plain).sum()
        own = [np.linalg.norm(response(drive_v, places_mm[0], bank)) for drive_v in (plain, quiet)]
        assert own[1] == pytest.approx(own[0], rel=1e-3 if kind == "nearest" else 0.1)
        if bank is alone:
            np.testing.assert_allclose(quiet, plain, rtol=0, atol=1e-4 * np.abs(plain).max())
    engine, bounded = independent_engine(), []
    for block in range(90):
        engine.move("finger", (3.0, 3.0))
        for other in range(3):
            engine.move(f"{other}", (7.0 + 4.0 * other, 3.0) if 20 <= block < 40 else FINGERS_MM[other + 1], 0.0)
        engine.next_block()
        bounded.append(engine.energy_bounded)
    assert any(bounded[20:45])
    assert not bounded[15]
    assert not bounded[-1]


def random_bank(position_mm, **options):
    green = np.random.default_rng(0).standard_normal((len(position_mm), 3, 200))
    return GreenArray(green, np.array(position_mm, float), 2000.0, **options)


def test_a_grid_without_finer_rows_then_auto_is_nearest_and_kernel_refused():
    actuator_mm = np.array([[-40.0, 0.0], [40.0, 0.0], [0.0, 40.0]])
    fine = random_bank([(x, y) for y in range(8) for x in range(8)], actuator_mm=actuator_mm)
    assert finer_rows(fine, "auto", np.ones(100)) == ("nearest", None)
    irregular, line = np.random.default_rng(0).uniform(0.0, 40.0, (60, 2)), [(4.0 * x, 0.0) for x in range(20)]
    for position_mm in (irregular, line, [(0.0, 0.0)]):
        bank = random_bank(position_mm, band_hz=(20.0, 400.0))
        with pytest.raises(InputError, match="'kernel'"):
            LiveEngine(bank, block_samples=BLOCK, look_ahead_samples=0, interpolation="kernel")
