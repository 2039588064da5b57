"""The architectures that a policy's network can have, one for each class of sizes that a card can hold."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from marl_sched.agents.networks.decima import DecimaNetwork
from marl_sched.agents.networks.deeprm import DeepRMNetwork
from marl_sched.agents.networks.hetgat.network import HetGATNetwork
from marl_sched.agents.networks.network import PolicyNetwork
from marl_sched.agents.policies.cards import DecimaSizes, DeepRMSizes, HetGATSizes, Sizes
from marl_sched.graph import GraphSpec

_NETWORKS: Mapping[type[Sizes], type[PolicyNetwork]] = {
    HetGATSizes: HetGATNetwork,
    DecimaSizes: DecimaNetwork,
    DeepRMSizes: DeepRMNetwork,
}


def new_network(graph: GraphSpec, sizes: Sizes) -> PolicyNetwork:
    """An untrained network for a metagraph; torch's generator draws its weights."""
    return _NETWORKS[type(sizes)](graph, **msgspec.structs.asdict(sizes))
