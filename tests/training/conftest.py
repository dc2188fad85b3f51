"""Runs that compile once."""

import pytest

from cmig_jax.training import loop


@pytest.fixture(scope="module")
def compiled_once():
    """Every step is logged, and the runs of a module, all of one config, share the step and the predictor of each number of devices."""
    shared = {}

    def once(make):
        def made(*arguments):
            key = make, arguments[-1].size
            if key not in shared:
                shared[key] = make(*arguments)
            return shared[key]

        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "LOG_EVERY", 1)
        patch.setattr(loop, "make_step", once(loop.make_step))
        patch.setattr(loop, "Predictor", once(loop.Predictor))
        yield
