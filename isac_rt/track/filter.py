"""The extended Kalman filter of one body: measurement model of both terminals, prediction, update
and birth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.special import gammaincinv

from isac_rt.frame.schedule import unambiguous_share
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.jit import jit
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


class Ambiguity(NamedTuple):
    """What a detection leaves open: the Doppler tells velocities a `period` [m/s] apart from each
    other no more. The beat is of range and of Doppler, so that a detection whose velocity was read
    one period too high was read too short by `shift` [m]."""

    period: float = np.inf
    shift: float = 0.0

    @classmethod
    def of(cls, waveform: Waveform, passes: int) -> Ambiguity:
        """At an active terminal (2 passes) or a passive one (1)."""
        period = 2 * waveform.max_velocity(passes)
        if passes == 2:
            period *= unambiguous_share(waveform)
        return cls(period, period * waveform.effective_carrier / waveform.slope)


UNAMBIGUOUS = Ambiguity()


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


@jit
def _leg_jacobian(offset: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivative of (length, rate) of one leg with respect to relative position and velocity (2,
    6), and of its direction with respect to the position, (I - e e^T)/r (3, 3)."""
    r = np.sqrt(np.sum(offset * offset))
    e = offset / r
    turn = (np.eye(3) - np.outer(e, e)) / r
    leg = np.zeros((2, 6))
    leg[0, :3], leg[1, 3:] = e, e
    for i in range(3):
        leg[1, i] = np.sum(turn[i] * velocity)
    return leg, turn


@jit
def _linearised(
    state: np.ndarray, own: np.ndarray, transmitter: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`measure` of one state (4,) and its derivative (4, S); `own`: position, velocity and the
    columns of the attitude (5, 3), `transmitter`: (0,) or (6 or 9,)."""
    offset, speed = state[:3] - own[0], state[3:6] - own[1]
    leg, turn = _leg_jacobian(offset, speed)
    e = leg[0, :3]
    z, out = np.empty(4), np.zeros((4, state.size))
    z[0], z[1] = np.sum(e * offset), np.sum(e * speed)
    for k in range(2):  # u_x, u_z
        axis = own[2 + 2 * k]
        z[2 + k] = np.sum(axis * e)
        for i in range(3):
            out[2 + k, i] = np.sum(axis * turn[i])
    out[:2, :6] = leg
    if transmitter.size:
        offset, speed = state[:3] - transmitter[:3], state[3:6] - transmitter[3:6]
        leg, turn = _leg_jacobian(offset, speed)
        z[0] += np.sum(leg[0, :3] * offset)
        z[1] += np.sum(leg[0, :3] * speed)
        out[:2, :6] += leg
    return z, out


def _terms(own: Pose, transmitter: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """A receiver and what it hears as the compiled functions take them."""
    mine = np.concatenate([own.position[None], own.velocity[None], own.rotation.T])
    return mine, np.zeros(0) if transmitter is None else np.ascontiguousarray(transmitter)


def jacobian(state: np.ndarray, own: Pose, transmitter: np.ndarray | None = None) -> np.ndarray:
    """Derivative of `measure` with respect to the body's state (S,): (4, S)."""
    return np.asarray(_linearised(np.ascontiguousarray(state), *_terms(own, transmitter))[1])


@jit
def _transmitter_jacobians(states: np.ndarray, transmitter: np.ndarray) -> np.ndarray:
    """`transmitter_jacobian` of each state (K, S): (K, 4, S)."""
    out = np.zeros((len(states), 4, transmitter.size))
    for k in range(len(states)):
        offset, speed = states[k, :3] - transmitter[:3], states[k, 3:6] - transmitter[3:6]
        out[k, :2, :6] = -_leg_jacobian(offset, speed)[0]
    return out


def transmitter_jacobian(state: np.ndarray, transmitter: np.ndarray) -> np.ndarray:
    """Derivative of the bistatic `measure` with respect to the transmitter's state (S,): (4, S)."""
    return np.asarray(_transmitter_jacobians(state[None], transmitter)[0])


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
    return Gaussian(*_carried(*g, *singer(interval, acceleration_std)))


@jit
def _carried(
    mean: np.ndarray, P: np.ndarray, F: np.ndarray, Q: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    P = F @ P @ F.T + Q
    return F @ mean, (P + P.T) / 2


@jit
def _unfold(measured: np.ndarray, off: float, ambiguity: tuple[float, float]) -> None:
    """Take from range and velocity, in place, the periods in a velocity so far `off`."""
    if np.isfinite(ambiguity[0]) and np.isfinite(off):
        periods = np.round(off / ambiguity[0])
        measured[0] += periods * ambiguity[1]
        measured[1] -= periods * ambiguity[0]


@jit
def _updated(
    mean: np.ndarray,
    P: np.ndarray,
    measurement: np.ndarray,
    R: np.ndarray,
    rows: np.ndarray,
    own: np.ndarray,
    transmitter: np.ndarray,
    ambiguity: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """`update` by some `rows` of a measurement: mean and covariance."""
    R = R[rows][:, rows].copy()
    x, deviation = mean, np.sqrt(np.diag(P))
    for _ in range(_ITERATIONS):
        z, full = _linearised(x, own, transmitter)
        off = measurement - z
        _unfold(off, off[1], ambiguity)
        y, H = off[rows], full[rows]
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T.copy()
        new = mean + K @ (y - H @ (mean - x))
        settled = np.all(np.abs(new - x) <= 1e-3 * deviation)
        x = new
        if settled:
            break
    A = np.eye(x.size) - K @ H
    P = A @ P @ A.T + K @ R @ K.T
    return x, (P + P.T) / 2


def update(
    g: Gaussian,
    measurement: np.ndarray,
    R: np.ndarray,
    own: Pose,
    transmitter: np.ndarray | None = None,
    *,
    ambiguity: Ambiguity = UNAMBIGUOUS,
) -> Gaussian:
    """Condition on one measurement (4,) with covariance R (4, 4); components that are NaN were not
    measured.

    Iterated EKF: the measurement is linearised again at the new mean until it stands (Gauss-Newton
    on the posterior), because a range known to a millimetre across a direction known to a metre
    bends visibly. Joseph form. Of what the `ambiguity` leaves open the reading nearest in velocity
    counts.
    """
    rows = np.flatnonzero(np.isfinite(measurement))
    terms = *_terms(own, transmitter), tuple(ambiguity)
    return Gaussian(*_updated(*g, measurement, R, rows, *terms))


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
        J = _transmitter_jacobians(mean.reshape(-1, mean.shape[-1]), transmitter.mean)
        J = J.reshape(*mean.shape[:-1], *J.shape[1:])
        S = S + J @ transmitter.covariance @ np.swapaxes(J, -1, -2)
    return z_mean, S


def reported(
    states: Sequence[Gaussian], own: Pose, transmitter: Gaussian | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """What `measure` says of bodies (K, 4), and its standard deviations (K, 4) by their covariances
    and, bistatic, the transmitter's."""
    if not states:
        return np.zeros((0, 4)), np.zeros((0, 4))
    means, covariances = (np.array(of) for of in zip(*states, strict=True))
    terms = _terms(own, None if transmitter is None else transmitter.mean)
    doubt = np.zeros((0, 0)) if transmitter is None else transmitter.covariance
    z, variance = _reported(means, covariances, *terms, doubt)
    return z, np.sqrt(variance)


@jit
def _reported(
    means: np.ndarray,
    covariances: np.ndarray,
    own: np.ndarray,
    transmitter: np.ndarray,
    doubt: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """And the variances (K, 4); `doubt` is the transmitter's covariance."""
    z, variance = np.empty((len(means), 4)), np.empty((len(means), 4))
    for k in range(len(means)):
        z[k], H = _linearised(means[k], own, transmitter)
        variance[k] = np.sum((H @ covariances[k]) * H, axis=1)
        if transmitter.size:
            J = _transmitter_jacobians(means[k : k + 1], transmitter)[0]
            variance[k] += np.sum((J @ doubt) * J, axis=1)
    return z, variance


def wrapped(difference: np.ndarray, ambiguity: Ambiguity) -> np.ndarray:
    """Differences (..., 2 or 4) of what was measured from what is expected, by the reading of the
    former that is nearest in velocity."""
    period, shift = ambiguity
    if not np.isfinite(period):
        return difference
    out = difference.copy()
    periods = np.round(out[..., 1] / period)
    out[..., 0] += np.where(np.isfinite(periods), periods, 0.0) * shift
    out[..., 1] -= periods * period
    return out


@jit
def bistatic_distance(length: float, baseline: np.ndarray, direction: np.ndarray) -> float:
    """Distance from the receiver to a reflector, rho = (L^2 - d^2) / (2 (L - d.u)) [m].

    From |rho u - d| = L - rho; `baseline` d (3,) points from the receiver to the transmitter,
    `direction` u (3,) unit to the reflector. Not positive where the length is not longer than the
    baseline.
    """
    ahead = np.sum(baseline * direction)
    return (length**2 - np.sum(baseline * baseline)) / (2 * (length - ahead))


def birth(
    measurement: np.ndarray,
    std: np.ndarray,
    own: Pose,
    transmitter: Gaussian | None = None,
    *,
    acceleration_std: float,
    ambiguity: Ambiguity = UNAMBIGUOUS,
) -> Gaussian | None:
    """State after a first detection (4,) with deviations (4,); None where it does not fix a
    position.

    Of what the `ambiguity` leaves open the reading counts that is nearest to standing still. The
    position from range and direction (front half-space), its covariance through the inverse
    Jacobian; the velocity is zero in the world with `BIRTH_SPEED_STD` per axis, conditioned on the
    measured rate: the component along the line of sight (or the bisector) is then known, the others
    are not. The acceleration is zero with `acceleration_std` [m/s^2] per axis.
    """
    u_x, u_z = measurement[2:]
    if not np.isfinite(measurement).all() or u_x**2 + u_z**2 >= 1:
        return None
    terms = _terms(own, None if transmitter is None else transmitter.mean)
    doubt = np.zeros((0, 0)) if transmitter is None else transmitter.covariance
    seen = np.asarray(measurement, float), np.fmax(std, STD_FLOOR)
    born, mean, covariance = _born(*seen, *terms, doubt, float(acceleration_std), tuple(ambiguity))
    return Gaussian(mean, covariance) if born else None


@jit
def _born(
    measurement: np.ndarray,
    std: np.ndarray,
    own: np.ndarray,
    transmitter: np.ndarray,
    doubt: np.ndarray,
    acceleration_std: float,
    ambiguity: tuple[float, float],
) -> tuple[bool, np.ndarray, np.ndarray]:
    """`birth`: whether there is one, its mean and covariance; `doubt` is the
    transmitter's covariance, `own` and `transmitter` are as of `_linearised`."""
    mean, P = _resting(measurement, own, transmitter), np.zeros((9, 9))
    if not mean.size:
        return False, mean, P
    read = measurement.copy()
    _unfold(read, measurement[1] - _linearised(mean, own, transmitter)[0][1], ambiguity)
    mean = _resting(read, own, transmitter)
    if not mean.size:
        return False, mean, P
    rho = np.sqrt(np.sum((mean[:3] - own[0]) ** 2))
    H, R = _linearised(mean, own, transmitter)[1], np.diag(std**2)
    if transmitter.size:
        T = _transmitter_jacobians(mean[None], transmitter)[0]
        R += T @ doubt @ T.T
    J, shown = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        J[i] = H[_POSITION[i], :3]
        for j in range(3):
            shown[i, j] = R[_POSITION[i], _POSITION[j]]
    if not np.isfinite(J).all():  # in the very place of the transmitter
        return False, mean, P
    if np.linalg.cond(J * np.array([[1.0], [rho], [rho]])) > 1e6:
        return False, mean, P
    back = np.linalg.inv(J)
    P[:3, :3] = back @ shown @ back.T
    if np.trace(P) > BIRTH_POSITION_STD_LIMIT**2:
        return False, mean, P
    for i in range(3, 6):
        P[i, i], P[i + 3, i + 3] = BIRTH_SPEED_STD**2, acceleration_std**2
    P = (P + P.T) / 2
    rate = np.array([1])
    return True, *_updated(mean, P, read, R, rate, own, transmitter, (np.inf, 0.0))


@jit
def _resting(measurement: np.ndarray, own: np.ndarray, transmitter: np.ndarray) -> np.ndarray:
    """State (9,) of a body at rest where range and direction place it, (0,): nowhere."""
    u_x, u_z, rho = measurement[2], measurement[3], measurement[0]
    forward = np.sqrt(max(1 - u_x**2 - u_z**2, 0.0))
    e = u_x * own[2] + forward * own[3] + u_z * own[4]
    if transmitter.size:
        rho = bistatic_distance(rho, transmitter[:3] - own[0], e)
    if not rho > 0:
        return np.zeros(0)
    out = np.zeros(9)
    out[:3] = own[0] + rho * e
    return out


def costs(
    z: np.ndarray,
    std: np.ndarray,
    mean: np.ndarray,
    S: np.ndarray,
    ambiguity: Ambiguity,
    probability: float,
) -> np.ndarray:
    """(K, Q) d^2 + ln det S of detections (Q, 4) with deviations against what is `expected` of K
    tracks, minus twice the log likelihood but for a constant; inf outside the gate in which a
    detection of the track lies with a `probability`. Components that are NaN were not measured."""
    residual = wrapped(z[None] - mean[:, None], ambiguity)
    out: np.ndarray = _costs(residual, np.fmax(std, STD_FLOOR) ** 2, S, _gates(probability))
    return out


@lru_cache(maxsize=8)
def _gates(probability: float) -> np.ndarray:
    """(5,) squared distances by the number of components."""
    return 2 * gammaincinv(np.arange(5) / 2, probability)


@jit
def _costs(
    residual: np.ndarray, variance: np.ndarray, S: np.ndarray, gates: np.ndarray
) -> np.ndarray:
    tracks, detections, _ = residual.shape
    out, y = np.full((tracks, detections), np.inf), np.empty(4)
    A, work = np.empty((4, 4)), np.empty((5, 4))
    for k in range(tracks):
        for q in range(detections):
            found = np.flatnonzero(np.isfinite(residual[k, q]))
            for i in range(found.size):
                y[i] = residual[k, q, found[i]]
                for j in range(i + 1):
                    A[i, j] = S[k, found[i], found[j]]
                A[i, i] += variance[q, found[i]]
            d2, log_det = distance(y[: found.size], A, work)
            if d2 <= gates[found.size]:
                out[k, q] = d2 + log_det
    return out


@jit
def distance(y: np.ndarray, S: np.ndarray, work: np.ndarray) -> tuple[float, float]:
    """y^T S^-1 y and ln det S of a residual (n,) by Cholesky's factor L of the covariance, of which
    the lower half is read: the square of L^-1 y, and twice the logarithms of L's diagonal. Infinity
    both where S is no covariance; `work` (n + 1, n)."""
    d2, log_det, L, w = 0.0, 0.0, work[1:], work[0]
    for i in range(y.size):
        for j in range(i + 1):
            left = S[i, j]
            for m in range(j):
                left -= L[i, m] * L[j, m]
            if j < i:
                L[i, j] = left / L[j, j]
            elif left > 0:
                L[i, i] = np.sqrt(left)
            else:
                return np.inf, np.inf
        left = y[i]
        for m in range(i):
            left -= L[i, m] * w[m]
        w[i] = left / L[i, i]
        d2 += w[i] ** 2
        log_det += 2 * np.log(L[i, i])
    return d2, log_det
