"""More devices and more processes: one run, the numbers of one device, and one stop for all."""

import dataclasses
import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from cmig_jax.devices import device_mesh, replicated
from cmig_jax.inference.predictor import Predictor
from cmig_jax.inference.run_folder import load_variables
from cmig_jax.models.cmignet.flags import FusionFlags, ImageFlags, LossFlags, MatchingFlags, PointsFlags
from cmig_jax.training import loop
from cmig_jax.training.loop import Interrupted, train, training_data
from cmig_jax.training.optim import optimizer
from cmig_jax.training.processes import in_turn
from cmig_jax.training.state import abstract_state, build
from cmig_jax.transform import RigidTransform

pytestmark = pytest.mark.usefixtures("compiled_once")
TOTAL = 6  # three epochs of two steps
STOPPED_AT = 3
ROOT = Path(__file__).parents[2]
# Sums over the batch are taken in another order: float32 rounding, which grows from step to step.
TOLERANCE = {"rel": 1e-3, "abs": 1e-4}


@pytest.fixture(scope="module")
def small(tiny):
    """Networks with batch statistics of points and pixels and a loss between pairs, but quickly compiled; validated at the end."""
    model = dataclasses.replace(
        tiny.model,
        points=PointsFlags(k=6, widths=(8,), dim=16),
        image=ImageFlags(widths=(16,), blocks=(1,)),
        fusion=FusionFlags(points="none", image="none"),
        matching=MatchingFlags(head="pcrnet", iterations=1),
        loss=LossFlags(overlap=False, cross_modal="nt-xent"),
    )
    optim = dataclasses.replace(tiny.optim, epochs=3, validate_every=3)
    return dataclasses.replace(tiny, name="small", model=model, optim=optim)


@pytest.fixture(scope="module")
def one_device(small, compiled_once, tmp_path_factory):
    run = tmp_path_factory.mktemp("one-device")
    train(small, run, progress=False, devices=1)
    return run


@pytest.fixture(scope="module")
def two_processes(small, flags, tmp_path_factory):
    """What two processes of one device each print, interrupted and continued; the folder at the end, and when they were stopped."""
    runs = tmp_path_factory.mktemp("two-processes")
    run, stopped = runs / small.name, runs / "stopped"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XLA_FLAGS": "--xla_backend_optimization_level=1", "JAX_PLATFORMS": "cpu"}
    script = [sys.executable, str(ROOT / "tests/training/two_processes.py")]
    arguments = [str(port), str(run), str(stopped), "quickstart", *flags(small), "--runs", str(runs)]
    options = {"cwd": runs, "env": environment, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen([*script, str(i), *arguments], **options) for i in range(2)]
    try:
        printed = [process.communicate(timeout=300) for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [process.returncode for process in processes] == [0, 0], printed
    return printed, run, stopped


def lines(run):
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


def assert_same_numbers(found, expected, **tolerance):
    assert [(line["step"], set(line)) for line in found] == [(line["step"], set(line)) for line in expected]
    for ours, theirs in zip(found, expected, strict=True):
        for name in set(ours) - {"pairs_per_second"}:
            assert ours[name] == pytest.approx(theirs[name], **tolerance), (ours["step"], name)


def test_an_interruption_of_one_process_stops_both_after_the_same_step(two_processes):
    printed, _, stopped = two_processes
    assert ["exit codes [130, 0]" in out for out, _ in printed] == [True, True]
    assert [line["step"] for line in lines(stopped)] == [1, 2, 3]
    assert [path.name for path in (stopped / "checkpoints").iterdir()] == [str(STOPPED_AT)]


def test_only_the_first_of_two_processes_prints_and_shows_progress(two_processes):
    (out, error), (other_out, other_error) = two_processes[0]
    assert f"stopped at step {STOPPED_AT} of {TOTAL}; continue with --resume" in error
    assert f"{TOTAL}/{TOTAL}" in error
    assert "epoch 3: validation" in out
    assert "validation" not in other_out
    assert "stopped at step" not in other_error
    assert f"/{TOTAL}" not in other_error
    assert "Traceback" not in error + other_error


def test_two_processes_interrupted_and_continued_equal_one(two_processes, one_device):
    _, run, _ = two_processes
    assert [line["step"] for line in lines(run)] == [1, 2, 3, 4, 5, 6, 6]
    assert_same_numbers(lines(run)[:1], lines(one_device)[:1], rel=1e-5)
    assert_same_numbers(lines(run), lines(one_device), **TOLERANCE)


def test_a_run_of_two_processes_continues_in_one(small, two_processes, tmp_path):
    _, run, stopped = two_processes
    shutil.copytree(stopped, tmp_path / "run")
    train(small, tmp_path / "run", resume=True, progress=False, devices=1)
    found = lines(tmp_path / "run")
    assert found[:STOPPED_AT] == lines(stopped)
    assert_same_numbers(found, lines(run), **TOLERANCE)


def test_a_run_of_eight_devices_continues_on_one(small, tmp_path, monkeypatch):
    steps, to_device = itertools.count(1), loop.to_device

    def interrupted_to_device(*arguments):
        if next(steps) == STOPPED_AT:
            signal.raise_signal(signal.SIGINT)
        return to_device(*arguments)

    monkeypatch.setattr(loop, "to_device", interrupted_to_device)
    with pytest.raises(Interrupted):
        train(small, tmp_path / "eight", progress=False, devices=8)
    shutil.copytree(tmp_path / "eight", tmp_path / "one")
    train(small, tmp_path / "eight", resume=True, progress=False, devices=8)
    train(small, tmp_path / "one", resume=True, progress=False, devices=1)
    one, eight = lines(tmp_path / "one"), lines(tmp_path / "eight")
    assert one[:STOPPED_AT] == eight[:STOPPED_AT]
    assert_same_numbers(one[STOPPED_AT : STOPPED_AT + 1], eight[STOPPED_AT : STOPPED_AT + 1], rel=1e-5)
    assert_same_numbers(one, eight, **TOLERANCE)


@pytest.mark.parametrize("batch", [8, 16])
def test_validation_over_eight_devices_equals_one(small, one_device, batch):
    """Of 6 pairs, so that a batch is filled up."""
    pairs, model = training_data(small).validation, build(small)
    rule = optimizer(small.optim, 2)
    found = []
    for mesh in (None, device_mesh(batch, 8)):
        like = abstract_state(model, rule, small, mesh or device_mesh(batch, 1))
        found.append(Predictor(model, batch, mesh).beside_truth(load_variables(one_device, like.variables)[1], pairs))
    (one, true), (eight, true_of_eight) = found
    assert len(pairs) == len(one.t) == 6
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), eight, one)
    expected = RigidTransform(R=np.stack([pair["R"] for pair in pairs]), t=np.stack([pair["t"] for pair in pairs]))
    for poses in (true, true_of_eight):
        jax.tree.map(np.testing.assert_array_equal, poses, expected)


def test_devices_hold_consecutive_pairs():
    mesh = device_mesh(16, 8)
    assert mesh.axis_names == ("batch",)
    assert [device.id for device in mesh.devices] == sorted(device.id for device in jax.devices())
    assert replicated(mesh).is_fully_replicated


def test_one_process_does_the_work_at_once():
    assert in_turn(lambda: 3) == 3
    with pytest.raises(OSError, match="full"):
        in_turn(full)


def full():
    raise OSError("full")
