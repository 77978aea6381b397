"""THE BELIEF: what each agent believes of agents it can't hear. Everything with rho, xi, eps or a hat is here."""

from khop_env.observers.design import Bound, DesignError, Funnels, ObserverDesign, TargetObservers
from khop_env.observers.layout import FloatArray, IntArray, PairLayout
from khop_env.observers.performance import Exponential, FunnelBank, PerformanceFunction, lower_bound

__all__ = [
    "Bound",
    "DesignError",
    "Exponential",
    "FloatArray",
    "FunnelBank",
    "Funnels",
    "IntArray",
    "ObserverDesign",
    "PairLayout",
    "PerformanceFunction",
    "TargetObservers",
    "lower_bound",
]
