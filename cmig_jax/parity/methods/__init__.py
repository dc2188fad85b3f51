"""The recorded cases of the networks beside CMIGNet: a file for each network declares what `parity.method` compares."""

from __future__ import annotations

from cmig_jax.parity.method import Method
from cmig_jax.parity.methods.dcp import DCP_V1, DCP_V2
from cmig_jax.parity.methods.idam_gnn import IDAM_GNN
from cmig_jax.parity.methods.masknet import MASKNET
from cmig_jax.parity.methods.omnet import OMNET
from cmig_jax.parity.methods.pcrnet_iterative import PCRNET_ITERATIVE
from cmig_jax.parity.methods.pointnetlk_revisited import POINTNETLK_REVISITED
from cmig_jax.parity.methods.prnet import PRNET
from cmig_jax.parity.methods.rpmnet import RPMNET

_ALL = (DCP_V1, DCP_V2, POINTNETLK_REVISITED, IDAM_GNN, RPMNET, PCRNET_ITERATIVE, PRNET, MASKNET, OMNET)
METHODS: dict[str, Method] = {method.name: method for method in _ALL}
