"""A training run from start, or from where it stopped, to its end."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import jax
import numpy as np
from jax.sharding import Mesh

from cmig_jax.config import Config, views_to_prepare
from cmig_jax.data.loader import BatchIterator, epoch_steps, training_batches
from cmig_jax.data.pairs import Pair, Pairs, training_objects
from cmig_jax.data.prepare import ensure_prepared
from cmig_jax.data.shards import Shards
from cmig_jax.data.sources import source_of
from cmig_jax.devices import device_mesh, to_device
from cmig_jax.evaluation.metrics import registration_metrics
from cmig_jax.files import remove_partial_files, replacing
from cmig_jax.inference.predictor import Predictor
from cmig_jax.training.checkpoint import Checkpoints, check_config, write_config
from cmig_jax.training.logs import Log, NoLog
from cmig_jax.training.optim import optimizer, schedule
from cmig_jax.training.processes import StopVote, in_turn, is_first
from cmig_jax.training.state import Step, TrainState, abstract_state, build, create_state, make_step

LOG_EVERY = 10  # steps


class Interrupted(Exception):
    """The run was asked to stop; it is saved and can be continued."""


class NonFiniteLoss(Exception):
    """A loss or gradient is not finite; the batch is saved."""


@dataclass(frozen=True)
class TrainingData:
    """Pairs to train on (drawn anew each epoch) and to validate on (fixed)."""

    train: Pairs
    validation: Pairs


def train(config: Config, run: Path, *, resume: bool = False, progress: bool = True, devices: int | None = None) -> None:
    """Train, validating and saving a checkpoint every `optim.validate_every` epochs.

    Several processes (`processes.join`) train as one: each makes its share of every batch, the first one writes.

    Args:
        config: the run's flags.
        run: the run folder, which several processes share.
        resume: continue the run in the folder (or start, if there is none).
        progress: show a bar.
        devices: how many to use (default: the most that share the batch evenly).

    Raises:
        ValueError: bad flags or data, or a folder that holds another run, or this one without `resume`.
        Interrupted: by Ctrl-C or SIGTERM in any process, after saving the last step.
        NonFiniteLoss: the batch is in the run folder.
    """

    def open_data() -> TrainingData:
        if is_first() and not resume and (run / "checkpoints").exists():
            raise ValueError(f"{run} holds a run: add --resume to continue it, or choose another --name")
        if is_first():
            check_config(run, config)
        return training_data(config)

    _Run(config, run, in_turn(open_data), devices).go(progress)


def training_data(config: Config) -> TrainingData:
    """Prepare the objects if need be, and split the training objects of the chosen categories.

    Raises:
        ValueError: a source without training objects, too few of them, or fewer points than the network needs.
    """
    data, needs = config.data, config.model.needs
    if not source_of(data).trains:
        raise ValueError(f"data.source = {data.source} has no objects to train on: expected another (evaluate.py takes it)")
    if data.cropped_points < needs.training_points:
        left = f"data.points = {data.points} leaves {data.cropped_points} points after the crop"
        raise ValueError(f"{left}: expected at least {needs.training_points}, the network's neighbours and keypoints in training")
    objects = Shards(ensure_prepared(data, views_to_prepare(config)), "train")
    train, held = training_objects(objects, data)
    views, normals = config.views if needs.views else None, needs.normals
    return TrainingData(
        train=Pairs(objects, train, data, views, config.seed, normals=normals),
        validation=Pairs(objects, held, data.as_tested, views, data.test_seed, normals=normals),
    )


class _Run:
    def __init__(self, config: Config, folder: Path, data: TrainingData, devices: int | None) -> None:
        self.config, self.folder, self.data = config, folder, data
        self.epoch_steps = epoch_steps(data.train, config)
        self.total = config.optim.epochs * self.epoch_steps
        self.mesh: Mesh = device_mesh(config.optim.batch, devices)
        self.batches: BatchIterator = training_batches(data.train, config, process=jax.process_index(), processes=jax.process_count())
        module, rule = build(config), optimizer(config.optim, self.epoch_steps)
        in_turn(self._open_folder)  # after all checks of flags, data and devices
        self.checkpoints = Checkpoints(folder)
        restored = self.checkpoints.restore_last(abstract_state(module, rule, config, self.mesh))
        if restored is None:
            self.state: TrainState = create_state(module, rule, config, self.mesh)
        else:
            self.state = restored[0]
            if restored[1]:  # a network converted from PyTorch has none
                self.batches.set_state(restored[1])
        self.step = int(self.state.step)
        self.update: Step = make_step(module, rule, config, self.mesh)
        self.key = jax.random.key(config.seed)
        self.predictor = Predictor(module, config.optim.batch, self.mesh)
        self.vote = StopVote(self.mesh)
        self.rate = schedule(config.optim, self.epoch_steps)
        self.pending: tuple[int, dict[str, jax.Array], Pair] | None = None
        self.clock = (time.perf_counter(), self.step)

    def go(self, progress: bool) -> None:
        log = Log(self.folder, self.step, self.total, progress=progress) if is_first() else NoLog()
        with _stop_signals() as stop, log:
            try:
                self._steps(log, stop)
            finally:
                self.checkpoints.close()

    def _open_folder(self) -> None:
        if is_first():
            write_config(self.folder, self.config)
            remove_partial_files(self.folder)
        elif not (self.folder / "config.json").exists():
            raise ValueError(f"{self.folder}: expected a folder that all processes share, found no config.json of the first one")

    def _steps(self, log: Log | NoLog, stop: threading.Event) -> None:
        every = self.epoch_steps * self.config.optim.validate_every
        while self.step < self.total:
            arrays = next(self.batches)
            self.state, scalars = self.update(self.state, to_device(arrays, self.mesh), self.key)
            self.step += 1
            stopping = self.vote(stop.is_set())
            # Read a step's numbers only while the next step runs, so that an accelerator never waits for the host.
            self._settle(log)
            self.pending = (self.step, scalars, arrays)
            at_end = self.step == self.total or self.step % every == 0
            if at_end or stopping:
                self._settle(log)
                self._validate(log) if at_end else self._save(None)
                self.clock = (time.perf_counter(), self.step)
            if stopping and self.step < self.total:
                raise Interrupted(f"stopped at step {self.step} of {self.total}; continue with --resume")

    def _settle(self, log: Log | NoLog) -> None:
        """Check and record the numbers of the last step."""
        if self.pending is None:
            return
        step, scalars, arrays = self.pending
        self.pending = None
        values = {name: float(value) for name, value in scalars.items()}
        self._check_finite(step, values, arrays)
        log.advance(values["loss"])
        if step % LOG_EVERY == 0 or step == self.total:
            now = time.perf_counter()
            rate = (step - self.clock[1]) * self.config.optim.batch / (now - self.clock[0])
            log.write(step, values | self._position(step) | {"pairs_per_second": rate})
            self.clock = (now, step)

    def _position(self, step: int) -> dict[str, float]:
        return {"epoch": step / self.epoch_steps, "learning_rate": float(np.asarray(self.rate(step - 1)))}

    def _validate(self, log: Log | NoLog) -> None:
        estimated, true = self.predictor.beside_truth(self.state.variables, self.data.validation)
        measures = {f"val_{name}": value for name, value in registration_metrics(estimated, true).items()}
        log.write(self.step, measures | self._position(self.step))
        epoch = self.step // self.epoch_steps
        log.say(f"epoch {epoch}: validation RMSE(R) {measures['val_rmse_r_deg']:.2f} deg, recall {measures['val_recall']:.2f}")
        self._save(measures)

    def _save(self, measures: dict[str, float] | None) -> None:
        self.checkpoints.save(self.step, self.state, self.batches.get_state(), measures)

    def _check_finite(self, step: int, values: dict[str, float], arrays: Pair) -> None:
        if np.isfinite(list(values.values())).all():
            return
        of_process = "" if jax.process_count() == 1 else f"-process-{jax.process_index()}"
        path = self.folder / f"not-finite-step-{step}{of_process}.npz"
        with replacing(path) as file:
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
        bad = ", ".join(f"{name} = {value}" for name, value in values.items() if not np.isfinite(value))
        last = self.checkpoints.last
        saved = "there is no checkpoint yet" if last is None else f"the last checkpoint is of step {last}"
        raise NonFiniteLoss(f"step {step}: {bad}; the batch is in {path}; {saved}")


@contextmanager
def _stop_signals() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C or SIGTERM into an event; a second one interrupts at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def handle(number: int, frame: FrameType | None) -> None:
        del number, frame
        stop.set()
        restore()
        os.write(2, b"\nstopping after this step; once more to stop at once\n")  # print is not safe in a signal handler

    for number in before:
        signal.signal(number, handle)
    try:
        yield stop
    finally:
        restore()
