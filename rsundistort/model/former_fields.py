"""Fields of dataclasses under their former names, which work for one version."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

__all__ = ["former_fields"]

_Class = TypeVar("_Class", bound=type)


def former_fields(**present: str) -> Callable[[_Class], _Class]:
    """Decorator of a dataclass: arguments and attributes of former names stand for the present ones, with a warning.

    Parameters
    ----------
    **present : str
        For each former name the present one.
    """

    def warn(cls: type, former: str) -> None:
        text = f"{cls.__name__}.{former} is now {cls.__name__}.{present[former]}"
        warnings.warn(text, DeprecationWarning, stacklevel=3)

    def decorate(cls: Any) -> Any:
        with_present_names = cls.__init__

        @functools.wraps(with_present_names)
        def with_former_names(self: Any, *args: Any, **given: Any) -> None:
            for former in [name for name in given if name in present]:
                warn(cls, former)
                # beside it `replace` gives the present one, as it was
                given[present[former]] = given.pop(former)
            with_present_names(self, *args, **given)

        def attribute(former: str) -> property:
            def value(self: Any) -> Any:
                warn(cls, former)
                return getattr(self, present[former])

            return property(value, doc=f"Former name of `{present[former]}`.")

        cls.__init__ = with_former_names
        for former in present:
            setattr(cls, former, attribute(former))
        return cls

    return decorate
