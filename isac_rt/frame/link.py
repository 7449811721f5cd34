"""Who receives whom."""

from __future__ import annotations

from typing import NamedTuple


class Link(NamedTuple):
    """From a transmitter to a receiver; twice the same name is an active terminal's own echoes.

    Examples
    --------
    >>> Link("AT", "PT1").passes, Link("AT", "AT").passes, str(Link("AT", "PT1"))
    (1, 2, 'AT->PT1')
    """

    tx: str
    rx: str

    @property
    def own(self) -> bool:
        """True if the receiver receives its own chirps."""
        return self.tx == self.rx

    @property
    def passes(self) -> int:
        """Number of passes of the reported range: 2 for echoes, 1 from terminal to terminal."""
        return 2 if self.own else 1

    def __str__(self) -> str:
        return f"{self.tx}->{self.rx}"
