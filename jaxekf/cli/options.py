"""Types of the values of the simulator's options, with their checks."""

from typing import Any, NamedTuple

import click


class Finite(click.FloatRange):
    """A number within bounds. NaN, which passes the check of bounds, is an error."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        number = super().convert(value, param, ctx)
        if number != number:
            self.fail(f"got '{value}', expected a number; try 0", param, ctx)
        return number


class Span(NamedTuple):
    """An interval of time in which markers are hidden."""

    begin_s: float
    end_s: float
    markers: tuple[str, ...] = ()
    """Names of the hidden markers; empty for all."""


def spans(
    _: click.Context, __: click.Parameter, values: tuple[str, ...]
) -> list[tuple[float, float]]:
    """Parse ``START,END`` in seconds."""
    return [_span(value, value.split(","), "START,END", "20,20.5")[:2] for value in values]


def hidden(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> list[Span]:
    """Parse ``START,END[,MARKER...]``: seconds, and the names of the hidden markers."""
    form, example = "START,END[,MARKER...]", "2,2.5,1,3"
    parsed = []
    for value in values:
        parts = value.split(",")
        span = _span(value, parts[:2], form, example)
        parsed.append(span._replace(markers=tuple(part.strip() for part in parts[2:])))
    return parsed


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
