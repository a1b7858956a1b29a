"""Independent live sources: filters against a direct minimum; levels and energies that the drives reach."""

import numpy as np
import pytest

from tests.unit.plate_banks import RATE_HZ, TAPS, plate_bank
from wavefocus.config.scene import Regularisation
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.live.finer import MAX_ENERGY, finer_rows, independent_filters
from wavefocus.rendering.scene.signals import Noise
from wavefocus.storage.errors import InputError

BANK = plate_bank()
BLOCK = 10
SIGNAL = Noise((80.0, 400.0), 0.3, 4)
FINGERS_MM = [(-10.0, -10.0), (14.0, -10.0), (-10.0, 14.0), (14.0, 14.0)]


def rows_of(places, actuators, bins, seed=0):
    random = np.random.default_rng(seed)
    return random.standard_normal((places, actuators, bins, 2)).astype(np.float32).view(np.complex64)[..., 0]


def energies(green, filters):
    """Energy over that of time reversal, (sources, bins)."""
    return np.square(np.abs(filters)).sum(axis=1) / np.square(np.abs(green)).sum(axis=1)


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


@pytest.mark.parametrize("actuators", [1, 3])
def test_places_that_cannot_be_told_apart_then_response_stays_and_energy_is_bounded(actuators):
    green = rows_of(24, actuators, 40)
    green[1] = green[0] * (1.0 + 1e-4)
    green[2] = green[0]
    green[..., 7:9] = 0.0
    filters, _ = independent_filters(green, [[place] for place in range(24)], green.conj())
    assert np.isfinite(filters).all()
    assert not filters[..., 7:9].any()
    green, filters = np.delete(green, [7, 8], axis=2), np.delete(filters, [7, 8], axis=2)
    power = np.square(np.abs(green)).sum(axis=1)
    np.testing.assert_allclose((green * filters).sum(axis=1), power, rtol=1e-3, atol=1e-4)
    assert energies(green, filters).max() < MAX_ENERGY * 1.01
    if actuators == 1:
        np.testing.assert_allclose(filters, green.conj(), rtol=0, atol=5e-3 * np.abs(green).max())


def played(places_mm, amplitudes, *, bank=BANK, blocks=100, velocity_mm_s=0.0, independent, saturation=0.0, **options):
    """Drives, without look-ahead, of sources that move to the right."""
    held = Regularisation(independent=independent, saturation=saturation)
    engine = LiveEngine(bank, block_samples=BLOCK, look_ahead_samples=0, signal=SIGNAL, regularisation=held, **options)
    drives = []
    for block in range(blocks):
        if block % 2 == 0:
            for source, (x_mm, y_mm) in enumerate(places_mm):
                way_mm = velocity_mm_s * block * BLOCK / RATE_HZ
                engine.move(f"{source}", (x_mm + way_mm, y_mm), amplitudes[source])
        drives.append(engine.next_block())
    return np.concatenate(drives, axis=1)


def response(drive_v, place_mm, first):
    row = int(np.argmin(np.square(BANK.position_mm - place_mm).sum(axis=1)))
    return sum(np.convolve(one, green) for one, green in zip(drive_v, BANK.green(row), strict=True))[first:-TAPS]


def level_db(drive_v, places_mm):
    """Largest energy at a quiet place, over that at the first one."""
    energy = [np.square(response(drive_v, place_mm, TAPS)).sum() for place_mm in places_mm]
    return 10 * np.log10(max(energy[1:]) / energy[0])


def test_of_fingers_at_rest_each_source_is_quiet_at_the_others():
    loud = [1.0, 0.0, 0.0, 0.0]
    plain, quiet = (played(FINGERS_MM, loud, independent=one) for one in (False, True))
    assert level_db(plain, FINGERS_MM) > -12.0
    assert level_db(quiet, FINGERS_MM) < -25.0
    at_focus = [response(one, FINGERS_MM[0], TAPS) for one in (plain, quiet)]
    assert np.linalg.norm(at_focus[1]) == pytest.approx(np.linalg.norm(at_focus[0]), rel=0.1)
    assert np.square(quiet).sum() < MAX_ENERGY * np.square(plain).sum()


@pytest.mark.parametrize(
    "places_mm",
    [
        [(3.0, 3.0), (3.0, 3.0)],
        [(3.0, 3.0), (4.0, 3.0)],
        [(3.0, 3.0), (-3.0, 3.0), (3.0, -3.0)],
        [(4.0 * number % 24.0 - 12.0, 4.0 * (number // 6) - 8.0) for number in range(24)],
    ],
    ids=["one place", "1 mm apart", "three near one another", "24"],
)
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_given_fingers_too_near_to_one_another_then_they_sound_within_the_energy(places_mm, interpolation):
    loud, blocks = [1.0] + [0.0] * (len(places_mm) - 1), 30
    plain, quiet = (
        played(places_mm, loud, blocks=blocks, interpolation=interpolation, independent=one) for one in (False, True)
    )
    assert np.isfinite(quiet).all()
    assert np.square(quiet).sum() < 1.2 * MAX_ENERGY * np.square(plain).sum()
    assert np.abs(quiet[:, -5 * BLOCK :]).max() > 0.0


def test_the_engine_says_while_the_energy_of_near_fingers_is_bounded():
    engine = LiveEngine(
        BANK, block_samples=BLOCK, look_ahead_samples=0, signal=SIGNAL, regularisation=Regularisation(independent=True)
    )
    bounded = []
    for block in range(90):
        engine.move("finger", (3.0, 3.0))
        for other in range(3):
            engine.move(f"{other}", (7.0 + 4.0 * other, 3.0) if 20 <= block < 40 else FINGERS_MM[other + 1], 0.0)
        engine.next_block()
        bounded.append(engine.energy_bounded)
    assert any(bounded[20:45])
    assert not bounded[15]
    assert not bounded[-1]


def test_given_a_grid_as_fine_as_such_rows_then_auto_takes_the_nearest_position():
    step_mm = np.arange(8.0)
    position_mm = np.stack(np.meshgrid(step_mm, step_mm), axis=-1).reshape(-1, 2)
    green = np.random.default_rng(0).standard_normal((64, 3, 200))
    bank = GreenArray(green, position_mm, 2000.0, actuator_mm=np.array([[-40.0, 0.0], [40.0, 0.0], [0.0, 40.0]]))
    assert finer_rows(bank, "auto", np.ones(100)) == ("nearest", None)


@pytest.mark.parametrize(
    "position_mm",
    [np.random.default_rng(0).uniform(0.0, 40.0, (60, 2)), [(4.0 * x, 0.0) for x in range(20)], [(0.0, 0.0)]],
    ids=["irregular", "a line", "one"],
)
def test_given_a_grid_without_finer_rows_then_kernel_is_refused_by_name(position_mm):
    green = np.random.default_rng(1).standard_normal((len(position_mm), 3, 100))
    bank = GreenArray(green, np.array(position_mm), 2000.0, band_hz=(20.0, 400.0))
    with pytest.raises(InputError, match="'kernel'"):
        LiveEngine(bank, block_samples=BLOCK, look_ahead_samples=0, interpolation="kernel")
