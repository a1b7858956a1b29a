"""Corrections of drives by scans: how far, how loud, and when they stop."""

import numpy as np
import pytest

from tests.unit.line_verification import scan_of
from tests.unit.plate_banks import RATE_HZ, TAPS, plate_bank
from wavefocus import Drive, InputError
from wavefocus.rendering.drive.coil_limits import DriveLimits
from wavefocus.rendering.verify.correction import correct_drive, correction_lines, held_out
from wavefocus.storage.bank.ledger import Status

PLACES_MM = [[0.0, 0.0], [20.0, 0.0], [-20.0, 4.0], [0.0, 16.0]]
ROWS = np.arange(len(PLACES_MM))
BANK = plate_bank(PLACES_MM)


def _focused(bank, samples=400):
    """Noise within the band, focused at the first place by time reversal."""
    spectrum = np.fft.rfft(np.random.default_rng(1).standard_normal(samples))
    frequency = np.fft.rfftfreq(samples, 1 / RATE_HZ)
    spectrum[(frequency < 80) | (frequency > 400)] = 0
    signal = np.fft.irfft(spectrum, samples)
    drive_v = np.stack([np.convolve(signal, green[::-1]) for green in bank.green(0)])
    drive_v *= 0.5 / np.abs(drive_v).max()
    none = np.zeros(1, np.int64)
    return Drive(drive_v, RATE_HZ, -(TAPS - 1) / RATE_HZ, "exact", 1.0, 0.0, none, none, none)


def _finger(strength=0.8):
    """The plate as a finger on the first place makes it: what it moves there sends waves everywhere."""
    greens = np.stack([BANK.green(row) for row in ROWS])
    late = np.zeros_like(greens[0])
    late[:, 3:] = greens[0][:, :-3]
    touched = greens - strength * 0.15 * late
    touched[0] = greens[0] - strength * (0.6 * greens[0] + 0.25 * late)
    return touched


class _Rig:
    """Plays drives on a plate, and counts."""

    def __init__(self, greens, noise_rms=0.0, lost=()):
        self.greens, self.noise_rms, self.lost, self.played = greens, noise_rms, lost, []
        self._rng = np.random.default_rng(7)

    def __call__(self, drive):
        self.played.append(drive)
        field = np.array(
            [sum(np.convolve(drive.drive_v[i], green[i]) for i in range(len(green))) for green in self.greens]
        )
        field += self.noise_rms * self._rng.standard_normal(field.shape)
        status = np.full(len(field), Status.VALID, np.uint8)
        status[list(self.lost)] = Status.POOR_SIGNAL
        field[list(self.lost)] = 0
        return scan_of(field, drive.start_s, RATE_HZ, self.noise_rms, status=status)


def _error(rig, drive):
    """Within the frequencies that the drive has: the relative difference from what the bank predicts of `first`."""
    first = rig.played[0]
    wanted = _Rig(np.stack([BANK.green(row) for row in ROWS]))(first).field
    quiet = _Rig(rig.greens)(drive).field
    bins = slice(*np.searchsorted(np.fft.rfftfreq(wanted.shape[1], 1 / RATE_HZ), (90, 390)))
    spectra = [np.fft.rfft(field, axis=1)[:, bins] for field in (wanted, quiet)]
    return np.linalg.norm(spectra[1] - spectra[0]) / np.linalg.norm(spectra[0])


def corrected(rig, rounds, bank=BANK, rows=ROWS, **options):
    return correct_drive(_focused(bank), bank, rows, rig, rounds, **{"limits": DriveLimits(), **options})


@pytest.mark.parametrize("strength", [0.2, 0.8])
def test_a_finger_on_the_focus_is_corrected_to_a_quarter_within_the_energy(strength):
    rig = _Rig(_finger(strength), noise_rms=1e-6)
    drive, found = corrected(rig, 3)
    before, after = (_error(rig, one) for one in (rig.played[0], drive))
    assert before > 0.05
    assert after < before / 4
    assert found.rounds[found.best].error == pytest.approx(after, rel=0.5)
    assert max(one.energy for one in found.rounds) <= 5.0 + 1e-9
    # With so few places none is held out, and one correction is made.
    assert (len(rig.played), found.stopped) == (2, "few")
    assert all(one.held_out is None for one in found.rounds)


@pytest.mark.parametrize("noise", [0.3, 3.0])
def test_a_scan_that_is_noisier_than_its_error_never_makes_it_worse(noise):
    greens = _finger(0.1)
    loud = np.sqrt(np.mean(_Rig(greens)(_focused(BANK)).field[0] ** 2))
    rig = _Rig(greens, noise_rms=noise * loud)
    drive, found = corrected(rig, 3)
    assert _error(rig, drive) <= 1.05 * _error(rig, rig.played[0])
    assert found.stopped in ("noise", "no better")


def test_energy_and_limits_hold_and_a_drive_at_its_limit_is_kept():
    _, found = corrected(_Rig(_finger()), 3, max_energy=1.5)
    assert max(one.energy for one in found.rounds) <= 1.5 + 1e-9
    assert found.rounds[found.best].error < found.rounds[0].error
    peak_v = float(np.abs(_focused(BANK).drive_v).max())
    drive, found = corrected(_Rig(_finger()), 3, limits=DriveLimits(peak_v=1.2 * peak_v))
    assert np.abs(drive.drive_v).max() <= 1.2 * peak_v
    assert found.rounds[found.best].error < found.rounds[0].error
    drive, _ = corrected(_Rig(_finger()), 3, limits=DriveLimits(peak_v=peak_v))
    assert np.abs(drive.drive_v).max() <= peak_v


def test_dropouts_are_left_out_and_too_many_end_it():
    _, found = corrected(_Rig(_finger(), lost=(2,)), 2)
    assert found.rounds[0].positions == 3
    assert found.rounds[found.best].error < found.rounds[0].error / 4
    first = _focused(BANK)
    drive, found = correct_drive(first, BANK, ROWS, _Rig(_finger(), lost=(0, 2, 3)), 2, limits=DriveLimits())
    assert drive is first
    assert (found.rounds, found.best, found.stopped) == ((), None, "dropouts")


MANY_MM = [[6.0 * x, 6.0 * y] for y in (-1, 0, 1) for x in (-2, -1, 0, 1, 2)]


def test_a_fifth_of_the_places_is_held_out_and_what_does_not_better_them_is_not_kept():
    bank = plate_bank(MANY_MM)
    rows = np.arange(len(MANY_MM))
    seen = np.setdiff1d(rows, held_out(rows))
    assert held_out(rows).tolist() == [2, 7, 12]
    greens = np.stack([bank.green(row) for row in rows])
    first = _focused(bank)

    weaker = greens * np.where(np.arange(greens.shape[1]) == 0, 0.5, 1.0)[None, :, None]  # one coil: true everywhere
    drive, found = correct_drive(first, bank, rows, _Rig(weaker), 3, limits=DriveLimits())
    assert found.rounds[found.best].held_out < found.rounds[0].held_out / 2

    # What the control places show is partly of other places: to follow it makes the true field worse.
    false = greens.copy()
    false[seen] += 0.2 * greens[np.roll(seen, 1)]
    drive, found = correct_drive(first, bank, rows, _Rig(false), 3, limits=DriveLimits())
    assert drive is first
    assert (found.best, found.stopped) == (0, "held out")
    assert len(found.rounds) == 2
    assert found.rounds[1].error < found.rounds[0].error
    assert "held out" in correction_lines(found)[-1]


def test_a_scene_too_long_for_its_places_is_refused():
    with pytest.raises(InputError, match="shorten"):
        corrected(_Rig(_finger()), 1, rows=np.tile(ROWS, 20_000))
