"""Communication networks: which links are up, whether a message arrives, and when.

A `Network` says how often agents send and what becomes of messages; a `Channel` plays it on the directed links of many
environments at once. A `Schedule` says which of these links are up.
"""

from khop_env.network.activity import Activity
from khop_env.network.channel import Channel, ChannelMemory
from khop_env.network.link import PlainLink, plain_noise
from khop_env.network.network import NO_NETWORK, PROFILES, Network
from khop_env.network.reading import Span
from khop_env.network.schedules import SCHEDULES, Both, Fixed, Outage, RandomLinks, Range, Schedule, Switching

__all__ = [
    "NO_NETWORK",
    "PROFILES",
    "SCHEDULES",
    "Activity",
    "Both",
    "Channel",
    "ChannelMemory",
    "Fixed",
    "Network",
    "Outage",
    "PlainLink",
    "RandomLinks",
    "Range",
    "Schedule",
    "Span",
    "Switching",
    "plain_noise",
]
