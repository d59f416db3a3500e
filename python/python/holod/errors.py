"""What holod raises and warns of."""


class HolodError(Exception):
    """Anything that fails, with its whole text. Itself, it is a fault of holod."""


class InputError(HolodError, ValueError):
    """An argument, an array or a file is not what it should be; the text says what was found and expected."""


class RigError(InputError):
    """A rig file is wrong, or a bench is none that the weights can serve; every fault is told."""


class UnavailableError(HolodError):
    """An engine is not to be had, or its device failed."""


class HolodWarning(UserWarning):
    """What works but is most often a mistake, in the words of the daemon's log."""
