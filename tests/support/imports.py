"""What a Python process imports."""

from __future__ import annotations

import subprocess
import sys

from waiting import LIMIT_S


def need_no_import(statement: str, heavy: set[str]) -> None:
    """Run a statement in a Python process of its own; it must import none of these modules."""
    check = f"found = {heavy} & set(sys.modules); sys.exit(f'imported {{found}}' if found else 0)"
    subprocess.run([sys.executable, "-c", f"import sys; {statement}; {check}"], check=True, timeout=LIMIT_S)
