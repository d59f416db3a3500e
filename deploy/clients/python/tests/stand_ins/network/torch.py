"""torch as far as the example asks of it."""

from types import SimpleNamespace

cuda = SimpleNamespace(is_available=lambda: False)
