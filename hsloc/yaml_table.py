"""Small YAML files that people write: a table of keys, nothing else."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any

from hsloc.errors import ConfigError, HslocError, no_such, not_read

if TYPE_CHECKING:
    from pathlib import Path

_MAX_BYTES = 64 << 10
_LARGEST_INT = 10**300
"""What is larger is not to be had as a float."""


def is_number(value: Any) -> bool:
    """Whether a value of YAML is a finite number."""
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) <= _LARGEST_INT
    return isinstance(value, float) and isfinite(value)


def load_table(
    path: Path, what: str, remedy: str = "", *, kind: type[HslocError] = ConfigError, may_be_empty: bool = False
) -> dict[str, Any]:
    """The keys of a YAML file. Raises `kind`, which names the file, for what is no table.

    Aliases are refused: nested ones expand half a kilobyte to gigabytes.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import AliasEvent

    try:
        if path.stat().st_size > _MAX_BYTES:
            raise kind(f"{path}: is too large for a {what} (more than {_MAX_BYTES >> 10} kB){remedy}")
        text = path.read_bytes().decode()
        if any(isinstance(event, AliasEvent) for event in YAML(typ="safe", pure=True).parse(text)):
            raise kind(f"{path}: has a YAML alias (*name); write the value in its place")
        values = YAML(typ="safe", pure=True).load(text)
    except FileNotFoundError as error:
        raise kind(no_such(path, what, remedy or "; check the path")) from error
    except OSError as error:
        if isinstance(error, PermissionError) or not remedy:
            raise kind(not_read(path, error)) from error
        raise kind(f"{path}: cannot be read ({error.strerror or error}){remedy}") from error
    except (YAMLError, ValueError, RecursionError, AttributeError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise kind(f"{path}: is not YAML ({reason}){remedy}") from error
    if values is None and may_be_empty:
        return {}
    if not isinstance(values, dict):
        raise kind(f"{path}: is not a {what}: it holds no keys{remedy}")
    return values
