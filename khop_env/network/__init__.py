"""Communication networks: whether a message arrives, and when.

A `Network` says how often agents send and what becomes of messages; a `Channel` plays it on the directed links of many
environments at once.
"""

from khop_env.network.channel import Channel, ChannelMemory
from khop_env.network.link import PlainLink, plain_noise
from khop_env.network.network import PROFILES, Network
from khop_env.network.reading import Range

__all__ = ["PROFILES", "Channel", "ChannelMemory", "Network", "PlainLink", "Range", "plain_noise"]
