"""Benchmarks: ratios, each measured within one run on one machine."""

from khop_env.bench.benchmark import benchmark

__all__ = ["benchmark"]
