"""The networks by name: the one place that lists them."""

from __future__ import annotations

from cmig_jax.config import Config, ModelFlags
from cmig_jax.config_json import from_values, parse_json
from cmig_jax.models.base import Model
from cmig_jax.models.cmignet.flags import upgraded
from cmig_jax.models.cmignet.model import CMIGNET
from cmig_jax.models.dcp.network import DCP
from cmig_jax.models.finet.network import FINET
from cmig_jax.models.idam.network import IDAM
from cmig_jax.models.masknet.network import MASKNET
from cmig_jax.models.omnet.network import OMNET
from cmig_jax.models.patches.network import PATCHES
from cmig_jax.models.pcrnet.network import PCRNET
from cmig_jax.models.pointnetlk.network import POINTNETLK
from cmig_jax.models.prnet.network import PRNET
from cmig_jax.models.rpmnet.network import RPMNET

NETWORKS: dict[str, Model] = {
    model.name: model for model in (CMIGNET, PATCHES, POINTNETLK, DCP, PRNET, IDAM, RPMNET, PCRNET, MASKNET, OMNET, FINET)
}


def model_of(flags: ModelFlags) -> Model:
    """Return the network that some flags belong to.

    Raises:
        ValueError: `NETWORKS` has no such network.
    """
    if flags.network not in NETWORKS:
        raise ValueError(f"network = {flags.network!r}: expected one of {', '.join(NETWORKS)}")
    return NETWORKS[flags.network]


def config_from_json(text: str) -> Config:
    """Read what `config_json.to_json` wrote, of this or an earlier layout.

    Raises:
        ValueError: as `config_json.from_values`, or not JSON.
    """
    values = parse_json(text)
    if "network" not in values:  # from before a config named its network: there was one
        values = upgraded(values)
    return from_values(values, {name: model.flags for name, model in NETWORKS.items()})
