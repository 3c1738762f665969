"""Draw the pictures of the documentation again: `python docs/images/draw.py http://127.0.0.1:8000 [INTEL_FOLDER]`.

The first argument is a running `hsloc serve`, whose page is shown with recordings/kidnapped.mcap; it needs Playwright
and a Chromium. With the folder that holds intel.clf.gz and intel.relations the map of the Intel lab is drawn, too.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from hsloc.cli.main import main as hsloc
from hsloc.client import Client

HERE = Path(__file__).resolve().parent
RECORDINGS = HERE.parents[1] / "recordings"


def page(url: str) -> None:
    """service.png: a result at the moment before the robot was kidnapped."""
    from playwright.sync_api import sync_playwright

    client = Client(url)
    job = client.submit(client.upload(RECORDINGS / "kidnapped.mcap"))["id"]
    client.wait(job)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        shown = browser.new_page(viewport={"width": 1280, "height": 1700})
        shown.goto(f"{url}/#job={job}&t=29.6")
        shown.wait_for_function("() => document.querySelector('.rv-now')?.textContent.startsWith('29.6 s')")
        shown.wait_for_timeout(500)
        shown.screenshot(path=HERE / "service.png")
        browser.close()


def report(name: str, *command: str) -> None:
    """The report.png of a run."""
    with tempfile.TemporaryDirectory() as folder:
        hsloc([*command, "--quiet", "--out", f"{folder}/run"])
        shutil.copy(f"{folder}/run/report.png", HERE / f"{name}.png")


if __name__ == "__main__":
    page(sys.argv[1].rstrip("/"))
    report("office", "replay", str(RECORDINGS / "office.mcap"), "--unknown-start")
    if len(sys.argv) > 2:
        intel = Path(sys.argv[2])
        report("intel", "map", str(intel / "intel.clf.gz"), "--relations", str(intel / "intel.relations"))
