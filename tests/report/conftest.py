"""A report of pairs that were never registered: every method's errors are known."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import DataConfig
from cmig_jax.evaluation.errors import Errors, Estimates
from cmig_jax.evaluation.matches import Matches
from cmig_jax.evaluation.metrics import isotropic_errors
from cmig_jax.report.gallery import Example, choose
from cmig_jax.report.page import Report
from cmig_jax.transform import RigidTransform
from configs import PRESETS

HOSTILE = '</script><img src=x onerror="alert(1)"> & $\\frac{ <!--'


def errors_of(count: int = 30, category: str = "chair") -> Errors:
    rng = np.random.default_rng(0)
    R, t = Rotation.random(count, rng=rng).as_matrix(), rng.normal(size=(count, 3))
    methods = {}
    for name, size in {"identity": 1.0, "ICP": 0.1, "CMIGNet": 0.03, "CMIGNet + ICP": 0.0}.items():
        found_R = Rotation.from_rotvec(size * rng.normal(size=(count, 3))).as_matrix() @ R
        found_t = t + size * rng.normal(size=(count, 3))
        errors = isotropic_errors(RigidTransform(R=found_R, t=found_t), RigidTransform(R=R, t=t))
        methods[name] = Estimates(found_R, found_t, *errors)
    return Errors(
        methods=methods,
        network="CMIGNet",
        R=R,
        t=t,
        angle_deg=np.degrees(Rotation.from_matrix(R).magnitude()),
        overlap=rng.uniform(0.3, 1, count),
        category=[category, "table"] * (count // 2),
    )


def example_of(
    errors: Errors, position: int, rank: int, *, matched: bool = True, points: int = 50, views: tuple[int, ...] = (2, 6, 16, 16)
):
    rng = np.random.default_rng(position)
    source = rng.normal(size=(points, 3)).astype(np.float32)
    target = (source @ errors.R[position].T + errors.t[position]).astype(np.float32)
    pair = {"source": source, "target": target[::-1], "views": rng.integers(0, 256, views, dtype=np.uint8)}
    matches = Matches(
        source=source[:20],
        target=target[:20],
        chosen=np.roll(np.arange(20), np.arange(20) % 2),
        used=np.arange(20) < 14,
        right=np.arange(20) % 3 > 0,
    )
    return Example(position, rank, pair, matches if matched else None, f"object {position}")


def report_of(errors: Errors, examples: list[Example]) -> Report:
    results = {name: {"rmse_r_deg": float(np.sqrt(np.mean(f.rotation_deg**2))), "pairs": len(errors)} for name, f in errors.methods.items()}
    results |= {"command": "python evaluate.py 'runs/a <b>' --report", "config": {}, "versions": {"python": "3.11", "jax": "0.10"}}
    config = dataclasses.replace(PRESETS["corrected"](), data=DataConfig(source="shapes"))
    return Report("a <b>", "best, step 7", config, results, errors, examples, [])


@pytest.fixture(scope="session")
def hostile() -> str:
    """A name that tries to break out of a page, and to start a formula."""
    return HOSTILE


@pytest.fixture(scope="session")
def make_errors():
    """Make the errors of four methods, the last of which is always right; every other pair is of the given category."""
    return errors_of


@pytest.fixture(scope="session")
def make_example():
    """Make a pair to show."""
    return example_of


@pytest.fixture(scope="session")
def make_report():
    """Make a report of some pairs, without figures."""
    return report_of


@pytest.fixture(scope="session")
def report() -> Report:
    """Make a report of four pairs out of 30, without figures; the worst has a hostile name or the next."""
    errors = errors_of(category=HOSTILE)
    return report_of(errors, [example_of(errors, *chosen) for chosen in choose(errors.methods["CMIGNet"].rotation_deg, 4)])
