"""The extended Kalman filter of one body: measurement model of both terminals, prediction, update
and birth."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from isac_rt.frame.antennas import unit_vector
from isac_rt.world.swarm import Pose

STD_FLOOR = np.array([1e-3, 1e-2, 2e-4, 2e-4])
"""Smallest measurement standard deviations that are believed [m, m/s, 1, 1]. At high SNR the errors
are not noise but the interpolation between cells, alike in successive frames: about 0.002 cell in
range, 0.02 in velocity, 0.002 in angle."""
BIRTH_SPEED_STD = 10.0
"""Per axis [m/s]: before its first detection a body is taken to stand still in the world, give or
take this."""
BIRTH_POSITION_STD_LIMIT = 100.0
"""A single detection that fixes the position worse than this [m] starts no track (near the line
through both terminals a bistatic length says nothing about where the reflector is)."""
MANOEUVRE_TIME = 1.0
"""Correlation time of a body's acceleration [s]. Turns, braking and gusts hold theirs for half a
second to some seconds; with PX4's default limits of 3 m/s^2 and 4 m/s^3 one needs 0.75 s."""
_ITERATIONS = 10
_POSITION = np.array([0, 2, 3])


class Gaussian(NamedTuple):
    """Mean and covariance of world position, velocity and, in a track, acceleration: (9,) [m, m/s,
    m/s^2] and (9, 9)."""

    mean: np.ndarray
    covariance: np.ndarray


def _unit(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Length and direction of (..., 3); written without abs so that a complex step passes
    through."""
    length = np.sqrt(np.sum(vector * vector, axis=-1))
    return length, vector / length[..., None]


def measure(state: np.ndarray, own: Pose, transmitter: np.ndarray | None = None) -> np.ndarray:
    r"""What `own` measures of a body: range, its rate and the direction cosines u_x and u_z.

    One-way form (an echo's range at the AT, the line of sight at a PT):
    :math:`r = |x-p|,\ \dot r = e\cdot(v-v_p),\ u = R^T e` with :math:`e = (x-p)/r`. Bistatic form:
    the path length
    :math:`|x-p_t| + |x-p|` and its rate; the direction is still that of arrival.

    Parameters
    ----------
    state : (..., 6 or 9) world position, velocity, acceleration of the body [m, m/s, m/s^2]
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


def _leg_jacobian(offset: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivative of (length, rate) of one leg with respect to relative position and velocity (2,
    6), and of its direction with respect to the position, (I - e e^T)/r (3, 3)."""
    r, e = _unit(offset)
    turn = (np.eye(3) - np.outer(e, e)) / r
    return np.stack([np.concatenate([e, np.zeros(3)]), np.concatenate([turn @ velocity, e])]), turn


def jacobian(state: np.ndarray, own: Pose, transmitter: np.ndarray | None = None) -> np.ndarray:
    """Derivative of `measure` with respect to the body's state (S,): (4, S)."""
    leg, turn = _leg_jacobian(state[:3] - own.position, state[3:6] - own.velocity)
    out = np.zeros((4, len(state)))
    out[:2, :6] = leg
    out[2:, :3] = (own.rotation.T @ turn)[[0, 2]]
    if transmitter is not None:
        out[:2, :6] += _leg_jacobian(state[:3] - transmitter[:3], state[3:6] - transmitter[3:6])[0]
    return out


def transmitter_jacobian(state: np.ndarray, transmitter: np.ndarray) -> np.ndarray:
    """Derivative of the bistatic `measure` with respect to the transmitter's state (S,): (4, S)."""
    out = np.zeros((4, len(transmitter)))
    out[:2, :6] = -_leg_jacobian(state[:3] - transmitter[:3], state[3:6] - transmitter[3:6])[0]
    return out


def measurement_covariance(
    std: np.ndarray, mean: np.ndarray, transmitter: Gaussian | None = None
) -> np.ndarray:
    """R (4, 4) of a detection: its own deviations (4,), not below `STD_FLOOR`, and for a bistatic
    one the uncertainty of the transmitter's track, seen from the body's state `mean`.

    The transmitter's error is the same in successive frames, but is treated here as if it were
    drawn anew: a reflector's covariance is too small by what they share.
    """
    R = np.diag(np.fmax(std, STD_FLOOR) ** 2)
    if transmitter is not None:
        J = transmitter_jacobian(mean, transmitter.mean)
        R = R + J @ transmitter.covariance @ J.T
    return R


@lru_cache(maxsize=64)
def singer(interval: float, acceleration_std: float) -> tuple[np.ndarray, np.ndarray]:
    r"""Transition F (9, 9) and covariance Q (9, 9) of Singer's model over an interval [s].

    The acceleration of each axis is a stationary Gauss-Markov process of standard deviation
    :math:`\sigma` [m/s^2] and correlation time :math:`\tau` = `MANOEUVRE_TIME`,
    :math:`\dot a = -a/\tau + w` with the density :math:`2\sigma^2/\tau` of w. As a process in
    continuous time it does not know how an interval is cut into frames:
    :math:`Q(2T) = F(T) Q(T) F(T)^T + Q(T)`, by which intervals beyond :math:`\tau` are halved.

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
    A = np.diag([1.0, 1.0], 1)  # of position, T velocity, T^2 acceleration over T: of order one
    A[2, 2] = -interval / MANOEUVRE_TIME
    M = np.zeros((6, 6))
    M[:3, :3], M[2, 5], M[3:, 3:] = -A, 1.0, A.T
    E, scale = expm(M), interval ** -np.arange(3.0)
    F = E[3:, 3:].T
    density = 2 * acceleration_std**2 / MANOEUVRE_TIME
    Q = density * interval**5 * np.outer(scale, scale) * (F @ E[:3, 3:])
    return np.kron(F * np.outer(scale, 1 / scale), np.eye(3)), np.kron(Q, np.eye(3))


def predict(g: Gaussian, interval: float, acceleration_std: float) -> Gaussian:
    """A track after an interval [s] by Singer's model of its acceleration [m/s^2]."""
    if interval == 0:  # the same time again; the powers of the interval in `singer` have no limit
        return g
    F, Q = singer(interval, acceleration_std)
    return Gaussian(F @ g.mean, _symmetric(F @ g.covariance @ F.T + Q))


def update(
    g: Gaussian,
    measurement: np.ndarray,
    R: np.ndarray,
    own: Pose,
    transmitter: np.ndarray | None = None,
    *,
    velocity_period: float = np.inf,
) -> Gaussian:
    """Condition on one measurement (4,) with covariance R (4, 4); components that are NaN were not
    measured.

    Iterated EKF: the measurement is linearised again at the new mean until it stands (Gauss-Newton
    on the posterior), because a range known to a millimetre across a direction known to a metre
    bends visibly. Joseph form. `velocity_period` [m/s] is the span of velocities that the Doppler
    tells apart; differences are taken modulo it.
    """
    rows = np.flatnonzero(np.isfinite(measurement))
    R = R[np.ix_(rows, rows)]
    x, P = g.mean, g.covariance
    for _ in range(_ITERATIONS):
        H = jacobian(x, own, transmitter)[rows]
        y = wrapped(measurement - measure(x, own, transmitter), velocity_period)[rows]
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        new = g.mean + K @ (y - H @ (g.mean - x))
        settled = np.all(np.abs(new - x) <= 1e-3 * np.sqrt(np.diag(P)))
        x = new
        if settled:
            break
    A = np.eye(len(x)) - K @ H
    return Gaussian(x, _symmetric(A @ P @ A.T + K @ R @ K.T))


def expected(
    mean: np.ndarray, covariance: np.ndarray, own: Pose, transmitter: Gaussian | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (..., 4) and covariance (..., 4, 4) of what will be measured of states (..., 9),
    measurement noise excluded.

    Unscented (12 points of position and velocity, equal weights): with a transversal velocity still
    unknown by 10 m/s and 0.15 s between frames the range rate bends by more than its own deviation,
    and a linearised gate would lose the target.
    """
    root = np.sqrt(6.0) * np.swapaxes(np.linalg.cholesky(covariance[..., :6, :6]), -1, -2)
    points = mean[..., None, :6] + np.concatenate([root, -root], axis=-2)
    z = measure(points, own, None if transmitter is None else transmitter.mean)
    z_mean = z.mean(axis=-2)
    dz = z - z_mean[..., None, :]
    S = np.swapaxes(dz, -1, -2) @ dz / z.shape[-2]
    if transmitter is not None:
        J = np.stack(
            [transmitter_jacobian(x, transmitter.mean) for x in mean.reshape(-1, mean.shape[-1])]
        ).reshape(*mean.shape[:-1], 4, -1)
        S = S + J @ transmitter.covariance @ np.swapaxes(J, -1, -2)
    return z_mean, S


def wrapped(difference: np.ndarray, velocity_period: float) -> np.ndarray:
    """Differences of measurements (..., 4) with the velocity brought to within half a period of
    zero."""
    if not np.isfinite(velocity_period):
        return difference
    out = difference.copy()
    out[..., 1] -= velocity_period * np.round(out[..., 1] / velocity_period)
    return out


def bistatic_distance(length: float, baseline: np.ndarray, direction: np.ndarray) -> float:
    """Distance from the receiver to a reflector, rho = (L^2 - d^2) / (2 (L - d.u)) [m].

    From |rho u - d| = L - rho; `baseline` d (3,) points from the receiver to the transmitter,
    `direction` u (3,) unit to the reflector. Not positive where the length is not longer than the
    baseline.
    """
    return float((length**2 - baseline @ baseline) / (2 * (length - baseline @ direction)))


def birth(
    measurement: np.ndarray,
    std: np.ndarray,
    own: Pose,
    transmitter: Gaussian | None = None,
    *,
    acceleration_std: float,
) -> Gaussian | None:
    """State after a first detection (4,) with deviations (4,); None where it does not fix a
    position.

    The position from range and direction (front half-space), its covariance through the inverse
    Jacobian; the velocity is zero in the world with `BIRTH_SPEED_STD` per axis, conditioned on the
    measured rate: the component along the line of sight (or the bisector) is then known, the others
    are not. The acceleration is zero with `acceleration_std` [m/s^2] per axis.
    """
    u_x, u_z = measurement[2:]
    if not np.isfinite(measurement).all() or u_x**2 + u_z**2 >= 1:
        return None
    e = own.to_world(unit_vector([u_x, u_z]))
    rho = float(measurement[0])
    if transmitter is not None:
        rho = bistatic_distance(rho, transmitter.mean[:3] - own.position, e)
    if rho <= 0:
        return None
    mean = np.concatenate([own.position + rho * e, np.zeros(6)])
    t = None if transmitter is None else transmitter.mean
    J = jacobian(mean, own, t)[_POSITION, :3]
    if np.linalg.cond(J * np.array([[1.0], [rho], [rho]])) > 1e6:
        return None
    R = measurement_covariance(std, mean, transmitter)
    back = np.linalg.inv(J)
    P = np.zeros((9, 9))
    P[:3, :3] = back @ R[np.ix_(_POSITION, _POSITION)] @ back.T
    if np.trace(P) > BIRTH_POSITION_STD_LIMIT**2:
        return None
    P[3:6, 3:6] = BIRTH_SPEED_STD**2 * np.eye(3)
    P[6:, 6:] = acceleration_std**2 * np.eye(3)
    rate_only = np.array([np.nan, measurement[1], np.nan, np.nan])
    return update(Gaussian(mean, _symmetric(P)), rate_only, R, own, t)


def mahalanobis(residual: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared distance and ln det S of residuals (..., 4) over their finite components, S (..., 4,
    4).

    A missing component is given a unit variance of its own and a residual of zero.
    """
    found = np.isfinite(residual)
    both = found[..., :, None] & found[..., None, :]
    S = np.where(both, S, np.eye(4))
    y = np.where(found, residual, 0.0)
    d2 = np.sum(y * np.linalg.solve(S, y[..., None])[..., 0], axis=-1)
    return d2, np.linalg.slogdet(S)[1]


def _symmetric(P: np.ndarray) -> np.ndarray:
    return (P + P.T) / 2
