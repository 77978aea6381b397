"""Hypothesis for compiled code: no deadline (the first example may compile), and the same examples on every machine."""

from hypothesis import HealthCheck, Phase, settings

settings.register_profile(
    "reproducible",
    deadline=None,
    derandomize=True,
    max_examples=100,
    phases=(Phase.explicit, Phase.generate, Phase.target, Phase.shrink),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("reproducible")
