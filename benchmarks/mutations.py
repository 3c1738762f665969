"""Damaged inputs for every reader: an error of ours or a result, within 2 s and 500 MB, and never a traceback.

    python benchmarks/mutations.py --count 100000
    python benchmarks/mutations.py --only db3 --first 4711 --count 1     # one of them again

Small files of every kind that hsloc reads are damaged in one place or a few: bits, bytes, lengths, cuts, repeated and
swapped pieces, in texts also words and numbers. The number of a mutation is its seed. What fails is kept in a folder,
named by its number, and the exit code is 1; a warning of Python or numpy is a failure, too.
"""

from __future__ import annotations

import argparse
import gzip
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

import log_formats
from log_builders import scan_payloads, write_raw, write_run
from mcap.writer import CompressionType

from hsloc.config import load
from hsloc.errors import HslocError
from hsloc.evaluation import read_relations
from hsloc.log import ReadOptions, check_log, open_log, read_calibration, read_profile
from hsloc.maps import read_map, save_map
from hsloc.model import OccupancyGrid, Pose2
from hsloc.trajectory_io.reader import read_trajectory

if TYPE_CHECKING:
    from collections.abc import Callable

LIMIT_S, LIMIT_MB, HARD_LIMIT_MB = 2.0, 500.0, 4000
ALL = ReadOptions(require_scan=False, require_odometry=False)
WORDS = (
    b"nan",
    b"inf",
    b"-inf",
    b"1e308",
    b"-1",
    b"0",
    b"1e-320",
    b"99999999999999999999",
    b"",
    b"x",
    b"\xff\xfe",
    b"*a",
)
INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)


class TooSlow(BaseException):
    """More CPU time than an input may take."""


def read_log(path: Path) -> None:
    """Everything that a log can be asked for."""
    log = open_log(path, ALL)
    for _ in log.events():
        pass
    log.map()
    log.initial_pose()
    check_log(log)


def read_a_map(path: Path) -> None:
    """The map whose YAML stands beside the image, whichever of the two is damaged."""
    read_map(path.parent / "map.yaml")


def kinds(folder: Path) -> dict[str, tuple[Callable[[Path], object], list[tuple[str, bytes]]]]:
    """Readers by kind, with sound files to begin with: names and bytes."""
    run = write_run(folder / "run.mcap", scans=6, truth=True)
    mcaps = [run, *(
        write_raw(folder / f"{number}.mcap", scan_payloads(6), **options)
        for number, options in enumerate(
            ({"compression": CompressionType.NONE}, {"compression": CompressionType.LZ4}, {"use_chunking": False})
        )
    )]  # fmt: skip
    mcaps += [log_formats.foxglove_mcap(run, folder / f"{name}.mcap", name) for name in ("json", "protobuf")]
    mcaps.append(log_formats.ros1_mcap(run, folder / "ros1.mcap"))
    bag = log_formats.bag1(run, folder / "run.bag")
    (db3,) = log_formats.bag2(run, folder / "bag2").glob("*.db3")
    ranges = " ".join(f"{1.0 + k / 100:.2f}" for k in range(30))
    carmen = "".join(
        f"ODOM {k}.0 0.1 0.2 0 0 0 {k}.5 host {k}.5\nFLASER 30 {ranges} 1 2 0 {k}.0 2 0 {k}.6 host {k}.6\n"
        f"ROBOTLASER1 0 -1.5 3.1 0.1 80 0.01 0 30 {ranges} 0 1 2 0 {k} 2 0 0 0 0 0 0 {k}.7 host {k}.7\n"
        for k in range(5)
    ).encode()
    wean = "".join(f"O {k} 2 0.1 {k}.1\nL {k} 2 0 {k} 3 0 {' '.join(['100'] * 180)} {k}.2\n" for k in range(4)).encode()
    cells = np.full((20, 30), 0, dtype=np.int8)
    cells[0], cells[5] = 100, -1
    save_map(OccupancyGrid(cells, 0.05, Pose2(1, 2, 0)), folder / "map.yaml")
    pgm, yaml = (folder / "map.pgm").read_bytes(), (folder / "map.yaml").read_bytes()
    from PIL import Image

    images = []
    for ending in ("png", "bmp"):
        Image.open(folder / "map.pgm").save(folder / f"image.{ending}")
        images.append((f"map.{ending}", (folder / f"image.{ending}").read_bytes()))
    (folder / "map.yaml").unlink()
    tum = "".join(f"{k}.25 {k / 10} 0.5 0 0 0 0.1 0.995\n" for k in range(20)).encode()
    csv = b"#timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z\n" + b"".join(
        b"%d000000000,1,2,0,1,0,0,0\n" % k for k in range(9)
    )
    plane = b"# t x y theta\n0 1 2 3\n1 2 3 4\n"
    relations = b"".join(b"%d.5 %d.5 1 0.2 0 0 0 0.1\n" % (k, k + 1) for k in range(9))
    return {
        "mcap": (read_log, [("a.mcap", path.read_bytes()) for path in mcaps]),
        "bag": (read_log, [("a.bag", bag.read_bytes())]),
        "db3": (read_log, [("a.db3", db3.read_bytes())]),
        "text": (read_log, [("a.clf", carmen), ("a.log", wean), ("a.clf.gz", gzip.compress(carmen, mtime=0))]),
        "map": (read_a_map, [("map.yaml", yaml), ("map.pgm", pgm), *images]),
        "trajectory": (read_trajectory, [("a.tum", tum), ("a.csv", csv), ("a.tum", plane)]),
        "relations": (read_relations, [("a.relations", relations)]),
        "yaml": (_read_yaml, [
            ("a.yaml", b"odometry: {scale: 1.01}\nlidars:\n  /scan: {x: 1, y: 2, yaw: 0.1}\n"),
            ("a.yaml", b"topics:\n  /scan: {rate: [8, 12], frame: laser}\ntransforms: [a -> b]\n"),
            ("a.yaml", b"hide: {budget: 300}\nlocaliser: {certify: true}\n"),
        ]),
    }  # fmt: skip


def _read_yaml(path: Path) -> None:
    for read in (read_calibration, read_profile, load):
        try:
            read(path)
        except HslocError as error:
            _one_line(error)


def _one_line(error: HslocError) -> None:
    if "\n" in str(error):
        raise AssertionError(f"an error of several lines: {error}")


def damaged(data: bytes, other: bytes, rng: np.random.Generator, is_text: bool) -> bytes:
    """The file with one damage or a few."""
    out = bytearray(data)
    for _ in range(int(rng.geometric(0.6))):
        if not out:
            break
        at, size = int(rng.integers(len(out))), int(rng.integers(1, 64))
        match int(rng.integers(9 if is_text else 7)):
            case 0:
                out[at] ^= 1 << int(rng.integers(8))
            case 1:
                out[at] = int(rng.integers(256))
            case 2:
                width = int(rng.choice((1, 2, 4, 8)))
                value = INTEGERS[int(rng.integers(len(INTEGERS)))] % (1 << (8 * width))
                out[at : at + width] = value.to_bytes(width, "little" if rng.random() < 0.8 else "big")
            case 3:
                del out[at : at + size]
            case 4:
                out[at:at] = out[at : at + size]
            case 5:
                begin = int(rng.integers(len(other)))
                out[at : at + size] = other[begin : begin + size]
            case 6:
                if rng.random() < 0.2:
                    del out[at:]
            case _:
                words = bytes(out).split(b" ")
                words[int(rng.integers(len(words)))] = WORDS[int(rng.integers(len(WORDS)))]
                out = bytearray(b" ".join(words))
    return bytes(out)


def peak_mb() -> float:
    """Most memory since `forget_peak`."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024.0


def forget_peak() -> None:
    """Begin anew to watch the memory."""
    Path("/proc/self/clear_refs").write_text("5")


def main() -> int:
    """Damage, read, and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", help="one kind")
    parser.add_argument("--keep", type=Path, default=Path("results/mutations"), help="folder for what fails")
    arguments = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (HARD_LIMIT_MB << 20, HARD_LIMIT_MB << 20))

    warnings.simplefilter("error")

    def too_slow(*_: object) -> None:
        raise TooSlow

    signal.signal(signal.SIGVTALRM, too_slow)
    outcomes: Counter[str] = Counter()
    slowest: dict[str, float] = {}
    largest: dict[str, float] = {}
    failures = 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        found = kinds(folder)
        names = [arguments.only] if arguments.only else list(found)
        for number in range(arguments.first, arguments.first + arguments.count):
            rng = np.random.default_rng(number)
            kind = names[number % len(names)]
            read, seeds = found[kind]
            name, data = seeds[int(rng.integers(len(seeds)))]
            other = seeds[int(rng.integers(len(seeds)))][1]
            place = folder / "work"
            place.mkdir(exist_ok=True)
            if kind == "map":
                for each, content in seeds:
                    (place / each).write_bytes(content)
                if name not in ("map.yaml", "map.pgm"):
                    (place / "map.yaml").write_bytes(seeds[0][1].replace(b"map.pgm", name.encode()))
            is_text = kind not in ("mcap", "bag", "db3")
            path = place / name
            path.write_bytes(damaged(data, other, rng, is_text))
            forget_peak()
            begin = time.process_time()
            problem = None
            signal.setitimer(signal.ITIMER_VIRTUAL, 2.0 * LIMIT_S)
            try:
                read(path)
                outcomes[f"{kind}: read"] += 1
            except HslocError as error:
                outcomes[f"{kind}: refused"] += 1
                if "\n" in str(error):
                    problem = f"an error of several lines: {str(error)[:200]!r}"
            except TooSlow:
                problem = "hangs"
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt):
                    raise
                problem = traceback.format_exc().strip()
            finally:
                signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
            seconds, memory = time.process_time() - begin, peak_mb()
            slowest[kind], largest[kind] = max(slowest.get(kind, 0.0), seconds), max(largest.get(kind, 0.0), memory)
            if problem is None and seconds > LIMIT_S:
                problem = f"takes {seconds:.1f} s"
            if problem is None and memory > LIMIT_MB:
                problem = f"takes {memory:.0f} MB"
            if problem is not None:
                failures += 1
                arguments.keep.mkdir(parents=True, exist_ok=True)
                (arguments.keep / f"{kind}-{number}-{name}").write_bytes(path.read_bytes())
                print(f"mutation {number} ({kind}, {name}): {problem}", flush=True)
            path.unlink()
            if (number + 1 - arguments.first) % 5000 == 0:
                print(f"{number + 1 - arguments.first} mutations, {failures} failures", flush=True)
    for key, count in sorted(outcomes.items()):
        print(f"{key}: {count}")
    for kind, seconds in slowest.items():
        print(f"{kind}: at most {seconds:.2f} s and {largest[kind]:.0f} MB")
    print(f"{arguments.count} mutations, {failures} failures")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
