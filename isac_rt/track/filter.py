"""Extended Kalman filter of one UAV: measurement models of both kinds of terminals, prediction,
update and initiation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.special import gammaincinv

from isac_rt.frame.schedule import unambiguous_share
from isac_rt.frame.waveform import Waveform
from isac_rt.world.swarm import Pose

STD_FLOOR = np.array([1e-3, 1e-2, 2e-4, 2e-4])
"""Smallest measurement standard deviations [m, m/s, 1, 1]. At high SNR interpolation between cells
dominates and is alike in successive frames: about 0.002 cell in range, 0.02 in velocity, 0.002 in
angle."""
INITIAL_SPEED_STD = np.array([10.0, 10.0, 3.0])
"""Standard deviations of a UAV's velocity before its first detection, about zero, the last one
upwards [m/s]: PX4's default limits are 12 m/s along, 3 m/s up and 1.5 m/s down."""
INITIAL_SPEED_DEVIATIONS = 3.0
"""Largest speed of the second reading of an ambiguous velocity [`INITIAL_SPEED_STD`]."""
INITIAL_POSITION_STD_LIMIT = 100.0
"""Largest standard deviation of the position from one detection that starts a track [m]. Near the
line through both terminals a bistatic path length does not fix the position."""
MANOEUVRE_TIME = 1.0
"""Correlation time of a UAV's acceleration [s]. Turns, braking and gusts last half a second to some
seconds; with PX4's default limits of 3 m/s^2 and 4 m/s^3 one needs 0.75 s."""
_ITERATIONS = 10
ROUNDING = 1e-12
"""Change of a state without deviation at which the iteration has converged."""
POSITION = np.array([0, 2, 3])
"""Rows of a measurement that fix the position: range, u_x, u_z."""


class Gaussian(NamedTuple):
    """Mean and covariance of world position, velocity and, in a track, acceleration: (9,) [m, m/s,
    m/s^2] and (9, 9)."""

    mean: np.ndarray
    covariance: np.ndarray


class Ambiguity(NamedTuple):
    """Ambiguity of a detection: velocities a `period` [m/s] apart have the same Doppler bin. The
    beat depends on range and Doppler, so a velocity read one period too high goes with a range read
    too short by `shift` [m]."""

    period: float = np.inf
    shift: float = 0.0

    @classmethod
    def of(cls, waveform: Waveform, passes: int) -> Ambiguity:
        """Return the ambiguity at an active terminal (2 passes) or a passive one (1)."""
        period = 2 * waveform.max_velocity(passes)
        if passes == 2:
            period *= unambiguous_share(waveform)
        return cls(period, period * waveform.effective_carrier / waveform.slope)


UNAMBIGUOUS = Ambiguity()


def _unit(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return length and direction of vectors (..., 3), without abs: tests differentiate by a
    complex step."""
    length = np.sqrt(np.sum(vector * vector, axis=-1))
    return length, vector / length[..., None]


def measure(state: np.ndarray, own: Pose, transmitter: np.ndarray | None = None) -> np.ndarray:
    r"""Return the measurement by `own` of a target: range, range rate and the direction cosines u_x
    and u_z.

    One-way form (echoes at the AT, lines of sight at a PT):
    :math:`r = |x-p|,\ \dot r = e\cdot(v-v_p),\ u = R^T e` with :math:`e = (x-p)/r`. Bistatic form:
    the path length :math:`|x-p_t| + |x-p|` and its rate, and the direction of arrival.

    Parameters
    ----------
    state : (..., 6 or 9) world position, velocity, acceleration of the UAV [m, m/s, m/s^2]
    own : pose of the receiver
    transmitter : (6 or 9,) state of the transmitter; None for the one-way form

    Returns
    -------
    (..., 4) : range [m], range rate [m/s, positive receding], u_x, u_z
    """
    distance, e = _unit(state[..., :3] - own.position)
    rate = np.sum(e * (state[..., 3:6] - own.velocity), axis=-1)
    u = own.to_body(e)
    if transmitter is not None:
        outward, e_t = _unit(state[..., :3] - transmitter[:3])
        distance = distance + outward
        rate = rate + np.sum(e_t * (state[..., 3:6] - transmitter[3:6]), axis=-1)
    return np.stack([distance, rate, u[..., 0], u[..., 2]], axis=-1)


def _segment_jacobian(offset: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (..., 2, 6) of (length, rate) of one path segment with respect to
    relative position and velocity, and (..., 3, 3) of its direction with respect to the position,
    (I - e e^T)/r."""
    r, e = _unit(offset)
    turn = (np.eye(3) - e[..., :, None] * e[..., None, :]) / r[..., None, None]
    segment = np.zeros((*e.shape[:-1], 2, 6))
    segment[..., 0, :3] = segment[..., 1, 3:] = e
    segment[..., 1, :3] = (turn @ velocity[..., None])[..., 0]
    return segment, turn


def jacobian(state: np.ndarray, own: Pose, transmitter: np.ndarray | None = None) -> np.ndarray:
    """Return the derivative (..., 4, S) of `measure` with respect to the UAV's states (..., S)."""
    segment, turn = _segment_jacobian(state[..., :3] - own.position, state[..., 3:6] - own.velocity)
    out = np.zeros((*state.shape[:-1], 4, state.shape[-1]))
    out[..., :2, :6] = segment
    out[..., 2:, :3] = own.rotation.T[[0, 2]] @ turn  # u_x, u_z
    if transmitter is not None:
        out[..., :2, :6] -= transmitter_jacobian(state, transmitter)[..., :2, :6]
    return out


def curvature(g: Gaussian, own: Pose, transmitter: np.ndarray | None = None) -> np.ndarray:
    r"""Return the covariance (..., 4, 4) that the second derivatives H of range and range rate add
    to expected measurements: :math:`\tfrac12\mathrm{tr}(H_i P H_j P)` (Bar-Shalom, Li and
    Kirubarajan, "Estimation with applications to tracking and navigation", 10.3.2).

    An array of three rows fixes a height to metres, a range to centimetres. Linearised at a wrong
    height, each range would appear to measure the height.
    """
    x, P = g.mean, g.covariance[..., None, :6, :6]
    H = _segment_hessian(x[..., :3] - own.position, x[..., 3:6] - own.velocity)
    if transmitter is not None:
        H = H + _segment_hessian(x[..., :3] - transmitter[:3], x[..., 3:6] - transmitter[3:6])
    HP, out = H @ P, np.zeros((*x.shape[:-1], 4, 4))
    out[..., :2, :2] = np.einsum("...iab,...jba->...ij", HP, HP) / 2
    return out


def narrowed(
    g: Gaussian, R: np.ndarray, own: Pose, transmitter: np.ndarray | None = None
) -> Gaussian:
    """Return states (K, S) with the covariance that directions measured with covariances R (K, 4,
    4) leave: `update` linearises where it ends, so that only what stays unknown bends. What range
    and rate tell about places across them is what bends."""
    P, H = g.covariance, jacobian(g.mean, own, transmitter)[:, 2:]
    HP = H @ P
    S = HP @ np.swapaxes(H, 1, 2) + R[:, 2:, 2:]
    return Gaussian(g.mean, P - np.swapaxes(HP, 1, 2) @ np.linalg.solve(S, HP))


def _segment_hessian(offset: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the second derivatives (..., 2, 6, 6) of (length, rate) of one path segment with
    respect to relative position and velocity."""
    r, e = _unit(offset)
    turn = _segment_jacobian(offset, velocity)[1]
    mixed = e[..., :, None] * (turn @ velocity[..., None])[..., None, :, 0]
    rate = np.sum(e * velocity, axis=-1)[..., None, None]
    H = np.zeros((*e.shape[:-1], 2, 6, 6))
    H[..., 0, :3, :3] = H[..., 1, :3, 3:] = H[..., 1, 3:, :3] = turn
    bent = mixed + np.swapaxes(mixed, -1, -2) + rate * turn
    H[..., 1, :3, :3] = -bent / r[..., None, None]
    return H


def transmitter_jacobian(state: np.ndarray, transmitter: np.ndarray) -> np.ndarray:
    """Return the derivative (..., 4, S) of the bistatic `measure` of UAVs (..., 6 or 9) with
    respect to the transmitter's state (S,)."""
    out = np.zeros((*state.shape[:-1], 4, transmitter.size))
    offset, speed = state[..., :3] - transmitter[:3], state[..., 3:6] - transmitter[3:6]
    out[..., :2, :6] = -_segment_jacobian(offset, speed)[0]
    return out


def measurement_covariance(
    std: np.ndarray, mean: np.ndarray, transmitter: Gaussian | None = None
) -> np.ndarray:
    """Return R (..., 4, 4) of detections from their deviations (..., 4), at least `STD_FLOOR`;
    bistatic ones add the uncertainty of the transmitter's track, at the targets' states `mean`.

    The transmitter's error persists between frames but is treated as independent: a reflector's
    covariance is too small by the common part.
    """
    R = np.fmax(std, STD_FLOOR)[..., None] ** 2 * np.eye(4)
    if transmitter is not None:
        J = transmitter_jacobian(mean, transmitter.mean)
        R = R + J @ transmitter.covariance @ np.swapaxes(J, -1, -2)
    return R


@lru_cache(maxsize=64)
def singer(interval: float, acceleration_std: float) -> tuple[np.ndarray, np.ndarray]:
    r"""Return transition F (9, 9) and covariance Q (9, 9) of Singer's model [1]_ over an interval
    [s].

    The acceleration of each axis is a stationary Gauss-Markov process of standard deviation
    :math:`\sigma` [m/s^2] and correlation time :math:`\tau` = `MANOEUVRE_TIME`,
    :math:`\dot a = -a/\tau + w` with the density :math:`2\sigma^2/\tau` of w. F and Q are Van
    Loan's matrix exponential [2]_. Intervals beyond :math:`\tau` are halved, as
    :math:`Q(2T) = F(T) Q(T) F(T)^T + Q(T)`.

    References
    ----------
    .. [1] R. A. Singer, "Estimating optimal tracking filter performance for manned maneuvering
       targets", IEEE Trans. AES-6(4), 1970, doi:10.1109/TAES.1970.310128
    .. [2] C. F. Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans.
       AC-23(3), 1978, doi:10.1109/TAC.1978.1101743
    """
    if interval > MANOEUVRE_TIME:
        F, Q = singer(interval / 2, acceleration_std)
        return F @ F, F @ Q @ F.T + Q
    A = np.diag([1.0, 1.0], 1)  # state (position, T velocity, T^2 acceleration), time in units of T
    A[2, 2] = -interval / MANOEUVRE_TIME
    M = np.zeros((6, 6))
    M[:3, :3], M[2, 5], M[3:, 3:] = -A, 1.0, A.T
    E, scale = expm(M), interval ** -np.arange(3.0)
    F = E[3:, 3:].T
    density = 2 * acceleration_std**2 / MANOEUVRE_TIME
    Q = density * interval**5 * np.outer(scale, scale) * (F @ E[:3, 3:])
    return np.kron(F * np.outer(scale, 1 / scale), np.eye(3)), np.kron(Q, np.eye(3))


def predict(g: Gaussian, interval: float, acceleration_std: float) -> Gaussian:
    """Return a track after an interval [s] by Singer's model of its acceleration [m/s^2]."""
    if interval == 0:  # `singer` divides by the interval
        return g
    F, Q = singer(interval, acceleration_std)
    P = F @ g.covariance @ F.T + Q
    return Gaussian(F @ g.mean, (P + P.T) / 2)


def update(
    g: Gaussian,
    measurement: np.ndarray,
    R: np.ndarray,
    own: Pose,
    transmitter: np.ndarray | None = None,
    *,
    ambiguity: Ambiguity = UNAMBIGUOUS,
) -> Gaussian:
    """Condition states (..., S) on a measurement (..., 4) each, with covariances R (..., 4, 4).
    Components that are NaN were not measured; they are the same in all.

    Iterated EKF (`conditioned`): linearisation at the new mean until it converges (Gauss-Newton on
    the posterior), because a range known to a millimetre over a cross-range known to a metre is
    visibly nonlinear. Of ambiguous velocities the nearest to the state's counts.
    """
    rows = np.flatnonzero(np.isfinite(measurement).reshape(-1, 4).all(axis=0))

    def seen(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        off = wrapped(measurement - measure(x, own, transmitter), ambiguity)
        return off[..., rows], jacobian(x, own, transmitter)[..., rows, :]

    return conditioned(g, R[..., rows[:, None], rows], seen)


def conditioned(
    g: Gaussian, R: np.ndarray, seen: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> Gaussian:
    """Condition states (..., S) on measurements (..., n) of covariances R by the iterated EKF in
    Joseph's form. `seen` returns, at states, the measurements less the expected ones and the
    derivatives H (..., n, S) of the latter. A converged state does not change any more."""
    mean, P = g
    x, moving = mean, np.ones(mean.shape[:-1], bool)
    enough = 1e-3 * np.sqrt(np.diagonal(P, axis1=-2, axis2=-1)) + ROUNDING
    K, H = np.zeros((*mean.shape, R.shape[-1])), np.zeros((*R.shape[:-1], mean.shape[-1]))
    for _ in range(_ITERATIONS):
        # K = P H^T S^-1, S = H P H^T + R; x = mean + K (z - h(x) - H (mean - x))
        off, at_x = seen(x)
        H = np.where(moving[..., None, None], at_x, H)
        gain = np.linalg.solve(H @ P @ np.swapaxes(H, -1, -2) + R, H @ P)  # S^-1 H P
        K = np.swapaxes(gain, -1, -2)
        innovation = off[..., None] - H @ (mean - x)[..., None]
        new = np.where(moving[..., None], mean + (K @ innovation)[..., 0], x)
        moving = moving & (np.abs(new - x) > enough).any(axis=-1)
        x = new
        if not moving.any():
            break
    # Joseph: (I - K H) P (I - K H)^T + K R K^T
    A = np.eye(x.shape[-1]) - K @ H
    P = A @ P @ np.swapaxes(A, -1, -2) + K @ R @ np.swapaxes(K, -1, -2)
    return Gaussian(x, (P + np.swapaxes(P, -1, -2)) / 2)


def expected(
    mean: np.ndarray, covariance: np.ndarray, own: Pose, transmitter: Gaussian | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (..., 4) and covariance (..., 4, 4) of the measurements expected of states
    (..., 6 or 9), without measurement noise.

    Unscented transform, with 12 points of position and velocity of equal weight: with a transversal
    velocity unknown by 10 m/s and 0.15 s between frames, the nonlinearity of the range rate exceeds
    its deviation, and a linearised gate would lose the target.
    """
    root = np.sqrt(6.0) * np.swapaxes(np.linalg.cholesky(covariance[..., :6, :6]), -1, -2)
    points = mean[..., None, :6] + np.concatenate([root, -root], axis=-2)
    z = measure(points, own, None if transmitter is None else transmitter.mean)
    z_mean = z.mean(axis=-2)
    dz = z - z_mean[..., None, :]
    S = np.swapaxes(dz, -1, -2) @ dz / z.shape[-2]
    if transmitter is not None:
        J = transmitter_jacobian(mean, transmitter.mean)
        S = S + J @ transmitter.covariance @ np.swapaxes(J, -1, -2)
    return z_mean, S


def reported(
    states: Sequence[Gaussian], own: Pose, transmitter: Gaussian | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected measurements (K, 4) of reported targets and their standard deviations
    (K, 4), from the targets' covariances and, bistatic, the transmitter's."""
    if not states:
        return np.zeros((0, 4)), np.zeros((0, 4))
    means, covariances = (np.array(of) for of in zip(*states, strict=True))
    there = None if transmitter is None else transmitter.mean
    H = jacobian(means, own, there)
    variance = ((H @ covariances) * H).sum(axis=-1)
    if transmitter is not None:
        J = transmitter_jacobian(means, transmitter.mean)
        variance += ((J @ transmitter.covariance) * J).sum(axis=-1)
    return measure(means, own, there), np.sqrt(variance)


def wrapped(difference: np.ndarray, ambiguity: Ambiguity) -> np.ndarray:
    """Return the differences (..., 2 or 4) between measurement and expectation for the reading of
    an ambiguous velocity that is nearest to the expected one."""
    period, shift = ambiguity
    if not np.isfinite(period):
        return difference
    out = difference.copy()
    periods = np.round(out[..., 1] / period)
    out[..., 0] += np.where(np.isfinite(periods), periods, 0.0) * shift
    out[..., 1] -= periods * period
    return out


def bistatic_distance(
    length: np.ndarray, baseline: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Return the distance from the receiver to reflectors (...), rho = (L^2 - d^2) / (2 (L - d.u))
    [m].

    From |rho u - d| = L - rho; `baseline` d (3,) points from the receiver to the transmitter,
    `direction` u (..., 3) is the unit vector to each reflector. The result is not positive where
    the length does not exceed the baseline.
    """
    ahead = direction @ baseline
    return np.asarray((length**2 - baseline @ baseline) / (2 * (length - ahead)))


@np.errstate(invalid="ignore", divide="ignore")  # a target at the transmitter's position
def initiate_all(
    measurement: np.ndarray,
    std: np.ndarray,
    own: Pose,
    transmitter: Gaussian | None = None,
    *,
    acceleration_std: float,
    ambiguity: Ambiguity = UNAMBIGUOUS,
) -> tuple[np.ndarray, Gaussian]:
    """Return the indices (K,) of the detections (Q, 4) with deviations (Q, 4) that fix a position,
    and the states (K, 9) after each.

    The position follows from range and direction (front half-space), its covariance from the
    inverse Jacobian. The velocity is zero in the world with `INITIAL_SPEED_STD`, conditioned on the
    measured rate, which fixes the component along the line of sight or the bisector. The
    acceleration is zero with `acceleration_std` [m/s^2] per axis. An ambiguous velocity gives two
    states, of the two readings nearest to rest; the second ones come last and are left out above
    `INITIAL_SPEED_DEVIATIONS`.
    """
    there = None if transmitter is None else transmitter.mean
    # first reading: nearest to rest; second: one period farther, on the other side of rest
    mean = resting(measurement, own, there)
    off = measurement - measure(mean, own, there)
    near = wrapped(off, ambiguity)
    read = measurement + (near - off)
    which = np.arange(len(measurement))
    if np.isfinite(ambiguity.period):
        period, shift = ambiguity
        far = read + np.sign(near[:, 1:2]) * [shift, -period, 0.0, 0.0]
        read, which = np.concatenate([read, far]), np.append(which, which)
    # readings slow enough whose range and direction fix a position well-conditioned
    mean = resting(read, own, there)
    H = jacobian(mean, own, there)
    speed = np.abs((read - measure(mean, own, there))[:, 1])
    limit = INITIAL_SPEED_DEVIATIONS * np.linalg.norm(H[:, 1, 3:6] * INITIAL_SPEED_STD, axis=1)
    fits = (np.arange(len(read)) < len(measurement)) | (speed <= limit)
    J = H[:, POSITION, :3]
    rho = np.linalg.norm(mean[:, :3] - own.position, axis=1)
    in_metres = J * np.stack([np.ones_like(rho), rho, rho], axis=1)[..., None]
    some = np.flatnonzero(fits & np.isfinite(J).all(axis=(1, 2)) & np.isfinite(read).all(axis=1))
    some = some[np.linalg.cond(in_metres[some]) <= 1e6]
    which, mean, read = which[some], mean[some], read[some]
    # covariance J^-1 R J^-T of the position, with the range's curvature
    R = measurement_covariance(std[which], mean, transmitter)
    back = np.linalg.inv(J[some])
    position = back @ R[:, POSITION[:, None], POSITION] @ np.swapaxes(back, 1, 2)
    P = np.zeros((len(which), 9, 9))
    P[:] = np.diag([0.0] * 3 + [*INITIAL_SPEED_STD] + [acceleration_std] * 3) ** 2
    P[:, :3, :3] = (position + np.swapaxes(position, 1, 2)) / 2
    along, bent = back[:, :, :1], curvature(Gaussian(mean, P), own, there)[:, :1, :1]
    P[:, :3, :3] += bent * along * np.swapaxes(along, 1, 2)
    near = np.trace(P[:, :3, :3], axis1=1, axis2=2) <= INITIAL_POSITION_STD_LIMIT**2
    which, mean, read, R, P = (a[near] for a in (which, mean, read, R, P))
    rate = np.full_like(read, np.nan)
    rate[:, 1] = read[:, 1]
    return which, update(Gaussian(mean, P), rate, R, own, there)


def resting(measurement: np.ndarray, own: Pose, transmitter: np.ndarray | None) -> np.ndarray:
    """Return the states (Q, 9) of targets at rest at the measured range and direction (Q, 4), or
    NaN."""
    rho, _, u_x, u_z = measurement.T
    e = own.to_world(np.stack([u_x, np.sqrt(1 - u_x**2 - u_z**2), u_z], axis=1))
    if transmitter is not None:
        rho = bistatic_distance(rho, transmitter[:3] - own.position, e)
    out = np.zeros((len(measurement), 9))
    out[:, :3] = own.position + np.where(rho > 0, rho, np.nan)[:, None] * e
    out[~(u_x**2 + u_z**2 < 1)] = np.nan
    return out


def costs(
    z: np.ndarray,
    std: np.ndarray,
    mean: np.ndarray,
    S: np.ndarray,
    ambiguity: Ambiguity,
    probability: float,
) -> np.ndarray:
    """Return d^2 + ln det S (K, Q), minus twice the log-likelihood up to a constant, of detections
    (Q, 4) with deviations under the measurements `expected` of K tracks; infinite outside the gate,
    which holds a track's detection with a `probability`. NaN components were not measured."""
    y = wrapped(z[None] - mean[:, None], ambiguity)
    measured = np.isfinite(y)
    y = np.where(measured, y, 0.0)
    most = gates(probability)[measured.sum(axis=-1)]
    variance = np.fmax(std, STD_FLOOR) ** 2
    own_variance = S[:, None, range(4), range(4)] + variance
    # necessary for the gate
    k, q = np.nonzero((y**2 <= most[..., None] * own_variance).all(axis=-1))
    both = measured[k, q, :, None] & measured[k, q, None, :]
    A = np.where(both, S[k] + np.eye(4) * variance[q, None], np.eye(4))
    d2, log_det = mahalanobis(y[k, q], A)
    out = np.full(y.shape[:2], np.inf)
    out[k, q] = np.where(d2 <= most[k, q], d2 + log_det, np.inf)
    return out


def mahalanobis(y: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return y^T S^-1 y and ln det S of residuals (N, n) with covariances (N, n, n), by Cholesky
    factors."""
    L = np.linalg.cholesky(S)
    whitened = np.linalg.solve(L, y[..., None])[..., 0]
    diagonal = np.diagonal(L, axis1=-2, axis2=-1)
    return (whitened**2).sum(axis=-1), 2 * np.log(diagonal).sum(axis=-1)


@lru_cache(maxsize=8)
def gates(probability: float) -> np.ndarray:
    """Return the gates, quantiles of chi-square, for 0 to 4 components (5,)."""
    return 2 * gammaincinv(np.arange(5) / 2, probability)
