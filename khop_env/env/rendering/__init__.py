"""Pictures of a running fleet, as arrays or in a window; needs pygame-ce, which is imported when one is made."""

from khop_env.env.rendering.renderer import Renderer

__all__ = ["Renderer"]
