"""Pairs of recordings: real partial clouds of one scene, each in the frame of its own sensor, and the true transform between them.

A pair is that of `pairs.py`, without `object` and with `overlap`. The clouds are normalised together (`sample.normalise_pair`), and a
random subset of each is kept. Neither crop, noise nor pose are drawn; `data.max_angle_deg` selects the pairs by the angle of their true
rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data.normals import observed_normals
from cmig_jax.data.pairs import Pair, black, evenly_spaced, render_clouds, seeded
from cmig_jax.data.recordings import between, read_manifest, read_recording
from cmig_jax.data.sample import normalise_pair


class RecordedPairs(Sequence[Pair]):
    """The pairs of a prepared folder of recordings; each is a function of (`data.test_seed`, its name) alone.

    Pairs whose true rotation is larger than `data.max_angle_deg` are left out (180 leaves none out). Both clouds have as many points as
    a cropped pair with the same flags.

    Args:
        folder: prepared folder (`recordings.ensure_recordings`).
        data: flags of the protocol.
        views: flags of the views to attach; None attaches none.
        limit: number of pairs, evenly spaced in the list; None: all.
        normals: whether to attach normals, estimated from each recording before it is thinned; they change nothing else of a pair.

    Attributes:
        categories: names of the scenes, which `label` counts.
        names: `"<source> to <target>"` of each pair.

    Raises:
        ValueError: no prepared folder, no pair within the angle, `limit` below 1, or views of the complete object, which a recording
            does not show.
    """

    def __init__(
        self, folder: Path, data: DataConfig, views: ViewsConfig | None, limit: int | None = None, *, normals: bool = False
    ) -> None:
        if views is not None and views.of == "object":
            raise ValueError(
                f"views.of = object with data.source = {data.source}: a recording has no complete object to render; "
                "expected views.of = source, target or both"
            )
        manifest = read_manifest(folder)
        self.folder, self.data, self.views, self.normals = folder, data, views, normals
        self.categories: tuple[str, ...] = tuple(manifest["categories"])
        self._recordings, self._pairs = manifest["recordings"], manifest["pairs"]
        angles = np.degrees([Rotation.from_matrix(self._target_from_source(i, j)[:3, :3]).magnitude() for i, j, _ in self._pairs])
        within = np.flatnonzero(angles <= data.max_angle_deg)
        if len(within) == 0:
            fault = f"the rotations of the {len(angles)} pairs of {folder} are larger"
            raise ValueError(f"data.max_angle_deg = {data.max_angle_deg}: {fault}; expected at least {np.ceil(10 * min(angles)) / 10}")
        self._numbers = within[evenly_spaced(len(within), limit)]
        self.names = tuple(self._name(number) for number in self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, position: int) -> Pair:  # type: ignore[override]
        if not -len(self) <= position < len(self):
            raise IndexError(position)
        number = int(self._numbers[position])
        rng = seeded(self.data.test_seed, self._name(number))
        pair = self._pair(number, rng)
        if self.views is not None:
            pair["views"] = self._shown(pair, self.views, rng)
        return pair

    def _name(self, number: int) -> str:
        return " to ".join(self._recordings[k]["name"] for k in self._pairs[number][:2])

    def _pair(self, number: int, rng: np.random.Generator) -> Pair:
        i, j, share = self._pairs[number]
        recordings = [self._recordings[k] for k in (i, j)]
        clouds = [read_recording(self.folder, recording["file"]) for recording in recordings]
        normalised, target_from_source = normalise_pair(*clouds), self._target_from_source(i, j)
        R, t = target_from_source[:3, :3], target_from_source[:3, 3]
        source = self._thinned(normalised.source, self.data.cropped_points, recordings[0]["name"], rng)
        target = self._thinned(normalised.target, self.data.target_points, recordings[1]["name"], rng)
        normals = {}
        if self.normals:
            normals["source_normals"] = observed_normals(normalised.source, source)
            normals["target_normals"] = observed_normals(normalised.target, target)
        return {
            "source": source,
            "target": target,
            **normals,
            "R": R.astype(np.float32),
            "t": normalised.normalised_translation(R, t).astype(np.float32),
            "overlap": np.float32(share),
            "label": np.int32(recordings[0]["label"]),
            "index": np.int32(number),
        }

    def _target_from_source(self, i: int, j: int) -> np.ndarray:
        source, target = (np.array(self._recordings[k]["world_from_sensor"]) for k in (i, j))
        return between(source, target)

    def _thinned(self, cloud: np.ndarray, count: int, name: str, rng: np.random.Generator) -> np.ndarray:
        if len(cloud) < count:
            raise ValueError(f"{name} has {len(cloud)} points: expected at least {count}, from data.points and data.keep")
        return cloud[rng.choice(len(cloud), count, replace=False)].astype(np.float32)

    def _shown(self, pair: Pair, views: ViewsConfig, rng: np.random.Generator) -> np.ndarray:
        """Return the views that `views.shown` asks for; those of another pair show other clouds, not the same two exchanged."""
        if views.shown == "zero":
            return black(views)
        if views.shown == "shuffled":
            own = set(self._pairs[int(pair["index"])][:2])
            others = [number for number, (i, j, _) in enumerate(self._pairs) if {i, j} != own]
            if not others:
                raise ValueError(f"views.shown=shuffled with one pair of recordings in {self.folder}: expected at least two")
            pair = self._pair(int(rng.choice(others)), rng)
        return render_clouds(pair, views)
