"""The benchmark, tiny: its keys, finite ratios, and that both networks do the same work."""

import functools
import io
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.bench import run, worker
from cmig_jax.bench.cases import CASES, case_of, make_arrays
from cmig_jax.bench.clock import KEPT, OURS, PYTORCH, Timing, in_turns
from cmig_jax.bench.products import Products, product_rate, products_of
from cmig_jax.bench.tables import case_lines, cloud_lines
from cmig_jax.bench.worker import Worker, network_of, resident
from cmig_jax.commands.bench import has_gpu
from cmig_jax.config import ComputeConfig


@pytest.fixture
def torch():
    return pytest.importorskip("torch")


def test_the_command_line_writes_the_keys_with_finite_ratios(torch, main, tmp_path):
    done = main("bench", "--cases", "tiny", "--repetitions", 1, "--no-stages", "--no-memory", "--json", tmp_path / "bench.json")
    assert done.returncode == 0, done.stderr
    assert "compilation" in done.stdout
    result = json.loads((tmp_path / "bench.json").read_text())["tiny"]
    for mode in ("inference", "training"):
        assert all(math.isfinite(value) and value > 0 for value in result[mode]["whole"].values())
        assert result[mode]["whole"]["ratio"] == pytest.approx(result[mode]["whole"]["pytorch_s"] / result[mode]["whole"]["ours_s"])


def test_both_networks_find_the_same_poses(torch):
    ours, reference = (network_of("tiny", who, "cpu", ComputeConfig()).inference()() for who in (OURS, PYTORCH))
    np.testing.assert_allclose(ours.R, reference.numpy(), atol=1e-3)


def test_every_stage_is_measured_in_both_networks(torch):
    for who in (OURS, PYTORCH):
        stages = network_of("tiny", who, "cpu", ComputeConfig()).stages(train=False)
        assert set(stages) == set(CASES["tiny"].stages)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not say how much memory a process holds")
def test_clouds_of_any_size_are_registered_without_pytorch(monkeypatch):
    monkeypatch.setitem(CASES, "points", CASES["tiny"])
    monkeypatch.setattr(run.Settings, "worker", lambda self, name, who: InProcess(name, who))
    rows = run.clouds((20, 30), run.Settings())
    assert [row["points"] for row in rows] == [20, 30]
    assert all(row["seconds"] > 0 and row["peak_gb"] > 0.01 for row in rows)
    assert len(cloud_lines(rows)) == 3


class InProcess:
    """A worker without a process, which would import everything once more."""

    def __init__(self, name, who):
        assert who == OURS
        self.network, self.works = network_of(name, who, "cpu", ComputeConfig()), {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def __call__(self, work):
        return worker._answer(self.network, self.works, work, "cpu")

    def memory(self, mode):
        return self(f"memory {mode}")


@pytest.mark.slow
def test_a_worker_that_fails_is_named():
    with (
        Worker("tiny", "ours", "cpu", ComputeConfig(), allocator={}) as process,
        pytest.raises(RuntimeError, match=r"ours \(tiny\) ended with code 1 at 'training x'"),
    ):
        process("training x")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--repetitions", "0"], "--repetitions 0: expected at least 1"),
        (["--clouds", "3"], "--clouds 3: expected at least 256"),
        (["--pairs", "4", "0"], "--pairs 0: expected at least 1"),
        (["--json", "none/a.json"], "--json none/a.json: expected a file in a folder that is there"),
        (["--device", "gpu"], "finds none"),
    ],
)
def test_what_cannot_be_measured_is_one_line_of_error(torch, main, flags, message):
    if "gpu" in flags and has_gpu():
        pytest.skip("there is a GPU")
    done = main("bench", *flags)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert message in done.stderr


def test_work_is_done_in_turns():
    calls, seconds = [], iter([4.0, 3.0, 1.0, 6.0, 3.0, 2.0, 5.0, 3.0, 1.0])

    def work(who):
        calls.append(who)
        return next(seconds)

    timing = in_turns({who: functools.partial(work, who) for who in (PYTORCH, KEPT, OURS)}, 3)
    assert calls == [PYTORCH, KEPT, OURS] * 3
    assert timing == Timing({PYTORCH: 5.0, KEPT: 3.0, OURS: 1.0}, spread=2.0)
    assert timing.as_json() == {"ratio": 5, "ratio_kept": 3, "pytorch_s": 5, "pytorch_kept_s": 3, "ours_s": 1, "spread": 2}


def product(x):
    return x @ x.T


def convolution(x):
    image, kernel = x.reshape(1, 4, 4, 2), jnp.ones((3, 3, 2, 5))
    return jax.lax.conv_general_dilated(image, kernel, (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (product, Products(2 * 8 * 8 * 4, 4 * (32 + 32 + 64))),
        (jax.jit(product), Products(2 * 8 * 8 * 4, 4 * (32 + 32 + 64))),
        (lambda x: jax.lax.map(product, jnp.stack([x, x, x])), Products(2 * 8 * 8 * 4, 4 * (32 + 32 + 64)) * 3),
        (lambda x: jax.lax.cond(x[0, 0] > 0, product, lambda x: jnp.ones((8, 8)), x), Products(2 * 8 * 8 * 4, 4 * (32 + 32 + 64))),
        (convolution, Products(2 * (2 * 2 * 5) * (3 * 3 * 2), 4 * (32 + 90 + 20))),
        (lambda x: jax.linear_transpose(convolution, x)(jnp.ones((1, 2, 2, 5))), Products(2 * 32 * (3 * 3 * 5) // 4, 4 * (20 + 90 + 32))),
        (lambda x: x + 1, Products()),
    ],
)
def test_products_are_counted_as_often_as_they_run(function, expected):
    assert products_of(jax.make_jaxpr(function)(jnp.ones((8, 4)))) == expected


def test_the_products_of_a_step_are_counted_through_loops_and_derivatives():
    network = network_of("tiny", OURS, "cpu", ComputeConfig())
    network.inference()
    network.training()
    inference, training = (network.costs[mode]["operations"] for mode in ("inference", "training"))
    assert 2 * inference < training < 4 * inference


def test_a_large_product_takes_time():
    assert 1e8 < product_rate(jnp.float32) < 1e16


def test_work_that_does_not_fit_into_memory_is_left_out():
    asked = []

    def too_large():
        asked.append(PYTORCH)

    timing = in_turns({PYTORCH: too_large, OURS: lambda: 2.0}, 3)
    assert asked == [PYTORCH]
    assert timing.as_json() == {"ours_s": 2, "spread": 1}
    assert in_turns({PYTORCH: too_large}, 3) | Timing({OURS: 2.0}, spread=1.5) == Timing({OURS: 2.0}, spread=1.5)


def test_what_has_no_number_is_a_dash():
    rows = {"whole": {"ours_s": 0.5, "operations": 2e9, "bytes": 1e9, "floor_s": 0.25, "spread": 1.0}}
    result = {"inference": rows, "training": {"whole": {"spread": 1.0}}, "memory": {"training": {"ours_peak_gb": 3.0}}}
    lines = case_lines("tiny:4", result | {"product_rate": 8e9, "compile_s": {"inference": 1.0}})
    assert lines[0].startswith("tiny:4: 4 pairs of 24 points")
    assert lines[2].split() == ["inference", "whole", "-", "-", "0.500", "125.00", "-", "-", "2.0", "1.00", "0.250"]
    assert lines[3].split() == ["training", "whole", *["-"] * 9]
    assert lines[4].split() == ["peak", "memory,", "training", "-", "GB", "3.00", "GB", "-"]


def allocate_with_torch():
    import torch

    torch.empty(2**60, dtype=torch.uint8)


@pytest.mark.parametrize("allocate", [lambda: bytearray(2**60), allocate_with_torch, lambda: jax.block_until_ready(jnp.zeros(2**50))])
def test_a_worker_goes_on_where_memory_does_not_suffice(torch, allocate, monkeypatch, capsys):
    class Network:
        def training(self):
            return allocate

        def inference(self):
            return lambda: None

    monkeypatch.setattr("sys.stdin", io.StringIO("training whole\ninference whole\n"))
    worker.main(Network(), "cpu")
    refused, done = capsys.readouterr().out.splitlines()
    assert json.loads(refused) is None
    assert json.loads(done) >= 0


def test_a_case_has_its_own_batch_or_the_one_asked_for():
    assert case_of("paper") == CASES["paper"]
    assert (case_of("paper:16").pairs, case_of("paper:16").flags) == (16, CASES["paper"].flags)
    assert (case_of("points:1:5000").pairs, case_of("points:1:5000").points) == (1, 5000)


def test_inputs_are_always_the_same():
    first, again = (make_arrays(CASES["tiny"]) for _ in range(2))
    assert first.source.shape == (2, 24, 3)
    assert (first.views.shape, first.views.dtype) == ((2, 2, 16, 16), np.uint8)
    np.testing.assert_array_equal(first.views, again.views)
    assert not np.array_equal(first.source[0], first.source[1])


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not say how much memory a process holds")
def test_memory_is_read_from_the_system():
    assert resident("VmHWM") >= resident("VmRSS") > 10e6
