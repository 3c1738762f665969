"""Compare trajectories with a reference (APE, RPE, per axis) or with checked relations; figures as evo's.

Files are TUM (`t x y z qx qy qz qw`), also as CSV; logs (LOG, LOG:TOPIC, LOG:/tf:map.base_link); or folders of results:
where the first is one, each brings its own reference.
With --relations a single file is an estimate of its own and needs no reference.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.errors import EvaluationError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hsloc.evaluation.metrics import Comparison, Evaluation
    from hsloc.evaluation.relations import Relations, RelationsResult
    from hsloc.evaluation.rpe import Delta
    from hsloc.evaluation.statistics import Statistics
    from hsloc.model import Trajectory
    from hsloc.warnings import RunWarning

HELP = "compare trajectories with a reference"
EXAMPLES = """
  hsloc eval reference.tum trajectory.tum --alignment se2 --save-plot error.png
  hsloc eval results/a results/b --json
  hsloc eval trajectory.tum --relations intel.relations --no-reference
"""

COLUMNS = ("rmse", "mean", "median", "std", "min", "max", "sse")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, how to pair and align them, and what to print."""
    parser.add_argument("files", nargs="+", metavar="POSES", help="REFERENCE ESTIMATE ..., or RESULTS ...")
    parser.add_argument(
        "--alignment", "-a", choices=("none", "origin", "se2", "se3"), default="none",
        help="Align the estimate with the reference first: by its first pose, or by least squares (default: none).",
    )  # fmt: skip
    parser.add_argument(
        "--t-max-diff", type=_not_negative, default=0.01, metavar="S",
        help="Largest time difference of a pair of poses [s] (default: 0.01).",
    )  # fmt: skip
    parser.add_argument(
        "--t-offset", type=float, default=0.0, metavar="S", help="Time that is added to the estimate's stamps [s]."
    )
    parser.add_argument(
        "--association", choices=("nearest", "interpolation"), default="nearest",
        help="Take the nearest pose, or interpolate the denser trajectory at the stamps of the other.",
    )  # fmt: skip
    parser.add_argument(
        "--delta", type=_positive, default=1.0, metavar="N", help="Length of the pieces of the RPE (default: 1)."
    )
    parser.add_argument("--delta-unit", choices=("m", "s", "frames"), default="m", help="Unit of --delta (default: m).")
    parser.add_argument("--all-pairs", action="store_true", help="Begin a piece of the RPE at every pose.")
    parser.add_argument(
        "--relations",
        metavar="FILE",
        help="File of relative poses to evaluate against, too: `t1 t2 x y z roll pitch yaw` a line.",
    )
    parser.add_argument(
        "--no-reference",
        action="store_true",
        help="All files are estimates and none is the reference; with --relations.",
    )
    parser.add_argument(
        "--save-results", type=Path, metavar="DIR", help="Write result files for evo_res there, a zip for each measure."
    )
    parser.add_argument("--plot", "-p", action="store_true", help="Show paths and errors over time in a window.")
    parser.add_argument(
        "--save-plot", type=Path, metavar="FILE", help="Write the same picture: a name that ends in .png, .svg or .pdf."
    )
    parser.add_argument("--json", action="store_true", help="Print JSON.")


def run(arguments: argparse.Namespace) -> int:
    """Evaluate each estimate and print one table, or JSON."""
    from hsloc.evaluation.metrics import format_json
    from hsloc.evaluation.relations import read_relations
    from hsloc.evaluation.rpe import Delta
    from hsloc.replay.references import read_reference

    files: list[str] = arguments.files
    # The results of a run bring their own reference.
    own = Path(files[0]).is_dir() and not arguments.no_reference
    alone = arguments.relations is not None and (arguments.no_reference or (len(files) == 1 and not own))
    if not alone and not own and len(files) == 1:
        print("hsloc eval: error: give REFERENCE and at least one ESTIMATE, or --relations", file=sys.stderr)
        return 2
    if arguments.no_reference and arguments.relations is None:
        print("hsloc eval: error: --no-reference needs --relations FILE", file=sys.stderr)
        return 2
    delta = Delta(arguments.delta, arguments.delta_unit, arguments.all_pairs)
    relations = None if arguments.relations is None else read_relations(arguments.relations)
    warnings: list[RunWarning] = []
    reference = None if alone or own else read_reference(files[0], (), warnings)
    comparisons: dict[str, Comparison] = {}
    results: dict[str, Result] = {}
    for path in files[0 if alone or own else 1 :]:
        estimate = read_reference(_inside(path, "trajectory.tum"), (), warnings)
        truth = read_reference(_inside(path, "reference.tum"), (), warnings) if own else reference
        compared, scored = _evaluate(path, estimate, truth, relations, arguments)
        if compared is not None:
            comparisons[path] = compared
            if (displaced := compared.displaced()) is not None:
                warnings.append(replace(displaced, text=f"{path}: {displaced.text}"))
        results[path] = None if compared is None else compared.evaluation((delta,)), scored
    for warning in dict.fromkeys(warnings):
        print(f"hsloc: warning: {warning}", file=sys.stderr)
    wanted = [name for name in ("save_results", "plot", "save_plot") if getattr(arguments, name)]
    if wanted:
        if alone:
            option = f"--{wanted[0].replace('_', '-')}"
            print(f"hsloc eval: error: {option} needs a reference to take errors from", file=sys.stderr)
            return 2
        _draw(arguments, comparisons)
        if arguments.save_results is not None:
            _save(arguments, comparisons, None if own else files[0], delta)
    if arguments.json:
        document = {
            "reference": None if alone or own else files[0],
            "relations": arguments.relations,
            "estimates": [
                {
                    "estimate": path,
                    **({} if evaluation is None else evaluation.to_dict()),
                    **({} if scored is None else {"relations": scored.to_dict()}),
                }
                for path, (evaluation, scored) in results.items()
            ],
        }
        sys.stdout.write(format_json(document))
    else:
        print("\n".join(_report(results, delta)))
    return 0


def _inside(path: str, name: str) -> str:
    """The file of a folder of results; a file is meant itself."""
    return str(Path(path) / name) if Path(path).is_dir() else path


Result = tuple["Evaluation | None", "RelationsResult | None"]


def _evaluate(
    path: str,
    estimate: Trajectory,
    reference: Trajectory | None,
    relations: Relations | None,
    arguments: argparse.Namespace,
) -> tuple[Comparison | None, RelationsResult | None]:
    from hsloc.evaluation.metrics import compare
    from hsloc.evaluation.relations import evaluate_relations

    try:
        compared = None
        if reference is not None:
            compared = compare(
                estimate,
                reference,
                alignment=arguments.alignment,
                max_difference_s=arguments.t_max_diff,
                association=arguments.association,
                offset_s=arguments.t_offset,
            )
        return compared, None if relations is None else evaluate_relations(estimate, relations)
    except EvaluationError as error:
        raise EvaluationError(f"{path}: {error}") from error


def _draw(arguments: argparse.Namespace, comparisons: Mapping[str, Comparison]) -> None:
    """Save the plot, and show it, where that is asked for."""
    from hsloc.report.png import save_plot, show_plot

    if arguments.save_plot is not None:
        save_plot(arguments.save_plot, comparisons)
    if arguments.plot:
        show_plot(comparisons)


def _save(
    arguments: argparse.Namespace, comparisons: Mapping[str, Comparison], reference: str | None, delta: Delta
) -> None:
    """Write the result files of each estimate, named after it, into the folder of --save-results."""
    from hsloc.errors import OutputError
    from hsloc.evaluation.alignment import parse_alignment
    from hsloc.evaluation.evo_results import write_evo_results

    folder: Path = arguments.save_results
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror or error}); choose another folder") from error
    short = [Path(path).resolve().with_suffix("").name for path in comparisons]
    unique = len(set(short)) == len(short)
    for (path, comparison), name in zip(comparisons.items(), short, strict=True):
        truth = _inside(path, "reference.tum") if reference is None else reference
        whole = "_".join(part for part in Path(path).with_suffix("").parts if part not in ("/", "..", "."))
        write_evo_results(
            folder, name if unique else whole, comparison, parse_alignment(arguments.alignment), delta, (truth, path)
        )


def _report(results: dict[str, Result], delta: Delta) -> list[str]:
    """The lines of the table: each measure once, and under it a row for each estimate."""
    measures: dict[str, dict[str, Statistics]] = {}
    lines = []
    for path, (evaluation, scored) in results.items():
        if evaluation is not None:
            lines.append(
                f"{path}: {evaluation.matched} pairs (unmatched: {evaluation.unmatched_estimate} of the estimate, "
                f"{evaluation.unmatched_reference} of the reference), alignment {evaluation.alignment}, "
                f"path {evaluation.length_estimate:.2f} m of {evaluation.length_reference:.2f} m"
            )
            x, y, theta = evaluation.axis_rmse
            lines.append(f"  RMSE by axis: x {x:.4f} m, y {y:.4f} m, theta {theta:.5f} rad")
            relative = evaluation.rpe[0].statistics
            measures.setdefault("APE translation (m)", {})[path] = evaluation.ape.trans_part
            measures.setdefault("APE rotation (deg)", {})[path] = evaluation.ape.angle_deg
            measures.setdefault(f"RPE translation (m) per {delta}", {})[path] = relative.trans_part
            measures.setdefault(f"RPE rotation (deg) per {delta}", {})[path] = relative.angle_deg
        if scored is not None:
            lines.append(f"{path}: {scored.matched} relations matched, {scored.unmatched} not")
            measures.setdefault("relations translation (m)", {})[path] = scored.statistics.trans_part
            measures.setdefault("relations rotation (deg)", {})[path] = scored.statistics.angle_deg
    return [*lines, "", *_table(measures)]


def _table(measures: dict[str, dict[str, Statistics]]) -> list[str]:
    rows: list[tuple[str, ...]] = [("", *COLUMNS, "n")]
    for measure, by_path in measures.items():
        rows.append((measure, *("" for _ in COLUMNS), ""))
        for path, statistics in by_path.items():
            numbers = [f"{getattr(statistics, name):.4f}" if statistics.count else "-" for name in COLUMNS]
            rows.append((f"  {path}", *numbers, str(statistics.count)))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _not_negative(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a number of at least 0")
    return value
