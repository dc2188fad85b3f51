"""Peak memory of one network doing one thing, in a process of its own: `measure` starts it, `python -m cmig_jax.bench.memory` is it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

from cmig_jax.bench.worker import Who, arguments, is_out_of_memory, network_of
from cmig_jax.config import ComputeConfig


def measure(case: str, who: Who, what: str, device: str, compute: ComputeConfig) -> dict[str, float]:
    """Run one network in a new process.

    Args:
        case: name of the case.
        who: which network.
        what: `inference` or `training`.
        device: `cpu` or `gpu`.
        compute: how ours computes.

    Returns:
        `peak_gb`, the largest resident memory of the process (of the device, on a GPU), and `above_runtime_gb`, without what the process
        held once libraries, weights and inputs were loaded; nothing if memory does not suffice.
    """
    return in_a_process("cmig_jax.bench.memory", what, *arguments(case, who, device, compute))


def in_a_process(module: str, *arguments: str) -> dict[str, Any]:
    """Run a module and read the JSON on the last line that it prints."""
    done = subprocess.run([sys.executable, "-m", module, *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{module} {' '.join(arguments)} ended with code {done.returncode}:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def resident(field: Literal["VmHWM", "VmRSS"]) -> int:
    """Return the largest (VmHWM) or present (VmRSS) resident memory of this process, bytes; 0 where the system does not say."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(field)), 0)


def main(what: str, network: Any, device: str) -> dict[str, float]:
    """Do it twice in this process; return the peaks."""
    before = resident("VmRSS")
    try:
        work = getattr(network, what)()
        work()
        work()
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        return {}
    peak = network.peak_bytes() if device == "gpu" else resident("VmHWM")
    return {"peak_gb": peak / 1e9, "above_runtime_gb": (peak - (0 if device == "gpu" else before)) / 1e9}


if __name__ == "__main__":
    what, case, who, device, compute = sys.argv[1:]
    print(json.dumps(main(what, network_of(case, who, device, compute), device)))  # type: ignore[arg-type]
