"""What it takes to run a replay again: command, configuration, versions, checksums."""

from __future__ import annotations

import platform
import shlex
from dataclasses import replace
from hashlib import file_digest, sha256
from importlib import metadata
from typing import TYPE_CHECKING, Any

from hsloc.config import dump, preset
from hsloc.options import OPTIONS, written
from hsloc.replay.map_and_start import map_files, state_file
from hsloc.report.data import Provenance
from hsloc.version import __version__

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.replay.run import Result
    from hsloc.request import RunRequest

_PACKAGES = ("numpy", "scipy", "numba", "mcap", "rosbags")


def provenance(result: Result) -> Provenance:
    """For the report."""
    versions = {"hsloc": __version__, "Python": platform.python_version()}
    versions |= {name: metadata.version(name) for name in _PACKAGES}
    hashes = {" ".join(result.request.names()): result.input_sha256}
    for given in (result.request.map_path, result.request.align_to):
        if given is not None:
            hashes |= {path.name: _sha256(path) for path in map_files(given)}
    if result.request.calibration is not None:
        hashes[result.request.calibration.name] = _sha256(result.request.calibration)
    return Provenance(command(result.request), dump(result.request.config), versions, hashes, _options(result))


def _options(result: Result) -> dict[str, Any]:
    """What `Provenance.options` has: files that the run was computed from by their content, others by their names."""
    request, grid = result.request, result.grid if result.true_grid is None else result.true_grid
    values = replace(request, bare_names=True).to_values()
    found = {option.name: values.get(option.name) for option in OPTIONS if option.place in ("run", "read")}
    del found["seed"]
    if request.map_path is not None:
        cells = sha256(grid.cells.tobytes()).hexdigest()
        found["map"] = (cells, result.given_resolution or grid.resolution, grid.origin, grid.occupied_threshold)
    if request.align_to is not None:
        found["align_to"] = [_sha256(path) for path in map_files(request.align_to)]
    if request.resume is not None:
        found["resume"] = _sha256(state_file(request.resume))
    if request.calibration is not None:
        found["calibration"] = _sha256(request.calibration)
    return found


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return file_digest(stream, "sha256").hexdigest()


def command(request: RunRequest) -> str:
    """The command line that repeats the run, in the folder in which it was made; but for --out it is complete.

    Of a map that was asked for it is `hsloc map`. With an own matcher, or the server's files (`bare_names`), it says
    what to put in.
    """
    values = request.to_values()
    maps = request.mode == "slam"
    words = ["hsloc", "map" if maps else "replay", *request.paths()]
    for option in OPTIONS:
        if option.place != "check" and not (maps and option.name == "mode"):
            words += written(option, _default_matcher(option.name, values))
    return " ".join(_quoted(word) for word in words)


def _default_matcher(name: str, values: dict[str, Any]) -> Any:
    """Matcher and mapper are named only where they are not the preset's."""
    if name in ("matcher", "mapper") and values[name] == getattr(preset(values["preset"]), name):
        return None
    return values.get(name)


def _quoted(word: str) -> str:
    """A word for bash on one line; bytes of a name that are no UTF-8, and control characters, as `$'\\xfc'`."""
    if word.isprintable():
        return shlex.quote(word)
    plain = word.replace("\\", "\\\\").replace("'", "\\'")
    octets = plain.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    return "$'" + "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in octets) + "'"


def config_text(result: Result) -> str:
    """The effective configuration; what else is needed to repeat the run stands above it."""
    own = result.request.own_matcher
    lines = [
        f"# hsloc {__version__}; run it again with: {command(result.request)}",
        *([] if own is None else [f"# matcher of the caller's own: {type(own).__name__}"]),
        f"# preset: {result.request.preset}",
        f"# input sha256: {result.input_sha256}",
    ]
    return "\n".join(lines) + "\n" + dump(result.request.config)
