"""Bytes of files bent at random, for tests of what reads them."""

from __future__ import annotations

import random
import re

WORDS = (
    *b'NaN -Infinity 1e999 null true [] {} "x" -1 0 1e9 9223372036854775808 0.5 [[1]]'.split(),
    b"9" * 5000,
    b"[" * 100_000,
    b'{"array": ["<f8", [4294967296, 8], "C", 0]}',
)
"""What may stand in the place of a number of a text."""


def bent(data: bytes, others: list[bytes], chance: random.Random) -> bytes:
    """Cut, flipped, moved, doubled, overwritten, taken from another file, numbers replaced."""
    out = bytearray(data)
    for _ in range(chance.choice([1, 1, 1, 2, 4])):
        a, b = sorted(chance.randrange(len(out) + 1) for _ in "ab")
        match chance.randrange(10):
            case 0:
                out = out[:a]
            case 1 | 2 | 3:
                for _ in range(chance.choice([1, 1, 8, 64])):
                    if out:
                        out[chance.randrange(len(out))] ^= 1 << chance.randrange(8)
            case 4:
                c = chance.randint(b, len(out))
                out = out[:a] + out[b:c] + out[a:b] + out[c:]
            case 5:
                out[a : chance.choice([a, b])] = out[a:b]
            case 6:
                out[a:b] = chance.choice([b"\0", b"\xff"]) * (b - a)
            case 7:
                other = chance.choice(others)
                c, d = sorted(chance.randrange(len(other) + 1) for _ in "cd")
                out[a:b] = other[c:d]
            case 8:
                out = bytearray(chance.choice(others))
            case _:
                if numbers := [*re.finditer(rb"-?\d+(\.\d+)?(e[-+]?\d+)?", bytes(out[:200_000]))]:
                    found = chance.choice(numbers)
                    out[found.start() : found.end()] = chance.choice(WORDS)
    return bytes(out)
