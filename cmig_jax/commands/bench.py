"""`cmig bench [flags]`."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from cmig_jax.commands.parsing import parser_of
from cmig_jax.config import ComputeConfig


@dataclass(frozen=True)
class Command:
    """Compare speed and memory of a network with its PyTorch reference, on the same weights and inputs, in turns.

    PyTorch is measured as it is installed and, on a CPU under Linux, also with settings by which it keeps the memory that it frees.
    """

    cases: tuple[Literal["paper", "points", "quickstart", "tiny"], ...] = ("paper", "points", "quickstart")
    """`paper`: batch of 2 pairs, 768 points, 20 views of 224 x 224, K = 256, n = 3, float32; `points`: that without the image encoder,
    whose result both are given; `quickstart`: the small preset's network and batch; `tiny`: for tests."""
    device: Literal["cpu", "gpu"] = "cpu"
    """Where to compute."""
    repetitions: int = 5
    """Repetitions of every measurement; medians are reported."""
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    """How our network computes."""
    jemalloc: bool = True
    """Run ours with the allocator jemalloc, as a training does, if it is installed."""
    stages: bool = True
    """Also time every stage alone."""
    memory: bool = True
    """Also take peak memory, in separate processes."""
    pairs: tuple[int, ...] = ()
    """Batch sizes to measure every case at; its own if not given."""
    clouds: tuple[int, ...] = ()
    """Instead, register clouds of these sizes with our network (`--compute.rows` is 512 if not given); needs no PyTorch."""
    json: Path | None = None
    """File to write the results to."""


parse = parser_of(Command)


def run(command: Command) -> int:
    """Measure, print, and write.

    Raises:
        ValueError: a flag with which nothing can be measured.
    """
    from cmig_jax.bench import run as bench
    from cmig_jax.bench.tables import case_lines, cloud_lines
    from cmig_jax.files import write_text

    _check(command)
    settings = bench.Settings(command.device, command.compute, command.repetitions, command.jemalloc)
    if command.clouds:
        settings = replace(settings, compute=replace(command.compute, rows=command.compute.rows or 512))
        results: dict[str, Any] = {"clouds": bench.clouds(command.clouds, settings)}
        print("\n".join(cloud_lines(results["clouds"])))
    else:
        results = {}
        for name in [f"{case}:{count}" for case in command.cases for count in command.pairs] or command.cases:
            results[name] = bench.times(name, settings, command.stages) | (bench.memory(name, settings) if command.memory else {})
            print("\n".join(case_lines(name, results[name])), flush=True)
    if command.json is not None:
        write_text(command.json, json.dumps(asdict(settings) | results, indent=1) + "\n")
    return 0


def _check(command: Command) -> None:
    from importlib.util import find_spec

    from cmig_jax.bench.cases import case_of

    if command.repetitions < 1:
        raise ValueError(f"--repetitions {command.repetitions}: expected at least 1")
    if command.pairs and min(command.pairs) < 1:
        raise ValueError(f"--pairs {min(command.pairs)}: expected at least 1")
    if command.clouds and min(command.clouds) < (fewest := case_of("points").flags.needs.points):
        raise ValueError(f"--clouds {min(command.clouds)}: expected at least {fewest} points, what the network needs")
    if command.json is not None and not command.json.parent.is_dir():
        raise ValueError(f"--json {command.json}: expected a file in a folder that is there")
    if not command.clouds and find_spec("torch") is None:
        raise ValueError("PyTorch, the reference, is not installed: expected `pip install torch`; only --clouds needs none")
    if command.device == "gpu" and not has_gpu():
        raise ValueError("--device gpu: JAX finds none here")


def has_gpu() -> bool:
    """Whether JAX finds a GPU; asked in another process, since JAX takes most of its memory as soon as it looks."""
    return subprocess.run([sys.executable, "-c", "import jax; jax.devices('gpu')"], capture_output=True, check=False).returncode == 0
