"""Train the network that comes with the package further, on a folder of your own clouds or meshes.

    python examples/fine_tune.py my_objects runs/mine --epochs 20
    cmig evaluate runs/mine
    cmig register source.ply target.ply --network runs/mine

`my_objects` holds a folder for each category, with files of any format of docs/data.md; pairs are drawn from each object as they were for
the network. The last 20 % of a category's files are for the test. The same command continues a training that was stopped.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp

from cmig_jax import Network, load
from cmig_jax.config import Config
from cmig_jax.training.checkpoint import Checkpoints, write_config
from cmig_jax.training.loop import train
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import state_of


def start_from(network: Network, config: Config, run: Path) -> None:
    """Write a run folder whose first checkpoint, at step 0, holds the weights of a network; `train` continues it."""
    write_config(run, config)
    checkpoints = Checkpoints(run)
    variables = jax.tree.map(jnp.asarray, network.variables)
    checkpoints.save(0, state_of(variables, optimizer(config.optim, 1)), iterator={})
    checkpoints.close()


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", type=Path, help="folder with a folder for each category")
    parser.add_argument("run", type=Path, help="folder for the trained network")
    parser.add_argument("--weights", type=Path, help="run folder or weights file to start from; by default those of the package")
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--learning-rate", type=float, default=5e-4, help="a quarter of what the network was trained with from the start")
    arguments = parser.parse_args()

    network = load(arguments.weights)
    config = replace(
        network.config,
        name=arguments.run.name,
        data=replace(network.config.data, source="meshes", root=str(arguments.objects), prepared=None),
        optim=replace(network.config.optim, epochs=arguments.epochs, batch=arguments.batch, learning_rate=arguments.learning_rate),
    )
    if not (arguments.run / "checkpoints").exists():
        start_from(network, config, arguments.run)
    train(config, arguments.run, resume=True)
    print(f"{arguments.run}: load it with cmig_jax.load({str(arguments.run)!r}), or cmig register --network {arguments.run}")


if __name__ == "__main__":
    main()
