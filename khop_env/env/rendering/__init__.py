"""Pictures of a running fleet, as arrays or in a window; needs pygame-ce, which is imported when one is drawn."""

from khop_env.env.rendering.renderer import Renderer
from khop_env.env.rendering.scene import Messages, Scene

__all__ = ["Messages", "Renderer", "Scene"]
