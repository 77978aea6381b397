"""Stable-Baselines3 callbacks of the user's own, called beside the training's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from khop_env.objects import called, load_object


class EndedError(Exception):
    """A callback ended the training."""


class OwnCallbacks(CallbackList):
    """The user's callbacks; if one returns False, the training ends before the next rollout, and none is called again.

    Stable-Baselines3 would leave the rollout in the middle, from where it can't be continued.

    Args:
        callbacks: in the order in which they are called.

    Raises:
        TypeError: if one isn't a Stable-Baselines3 callback.
    """

    def __init__(self, callbacks: BaseCallback | Sequence[BaseCallback]) -> None:
        found = [callbacks] if isinstance(callbacks, BaseCallback) else list(callbacks)
        for each in found:
            if not isinstance(each, BaseCallback):
                hint = f"; make an object, {each.__name__}()" if isinstance(each, type) else ""
                raise TypeError(
                    f"callbacks must be objects of subclasses of Stable-Baselines3's BaseCallback; got {each!r}{hint}"
                )
        super().__init__(found)
        self.ended = False

    def _on_step(self) -> bool:
        if not self.ended:
            self.ended = not super()._on_step()
        return True

    def _on_rollout_end(self) -> None:
        if not self.ended:
            super()._on_rollout_end()

    def _on_rollout_start(self) -> None:
        if self.ended:
            raise EndedError
        super()._on_rollout_start()


def named_callbacks(names: Iterable[str]) -> list[BaseCallback]:
    """Callbacks by their names, "my_file.py:MyCallback" or "my_module:my_callback".

    Args:
        names: of callbacks, or of classes and functions that are called without arguments to make one.

    Raises:
        ValueError: if there is none of this name, or calling it raises.
    """
    found = []
    for name, loaded in [(name, load_object(name)) for name in names]:
        made = loaded if isinstance(loaded, BaseCallback) or not callable(loaded) else called(name, loaded)
        if not isinstance(made, BaseCallback):
            raise ValueError(
                f"callback {name!r}: expected a Stable-Baselines3 callback, or a class or function that makes one; got "
                f"{type(made).__name__}"
            )
        found.append(made)
    return found
