"""How soon the page shows its jobs, and what it asks for while nobody does anything, with many jobs in the database.

    python benchmarks/service/page_load.py --jobs 1000 10000

One job on twenty seconds of the office is run; the others are copies of its row, with its figures, and with its picture
alone of its files. Needs Playwright and a Chromium.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import sys
import tempfile
import uuid
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
from live_service import Live, submit, wait
from playwright.sync_api import sync_playwright
from sqlalchemy import create_engine, insert, select, update

from hsloc_service.db.tables import AssetRow, CounterRow, JobRow
from hsloc_service.jobs.repository import SEQ
from hsloc_service.settings import Settings

OFFICE = Path(__file__).parents[2] / "recordings" / "office.mcap"
IDLE_S = 10.0
LOADS = 5
# The time of the first frame after the rows are there (ms).
WATCH = """(() => { const look = () => { if (document.querySelector("#jobs [data-job]"))
  requestAnimationFrame(() => { window.rowsShown = performance.now(); }); else requestAnimationFrame(look); };
  requestAnimationFrame(look); })()"""


def copies(database: Path, count: int) -> None:
    """Copy the one job of a database until there are `count` of them."""
    engine = create_engine(f"sqlite:///{database}")
    with engine.begin() as connection:
        job = dict(connection.execute(select(JobRow.__table__)).mappings().one())
        picture = select(AssetRow.__table__).where(AssetRow.name == "thumbnail.png")
        assets = [dict(row) for row in connection.execute(picture).mappings()]
        ids = [str(uuid.uuid4()) for _ in range(count - 1)]
        jobs: list[dict[str, Any]] = [
            {**job, "id": ident, "seq": job["seq"] + 1 + k, "log_name": f"run-{k}.mcap", "created": job["created"] + k}
            for k, ident in enumerate(ids)
        ]
        connection.execute(insert(JobRow.__table__), jobs)
        connection.execute(insert(AssetRow.__table__), [{**row, "job_id": ident} for ident in ids for row in assets])
        connection.execute(update(CounterRow.__table__).where(CounterRow.name == SEQ).values(value=job["seq"] + count))
    engine.dispose()


def look(browser: Any, url: str) -> tuple[float, float]:
    """Times until something and until rows are painted, in a new browser profile [s]."""
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.add_init_script(WATCH)
    page.goto(url)
    page.wait_for_function("() => window.rowsShown")
    rows = page.evaluate("window.rowsShown")
    first = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
    context.close()
    return first / 1000.0, rows / 1000.0


def idle(browser: Any, url: str) -> tuple[int, int]:
    """Answers and bytes of them, with their headers, in `IDLE_S` after the page has come to rest."""
    page = browser.new_page()
    page.goto(url)
    page.wait_for_selector("#jobs [data-job]")
    page.wait_for_load_state("networkidle")
    answers: list[Any] = []
    page.on("response", lambda answer: answers.append(answer))
    page.wait_for_timeout(1000 * IDLE_S)
    size = 0
    for answer in answers:
        headers = answer.headers_array()
        size += sum(len(header["name"]) + len(header["value"]) + 4 for header in headers)
        size += 0 if answer.status == 304 else len(answer.body())  # a body before compression
    page.close()
    return len(answers), size


def main() -> None:
    """Print one line for each number of jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, nargs="+", default=[1000, 10000], metavar="N", help="Jobs in the database.")
    numbers = parser.parse_args().jobs
    worker = {"HSLOC_WORKER_COMMAND": ",".join(Settings().worker_command), "HSLOC_SANDBOX": "none"}
    for number in numbers:
        with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
            live = Live(Path(folder), HSLOC_JOB_MEMORY_BYTES="4G", **worker).start()
            try:
                with live.client() as client:
                    submit(client, OFFICE.read_bytes(), read={"end_s": 20.0})
                    wait(client, client.get("/v1/jobs").json()["jobs"][0]["id"], 300.0)
                live.end()
                copies(live.data / "hsloc.db", number)
                live.start()
                browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
                first, rows = zip(*(look(browser, live.url) for _ in range(LOADS)), strict=True)
                answers, size = idle(browser, live.url)
                browser.close()
            finally:
                live.end()
            print(
                f"{number} jobs: first paint {statistics.median(first):.2f} s (at most {max(first):.2f}), "
                f"rows {statistics.median(rows):.2f} s (at most {max(rows):.2f}); "
                f"idle for {IDLE_S:.0f} s: {answers} answers, {size / 1000:.1f} kB"
            )


if __name__ == "__main__":
    main()
