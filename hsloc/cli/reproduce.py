"""Run the papers' experiments again and set the published figures beside the measured ones."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    from hsloc.reproduction import Material

HELP = "run the experiments of the papers again"
EXAMPLES = """
  hsloc reproduce                              all experiments, about an hour
  hsloc reproduce E1 --seeds 20 --out results/e1
"""

_EXPERIMENTS = ("E1", "E2", "E3", "E4", "M1")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Experiments, data, seeds, output."""
    parser.add_argument(
        "experiments", nargs="*", type=_experiment, metavar="EXPERIMENT",
        help="E1: match a scan; E2: fitness over iterations; E3: localisation; E4: SLAM; M1: windows (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--data", type=Path, metavar="DIR",
        help="Folder with scan1.csv, localisation_map.csv and waypoints.csv (default: $HSLOC_DATA/paper, "
        "or ../shared/data/paper; without it the simulated set-up only).",
    )  # fmt: skip
    parser.add_argument(
        "--own", action="store_true", help="Use the simulated set-up only, even where the data of the course report is."
    )
    parser.add_argument(
        "--seeds", type=_count, metavar="N",
        help="Repetitions of each experiment (default: E1 200, E2 50, E3 20, E4 20, M1 200 windows).",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="Folder of the results (default: results/reproduce-TIME)."
    )
    parser.add_argument("--overwrite", action="store_true", help="Replace the folder if it exists.")
    parser.add_argument("--json", action="store_true", help="Print the results as JSON on stdout.")
    parser.add_argument("-q", "--quiet", action="store_true", help="Print errors only.")


def run(arguments: argparse.Namespace) -> int:
    """Run, write, print; 1 where something that ought to hold does not."""
    from hsloc.cli.main import EXIT_FAILED, EXIT_OK
    from hsloc.cli.output import default_folder, link_latest, refuse_early
    from hsloc.evaluation.metrics import format_json
    from hsloc.reproduction import reproduce
    from hsloc.reproduction.results import write_results

    folder = arguments.out or default_folder("reproduce")
    refuse_early(folder, arguments.overwrite)
    materials, notes = _materials(arguments.data, arguments.own)
    experiments = [name for name in _EXPERIMENTS if not arguments.experiments or name in arguments.experiments]
    with ProgressLine(arguments.quiet) as line:
        reproduction = reproduce(materials, experiments, arguments.seeds, line.show)
        text = write_results(reproduction, folder, notes, overwrite=arguments.overwrite)
    if arguments.out is None:
        link_latest(folder)
    if arguments.json:
        print(format_json({**reproduction.to_dict(), "notes": notes, "results": str(folder)}), end="")
    elif not arguments.quiet:
        print(text)
        print(f"results: {folder}")
    return EXIT_OK if all(verdict.met for verdict in reproduction.verdicts) else EXIT_FAILED


def _materials(data: Path | None, own: bool) -> tuple[list[Material], list[str]]:
    """What to run on. A folder that was named must be there; the default may be missing, with a warning."""
    from hsloc.reproduction import own_material, report_material

    if own:
        return [own_material()], ["the report's data was left out (--own)."]
    if data is not None:
        return [report_material(data), own_material()], []
    root = os.environ.get("HSLOC_DATA")
    folder = (Path(root) if root else Path("..") / "shared" / "data") / "paper"
    if folder.is_dir():
        return [report_material(folder), own_material()], []
    return [own_material()], [
        (
            f"the report's data is not at hand ({folder} does not exist; name it with --data DIR): E1 to E4 are run on "
            "our own set-up alone, and the published figures beside them belong to another scan and another map."
        )
    ]


def _experiment(text: str) -> str:
    if text.upper() not in _EXPERIMENTS:
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(_EXPERIMENTS)}")
    return text.upper()


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)
