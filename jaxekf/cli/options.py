"""Kinds of values that the simulator's options take, checked when they are read."""

from typing import Any, NamedTuple

import click


class Finite(click.FloatRange):
    """A number within bounds; NaN, which is within any, is refused."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        number = super().convert(value, param, ctx)
        if number != number:
            self.fail(f"got '{value}', expected a number; try 0", param, ctx)
        return number


class Span(NamedTuple):
    """A stretch of time that markers are hidden in."""

    begin_s: float
    end_s: float
    markers: tuple[str, ...] = ()
    """Names; empty for all."""


def spans(
    _: click.Context, __: click.Parameter, values: tuple[str, ...]
) -> list[tuple[float, float]]:
    """``START,END`` in seconds, each as two numbers."""
    return [_span(value, value.split(","), "START,END", "20,20.5")[:2] for value in values]


def hidden(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> list[Span]:
    """``START,END[,MARKER...]``: seconds, and the names of the markers that are hidden."""
    form, example = "START,END[,MARKER...]", "2,2.5,1,3"
    found = []
    for value in values:
        parts = value.split(",")
        span = _span(value, parts[:2], form, example)
        found.append(span._replace(markers=tuple(part.strip() for part in parts[2:])))
    return found


def _span(value: str, parts: list[str], form: str, example: str) -> Span:
    try:
        begin, end = (float(part) for part in parts)
    except ValueError:
        raise click.BadParameter(
            f"got '{value}', expected {form} in seconds; try {example}"
        ) from None
    if not 0.0 <= begin < end:
        raise click.BadParameter(f"got '{value}', expected 0 <= START < END; try {example}")
    return Span(begin, end)
