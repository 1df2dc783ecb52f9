"""Arguments by a wrong name are answered by the right one."""

import difflib
import functools
import inspect
from collections.abc import Callable


def names_checked(function: Callable) -> Callable:
    """`function`, whose TypeError for an argument that it does not have names the nearest that it
    has, or all.

    >>> @names_checked
    ... def light(depth, wavelength): ...
    >>> light(3.0, wavelengths=[490.0])
    Traceback (most recent call last):
    TypeError: light has no argument 'wavelengths'; did you mean 'wavelength'?
    """
    known = [name for name in inspect.signature(function).parameters if name != "self"]
    owner = function.__qualname__.removesuffix(".__init__").split(".")[-1]

    @functools.wraps(function)
    def call(*args, **kwargs):
        for name in kwargs:
            if name not in known:
                by_letters = {one.lower(): one for one in known}
                near = difflib.get_close_matches(name.lower(), by_letters, n=1)
                hint = (
                    f"did you mean {by_letters[near[0]]!r}?"
                    if near
                    else (f"it has {', '.join(known)}.")
                )
                raise TypeError(f"{owner} has no argument {name!r}; {hint}")
        return function(*args, **kwargs)

    return call
