"""Recordings to pairs: real partial clouds of one scene, each in the frame of its own sensor, and the true transform between them.

A pair is that of `pairs.py`, without `object` and with `overlap`. As `registration.register` does with a user's clouds, each cloud is
centred at its own mean, both are scaled by one factor, and a random subset is kept of each: what tells where they belong is in their
shapes alone. Neither crop, noise nor pose are drawn; `data.max_angle_deg` chooses the pairs, by the angle of their true rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cmig_jax.config import Config
from cmig_jax.data.pairs import Pair, black, evenly_spaced, render_clouds
from cmig_jax.data.recordings import between, read_manifest, read_recording
from cmig_jax.data.sample import normalise_together


class RecordedPairs(Sequence[Pair]):
    """The pairs of a prepared folder of recordings; pair i is a function of (`data.test_seed`, its number in the folder) alone.

    Pairs whose true rotation is larger than `data.max_angle_deg` are left out (180 leaves none out). Both clouds have the points that a
    cropped pair of the same flags has: `data.points`, times `data.keep` unless `data.crop=none`.

    Args:
        folder: of `recordings.ensure_recordings`.
        config: `data` and `views` flags.
        views: whether to attach images.
        limit: how many of them, evenly spaced; None: all.

    Attributes:
        categories: names of the scenes, which `label` counts.
        names: `"<source> to <target>"` of each pair.

    Raises:
        ValueError: no prepared folder, no pair within the angle, `limit` below 1, or views of the complete object, which a recording
            has not.
    """

    def __init__(self, folder: Path, config: Config, views: bool = True, limit: int | None = None) -> None:
        if views and config.views.of == "object":
            raise ValueError(
                f"views.of = object with data.source = {config.data.source}: a recording has no complete object to render; "
                "expected views.of = source, target or both"
            )
        manifest = read_manifest(folder)
        self.folder, self.config, self.with_views = folder, config, views
        self.categories: tuple[str, ...] = tuple(manifest["categories"])
        self._recordings, self._pairs = manifest["recordings"], manifest["pairs"]
        angles = np.degrees([Rotation.from_matrix(self._target_from_source(i, j)[:3, :3]).magnitude() for i, j, _ in self._pairs])
        within = np.flatnonzero(angles <= config.data.max_angle_deg)
        if len(within) == 0:
            fault = f"the {len(angles)} pairs of {folder} turn by at least {min(angles):.1f} degrees"
            raise ValueError(f"data.max_angle_deg = {config.data.max_angle_deg}: expected more, {fault}")
        self._numbers = within[evenly_spaced(len(within), limit)]
        self.names = tuple(" to ".join(self._recordings[k]["name"] for k in self._pairs[number][:2]) for number in self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, position: int) -> Pair:  # type: ignore[override]
        if not -len(self) <= position < len(self):
            raise IndexError(position)
        number = int(self._numbers[position])
        rng = np.random.default_rng([self.config.data.test_seed, number])
        pair = self._pair(number, rng)
        if self.with_views:
            pair["views"] = self._shown(pair, rng)
        return pair

    def _pair(self, number: int, rng: np.random.Generator) -> Pair:
        i, j, share = self._pairs[number]
        recordings = [self._recordings[k] for k in (i, j)]
        clouds = [read_recording(self.folder, recording["file"]) for recording in recordings]
        source, target, centre_source, centre_target, scale = normalise_together(*clouds)
        target_from_source = self._target_from_source(i, j)
        R = target_from_source[:3, :3]
        t = (R @ centre_source + target_from_source[:3, 3] - centre_target) / scale
        return {
            "source": self._thinned(source, recordings[0]["name"], rng),
            "target": self._thinned(target, recordings[1]["name"], rng),
            "R": R.astype(np.float32),
            "t": t.astype(np.float32),
            "overlap": np.float32(share),
            "label": np.int32(recordings[0]["label"]),
            "index": np.int32(number),
        }

    def _target_from_source(self, i: int, j: int) -> np.ndarray:
        return between(*(np.array(self._recordings[k]["world_from_sensor"]) for k in (i, j)))

    def _thinned(self, cloud: np.ndarray, name: str, rng: np.random.Generator) -> np.ndarray:
        data = self.config.data
        count = data.points if data.crop == "none" else round(data.points * data.keep)
        if len(cloud) < count:
            raise ValueError(f"{name} has {len(cloud)} points: expected at least {count}, of data.points and data.keep")
        return cloud[rng.choice(len(cloud), count, replace=False)].astype(np.float32)

    def _shown(self, pair: Pair, rng: np.random.Generator) -> np.ndarray:
        """Return the views that `views.shown` asks for; those of another pair are of other clouds, not of the same two exchanged."""
        views = self.config.views
        if views.shown == "zero":
            return black(views)
        if views.shown == "shuffled":
            own = set(self._pairs[int(pair["index"])][:2])
            others = [number for number, (i, j, _) in enumerate(self._pairs) if {i, j} != own]
            if not others:
                raise ValueError(f"views.shown=shuffled with one pair of recordings in {self.folder}: expected at least two")
            pair = self._pair(int(rng.choice(others)), rng)
        return render_clouds(pair, views)
