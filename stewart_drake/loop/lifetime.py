"""Letting go of Drake systems that are written in Python.

Drake keeps such a system for ever, and with it the diagram that it is in (Drake's issues 22515,
23930 and 24162): in C++, where Python's garbage collector does not look, a system holds its
callbacks, which as bound methods hold the system; and a diagram holds its systems, whose attributes
hold the diagram. A thousand runs would leave up to a gigabyte behind. `weak` makes callbacks that
hold nothing, `let_go` opens the other circle where a diagram is no longer needed.
"""

import weakref
from collections.abc import Callable, Sequence
from typing import Any, Final

_NOTES: Final = "_pydrake_internal_ref_cycle_peers"


def weak(method: Callable[..., Any], *first: Any) -> Callable[..., Any]:
    """A function that calls a bound method with `first` before its own arguments.

    It does not keep the method's object alive, which must still be there when it is called.
    """
    reference = weakref.WeakMethod(method)

    def call(*arguments: Any) -> Any:
        target = reference()
        assert target is not None, "called for a system that is gone"
        return target(*first, *arguments)

    return call


def let_go(diagram: Any, kept: Sequence[Any] = (), made: Sequence[Any] = ()) -> None:
    """Take all attributes from a diagram and its subsystems; nobody may use them afterwards.

    Among them is what Drake notes there about builders and ports. In C++ nothing changes.

    Args:
        diagram: that is no longer needed.
        kept: systems in it that somebody else goes on using: they lose nothing, and keep the
            diagram.
        made: systems of somebody else's that lose Drake's notes only.
    """
    if any(diagram is system for system in kept):
        return
    if any(diagram is system for system in made):
        vars(diagram).pop(_NOTES, None)
        return
    for system in diagram.GetSystems() if hasattr(diagram, "GetSystems") else ():
        let_go(system, kept, made)
    vars(diagram).clear()
