"""Benchmarks, ratios that are measured within one run on one machine (`khop bench`); and the published study."""
