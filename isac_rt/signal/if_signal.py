"""IF samples from paths, waveform and payload: the interface to all methods of synthesis."""

from __future__ import annotations

import numpy as np

from isac_rt.frame.cube import IFCube, ReceiveArray, Reference
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.signal.methods import Auto, Method
from isac_rt.signal.noise import SILENCE, WhiteNoise, add_white_noise
from isac_rt.signal.tones import Links, Tones, tones_of

_AUTO = Auto()


def if_signal(
    waveform: Waveform,
    links: Links,
    receiver: ReceiveArray,
    reference: Reference,
    method: Method = _AUTO,
) -> IFCube:
    r"""Synthesise the dechirped IF samples of one receiver in one frame, without noise.

    .. math::

        s[m,l,p,n] = \sum A \beta_{m'p}\, \bar g\, h(\alpha\tau)\, e^{j2\pi(f_c\tau +
        \alpha\tau(u-\tau/2))}

    over paths and transmit groups m', with the amplitude A, the DPSK phase beta, the conjugate path
    gain, the IF filter h and the sum of delays

        tau = path + data + element delays + clock offset + 2 (b' + m' - b - m) T_d,

    b' and b the first resource blocks of the transmitter and of the receiver's reference. A farther
    target has a higher fast-time frequency, a receding one a positive slow-time frequency; a wave
    from body direction u has the phase factor exp(-j 2 pi f r.u/c) at element r.

    Parameters
    ----------
    waveform : Waveform
    links : transmissions and the paths from each to this receiver; amplitudes in sqrt(W), gains
        without unit
    receiver : ReceiveArray
    reference : Reference
    method : `Auto` (the default), `Exact`, `Direct`, `Gridded` or `Separable`
        (`isac_rt.signal.methods`)

    Returns
    -------
    IFCube

    Raises
    ------
    ValueError
        If the epoch of a path set is a slot or more from mid-frame, there is neither link nor
        schedule, or the waveform has some groups only.

    Notes
    -----
    Not modelled: motion during the flight of light, and the change of directions within a frame (a
    phase error of 2 pi v r t / (R lambda), 0.03 rad at an outer element for 10 m/s across at 30 m).
    Wavefronts are spherical at both ends, jointly for lines of sight; for other paths, and for
    lines of sight in `Gridded`, the joint term r_tx.r_rx/L of the perpendicular offsets is omitted
    (5e-6 m, 0.01 rad at 30 m).

    Examples
    --------
    A target 60 m ahead, received by its own sender: its beat lies in range cell 2 R / (c
    delay_step).

    >>> import numpy as np
    >>> import isac_rt as irt
    >>> from isac_rt.frame.antennas import Antennas
    >>> from isac_rt.frame.payload import unmodulated
    >>> from isac_rt.frame.schedule import conventional_schedule
    >>> from isac_rt.propagation.pathset import make_paths
    >>> from isac_rt.world.swarm import Pose
    >>> w = irt.Waveform(num_chirps=6, num_groups=1)
    >>> arrays = Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=w.wavelength / 2)
    >>> pose, ahead = Pose.at_rest(), np.array([[0.0, 1.0, 0.0]])
    >>> sent = irt.Transmission(name="A", pose=pose, antennas=arrays,
    ...     schedule=conventional_schedule(1, 6, 3), payload=unmodulated(w))
    >>> echo = make_paths(gain=np.ones(1), delay=np.array([2 * 60 / 299792458]), departure=ahead,
    ...     arrival=ahead, kind=irt.PathKind.TARGET, epoch=w.frame_duration / 2, tx="A", rx="A")
    >>> cube = irt.if_signal(w, [(sent, echo)], irt.ReceiveArray(pose, arrays), irt.Reference(0.0))
    >>> cube.samples.shape, int(np.abs(np.fft.fft(cube.samples[0, 0, 0])).argmax())
    ((1, 3, 6, 1024), 240)
    """
    return noisy_if_signal(waveform, links, receiver, reference, method, SILENCE)


def noisy_if_signal(
    waveform: Waveform,
    links: Links,
    receiver: ReceiveArray,
    reference: Reference,
    method: Method,
    noise: WhiteNoise,
) -> IFCube:
    """Return the sum of `if_signal` and the noise of `add_noise`, bit for bit. The noise is added
    while the samples are in the processor's cache."""
    schedule, tones = received_tones(waveform, links, receiver, reference)
    return IFCube(
        samples=method.samples(waveform, tones, noise),
        waveform=waveform,
        schedule=schedule,
        start_time=reference.start_time,
    )


def add_noise(cube: IFCube, power: float, seed_words: np.ndarray) -> IFCube:
    """Add thermal noise to the cube's samples, in place, and return the cube.

    Parameters
    ----------
    power : E|n|^2 per complex sample [W]
    seed_words : (2,) uint32, ``seed_sequence(...).generate_state(2)``; one pair per receiver and
        frame
    """
    add_white_noise(cube.samples, power, seed_words)
    return cube


def received_tones(
    waveform: Waveform, links: Links, receiver: ReceiveArray, reference: Reference
) -> tuple[Schedule, Tones]:
    """Return the schedule of the reference chirps and the tones received in them."""
    schedule, first_block = reference.schedule, reference.first_block
    if schedule is None:
        if not links:
            raise ValueError(
                "a frame with neither a link nor a schedule; pass the schedule of the cube"
            )
        schedule = links[0][0].schedule
    if waveform.blocks is not None:
        raise ValueError(
            "if_signal makes all groups of a frame; take those that a receiver reads with "
            "IFCube.of_groups"
        )
    if first_block is None:
        first_block = links[0][0].first_block if links else 0
    middle, slot = reference.start_time + waveform.frame_duration / 2, waveform.slot_duration
    for transmission, paths in links:
        if abs(paths.epoch - middle) >= slot:
            raise ValueError(
                f"paths {transmission.name}->{paths.rx} have epoch {paths.epoch!r} s, the middle "
                f"of the frame is {middle!r} s; "
                f"compute the paths within a slot ({slot:g} s) of start_time + frame_duration/2"
            )
    return schedule, tones_of(waveform, links, receiver, middle, first_block)
