"""Observers: pair layout, funnels and the design rule, and every realisation of the paper's PPSO and PPIO.

Everything with rho, xi, eps, a guaranteed bound, or a hat over x or g is here. A realisation owns its memory
(`Observers`): the coupled proximal step, the explicit step, and the message-passing reference.
"""

from khop_env.observers.base import (
    Assumptions,
    Certified,
    Extremes,
    Information,
    Memory,
    Observers,
    Plant,
    PlantState,
    SolveError,
)
from khop_env.observers.boxes import Box
from khop_env.observers.certificate import Certificate
from khop_env.observers.dead_reckoning import Prediction, predict
from khop_env.observers.design import (
    Bound,
    DesignError,
    DesignRule,
    Funnels,
    ObserverDesign,
    TargetObservers,
)
from khop_env.observers.estimators import Estimator, Relay
from khop_env.observers.explicit import BatchedRightHandSide, Derivative, Explicit, FunnelError, RightHandSide
from khop_env.observers.funnel_observers import FunnelObservers, LinksNow
from khop_env.observers.known_estimators import ESTIMATORS, as_estimator
from khop_env.observers.layout import FloatArray, IntArray, PairArrays, PairLayout, TargetBlock
from khop_env.observers.messages import MessagePassing
from khop_env.observers.networked import Networked
from khop_env.observers.node import Estimate, ObserverNode
from khop_env.observers.performance import Exponential, FunnelBank, PerformanceFunction, lower_bound
from khop_env.observers.proximal import Proximal
from khop_env.observers.rounds import Rounds
from khop_env.observers.wire import Known, Message

__all__ = [
    "ESTIMATORS",
    "Assumptions",
    "BatchedRightHandSide",
    "Bound",
    "Box",
    "Certificate",
    "Certified",
    "Derivative",
    "DesignError",
    "DesignRule",
    "Estimate",
    "Estimator",
    "Explicit",
    "Exponential",
    "Extremes",
    "FloatArray",
    "FunnelBank",
    "FunnelError",
    "FunnelObservers",
    "Funnels",
    "Information",
    "IntArray",
    "Known",
    "LinksNow",
    "Memory",
    "Message",
    "MessagePassing",
    "Networked",
    "ObserverDesign",
    "ObserverNode",
    "Observers",
    "PairArrays",
    "PairLayout",
    "PerformanceFunction",
    "Plant",
    "PlantState",
    "Prediction",
    "Proximal",
    "Relay",
    "RightHandSide",
    "Rounds",
    "SolveError",
    "TargetBlock",
    "TargetObservers",
    "as_estimator",
    "lower_bound",
    "predict",
]
