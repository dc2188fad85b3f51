"""Machines other than Linux, which lack some functions of the system; and the lock of a prepared folder."""

import os
import signal
import subprocess
import sys

import pytest
from filelock import FileLock, Timeout

from cmig_jax.data import shard_jobs
from cmig_jax.data.prepare import available_cores
from cmig_jax.data.shards import LOCK, locked


def test_preparation_works_on_other_machines(meshes, prepared_meshes, contents, tmp_path):
    """macOS has no `sched_getaffinity`, Windows no `fcntl` and no `pthread_sigmask`; worker processes run the first lines too."""
    script = tmp_path / "script.py"
    script.write_text(
        "import importlib, os, pkgutil, signal, sys\n"
        "sys.modules['fcntl'] = None\n"
        "del os.sched_getaffinity, signal.pthread_sigmask\n"
        "os.cpu_count = lambda: 2\n"
        "if __name__ == '__main__':\n"
        "    import cmig_jax.data\n"
        "    for module in pkgutil.walk_packages(cmig_jax.data.__path__, 'cmig_jax.data.'):\n"
        "        importlib.import_module(module.name)\n"
        "    from cmig_jax.config import DataConfig, ViewsConfig\n"
        "    cmig_jax.data.prepare.OBJECTS_PER_SHARD = 2\n"
        f"    data = DataConfig(source='meshes', root={str(meshes)!r})\n"
        f"    cmig_jax.data.prepare.prepare(data, ViewsConfig(layout='axes', count=6, size=16), {str(tmp_path / 'out')!r})\n"
        "    print(len([name for name in sys.modules if name.startswith('cmig_jax.data.')]))\n"
    )
    run = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, run.stderr
    assert int(run.stdout) > 20
    assert contents(tmp_path / "out") == contents(prepared_meshes)


@pytest.mark.parametrize(("count", "cores"), [(2, 2), (None, 1)])
def test_without_affinity_the_cores_of_the_machine_count(monkeypatch, count, cores):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: count)
    assert available_cores() == cores


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="needs signal masks")
def test_the_signal_mask_is_restored():
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with shard_jobs._interrupts_blocked():
            pass
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, set())
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def test_the_lock_excludes_another_process_until_that_ends(tmp_path):
    script = f"from cmig_jax.data.shards import *\nwith locked(Path({str(tmp_path)!r})): print(flush=True); input()"
    other = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(Timeout), FileLock(tmp_path / LOCK, timeout=0.2):
            pass
    finally:
        other.kill()
        other.communicate()
    with locked(tmp_path), pytest.raises(Timeout), FileLock(tmp_path / LOCK, timeout=0.1):
        pass
