"""Decentralised k-hop prescribed performance observers, and multi-agent environments under partial communication."""

__version__ = "0.1.0"
