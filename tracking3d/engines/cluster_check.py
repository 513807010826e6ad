"""Whether a Ray cluster responds: tried by a process of its own, since Ray itself waits for minutes and then aborts.

What Ray prints meanwhile goes nowhere.
"""

from __future__ import annotations

import subprocess
import sys

_CONNECT = """
import logging, os, sys
import ray
print("imported", flush=True)
try:
    ray.init(address=sys.argv[1], logging_level=logging.CRITICAL, log_to_driver=False)
except BaseException as error:
    print(" ".join(str(error).split())[:1000] or type(error).__name__, flush=True)
    os._exit(1)
ray.shutdown()
os._exit(0)
"""


def fault_of_cluster(address: str, seconds: float) -> str:
    """Why no cluster can be used at an address; empty if one can.

    Args:
        address: The cluster's address.
        seconds: How long it may take to respond; the time in which Ray is imported is not counted.
    """
    with subprocess.Popen(
        [sys.executable, "-c", _CONNECT, address],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        encoding="utf-8",
        errors="replace",
    ) as process:
        assert process.stdout is not None
        try:
            process.stdout.readline()
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            return f"no response in {seconds:g} seconds"
        finally:
            process.kill()
        lines = process.stdout.read().strip().splitlines()
    if process.returncode == 0:
        return ""
    return lines[-1] if lines else "Ray ended while it connected"
