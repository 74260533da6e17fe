"""One family of errors. Each says what was expected, what came, and where."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UnshadeError(Exception):
    """Base of every error a user can cause. ``exit_code`` is what the command line returns."""

    exit_code = 1


class PictureError(UnshadeError):
    """A picture cannot be read, holds no sphere, or has a size that cannot be used."""

    exit_code = 3


class TreeError(UnshadeError):
    """A tree breaks the grammar; ``address`` says at which node."""

    exit_code = 4

    def __init__(self, message: str, address: str = "") -> None:
        super().__init__(f"{message} (at {address})" if address else message)
        self.address = address


class TreeSyntaxError(TreeError):
    """A tree's text or JSON cannot be read; ``column`` is 1-based where there is one."""

    def __init__(self, message: str, text: str = "", column: int = 0) -> None:
        if column:
            start = max(0, column - 50)
            message = f"column {column}: {message}\n  {text[start : column + 30]}\n  {' ' * (column - 1 - start)}^"
        super().__init__(message)
        self.column = column


class AddressError(TreeError):
    """No node, leaf kind or parameter has this address or name."""


class OutputError(UnshadeError):
    """A result cannot be written."""

    exit_code = 5


class MissingExtraError(UnshadeError):
    """An optional library or a weight file is not installed."""

    exit_code = 6


class MissingWeightsError(MissingExtraError):
    """The trained weights of a network are not where they are looked for.

    ``reason`` is the message without ``instead``, what can be had without them.
    """

    def __init__(self, reason: str, instead: str = "") -> None:
        super().__init__(f"{reason} ({instead})" if instead else reason)
        self.reason = reason


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`` - did you mean 'x'?`` for the nearest known word, or the list of them."""
    known = list(known)
    near = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(known)}"
