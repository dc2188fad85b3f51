"""Register a folder of scans of one thing or place, and merge them into one cloud.

    python examples/folder_to_model.py scans --out model.ply

Scans are taken in the order of their names; neighbours need not overlap, as long as each scan overlaps with some other one. The model is
in the frame of the first. `cmig register --sequence` does the same, and keeps colours and normals. The exit code is 0 if every scan found
its place, otherwise 1.
"""

import argparse
from pathlib import Path

import trimesh

from cmig_jax import register_sequence
from cmig_jax.data.geometry_files import geometry_files, read_geometry


def main() -> int:
    """Run the example; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", type=Path, help="folder of clouds of any format of docs/data.md, in one unit")
    parser.add_argument("--out", type=Path, default=Path("model.ply"), help="file for the merged cloud (PLY)")
    parser.add_argument("--cell", type=float, help="distance between points of the merged cloud; by default that of the scans")
    arguments = parser.parse_args()

    paths = geometry_files(arguments.scans)
    clouds = [read_geometry(path, invalid="drop").points for path in paths]
    found = register_sequence(clouds, names=[path.name for path in paths], progress=True)
    print(found)
    model = found.merged(clouds, arguments.cell)
    trimesh.PointCloud(model).export(arguments.out)
    print(f"{arguments.out}: {len(model)} points")
    return 0 if found.trusted else 1


if __name__ == "__main__":
    raise SystemExit(main())
