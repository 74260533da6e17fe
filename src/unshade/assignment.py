"""Assignments such as ``highlight.sharpness*=2``, and the values in them, written as in the text form of trees."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from unshade.errors import TreeError
from unshade.nodes import Leaf, Parameter, Raster, Value
from unshade.text import parse

OPERATIONS: dict[str, Callable[[float, float], float]] = {
    "=": lambda old, new: new,
    "*=": lambda old, new: old * new,
    "/=": lambda old, new: old / new,
    "+=": lambda old, new: old + new,
    "-=": lambda old, new: old - new,
}

BRACKETED = re.compile(r"\s*\((.*)\)\s*", re.DOTALL)

FORM = re.compile(r"\s*(?P<where>.+?)\.(?P<parameter>\w+)\s*(?P<operation>[*/+-]?=)\s*(?P<value>.*?)\s*", re.DOTALL)


@dataclass(frozen=True)
class Assignment:
    """``ADDRESS.PARAMETER=VALUE``, or with ``*=``, ``/=``, ``+=`` or ``-=``."""

    where: str
    parameter: str
    operation: str
    value: str

    @staticmethod
    def of(text: str) -> Assignment:
        """Read ``multiply.0.color=#3366ff``. Raises TreeError."""
        found = FORM.fullmatch(text)
        if found is None:
            raise TreeError(f"expected ADDRESS.PARAMETER=VALUE such as highlight.sharpness*=2, got {text!r}")
        return Assignment(**found.groupdict())

    def of_value(self, parameter: Parameter, old: Value) -> tuple[float, ...]:
        """What it makes of the value of a parameter, inside the parameter's range. Raises TreeError."""
        where = f"{self.where}.{self.parameter}"
        if isinstance(old, Raster):
            raise TreeError(f"{where} is a picture, which an edit cannot set")
        lobes = len(old) // parameter.size
        if self.operation == "=":
            return _read(parameter, self.value, where) * lobes
        if parameter.type == "direction":
            raise TreeError(f"{where} is a direction: set it with =, or move it by degrees")
        numbers = _numbers(self.value, where)
        if len(numbers) not in (1, parameter.size):
            raise TreeError(f"{where}: expected 1{' or 3' * (parameter.size == 3)} numbers after {self.operation}, got {self.value!r}")
        if self.operation == "/=" and 0.0 in numbers:
            raise TreeError(f"{where}: cannot be divided by 0")
        factors = numbers * (len(old) // len(numbers))
        changed = (OPERATIONS[self.operation](number, factor) for number, factor in zip(old, factors, strict=True))
        return tuple(min(max(number, parameter.low), parameter.high) for number in changed)


def _read(parameter: Parameter, text: str, where: str) -> tuple[float, ...]:
    """A value in any of the forms that the text of a tree may have."""
    if parameter.type in ("scalar", "rotation"):
        numbers = _numbers(text, where)
        if len(numbers) != parameter.size:
            raise TreeError(f"{where}: expected {parameter.size} number{'s' * (parameter.size > 1)}, got {text!r}")
        return numbers
    return read_color(text, where) if parameter.type == "color" else read_direction(text, where)


def read_color(text: str, where: str = "colour") -> tuple[float, ...]:
    """``#rgb``, ``#rrggbb``, a word, or three numbers in [0, 1]. Raises TreeError."""
    return _sugar("albedo", "color", text, where)


def read_direction(text: str, where: str = "direction") -> tuple[float, ...]:
    """Words such as ``left up``, or three numbers. Raises TreeError."""
    return _sugar("diffuse", "direction", text, where)


def _sugar(kind: str, parameter: str, text: str, where: str) -> tuple[float, ...]:
    written = f"({text})" if "," in text and "(" not in text else text
    try:
        leaf = parse(f"{kind}({parameter}={written})").root
    except TreeError as error:
        # The column would be that of the sentence made here, not of what was given.
        reason = str(error).partition("\n")[0].partition(": ")[2] or str(error)
        what = reason.removeprefix(f"{kind}.{parameter}: ")
        raise TreeError(f"{where}: {what}" + ("" if repr(text) in what else f" (in {text!r})")) from None
    assert isinstance(leaf, Leaf)
    return tuple(leaf[parameter])


def _numbers(text: str, where: str) -> tuple[float, ...]:
    bracketed = BRACKETED.fullmatch(text)
    try:
        numbers = tuple(float(part) for part in (bracketed[1] if bracketed else text).split(","))
    except ValueError:
        numbers = (math.nan,)
    if not all(math.isfinite(number) for number in numbers):
        raise TreeError(f"{where}: expected a number, got {text!r}")
    return numbers
