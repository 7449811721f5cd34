"""Streams of Gaussian noise by counter-based random numbers (Threefry)."""

from __future__ import annotations

import numpy as np
from numba import uint32

from isac_rt.kernels.jit import jit

_BLOCK = 512
"""Samples whose words stay in the nearest cache."""
_PARITY = np.uint32(0x1BD11BDA)  # Threefish key-schedule constant, 32-bit variant
_LN2 = np.float32(np.log(2.0))
_TWO_PI = np.float32(2 * np.pi)
_UNIT = np.float32(2.0**-32)
_ONE, _HALF, _QUARTER, _FOUR = np.float32(1), np.float32(0.5), np.float32(0.25), np.float32(4)
# Taylor coefficients: of 2 atanh(s) for |s| <= 0.172, and of sine and cosine for |x| <= pi/4; what
# is cut is below 1 ulp
_LOG = tuple(np.float32(2 / n) for n in (1, 3, 5, 7, 9))
_SIN = tuple(np.float32(c) for c in (1, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880))
_COS = tuple(np.float32(c) for c in (1, -1 / 2, 1 / 24, -1 / 720, 1 / 40320))


@jit(inline=True)
def _mix(a, b, r):
    """One Threefry round, modulo 2^32 as all below: add, rotate, exclusive or."""
    a = uint32(a + b)
    return a, uint32(uint32(uint32(b << uint32(r)) | uint32(b >> uint32(32 - r))) ^ a)


@jit(inline=True)
def _even_rounds(a, b):
    """Four rounds of an even group."""
    a, b = _mix(a, b, 13)
    a, b = _mix(a, b, 15)
    a, b = _mix(a, b, 26)
    return _mix(a, b, 6)


@jit(inline=True)
def _odd_rounds(a, b):
    """Four rounds of an odd group."""
    a, b = _mix(a, b, 17)
    a, b = _mix(a, b, 29)
    a, b = _mix(a, b, 16)
    return _mix(a, b, 24)


@jit(fast=True, borrows=True)
def random_words(first_words, second_words, first, key0, key1):
    """The two words of sample `first` of the stream and of those after it: Threefry with 20 rounds
    of a two-word counter under a two-word key."""
    low, high = uint32(first), uint32(first >> np.uint64(32))
    key2 = uint32(uint32(key0 ^ key1) ^ _PARITY)
    one, two = uint32(key2 + uint32(1)), uint32(key0 + uint32(2))
    three, four, five = uint32(key1 + uint32(3)), uint32(key2 + uint32(4)), uint32(key0 + uint32(5))
    for i in range(first_words.shape[0]):
        a = uint32(low + uint32(i))
        b = uint32(uint32(high + uint32(a < low)) + key1)
        a, b = _even_rounds(uint32(a + key0), b)
        a, b = _odd_rounds(uint32(a + key1), uint32(b + one))
        a, b = _even_rounds(uint32(a + key2), uint32(b + two))
        a, b = _odd_rounds(uint32(a + key0), uint32(b + three))
        a, b = _even_rounds(uint32(a + key1), uint32(b + four))
        first_words[i], second_words[i] = uint32(a + key2), uint32(b + five)


@jit(inline=True)
def _minus_log(word):
    """-ln of the uniform (word + 1/2) / 2^32, float32; at most 22.9 (an amplitude of 6.8 sigma)."""
    u = np.float32(word) * _UNIT + _HALF * _UNIT
    bits = np.float32(u).view(np.int32)
    above = np.int32(bits - np.int32(0x3F3504F3))  # mantissa in [sqrt(1/2), sqrt(2))
    exponent = np.int32(above >> np.int32(23))
    mantissa = np.int32(bits - np.int32(exponent << np.int32(23))).view(np.float32)
    s = (mantissa - _ONE) / (mantissa + _ONE)
    q = s * s
    log = s * (_LOG[0] + q * (_LOG[1] + q * (_LOG[2] + q * (_LOG[3] + q * _LOG[4]))))
    return -(np.float32(exponent) * _LN2 + log)


@jit(inline=True)
def _cos_sin(word):
    """Cosine and sine of 2 pi word / 2^32, float32."""
    cycles = np.float32(np.int32(word)) * _UNIT
    quarter = np.rint(cycles * _FOUR)
    x = (cycles - quarter * _QUARTER) * _TWO_PI
    q = x * x
    s = x * (_SIN[0] + q * (_SIN[1] + q * (_SIN[2] + q * (_SIN[3] + q * _SIN[4]))))
    c = _COS[0] + q * (_COS[1] + q * (_COS[2] + q * (_COS[3] + q * _COS[4])))
    quadrant = np.int32(np.int32(quarter) & np.int32(3))
    swap = np.int32(quadrant & np.int32(1))
    cosine, sine = (s if swap else c), (c if swap else s)
    if quadrant == 1 or quadrant == 2:
        cosine = -cosine
    if quadrant >= 2:
        sine = -sine
    return cosine, sine


@jit(fast=True, borrows=True)
def _add_gaussians(out, power, first_words, second_words):
    """Add a complex Gaussian of each two words to (out[2 i], out[2 i + 1])."""
    for i in range(out.shape[0] // 2):
        r = np.sqrt(power * _minus_log(first_words[i]))
        c, s = _cos_sin(second_words[i])
        out[2 * i] += r * c
        out[2 * i + 1] += r * s


@jit(fast=True)
def add_stream(out, power, key0, key1, first):
    """Add sample `first + i` of the stream to (out[2 i], out[2 i + 1])."""
    words = np.empty((2, _BLOCK), np.uint32)
    add_stream_by(out, power, key0, key1, first, words)


@jit(fast=True, borrows=True)
def add_stream_by(out, power, key0, key1, first, words):
    """`add_stream` with room (2, _BLOCK) for `words`."""
    for start in range(0, out.shape[0] // 2, _BLOCK):
        random_words(words[0], words[1], np.uint64(first + np.uint64(start)), key0, key1)
        _add_gaussians(out[2 * start : 2 * (start + _BLOCK)], power, words[0], words[1])


def words_buffer() -> np.ndarray:
    """For `add_stream_by`."""
    return np.empty((2, _BLOCK), np.uint32)
