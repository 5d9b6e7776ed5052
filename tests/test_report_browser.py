"""The report in a real browser: it draws, without an error and without asking for anything.

Skipped where there is no Chromium.
"""

import re
import shutil
import subprocess

import pytest
from click.testing import CliRunner

from jaxekf.cli import main
from jaxekf.simulation import demo

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, NAMES)), None)
pytestmark = pytest.mark.skipif(
    BROWSER is None, reason=f"There is no browser here: none of {', '.join(NAMES)} is on the path."
)


def dom(file, folder):
    """The page as it is after its scripts have run."""
    command = [
        str(BROWSER),
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--disable-background-networking",
        f"--user-data-dir={folder}",
        "--window-size=1440,900",
        "--virtual-time-budget=60000",
        "--enable-logging=stderr",
        "--dump-dom",
        file.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    root = re.search(r"<html[^>]*>", done.stdout)
    assert root is not None, done.stderr
    states = dict(re.findall(r'data-(\w+)="([^"]*)"', root.group()))
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return done.stdout, states, console


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    for arguments in (
        ["estimate", demo.FOLDER / "free-5", "-o", folder / "result"],
        ["report", folder / "result" / "free-5", "-o", folder / "report.html"],
    ):
        made = CliRunner().invoke(main, [str(a) for a in arguments])
        assert made.exit_code == 0, made.output
    return folder / "report.html"


def test_it_draws_everything_and_asks_for_nothing(report, tmp_path):
    """Would catch a script error, a figure that is not drawn, a request, or a button that sends data."""
    page, states, console = dom(report, tmp_path)
    assert states == {"errors": "0", "blocked": "0", "drawn": "5", "ready": "true"}
    assert console == []
    plots = [text.split("</figure>")[0] for text in page.split("<figure>")[1:]]
    assert len(plots) == 5
    for plot in plots:
        assert '<svg class="main-svg"' in plot
    # Estimates, their bands and the tracker's dots are there as shapes.
    assert 'class="js-fill"' in plots[0] and 'class="js-line"' in plots[0]
    assert plots[0].count('class="point"') > 1000
    assert 'data-title="Zoom"' in page and 'data-title="Share' not in page


def test_errors_and_requests_would_be_counted(report, tmp_path):
    """Would catch counters that cannot count, by which the test above proves nothing."""
    text = report.read_text("utf-8")
    broken = '<img src="https://example.org/a.png"><script>throw new Error("x");</script></main>'
    (tmp_path / "broken.html").write_text(text.replace("</main>", broken), "utf-8")
    _, states, _ = dom(tmp_path / "broken.html", tmp_path)
    assert states["errors"] == "1" and states["blocked"] == "1"
