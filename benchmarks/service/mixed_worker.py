"""A job's process: the real localiser for an MCAP file, else the tests' fake worker, which is the first argument."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

MAGIC = b"\x89MCAP"


def main() -> None:
    fake, folder = sys.argv.pop(1), Path(sys.argv[1])
    log = json.loads((folder / "job.json").read_text())["log"]
    if (folder / "input" / log).open("rb").read(len(MAGIC)) == MAGIC:
        runpy.run_module("hsloc_service.execution.worker", run_name="__main__", alter_sys=True)
    else:
        runpy.run_path(fake, run_name="__main__")


if __name__ == "__main__":
    main()
