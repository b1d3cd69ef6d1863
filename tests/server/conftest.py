"""Fixtures of the server's tests."""

from tests.server.support import servers

__all__ = ["servers"]
