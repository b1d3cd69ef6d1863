"""Visual-inertial mapping: merge, optimise, loop-close and sparsify maps of many sessions."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from maplab_py.console.session.session import Session, open_map

__all__ = ["Session", "open_map"]


def __getattr__(name: str) -> Any:
    """Import the session only when somebody asks for it."""
    if name in __all__:
        from maplab_py.console.session import session

        return getattr(session, name)
    raise AttributeError(f"module 'maplab_py' has no attribute '{name}'")
