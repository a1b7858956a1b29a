"""Gaussian processes at one frequency: of waves, and of the rest that no wave of one wave number explains.

At position x_i, of actuator a, is measured

    d_a(x_i) = sum_c s_ac psi_c(x_i; x_a) + sum_j q_aj H0(2)(k |x_i - y_j|) + e_i,

psi the actuator's own waves, y_j sources on a ring around everything. With P_a the mean power of d_a,

    s_ac ~ N(0, 100 P_a / mean_i |psi_c(x_i)|^2)  (1 in place of 100 for waves of other frequencies; of a solid 1e-4),
    q_aj ~ N(0, P_a [rho1 |H0(2)(k |x_a - y_j|)|^2 / Z_a + rho2 / Z]),
    e_i  ~ N(0, P_a [n1 level_i^2 + n2]),

where Z_a and Z make rho1 and rho2 the shares of the power that such waves bring. On a lattice coarser than half a
wavelength waves of pairs of directions agree at every position, so that positions left out cannot tell them apart. The
prior can: a reflected wave comes from where the actuator's own wave meets the rim.

With X = D^(-1/2) Phi V^(1/2) (D the covariance of e, V the prior's variances) and B = 1 + X* X, the strengths are
V^(1/2) B^(-1) X* D^(-1/2) d, and the variance at x is phi V^(1/2) B^(-1) V^(1/2) phi*.

N. Antonello et al., IEEE/ACM TASLP 25, 1929 (2017): equivalent sources for sound fields. D. Caviedes-Nozal et al., JASA
149, 1107 (2021): Gaussian processes with wave kernels. C. Rasmussen and C. Williams, Gaussian Processes for Machine
Learning (2006), sections 2.2, 5.4. A. Sundstroem et al., arXiv 2506.13279 (2025): priors from the boundary.

The rest is a field whose wave numbers fill a disk.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import numpy as np
from scipy.linalg import blas, cho_factor, cho_solve, eigh, lapack
from scipy.optimize import minimize

from wavefocus.calibration import Complex64Array, Complex128Array, Float64Array
from wavefocus.calibration.coarse_grid.waves import distances_mm, outgoing, outgoing_each, waves_of_actuators
from wavefocus.calibration.wave_model import disk_kernel

_SHARE_LIMITS = ((-12.0, 0.5), (-25.0, 2.0), (-16.0, 0.0), (-24.0, 0.0))
"""Of log (rho1, rho2, n1, n2). A rim reflects no more than arrives: rho1 is below 1.6."""
_WAVENUMBER_LIMITS = ((-5.0, 5.0), (-60.0, 0.0))
"""Of the wave number, in percent: log |k| relative to where the search starts, and Im k / |k|."""
_PERCENT = 0.01
"""A wave number changes the evidence so strongly that it is searched for in percent."""
FIRST_SHARES = np.array([-2.0, -10.0, -10.0, -14.0])
_OWN_SHARE = 100.0
"""Prior power of an actuator's own wave over what was measured: large, so that it is free."""
SMEARED_SHARE, SMEARED_SHARE_OF_A_SOLID = 1.0, 1e-4
"""The same of the waves of other frequencies. A solid has 18 of them per actuator: free, they fit the noise of 64
positions."""
_DERIVATIVE_STEP = 1e-5
"""Relative step in k of the central difference; waves of 100 rad then err by 1e-6."""


class FrequencyWaves:
    """The model of all actuators at one frequency.

    wavenumber: k in rad/mm.
    pressure_share: See `waves_of_actuators`.
    points_mm, float64 (positions, 2); actuator_mm, float64 (actuators, 2); ring_mm, float64 (sources, 2).
    power, float64 (actuators,): P, > 0.
    relative_level, float64 (positions, actuators): Square of level_i.
    transfer, complex128 (positions, actuators): d.
    """

    def __init__(
        self,
        wavenumber: complex,
        pressure_share: float,
        points_mm: Float64Array,
        actuator_mm: Float64Array,
        ring_mm: Float64Array,
        power: Float64Array,
        relative_level: Float64Array,
        transfer: Complex128Array,
    ) -> None:
        self.wavenumber, self._share = complex(wavenumber), pressure_share
        self._points_mm, self._actuator_mm, self._ring_mm = points_mm, actuator_mm, ring_mm
        self._to_ring_mm = distances_mm(points_mm, ring_mm)
        self._power, self._relative_level = power, relative_level
        self._values = transfer / np.sqrt(power)
        self._sources = outgoing(self.wavenumber, self._to_ring_mm)
        (self._own,) = waves_of_actuators([self.wavenumber], pressure_share, points_mm, actuator_mm)
        met = np.square(np.abs(outgoing(self.wavenumber, distances_mm(actuator_mm, ring_mm))))
        seen = np.square(np.abs(self._sources)).mean(axis=0)
        self._image = met / (met @ seen)[:, None]
        self._even = 1.0 / seen.sum()
        # A solid has six waves of its own: shear and pressure waves, each once of order 0 and twice of order 2.
        count, smeared = (6, SMEARED_SHARE_OF_A_SOLID) if pressure_share else (1, SMEARED_SHARE)
        shares = np.where(np.arange(len(self._own)) < count, _OWN_SHARE, smeared)
        self._own_variance = shares[:, None] / np.square(np.abs(self._own)).mean(axis=1)

    def evidence(self, theta: Float64Array) -> tuple[float, Float64Array]:
        """Minus twice the log marginal likelihood, a value measured, and its gradient.

        theta, float64 (6,): log (rho1, rho2, n1, n2); in percent, log of |k| over where it starts, and Im k / |k|.
        """
        start = abs(self.wavenumber)
        size, sine = np.exp(_PERCENT * theta[4]) * start, _PERCENT * theta[5]
        cosine = np.sqrt(1.0 - sine**2)
        k = size * (cosine + 1j * sine)
        slopes = _PERCENT * np.array([k, size * (1j - sine / cosine)])
        sources, first = outgoing_each([(k, 0), (k, 1)], self._to_ring_mm)
        source_slope = -self._to_ring_mm * first  # of H0(k r) by k
        step = _DERIVATIVE_STEP * k
        own, after, before = waves_of_actuators(
            [k, k + step, k - step], self._share, self._points_mm, self._actuator_mm
        )
        own_slope = (after - before) / (2.0 * step)
        rho1, rho2, n1, n2 = np.exp(theta[:4])
        total, gradient, waves = 0.0, np.zeros(6), len(own)
        for actuator in range(self._values.shape[1]):
            reflected, even = rho1 * self._image[actuator], np.full(len(self._ring_mm), rho2 * self._even)
            root = np.sqrt(np.append(self._own_variance[:, actuator], reflected + even))
            by_level = n1 * self._relative_level[:, actuator]
            variance = by_level + n2
            scale = 1.0 / np.sqrt(variance)
            x = _side_by_side(own[:, :, actuator], sources, root, scale)
            y = self._values[:, actuator] * scale
            low = _factor(x)
            # Of the transposed inverse of B, its upper triangle.
            inverse = lapack.zpotri(low.T, lower=0)[0]
            beta = blas.zhemv(1.0, inverse, y.conj() @ x, lower=0).conj()
            alpha = y - x @ beta
            xi = blas.zhemm(1.0, inverse, x.T, lower=0).T
            total += np.vdot(y, alpha).real + 2.0 * np.log(low.diagonal().real).sum() + np.log(variance).sum()
            by_wave = (1.0 - inverse.diagonal().real - np.square(np.abs(beta)))[waves:]
            by_noise = 1.0 - np.square(np.abs(alpha)) - np.einsum("im,im->i", xi.view(np.float64), x.view(np.float64))
            gradient[0] += (by_wave * reflected / (reflected + even)).sum()
            gradient[1] += (by_wave * even / (reflected + even)).sum()
            gradient[2] += (by_noise * by_level / variance).sum()
            gradient[3] += (by_noise * n2 / variance).sum()
            moved = _side_by_side(own_slope[:, :, actuator], source_slope, root, scale)
            by_k = np.vdot(xi, moved) - np.vdot(alpha, moved @ beta)
            gradient[4:] += 2.0 * (by_k * slopes).real
        return total / self._values.size, gradient / self._values.size

    def fitted(self, starts: Sequence[Float64Array], evaluations: int) -> tuple[complex, Float64Array, float]:
        """Wave number and shares of greatest evidence, and the value of `evidence`; starts are of shares (4,)."""
        limits = (*_SHARE_LIMITS, *_WAVENUMBER_LIMITS)
        sine = self.wavenumber.imag / abs(self.wavenumber) / _PERCENT
        options: Any = {"maxfun": evaluations, "ftol": 1e-6, "gtol": 1e-4}

        def search(start: Float64Array) -> Any:
            inside, evidence = np.clip([*start, 0.0, sine], *np.array(limits).T), cast(Any, self.evidence)
            return minimize(evidence, inside, jac=True, method="L-BFGS-B", bounds=limits, options=options)

        with ThreadPoolExecutor(len(starts)) as pool:
            tries = list(pool.map(search, starts))
        best = min(tries, key=lambda result: float(result.fun))
        size, sine = np.exp(_PERCENT * best.x[4]), _PERCENT * best.x[5]
        k = complex(size * abs(self.wavenumber) * (np.sqrt(1.0 - sine**2) + 1j * sine))
        return k, np.asarray(best.x[:4]), float(best.fun)

    def strengths(self, shares: Float64Array) -> Complex128Array:
        """Strengths at log (rho1, rho2, n1, n2), complex128 (own waves + sources, actuators)."""
        found = []
        for actuator in range(len(self._power)):
            x, y, root, _ = self._scaled(actuator, shares)
            found.append(root * lapack.zpotrs(_factor(x).T, y.conj() @ x, lower=0)[0].conj())
        return np.asarray(np.array(found).T * np.sqrt(self._power), dtype=np.complex128)

    def sums(self, strength: Complex128Array) -> Complex128Array:
        """The waves at the positions, (positions, actuators)."""
        waves = len(self._own)
        own = np.einsum("cpa,ca->pa", self._own, strength[:waves])
        return np.asarray(own + self._sources @ strength[waves:])

    def left_out(self, shares: Float64Array) -> tuple[Complex128Array, Float64Array]:
        """Error at each position if it alone is left out, and its variance, noise included, (positions, actuators)."""
        error, variance = np.empty_like(self._values), np.empty(self._values.shape)
        for actuator in range(len(self._power)):
            explained, left, noise = self._whitened(actuator, shares)
            free = np.maximum(1.0 - np.square(np.abs(explained)).sum(axis=1), 1e-9)
            error[:, actuator] = noise * left / free
            variance[:, actuator] = noise**2 / free
        return error * np.sqrt(self._power), variance * self._power

    def whitened(self, shares: Float64Array) -> tuple[Complex64Array, Complex128Array, Float64Array]:
        """What every left-out error follows from (`left_out_rows`), in the units of what is measured.

        Returns E = X B^(-1/2), complex64 (actuators, positions, own waves + sources); ``D^(1/2) C^-1 d`` and the root
        of D, (actuators, positions).
        """
        parts = [self._whitened(actuator, shares) for actuator in range(len(self._power))]
        explained, left, noise = zip(*parts, strict=True)
        return (
            np.stack(explained, dtype=np.complex64, casting="same_kind"),
            np.stack(left),
            np.stack(noise) * np.sqrt(self._power)[:, None],
        )

    def _whitened(self, actuator: int, shares: Float64Array) -> tuple[Complex128Array, Complex128Array, Float64Array]:
        x, y, _, noise = self._scaled(actuator, shares)
        explained = x @ _inverse_of(_factor(x)).conj().T
        return explained, y - explained @ (y.conj() @ explained).conj(), noise

    def variance(self, points_mm: Float64Array, shares: Float64Array) -> Float64Array:
        """Variance of the waves at points (n, 2), without noise: (n, actuators)."""
        sources = outgoing(self.wavenumber, distances_mm(points_mm, self._ring_mm))
        (own,) = waves_of_actuators([self.wavenumber], self._share, points_mm, self._actuator_mm)
        variance = np.empty((len(points_mm), len(self._power)))
        for actuator, power in enumerate(self._power.tolist()):
            x, _, root, _ = self._scaled(actuator, shares)
            half = _inverse_of(_factor(x))
            phi = _side_by_side(own[:, :, actuator], sources, root)
            variance[:, actuator] = power * np.square(np.abs(phi @ half.conj().T)).sum(axis=1)
        return variance

    def _scaled(
        self, actuator: int, shares: Float64Array
    ) -> tuple[Complex128Array, Complex128Array, Float64Array, Float64Array]:
        """X and D^(-1/2) d of one actuator, V^(1/2), D^(1/2); powers over P."""
        rho1, rho2, n1, n2 = np.exp(shares)
        root = np.sqrt(np.append(self._own_variance[:, actuator], rho1 * self._image[actuator] + rho2 * self._even))
        noise = np.sqrt(n1 * self._relative_level[:, actuator] + n2)
        x = _side_by_side(self._own[:, :, actuator], self._sources, root, 1.0 / noise)
        return x, self._values[:, actuator] / noise, root, noise


def _side_by_side(
    own: Complex128Array, sources: Complex128Array, root: Float64Array, scale: Float64Array | None = None
) -> Complex128Array:
    """Own waves (waves, points) and sources (points, sources) times `root`, rows times `scale`: (points, both)."""
    waves = len(own)
    phi = np.empty((len(sources), root.size), dtype=np.complex128)
    np.multiply(own.T, root[:waves], out=phi[:, :waves])
    np.multiply(sources, root[waves:], out=phi[:, waves:])
    if scale is not None:
        phi *= scale[:, None]
    return phi


def _factor(x: Complex128Array) -> Complex128Array:
    """Lower Cholesky factor of B = 1 + X* X. Raises LinAlgError: B is not positive definite in these numbers."""
    gram = blas.zherk(1.0, x.T)  # transposed: its upper triangle, and no other is looked at
    np.einsum("ii->i", gram)[:] += 1.0
    factor, failed = lapack.zpotrf(gram, lower=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the matrix of the waves is not positive definite")
    return np.asarray(factor.T)


def _inverse_of(low: Complex128Array) -> Complex128Array:
    return np.asarray(lapack.ztrtri(low.T, lower=0)[0].T)


REST_JUDGED, REST_POSITIONS = 16, 400
"""Frequencies at which the rest is judged, and positions that judge it, at most."""
_NO_REST = (0.0, 1.0)
_REST_RIDGES = tuple(np.geomspace(1e-6, 1.0, 13).tolist())
REST_RADIUS, REST_RESOLVED = 1.15, (0.5, 1.0)
"""Radius of the rest's disk in wave numbers; or in shares of what the positions resolve, pi over their spacing. Half of
it averages noise and still holds the near fields of bending waves, which all of it does not tell from noise."""
_MAX_REST = 0.95
"""Where left-out positions keep more than this share of the residuals, in the median and in the mean square, there is
no rest."""


def choose_rest(
    residual: Complex128Array, apart_mm: Float64Array, wavenumber: float, resolved: float
) -> tuple[float, float]:
    """Radius of the rest's disk in rad/mm, 0 for none; ridge.

    Those of greatest evidence, each actuator's rest with a power of its own. Where the positions do not resolve the
    waves, a rest between them is anyone's guess, and there is none.

    residual, complex128 (positions, actuators): What the waves leave at some positions.
    apart_mm, float64 (positions, positions): Their distances.
    wavenumber: Of the waves, in rad/mm.
    resolved: Largest wave number that the positions resolve.
    """
    if wavenumber > resolved:
        return _NO_REST
    tries = []
    for radius in (REST_RADIUS * wavenumber, *(share * resolved for share in REST_RESOLVED)):
        size, turn = eigh(disk_kernel(radius * apart_mm))
        seen = np.square(np.abs(turn.T @ residual))
        for ridge in _REST_RIDGES:
            power = np.maximum(size, 0.0) + ridge
            by_actuator = np.maximum((seen / power[:, None]).mean(axis=0), 1e-300)
            cost = np.log(power).mean() + np.log(by_actuator).mean()
            tries.append((float(cost), float(radius), ridge))
    _, radius, ridge = min(tries)
    missed = np.linalg.norm(left_out_rest(disk_kernel(radius * apart_mm), ridge, residual)[0], axis=1)
    there = np.maximum(np.linalg.norm(residual, axis=1), 1e-300)
    left = min(float(np.median(missed / there)), float(np.linalg.norm(missed) / np.linalg.norm(there)))
    return (radius, ridge) if left < _MAX_REST else _NO_REST


def left_out_rest(
    kernel: Float64Array, ridge: float, residual: Complex128Array
) -> tuple[Complex128Array, Float64Array]:
    """Error at each position if it is left out, ``(C^-1 r)_i / (C^-1)_ii`` with C = K + ridge, and 1 / (C^-1)_ii."""
    inverse = cho_solve(cho_factor(kernel + ridge * np.eye(len(kernel))), np.eye(len(kernel)))
    share = 1.0 / inverse.diagonal()
    return np.asarray(inverse @ residual * share[:, None]), np.asarray(share)
