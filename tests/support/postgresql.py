"""A PostgreSQL of Debian's packages on a Unix socket, started by the tests; a database of its own for each of them."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
import uuid
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import pytest
from waiting import LIMIT_S

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


@cache
def programs() -> Path | None:
    """The folder with initdb and postgres; None where there is no PostgreSQL."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    on_path = shutil.which("initdb")
    return found[-1].parent if found else Path(on_path).parent if on_path else None


def need_postgresql() -> Path:
    pytest.importorskip("psycopg", reason="POSTGRESQL IS NOT TESTED: pip install 'psycopg[binary]'")
    found = programs()
    if found is None:
        pytest.skip("POSTGRESQL IS NOT TESTED: apt-get install postgresql")
    return found


class Server:
    """A running PostgreSQL."""

    def __init__(
        self,
        folder: Path,
        programs: Path,
        fsync: bool = False,
        address: str = "",
        variables: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Also at an IP address of this machine, for all of its network; with variables in its environment."""
        self.folder, self._programs, self._fsync = folder, programs, fsync
        self._address, self._variables = address, dict(variables)
        self._user = None
        if os.getuid() == 0:  # PostgreSQL does not run as root
            self._user = "postgres"
            found = pwd.getpwnam("postgres")
            os.chown(folder, found.pw_uid, found.pw_gid)
        self._run("initdb", "-D", str(folder / "db"), "-U", "hsloc", "--auth=trust", "--no-sync", "-E", "UTF8")
        if address:
            with (folder / "db" / "pg_hba.conf").open("a") as rules:
                rules.write("host all all samenet trust\n")

    def start(self) -> None:
        options = f"-k {self.folder} -c listen_addresses={self._address} -c shared_buffers=16MB -c max_connections=200"
        options += f" -c fsync={'on' if self._fsync else 'off'}"
        self._run("pg_ctl", "-D", str(self.folder / "db"), "-w", "-o", options, "-l", str(self.folder / "log"), "start")

    def stop(self, mode: str = "fast") -> None:
        self._run("pg_ctl", "-D", str(self.folder / "db"), "-w", "-m", mode, "stop")

    def new_database(self) -> str:
        """The URL of an empty database."""
        name = f"test_{uuid.uuid4().hex}"
        self._run("createdb", "-h", str(self.folder), "-U", "hsloc", name)
        return f"postgresql://hsloc@/{name}?host={self._address or self.folder}"

    def _run(self, program: str, *arguments: str) -> None:
        subprocess.run(
            [str(self._programs / program), *arguments],
            user=self._user,
            group=self._user,
            extra_groups=[] if self._user else None,
            cwd=self.folder,
            env={"PATH": os.environ["PATH"], "LC_ALL": "C.UTF-8", **self._variables},
            check=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=LIMIT_S,
        )


@contextmanager
def running(
    fsync: bool = False, address: str = "", variables: Mapping[str, str] = MappingProxyType({})
) -> Iterator[Server]:
    """A server that ends with the block. Its socket's path must be short."""
    with tempfile.TemporaryDirectory(prefix="hsloc-pg-", ignore_cleanup_errors=True) as folder:
        server = Server(Path(folder), need_postgresql(), fsync, address, variables)
        server.start()
        try:
            yield server
        finally:
            server.stop("immediate")
