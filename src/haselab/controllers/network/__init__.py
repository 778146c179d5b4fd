"""A small integer network as a controller."""

from haselab.controllers.network.controller import NETWORK, NetworkController, network_kind
from haselab.controllers.network.weights import FEATURES, HIDDEN, Network

__all__ = ["FEATURES", "HIDDEN", "NETWORK", "Network", "NetworkController", "network_kind"]
