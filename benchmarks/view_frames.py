"""How smoothly the map of a report pans: 100,000 poses on a map of 4,000 x 4,000 cells, in Chromium.

    python benchmarks/view_frames.py

Needs Playwright and a Chromium. Without a graphics card, as on most servers, Chromium draws on the processor.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np

from hsloc.model import OccupancyGrid, Pose2, Trajectory
from hsloc.report.data import ReportParts
from hsloc.report.html import write_report_html

POSES, CELLS, RESOLUTION, FRAMES = 100_000, 4000, 0.05, 480
PAN = """async (frames) => {
  const data = JSON.parse(document.getElementById("data").textContent), image = new Image();
  image.src = data.map.image;
  await image.decode();
  const root = document.createElement("div"), charts = document.createElement("div");
  document.body.replaceChildren(root, charts);
  const view = new ResultView(root, data, image, charts), frame = () => new Promise(requestAnimationFrame);
  view.zoom(2);
  await frame(); await frame();
  view.draw(); await frame(); await frame();
  const work = [], drawn = [], timed = (list, before, known = new Set()) => {
    let least = Infinity;  // of five times: what else runs on the machine does not count
    for (let again = 0; again < 5; again += 1) {
      before();
      const start = performance.now();
      view.drawBase(); view.drawOver();
      for (const canvas of [view.$base, ...view.still.tiles.values()]) {
        if (!known.has(canvas)) canvas.getContext("2d").getImageData(0, 0, 1, 1);  // waits until it is drawn
      }
      least = Math.min(least, performance.now() - start);
    }
    list.push(least);
  };
  for (let k = 0; k < frames; k += 1) {
    const before = view.still, tiles = new Map(before.tiles);
    view.move(k % 240 < 120 ? 7 : -7, k % 160 < 80 ? 3 : -3);
    // tiles that come in are drawn each time
    timed(work, () => { view.still = { ...before, tiles: new Map(tiles) }; }, new Set(tiles.values()));
    await frame();
  }
  for (let k = 0; k < 20; k += 1) timed(drawn, () => { view.still = null; });
  work.sort((a, b) => a - b); drawn.sort((a, b) => a - b);
  const median = (list) => list[list.length >> 1];
  const [p95, p99] = [0.95, 0.99].map((part) => work[Math.floor(part * frames)]);
  return { median: median(work), p95, p99, longest: work.at(-1), whole: median(drawn) };
}"""


def main() -> None:
    """Write a report, pan its map, print the times."""
    from playwright.sync_api import sync_playwright

    rng = np.random.default_rng(0)
    cells = np.zeros((CELLS, CELLS), dtype=np.int8)
    cells[:: CELLS // 20], cells[:, :: CELLS // 20] = 100, 100
    heading = np.cumsum(rng.normal(0.0, 0.03, POSES))
    xy = np.cumsum(0.02 * np.column_stack((np.cos(heading), np.sin(heading))), axis=0)
    xy = np.abs((xy + 100.0) % 400.0 - 200.0)  # reflected at the edges of the map
    trajectory = Trajectory(np.arange(POSES, dtype=np.int64) * 20_000_000, np.column_stack((xy, heading)))
    parts = ReportParts(title="frames", trajectory=trajectory, grid=OccupancyGrid(cells, RESOLUTION, Pose2()))
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = Path(folder) / "report.html"
        write_report_html(path, parts)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        page.goto(path.as_uri())
        found = page.evaluate(PAN, FRAMES)
        browser.close()
    print(f"report.html: {POSES} poses, map of {CELLS} x {CELLS} cells")
    print(f"a frame while panning: median {found['median']:.1f} ms, 95 % below {found['p95']:.1f} ms, ", end="")
    print(f"99 % below {found['p99']:.1f} ms, the longest {found['longest']:.1f} ms")
    print(f"all drawn at once: median {found['whole']:.1f} ms")


if __name__ == "__main__":
    main()
