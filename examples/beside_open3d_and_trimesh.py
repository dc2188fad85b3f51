"""Register objects of trimesh and Open3D, and move them with their own methods.

    python examples/beside_open3d_and_trimesh.py

`register` takes what has `points` or `vertices`; `.matrix` is the 4 x 4 array that both libraries take. Open3D is left out if it is not
installed.
"""

import argparse

import numpy as np
import trimesh

from cmig_jax import register


def chair(points: int, seed: int) -> trimesh.PointCloud:
    """Sample a seat, a back and an arm rest on one side."""
    boxes = [((2, 2, 0.2), (0, 0, 0)), ((2, 0.2, 2), (0, 1, 1)), ((0.2, 1.4, 0.5), (0.9, 0.2, 0.5))]
    parts = [trimesh.creation.box(size).apply_translation(middle) for size, middle in boxes]
    sampled = trimesh.sample.sample_surface(trimesh.util.concatenate(parts), points, seed=seed)
    return trimesh.PointCloud(sampled[0])


def with_trimesh() -> None:
    """Register two clouds of trimesh."""
    source, target = chair(1_000, seed=0), chair(1_000, seed=1)
    target.apply_transform(trimesh.transformations.rotation_matrix(2.0, (1, 2, 3), (1, 0, 0)))
    found = register(source, target)
    source.apply_transform(found.matrix)
    report("trimesh", np.asarray(source.vertices), np.asarray(target.vertices))


def with_open3d() -> None:
    """Register two clouds of Open3D."""
    try:
        import open3d  # pyright: ignore[reportMissingImports]
    except ImportError:
        print("Open3D: left out, it is not installed (pip install open3d)")
        return
    source, target = (open3d.geometry.PointCloud(open3d.utility.Vector3dVector(chair(1_000, seed).vertices)) for seed in (0, 1))
    target.rotate(target.get_rotation_matrix_from_xyz((0.5, 1.0, 2.0)), center=(0, 0, 0))
    found = register(source, target)
    source.transform(found.matrix)
    report("Open3D", np.asarray(source.points), np.asarray(target.points))


def report(library: str, source: np.ndarray, target: np.ndarray) -> None:
    """Print how far each point of the target is from the moved source."""
    distance = np.linalg.norm(source[:, None] - target[None], axis=2).min(axis=0)
    print(f"{library}: after registration, half of the target's points have a neighbour within {np.median(distance):.3f}")


def main() -> None:
    """Run the example."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    with_trimesh()
    with_open3d()


if __name__ == "__main__":
    main()
