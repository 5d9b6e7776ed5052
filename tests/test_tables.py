"""Tables of the command line: every number whole at every width."""

import re
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from jaxekf.cli import console

COLUMNS = ["run", "attitude RMSE\n(deg)", "rate RMSE\n(deg/s)", "95 %", "note on the run"]
ROWS = [
    [
        f"a-run-of-a-name-{i}",
        123456.789 + i,
        float("nan"),
        f"{i}.00001 to {i}.00002",
        f"seen {i} times",
    ]
    for i in range(3)
]


def printed(capsys, monkeypatch, width, columns=COLUMNS, rows=ROWS, title="Title"):
    monkeypatch.setattr(console, "_terminal_width", lambda: width)
    console.print_table(title, columns, rows)
    return capsys.readouterr().out


@pytest.mark.parametrize("width", [20, 40, 80, 120, 200, 100_000])
@pytest.mark.parametrize("times", [1, 3])
def test_no_number_is_shortened(capsys, monkeypatch, width, times):
    """Would catch "12345…" in a narrow terminal, which is another number, and columns that are left out."""
    columns, rows = (
        [*COLUMNS, *(times - 1) * COLUMNS[1:]],
        [[*r, *(times - 1) * r[1:]] for r in ROWS],
    )
    text = printed(capsys, monkeypatch, width, columns, rows)
    assert "…" not in text
    for row in rows:
        for cell in row:
            shown = console._cell(cell)
            assert text.count(shown) >= row.count(cell), shown
    for name in columns:
        for word in name.split():
            assert word in text


def test_a_table_fits_its_terminal(capsys, monkeypatch):
    """Would catch lines that the terminal breaks in the middle of a table of 80 columns."""
    for width in (80, 120, 200):
        text = printed(capsys, monkeypatch, width)
        assert max(len(line) for line in text.splitlines()) <= width
        assert re.search(r"a-run-of-a-name-1 +123457\.789 +– +1\.00001 to 1\.00002", text)
    turned = printed(capsys, monkeypatch, 70)
    assert max(len(line) for line in turned.splitlines()) <= 70
    narrow = printed(capsys, monkeypatch, 40)
    assert "  a-run-of-a-name-1\n    attitude RMSE (deg): 123457.789\n" in narrow


def test_a_pipe_has_no_width(capsys, monkeypatch):
    """Would catch rows of a log file that are broken at 120 characters."""
    rows = [[f"{i}-{300 * 'x'}", float(i)] for i in range(2)]
    text = printed(capsys, monkeypatch, console._UNLIMITED, ["name", "value"], rows, "T" * 150)
    assert "T" * 150 in text
    assert f"1-{300 * 'x'}" in text


def test_an_empty_table_is_printed(capsys, monkeypatch):
    """Would catch an IndexError for a command that found nothing."""
    assert "Title" in printed(capsys, monkeypatch, 80, rows=[])


def test_brackets_are_no_markup(capsys, monkeypatch):
    """Would catch names such as gyroscope_matrix[0,1] that rich reads as a style."""
    rows = [["noise[red]", 1.0], ["matrix[0,1]", 2.0]]
    text = printed(capsys, monkeypatch, 80, ["parameter", "value"], rows, "Run [a]")
    assert "noise[red]" in text
    assert "matrix[0,1]" in text
    assert "Run [a]" in text


@pytest.mark.parametrize("quiet", [False, True])
def test_lines_where_there_is_no_bar(quiet):
    """Would catch minutes of silence in a pipe or a log file, and lines in spite of --quiet."""

    @click.command()
    @console.quiet_option
    def slow():
        with console.tuning_progress(60) as bar:
            bar.stage("fold 1/2")
            bar.printed -= 60.0
            bar(
                SimpleNamespace(number=7, training=1.25, validation=float("nan"), rejected=False),
                60,
            )
            bar(
                SimpleNamespace(number=8, training=1.0, validation=float("nan"), rejected=False), 60
            )

    result = CliRunner().invoke(slow, ["--quiet"] if quiet else [])
    assert result.exit_code == 0
    lines = (
        [] if quiet else ["tuning: compiling", "fold 1/2", "fold 1/2: 1.25 after iteration 7 of 60"]
    )
    assert result.stderr.splitlines() == lines
