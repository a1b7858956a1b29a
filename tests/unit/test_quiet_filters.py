"""Filters of least energy, against the equations evaluated densely, and stiff cases."""

import numpy as np
import pytest
from scipy.optimize import minimize

from wavefocus.rendering.drive.quiet_filters import Focus, Moment, find_multipliers, least_energy

BINS, ACTUATORS = 12, 6


def rows(count, seed=0, *, actuators=ACTUATORS, scale=1.0):
    parts = np.random.default_rng(seed).standard_normal((2, BINS, count, actuators))
    return scale * (parts[0] + 1j * parts[1])


def moment_of(row, quiet, place, power=None, sigma=None):
    power = np.ones(BINS) if power is None else power
    foci = [Focus(row, quiet, place, sigma)]
    return Moment(foci, power[None, None].astype(complex), quiet, place, np.ones((1, place.max() + 1), bool))


def filters_of(focus, found):
    return least_energy([focus], found.of_place)[0]


def test_given_a_small_case_then_a_general_solver_finds_no_less_energy():
    """SciPy's SLSQP knows nothing of multipliers: it has the filters themselves, the energy and the bounds."""
    bins, actuators, level = 4, 5, np.array([1e-3, 3e-3])
    h, q = rows(1, actuators=actuators)[:bins, 0], rows(3, 1, actuators=actuators)[:bins]
    power, place, a = np.linspace(0.5, 2.0, bins), np.array([0, 1, 1]), np.square(np.abs(h)).sum(axis=1)
    focus = Focus(h, q, place)
    moment = Moment([focus], power[None, None].astype(complex), q, place, np.ones((1, 2), bool))
    w = filters_of(focus, find_multipliers([moment], level))
    bound = level * (power @ np.square(np.abs((h * w).sum(axis=1))))

    def responses(x):
        filters = x.view(complex).reshape(bins, actuators)
        there = power @ np.square(np.abs((q @ filters[..., None])[..., 0]))
        return (h * filters).sum(axis=1), np.array([there[0], there[1:].mean()])

    def energy(x):
        return float(power @ np.square(x).reshape(bins, -1).sum(axis=1))

    constraints = [
        {"type": "ineq", "fun": lambda x: 1.0 - responses(x)[1] / bound},
        {"type": "eq", "fun": lambda x: (responses(x)[0] - a).view(float)},
    ]
    found = minimize(
        energy, h.conj().ravel().view(float), jac=lambda x: 2.0 * np.repeat(power, 2 * actuators) * x,
        constraints=constraints, method="SLSQP", options={"maxiter": 500, "ftol": 1e-10},
    )  # fmt: skip
    assert found.success
    assert energy(np.ascontiguousarray(w).ravel().view(float)) == pytest.approx(found.fun, rel=3e-3)
    np.testing.assert_allclose(w, found.x.view(complex).reshape(w.shape), rtol=0, atol=0.02 * np.abs(w).max())


STIFF = {
    "one place twice": (lambda: np.repeat(rows(1, 1), 2, axis=1), 1e-3, True),
    "two places that are nearly one": (lambda: rows(1, 1) * (1.0 + 1e-9 * np.arange(2))[:, None], 1e-3, True),
    "more places than actuators": (lambda: rows(24, 1), 1e-3, False),
    "fifty places": (lambda: rows(50, 1), 1e-3, False),
    "nearly the focus": (lambda: rows(1) * (1 + 1e-7) + 1e-7 * rows(1, 1), 1e-3, False),
    "no energy there": (lambda: 0.0 * rows(2, 1), 1e-3, True),
    "a level beyond reach": (lambda: rows(2, 1), 1e-30, False),
    "tiny rows": (lambda: 1e-60 * rows(2, 1), 1e-3, True),
}


@pytest.mark.parametrize("name", STIFF)
def test_given_a_stiff_case_then_the_filters_are_finite_and_keep_to_the_energy(name):
    make, level, reachable = STIFF[name]
    h, q = rows(1)[:, 0], make()
    place = np.arange(q.shape[1])
    found = find_multipliers([moment_of(h, q, place)], np.full(len(place), level), most_energy=10.0)
    assert np.isfinite(found.level).all()
    assert np.isfinite(found.of_place).all()
    assert found.energy <= 10.0 * (1 + 1e-9)
    assert bool((found.level <= level * 1.01).all()) == reachable
    w = filters_of(Focus(h, q, place), found)
    np.testing.assert_allclose((h * w).sum(axis=1), np.square(np.abs(h)).sum(axis=1), rtol=1e-6)


def test_given_an_infeasible_place_then_the_others_are_still_quiet():
    h = rows(1)[:, 0]
    q = np.concatenate([h[:, None] * (1 + 1e-9), rows(2, 1)], axis=1)
    found = find_multipliers([moment_of(h, q, np.arange(3))], np.full(3, 1e-3), most_energy=10.0)
    assert found.level[0] > 0.9
    np.testing.assert_allclose(found.level[1:], 1e-3, rtol=0.05)
