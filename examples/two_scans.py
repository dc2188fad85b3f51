"""Register two scans: from two files to the transform, the moved scan and a picture.

    python examples/two_scans.py source.ply target.ply --out result

`cmig register` does the same without a script. The exit code is 0 if the result is trusted, otherwise 1.
"""

import argparse
from pathlib import Path

import numpy as np

from cmig_jax import register
from cmig_jax.data.geometry_files import read_geometry, suffix_of, write_moved
from cmig_jax.report.plots import plot_pairs

MOST_DRAWN = 2_000


def main() -> int:
    """Run the example; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="cloud of any format of docs/data.md; of a mesh, its vertices")
    parser.add_argument("target", type=Path, help="the other one, in the same unit")
    parser.add_argument("--out", type=Path, default=Path("result"), help="folder to write to")
    arguments = parser.parse_args()

    source, target = (read_geometry(path, invalid="drop") for path in (arguments.source, arguments.target))
    found = register(source.points, target.points)
    print(found)
    if not found.trusted:
        print(f"Do not use this transform unseen: {found.why}. {len(found.alternatives)} other pose(s) are in found.alternatives.")

    arguments.out.mkdir(parents=True, exist_ok=True)
    np.savetxt(arguments.out / "target_from_source.txt", found.matrix)
    write_moved(arguments.out / f"aligned{suffix_of(arguments.source)}", source, found.matrix)  # with its colours and other attributes
    pose = found.target_from_source
    drawn = [cloud.points[:: 1 + len(cloud.points) // MOST_DRAWN] for cloud in (source, target)]
    plot_pairs([{"source": drawn[0], "target": drawn[1], "R": pose.R, "t": pose.t}], arguments.out / "pair.png")
    print(f"written to {arguments.out}")
    return 0 if found.trusted else 1


if __name__ == "__main__":
    raise SystemExit(main())
