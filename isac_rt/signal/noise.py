"""White Gaussian noise of a receiver from a counter-based generator: no sample depends on the order
of work.

Sample i of a stream is a pure function of (key, i): Threefry-2x32 with 20 rounds [1]_ makes two
32-bit words of the counter i, Box-Muller makes one complex Gaussian of them. Threads and partitions
can therefore not change a value.

References
----------
.. [1] J. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC'11,
doi:10.1145/2063384.2063405
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.kernels import signal_noise
from isac_rt.kernels.jit import twin_of


class WhiteNoise(NamedTuple):
    """A draw of white noise.

    Attributes
    ----------
    power : E|n|^2 per complex sample [W]
    seed_words : (2,) uint32, the stream, ``seed_sequence(...).generate_state(2)``
    """

    power: float
    seed_words: np.ndarray

    @property
    def numbers(self) -> tuple[np.float32, np.uint32, np.uint32]:
        """Power and key for kernels."""
        first, second = self.seed_words
        return np.float32(self.power), np.uint32(first), np.uint32(second)

    def add_to(self, samples: np.ndarray) -> None:
        """Add the noise in place to samples, complex64 and contiguous."""
        if self.power:
            add_white_noise(samples, *self)


SILENCE = WhiteNoise(0.0, np.zeros(2, np.uint32))
"""No noise."""
_ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
_PARITY = 0x1BD11BDA


@twin_of(signal_noise.add_stream)
def add_stream(
    out: np.ndarray, power: float, key0: np.uint32, key1: np.uint32, first: np.uint64
) -> None:
    """Add sample `first + i` of the stream to (out[2 i], out[2 i + 1]): Threefry-2x32 of the
    counter, figure 2 of [1]_, and the Box-Muller transform."""
    # counter and key schedule, the third key word by parity
    counter = np.uint64(first) + np.arange(out.size // 2, dtype=np.uint64)
    a, b = counter.astype(np.uint32), (counter >> np.uint64(32)).astype(np.uint32)
    keys = [np.uint32(key0), np.uint32(key1)]
    keys.append(keys[0] ^ keys[1] ^ np.uint32(_PARITY))
    a, b = a + keys[0], b + keys[1]
    for group in range(5):  # 20 rounds: add, rotate, exclusive or; a key after every four
        for bits in _ROTATIONS[group % 2]:
            a = a + b
            b = (b << np.uint32(bits) | b >> np.uint32(32 - bits)) ^ a
        a = a + keys[(group + 1) % 3]
        b = b + keys[(group + 2) % 3] + np.uint32(group + 1)
    # Box-Muller: Rayleigh magnitude, uniform phase
    radius = np.sqrt(-power * np.log((a + 0.5) / 2**32))
    sample = radius * np.exp(2j * np.pi * b / 2**32)
    out[0::2] += sample.real.astype(out.dtype)
    out[1::2] += sample.imag.astype(out.dtype)


def add_white_noise(samples: np.ndarray, power: float, key: np.ndarray, first: int = 0) -> None:
    """Add circular complex Gaussian noise in place.

    Parameters
    ----------
    samples : complex64, contiguous; its element i (in memory order) gets sample ``first + i`` of
        the stream
    power : E|n|^2 [W]; real and imaginary part have half of it each
    key : (2,) uint32, the stream; streams of different keys are independent
    first : index of the first sample in the stream, for parts of a cube
    """
    add_stream(
        samples.reshape(-1).view(np.float32), *WhiteNoise(power, key).numbers, np.uint64(first)
    )
