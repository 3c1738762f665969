"""Machines as network namespaces of this one (root only): each has an address on a bridge, and can be cut off from it.

Their wall clocks are set by a library that is loaded before libc's, and built here by the C compiler. Monotonic clocks
go on. (libfaketime 0.9.10 will not do: with it every `time.sleep` of Python 3.11 fails with EINVAL.)
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

SOURCE = r"""
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static long offset, read_at = -1;

static long forward(void) {
    struct timespec now;
    syscall(SYS_clock_gettime, CLOCK_MONOTONIC, &now);
    if (now.tv_sec != read_at) {
        char text[32] = "";
        const char *path = getenv("CLOCK_OFFSET_FILE");
        int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
        if (file >= 0) {
            if (read(file, text, sizeof text - 1) > 0) offset = atol(text);
            close(file);
        }
        read_at = now.tv_sec;
    }
    return offset;
}

int clock_gettime(clockid_t id, struct timespec *at) {
    int failed = syscall(SYS_clock_gettime, id, at);
    if (!failed && id == CLOCK_REALTIME) at->tv_sec += forward();
    return failed;
}

int gettimeofday(struct timeval *restrict at, void *restrict zone) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    at->tv_sec = now.tv_sec;
    at->tv_usec = now.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *at) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (at) *at = now.tv_sec;
    return now.tv_sec;
}
"""


class Clock:
    """The wall clock of one machine, as an offset in a file; the library is in the same folder."""

    def __init__(self, path: Path) -> None:
        self.path, self._library = path, path.parent / "clock.so"
        if not self._library.exists():
            command = ["cc", "-shared", "-fPIC", "-O1", "-x", "c", "-o", str(self._library), "-"]
            subprocess.run(command, input=SOURCE.encode(), check=True)
        self.set_forward(0)

    @property
    def variables(self) -> dict[str, str]:
        """What a process must be started with."""
        return {"LD_PRELOAD": str(self._library), "CLOCK_OFFSET_FILE": str(self.path)}

    def set_forward(self, seconds: int) -> None:
        self.path.write_text(f"{seconds}\n")
        self.path.chmod(0o644)


class Machine:
    """A network namespace."""

    def __init__(self, name: str, address: str, clock: Clock) -> None:
        self.name, self.address, self.clock = name, address, clock

    @property
    def prefix(self) -> list[str]:
        """The beginning of a command that runs on the machine; the process keeps its id."""
        return ["nsenter", f"--net=/run/netns/{self.name}"]

    def cut(self) -> None:
        """Drop what goes to the machine and comes from it; its connections do not notice."""
        _ip("link", "set", f"{self.name}x", "down")

    def join(self) -> None:
        _ip("link", "set", f"{self.name}x", "up")


class Network:
    """A bridge with machines."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._mark = folder, f"h{os.getpid() % 100000}"
        self._net = f"10.213.{os.getpid() % 250}"
        self._machines: list[Machine] = []
        self.address = f"{self._net}.1"
        """Of this process, on the same bridge."""
        _ip("link", "add", f"{self._mark}b", "type", "bridge")
        _ip("address", "add", f"{self.address}/24", "dev", f"{self._mark}b")
        _ip("link", "set", f"{self._mark}b", "up")

    def machine(self) -> Machine:
        number = len(self._machines)
        name, address = f"{self._mark}n{number}", f"{self._net}.{number + 10}"
        _ip("netns", "add", name)
        made = Machine(name, address, Clock(self._folder / f"{name}.clock"))
        self._machines.append(made)
        _ip("link", "add", f"{name}x", "type", "veth", "peer", "name", "eth0", "netns", name)
        _ip("link", "set", f"{name}x", "master", f"{self._mark}b", "up")
        _ip("-n", name, "address", "add", f"{address}/24", "dev", "eth0")
        for device in ("eth0", "lo"):
            _ip("-n", name, "link", "set", device, "up")
        return made

    def close(self) -> None:
        for each in self._machines:
            with suppress(subprocess.CalledProcessError):
                _ip("netns", "del", each.name)
        _ip("link", "del", f"{self._mark}b")


class S3:
    """moto's server on a machine of its own, with one bucket. It keeps all in memory, so it is cut off, not killed."""

    def __init__(self, machine: Machine, log: Path) -> None:
        self.machine, self.url = machine, f"http://{machine.address}:5000"
        command = [*machine.prefix, sys.executable, "-m", "moto.server", "-H", machine.address, "-p", "5000"]
        with log.open("ab") as output:
            self.process = subprocess.Popen(command, stdout=output, stderr=output)
        self.variables = {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ACCESS_KEY_ID": "one",
            "AWS_SECRET_ACCESS_KEY": "two",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        for _ in range(600):
            with suppress(OSError), urllib.request.urlopen(self.url, timeout=5.0):
                break
            time.sleep(0.1)
        request = urllib.request.Request(f"{self.url}/fleet", method="PUT")
        urllib.request.urlopen(request, timeout=30.0).close()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, stdout=subprocess.DEVNULL)
