"""Where compiled programs are kept."""

from pathlib import Path

import jax
import pytest

from cmig_jax.compilation import keep_compiled_programs


@pytest.fixture(autouse=True)
def settings_stay():
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_the_folder_is_the_users_or_one_of_ours(monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/somewhere")
    assert keep_compiled_programs() == "/somewhere"
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    assert keep_compiled_programs() == str(Path.home() / ".cache" / "cmig_jax" / "compiled")
