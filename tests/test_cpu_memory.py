"""jemalloc: a training from the command line starts again with it, and nothing else does."""

import os
import subprocess
import sys

import pytest

from cmig_jax import cpu_memory

PRINT = """
import os, sys
from cmig_jax import cli
from cmig_jax.commands import train
train.parse = lambda *arguments: print(os.environ.get("LD_PRELOAD", "none"), os.environ.get("MALLOC_CONF"))
train.run = lambda command: 0
sys.exit(cli.entry())
"""


@pytest.fixture
def installed(monkeypatch):
    monkeypatch.setattr(cpu_memory.sys, "platform", "linux")
    monkeypatch.setattr(cpu_memory.ctypes.util, "find_library", lambda name: f"lib{name}.so.2")
    for variable in ("LD_PRELOAD", "MALLOC_CONF"):
        monkeypatch.delenv(variable, raising=False)


def test_a_new_process_is_told_to_load_it(installed):
    assert cpu_memory.environment() == {"LD_PRELOAD": "libjemalloc.so.2", "MALLOC_CONF": "oversize_threshold:0"}


def test_other_libraries_and_settings_of_the_user_stay(installed, monkeypatch):
    monkeypatch.setenv("LD_PRELOAD", "libmine.so")
    monkeypatch.setenv("MALLOC_CONF", "narenas:2")
    assert cpu_memory.environment() == {"LD_PRELOAD": "libjemalloc.so.2:libmine.so", "MALLOC_CONF": "narenas:2"}


@pytest.mark.parametrize("preloaded", ["libjemalloc.so.2", "/usr/lib/libtcmalloc.so"])
def test_an_allocator_of_the_users_stays(installed, monkeypatch, preloaded):
    monkeypatch.setenv("LD_PRELOAD", preloaded)
    assert cpu_memory.environment() == {}


def test_without_it_nothing_changes(installed, monkeypatch):
    monkeypatch.setattr(cpu_memory.ctypes.util, "find_library", lambda name: None)
    assert cpu_memory.environment() == {}
    cpu_memory.restart_with_jemalloc()


@pytest.mark.skipif(not cpu_memory.environment(), reason="jemalloc is not installed")
@pytest.mark.parametrize(("flags", "expected"), [((), "jemalloc"), (("--no-jemalloc",), "none")])
def test_a_training_restarts_with_it_once(flags, expected):
    command = [sys.executable, "-c", PRINT, "train", "quickstart", *flags]
    environment = {name: value for name, value in os.environ.items() if name not in ("LD_PRELOAD", "MALLOC_CONF")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert expected in done.stdout
    assert done.stdout.count("\n") == 1
