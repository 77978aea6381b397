"""The contract of the environments as checks for any environment: `check_environment(env)`, or `khop test`."""

from khop_env.testing.checking import CHECKS, check_environment
from khop_env.testing.equality import arrays, difference
from khop_env.testing.report import Check, Report

__all__ = ["CHECKS", "Check", "Report", "arrays", "check_environment", "difference"]
