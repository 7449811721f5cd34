"""Heights of buildings as people write them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

HIGHEST_M = 1500.0
"""No building is higher."""
FOOT_M, INCH_M = 0.3048, 0.0254
_LONGEST = 100
_ABOUT = re.compile(r"^(?:~|≈|±|<|>|=|ca\.?|c\.|circa|about|approx\.?)\s*")
_METRES = re.compile(r"^(\d[\d.,]*)\s*(?:m|mt|mtr|met(?:er|re)s?)?\.?$")
_FEET = re.compile(
    r"^(\d[\d.,]*)\s*(?:'|′|’|ft|feet|foot)\.?\s*(?:(\d[\d.,]*)\s*(?:\"|″|”|''|in|inch|inches)?\.?)?$"
)
_SEVERAL = re.compile(r"[;|]|(?<=[\d'\"m])\s*[-–]\s*(?=\d)")


def _number(text: str) -> float:
    """``12.5``, ``12,5`` and ``1,234.5``: of two kinds of mark the last is the decimal's."""
    text = text.rstrip(".,")
    at = max(text.rfind("."), text.rfind(","))
    whole, mark, rest = (text, "", "0") if at < 0 else (text[:at], text[at], text[at + 1 :])
    if mark and mark in whole:
        return math.nan
    return float(f"{re.sub('[.,]', '', whole)}.{rest}")


def _length(text: str) -> float:
    text = _ABOUT.sub("", text.strip())
    feet = _FEET.match(text)
    if feet:
        return _number(feet[1]) * FOOT_M + (_number(feet[2]) * INCH_M if feet[2] else 0.0)
    metres = _METRES.match(text)
    return _number(metres[1]) if metres else math.nan


def parse_length(value: Any) -> float | None:
    r"""A length in metres; None if there is none.

    A number, or text: ``12.5``, ``12,5``, ``12 m``, ``40'``, ``40 ft``, ``131'3"``, ``~12``. Of
    several (``10;12``, ``10-12``) the greatest.

    Raises
    ------
    ValueError  If it is anything else, negative or more than a building's height.

    Examples
    --------
    >>> parse_length("12,5"), round(parse_length("131'3\""), 3), parse_length("10;12")
    (12.5, 40.005, 12.0)
    """
    if value is None or (isinstance(value, str) and not value.strip()):
        return None
    number: float = math.nan
    if isinstance(value, str) and len(value) <= _LONGEST:
        try:
            number = float(value)
        except ValueError:
            parts = [_length(part) for part in _SEVERAL.split(value.lower().strip("; "))]
            number = math.nan if any(map(math.isnan, parts)) else max(parts)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        number = value
    if not 0 <= number <= HIGHEST_M:
        raise ValueError(f"{str(value)[:_LONGEST]!r} is no height of a building in metres")
    return float(number)


def roof_over_ground(attributes: Mapping[str, Any]) -> float | None:
    """Height of a building of the Dutch 3D BAG [m], which states roof and ground over the sea; None
    where it does not.

    Examples
    --------
    >>> roof_over_ground({"b3_h_dak_70p": 7.5, "b3_h_maaiveld": -0.5})
    8.0
    """
    ground = attributes.get("b3_h_maaiveld")
    roof = next((v for name in _ROOFS if (v := attributes.get(name)) is not None), None)
    if not isinstance(roof, int | float) or not isinstance(ground, int | float):
        return None
    return float(roof - ground) if roof > ground else None


_ROOFS = ("b3_h_dak_70p", "b3_h_dak_50p", "b3_h_dak_max")
