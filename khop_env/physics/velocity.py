"""From a commanded velocity to each agent model's own inputs.

Consensus laws and leaders' routes command the velocity of an agent's position; the inputs that realise it depend on the
model. For a model of your own add an entry: `VELOCITY_CONTROLLERS["my_type"] = my_function`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from khop_env.physics.agent_model import AgentModel, FloatArray
from khop_env.physics.models import DoubleIntegrator, SurfaceVessel, vessel_form
from khop_env.physics.right_hand_sides import UNICYCLE, VELOCITY_RATE, Form, evaluated, velocity_inputs

VelocityController = Callable[..., FloatArray]


def _direct(model: AgentModel, x: FloatArray, velocity: FloatArray) -> FloatArray:
    """The input is the velocity."""
    return velocity


def _double_integrator(model: DoubleIntegrator, x: FloatArray, velocity: FloatArray) -> FloatArray:
    """Cancel the damping and let the velocity error decay."""
    speed = x[..., 2:]
    return model.damping * speed + VELOCITY_RATE * (velocity - speed)


def _unicycle(model: AgentModel, x: FloatArray, velocity: FloatArray) -> FloatArray:
    """Feedback linearisation about the point OFFSET ahead (d'Andrea-Novel, Campion and Bastin, 1995)."""
    return evaluated(velocity_inputs, Form(UNICYCLE), 2, x[..., :3], velocity)


def _vessel(model: SurfaceVessel, x: FloatArray, velocity: FloatArray) -> FloatArray:
    """Body velocities follow the rotated command and the yaw rate is damped; drag helps, so it isn't cancelled."""
    return evaluated(velocity_inputs, vessel_form(model), 3, x[..., :6], velocity)


VELOCITY_CONTROLLERS: dict[str, VelocityController] = {
    "integrator": _direct,
    "drifter": _direct,
    "cart": _double_integrator,
    "unicycle": _unicycle,
    "vessel": _vessel,
}
"""For each type of agents a function (model, x, velocity) -> inputs that makes their position follow a velocity.

Laws and scripted policies command velocities; a model of your own needs an entry under its `type`.
"""


def velocity_to_input(model: AgentModel, x: FloatArray, velocity: FloatArray) -> FloatArray:
    """Inputs (..., m) that make the position of agents of `model` follow `velocity` (..., d), within the limits.

    Args:
        model: the agents' common model.
        x: (..., n) their states.
        velocity: (..., d) commanded velocities in m/s.

    Raises:
        ValueError: for a model without an entry in `VELOCITY_CONTROLLERS`.
    """
    controller = VELOCITY_CONTROLLERS.get(model.type)
    if controller is None:
        raise ValueError(
            f"no velocity controller for agents of type {model.type!r}; known: "
            f"{', '.join(VELOCITY_CONTROLLERS)}. Add VELOCITY_CONTROLLERS[{model.type!r}] = function(model, x, v)"
        )
    u = controller(model, x, velocity)
    return np.minimum(np.maximum(u, -model.input_limit), model.input_limit)
